"""Refuses numbers of the environments that are not finite, before anything is made of them."""

from typing import TypeVar

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_chac.common.arguments import checked
from sb3_chac.common.checks import check_finite, check_step
from sb3_chac.common.own_arrays import keep_last_observations

SelfCheckedLearning = TypeVar("SelfCheckedLearning", bound="CheckedLearning")


class CheckedVecEnv(VecEnvWrapper):
    """
    Raises one error for the first observation, reward or cost that is NaN or infinite; gives copies of the actions away.

    :param venv: the environments
    :param model: that learns in them, its steps are named in the error
    """

    def __init__(self, venv: VecEnv, model: BaseAlgorithm):
        super().__init__(venv)
        self.model = model

    def reset(self) -> VecEnvObs:
        observations = self.venv.reset()
        check_finite("observation", observations, self.model.num_timesteps)  # type: ignore[arg-type]
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self.venv.step_async(actions.copy())  # what is stored are the actions: the environments may change theirs

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = self.venv.step_wait()
        check_step(observations, rewards, infos, self.model.num_timesteps)  # type: ignore[arg-type]
        return observations, rewards, dones, infos


def check_env_is_there(model: BaseAlgorithm) -> None:
    """
    Check that a model can go on learning, one that was loaded.

    :raises ValueError: if it has no environments
    """
    if model.env is None:
        raise ValueError(f"env: pass it to {type(model).__name__}.load(..., env=...), or to set_env(), before learning.")


def check_what_is_normalized(env: VecEnv, model: BaseAlgorithm) -> None:
    """
    ``VecNormalize`` clips what is infinite and takes what is NaN into its statistics for good. From now on what it is given
    is checked before.

    :param env: the environments, nothing is done if they are not normalized
    :param model: that learns in them
    """
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecNormalize):
            below = env.venv.venv if isinstance(env.venv, CheckedVecEnv) else env.venv
            env.venv = CheckedVecEnv(below, model)
        env = env.venv


def check_critics_were_kept(model: BaseAlgorithm) -> None:
    """
    Check that a model can go on learning, one that was published.

    :raises ValueError: if its critics are zeros, as in the agents of benchmarks/agents, which are published without them
    """
    critic = getattr(model.policy, "critic", None)
    if critic is not None and not any(parameter.any() for parameter in critic.parameters()):
        raise ValueError(
            f"policy: the critics of this {type(model).__name__} are all zeros: it was published to act, without what only "
            "learns, and cannot go on learning. Evaluate it, or train a new one."
        )


class CheckedLearning(BaseAlgorithm):
    """Base of algorithms that refuse, when learning begins, what they cannot learn from."""

    @checked
    def learn(
        self: SelfCheckedLearning,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCheckedLearning:
        check_env_is_there(self)
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)  # type: ignore[arg-type, safe-super]

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        assert self.env is not None
        check_critics_were_kept(self)
        keep_last_observations(self.env)
        check_what_is_normalized(self.env, self)
        prepared = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        check_finite("observation", self._last_obs, self.num_timesteps)  # type: ignore[arg-type]
        return prepared
