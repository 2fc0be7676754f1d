"""Checks for off-policy algorithms."""

import io
import pathlib
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, TensorDict
from stable_baselines3.common.vec_env import VecEnv

from sb3_chac.common.arguments import check_policy_kwargs
from sb3_chac.common.checked_env import CheckedLearning
from sb3_chac.common.checks import (
    MismatchedParameters,
    check_action_space,
    check_finite,
    check_integer,
    check_learning_rate,
    check_policy,
    check_range,
    check_step,
)
from sb3_chac.common.own_steps import NoticesOthers
from sb3_chac.common.saved_by import NamedAlgorithm


class CheckedOffPolicyAlgorithm(CheckedLearning, NamedAlgorithm, NoticesOthers, OffPolicyAlgorithm):
    """
    SB3's OffPolicyAlgorithm for continuous actions, which refuses bad arguments, checkpoints of other algorithms and
    observations or rewards that are not finite, each with one message, before anything is changed or stored.
    """

    # What ``policy`` must derive from
    required_policy: type[BasePolicy]
    # What ``replay_buffer_class`` must derive from
    required_buffer: ClassVar[type[ReplayBuffer]] = ReplayBuffer
    # That it has, see ``check_policy_kwargs``
    networks: ClassVar[tuple[str, ...]] = ("pi", "qf")

    def _setup_model(self) -> None:
        self._check_arguments()
        super()._setup_model()

    def _check_arguments(self) -> None:
        """
        Called on creation and on loading, before anything is built.

        :raises ValueError: names the argument and the remedy
        """
        check_policy(type(self), self.policy_class, self.required_policy)
        check_policy_kwargs("policy_kwargs", self.policy_class, self.policy_kwargs, self.networks)
        check_learning_rate("learning_rate", self.learning_rate)
        check_integer("buffer_size", self.buffer_size, low=1)
        check_integer("batch_size", self.batch_size, low=1)
        check_integer("learning_starts", self.learning_starts, low=0)
        check_integer("gradient_steps", self.gradient_steps, low=-1)
        check_integer("n_steps", self.n_steps, low=1)
        check_range("tau", self.tau, low=0.0, high=1.0)
        check_range("gamma", self.gamma, low=0.0, high=1.0)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        check_action_space(env.action_space)
        return BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)

    def _forget_episodes(self) -> None:
        super()._forget_episodes()
        self._end_trajectories()

    def _end_trajectories(self) -> None:
        """Let no return of several steps run on from the last row of the replay buffer."""
        buffer = self.replay_buffer
        if buffer is not None and buffer.size() and getattr(buffer, "handle_timeout_termination", False):
            last = buffer.pos - 1
            buffer.timeouts[last] = np.maximum(buffer.timeouts[last], 1 - buffer.dones[last])

    def _begin_step(self) -> None:
        """Called before each step of the environments. New episodes begin if somebody else has moved them."""
        if self.others_moved:
            self._last_obs = self._begin_episodes()
            if self._vec_normalize_env is not None:
                self._last_original_obs = self._vec_normalize_env.get_original_obs()
            if self.action_noise is not None:
                self.action_noise.reset()

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        self._begin_step()
        return super()._sample_action(learning_starts, action_noise, n_envs)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        check_finite("action", buffer_action, self.num_timesteps)
        check_step(new_obs, reward, infos, self.num_timesteps)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Load as SB3 does.

        :raises ValueError: if it is no buffer of the kind that this algorithm needs; then nothing is changed
        """
        before = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        if not isinstance(self.replay_buffer, self.required_buffer):
            other, self.replay_buffer = self.replay_buffer, before
            name = self.required_buffer.__name__
            raise ValueError(f"load_replay_buffer: {path} holds no {name}, got {type(other).__name__}.")

    def set_parameters(
        self,
        load_path_or_dict: str | pathlib.Path | io.BufferedIOBase | TensorDict,
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """
        Set parameters as SB3 does, but parameters of another algorithm or network are refused before any is copied.

        :raises MismatchedParameters: names what differs
        """
        params: Any = load_path_or_dict
        if not isinstance(params, dict):
            _, params, _ = load_from_zip_file(load_path_or_dict, device=device, load_data=False)  # type: ignore[arg-type]
        if exact_match:
            own = self.get_parameters()
            differing = sorted(params.keys() ^ own.keys())
            if not differing:
                shapes, own_shapes = (
                    {name: tensor.shape for name, tensor in group["policy"].items()} for group in (params, own)
                )
                differing = sorted({name for name, _ in shapes.items() ^ own_shapes.items()})
            if differing:
                raise MismatchedParameters(
                    f"set_parameters: not the parameters of this {type(self).__name__}: {', '.join(differing[:6])}"
                    f"{', ...' if len(differing) > 6 else ''} differ. Load them into the class, policy_kwargs and ent_coef "
                    "that saved them. Nothing was changed."
                )
        super().set_parameters(params, exact_match, device)
