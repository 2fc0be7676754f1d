"""What the algorithms that learn from takeovers share: asking the human, storing who drove, counting."""

import io
import os
import pathlib
import warnings
from collections import deque
from typing import Any, TypeVar

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import safe_mean

from sb3_chac.common.buffers import DualReplayBuffer
from sb3_chac.common.off_policy_algorithm import CheckedOffPolicyAlgorithm
from sb3_chac.human.demonstrations import Demonstrations, load_demonstrations

SelfGuided = TypeVar("SelfGuided", bound="GuidedOffPolicyAlgorithm")

# Counted from the start of the training, saved with the model and shown in the logger
COUNTS = (
    "total_steps",
    "human_steps",
    "takeovers",
    "takeover_cost",
    "safety_cost",
    "safety_cost_human",
    "collisions",
    "departures",
)


class GuidedOffPolicyAlgorithm(CheckedOffPolicyAlgorithm):
    """
    Base of the algorithms in whose training environments a human takes over.

    While it learns, the ``InterventionWrapper`` of each training environment is armed; it is disarmed whenever ``learn`` ends,
    so that the human never drives an evaluation. What the human drove is stored apart (``DualReplayBuffer``), with the action
    that was executed and the one that the novice proposed. Environments that do the takeovers themselves may report them in
    ``info["intervene_action"]`` (HIL-SERL's key).
    """

    replay_buffer: DualReplayBuffer

    def _setup_model(self) -> None:
        if self.replay_buffer_class is None:
            self.replay_buffer_class = DualReplayBuffer
        if not issubclass(self.replay_buffer_class, DualReplayBuffer):
            raise ValueError(
                f"replay_buffer_class must derive from DualReplayBuffer, got {self.replay_buffer_class.__name__}: "
                f"{type(self).__name__} keeps what the human drove apart. Leave it out to get the default."
            )
        if self.n_steps > 1:
            self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "n_steps": self.n_steps, "gamma": self.gamma}
        if not hasattr(self, "counts"):  # else it was loaded
            self.counts = dict.fromkeys(COUNTS, 0.0)
            self.wrapper_states: list[dict[str, int]] = []
        self._forget_episodes()
        self.ep_cost_buffer: deque[float] = deque(maxlen=self._stats_window_size)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="`n_steps=")  # the dual buffer gets it, just above
            super()._setup_model()

    def store_demonstrations(self, dataset: str | os.PathLike[str] | Demonstrations) -> None:
        """
        Puts a dataset into the replay buffer, as if it had been driven: what the human drove (all of it, if the dataset does
        not say who drove) beside what the novice proposed, and the rest. It is not counted as steps of this training.

        :param dataset: id or folder of a dataset of Minari, or Demonstrations
        :raises DatasetError: if it is missing, damaged or does not fit
        """
        data = load_demonstrations(dataset, self.observation_space, self.action_space)

        def scaled(actions: np.ndarray) -> np.ndarray:
            return self.policy.scale_action(actions).reshape(len(data), -1)

        actions = scaled(data.actions)
        novice_actions = actions if data.novice_actions is None else scaled(data.novice_actions)
        takeovers = np.ones(len(data), dtype=bool) if data.takeovers is None else data.takeovers
        begins_episode = np.diff(data.episodes, prepend=-1) != 0
        starts = takeovers & (begins_episode | ~np.roll(takeovers, 1))
        dones = data.terminations | data.truncations
        columns = (data.observations, data.next_observations, actions, data.rewards, dones)
        for i in range(len(data)):
            info = {
                "takeover": bool(takeovers[i]),
                "takeover_start": bool(starts[i]),
                "novice_action": novice_actions[i],
                "TimeLimit.truncated": bool(data.truncations[i]),
            }
            obs, next_obs, action, reward, done = (column[i : i + 1] for column in columns)
            self.replay_buffer.add(obs, next_obs, action, reward, done, [info])
        self.replay_buffer.end_trajectories()

    def _forget_episodes(self) -> None:
        self.episode_costs = np.zeros(self.n_envs)
        self.human_driving = np.zeros(self.n_envs, dtype=bool)

    def _needs_human(self) -> bool:
        """Whether the human is asked in this stage of the training."""
        return True

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        self.replay_buffer.end_trajectories()
        if reset_num_timesteps or self._last_obs is None:  # the environments are about to be reset
            self._forget_episodes()
        prepared = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        self._prepare_wrappers()
        if self._needs_human():
            self._arm()
        return prepared

    def learn(
        self: SelfGuided,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfGuided:
        try:
            super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        except BaseException:
            try:
                self._disarm()
            except Exception:  # the environments may be what failed: that error is the one to be seen
                warnings.warn("The human could not be taken out of the training environments: do not evaluate in them.")
            raise
        self._disarm()
        return self

    def _prepare_wrappers(self) -> None:
        """Wrappers that are new go on with the counts of those before them."""
        assert self.env is not None
        if not self.wrapper_states or not self.env.has_attr("load_state_dict"):
            return
        if len(self.wrapper_states) != self.n_envs:  # another number of environments than before: deal out the sums
            sums = {name: sum(state[name] for state in self.wrapper_states) for name in self.wrapper_states[0]}
            self.wrapper_states = [
                {name: (total + idx) // self.n_envs for name, total in sums.items()} for idx in range(self.n_envs)
            ]
        for idx, state in enumerate(self.wrapper_states):
            self.env.env_method("load_state_dict", state, indices=idx)

    def _arm(self) -> None:
        """Ask the human from now on."""
        assert self.env is not None
        if not self.env.has_attr("arm"):
            warnings.warn(
                f"{type(self).__name__}: no human is in the loop. Wrap the training environments in "
                "sb3_chac.InterventionWrapper (RL-Zoo3: env_wrapper), or report takeovers in info['intervene_action']."
            )
            return
        self.env.env_method("arm")

    def _disarm(self) -> None:
        if self.env is not None and self.env.has_attr("disarm"):
            self.env.env_method("disarm")

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        As in SB3.

        :raises ValueError: if it is not a ``DualReplayBuffer``; then nothing is changed
        """
        before = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        if not isinstance(self.replay_buffer, DualReplayBuffer):
            other, self.replay_buffer = self.replay_buffer, before
            raise ValueError(f"load_replay_buffer: {path} holds no DualReplayBuffer, got {type(other).__name__}.")

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        # A model that has learned before does not start with random actions again
        return super()._sample_action(0 if self._n_updates else learning_starts, action_noise, n_envs)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        executed = np.array(buffer_action, dtype=np.float32)
        marked = []
        for idx, info in enumerate(infos):
            takeover = bool(info.get("takeover", "intervene_action" in info))
            if takeover:
                applied = info.get("applied_action", info.get("intervene_action"))
                if applied is None:
                    raise ValueError(
                        f"info['takeover'] of environment {idx} is set, but what was executed is missing: add it as "
                        "info['applied_action'], in the units of the action space."
                    )
                executed[idx] = self.policy.scale_action(np.asarray(applied))
            start = bool(info.get("takeover_start", takeover and not self.human_driving[idx]))
            marked.append({**info, "takeover": takeover, "takeover_start": start, "novice_action": buffer_action[idx]})
            self.human_driving[idx] = takeover and not dones[idx]
        super()._store_transition(replay_buffer, executed, new_obs, reward, dones, marked)
        self._count(marked, dones)

    def _count(self, infos: list[dict[str, Any]], dones: np.ndarray) -> None:
        counts = self.counts
        for idx, (info, done) in enumerate(zip(infos, dones, strict=True)):
            cost, takeover = float(info.get("cost", 0.0)), info["takeover"]
            counts["total_steps"] += 1
            counts["human_steps"] += takeover
            counts["takeovers"] += info["takeover_start"]
            counts["takeover_cost"] += info.get("takeover_cost", 0.0)
            counts["safety_cost"] += cost
            counts["safety_cost_human"] += cost * takeover
            counts["collisions"] += bool(info.get("collision", False))
            counts["departures"] += bool(info.get("out_of_road", False))
            self.episode_costs[idx] += cost
            if done:
                self.ep_cost_buffer.append(self.episode_costs[idx])
                self.episode_costs[idx] = 0.0
        if "human_steps" in infos[0] and "total_steps" in infos[0]:
            self.wrapper_states = [{name: info[name] for name in ("human_steps", "total_steps")} for info in infos]

    def dump_logs(self) -> None:
        counts = self.counts
        for name in ("human_steps", "total_steps", "takeovers", "takeover_cost"):
            self.logger.record(f"takeover/{name}", counts[name])
        self.logger.record("takeover/rate", counts["human_steps"] / max(counts["total_steps"], 1))
        for name in ("safety_cost", "safety_cost_human", "collisions", "departures"):
            self.logger.record(f"safety/{name}", counts[name])
        if self.ep_cost_buffer:
            self.logger.record("rollout/ep_cost_mean", safe_mean(self.ep_cost_buffer))
        super().dump_logs()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "episode_costs", "human_driving", "ep_cost_buffer"]
