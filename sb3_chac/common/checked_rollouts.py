"""Refuses steps of the environments that are not finite, for the algorithms that learn from rollouts."""

import numpy as np
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_chac.common.checks import check_reset, check_step
from sb3_chac.common.own_arrays import keep_last_observations
from sb3_chac.common.utils import detach_distributions


class CheckedVecEnv(VecEnvWrapper):
    """
    Raises one error for the first observation, reward or cost that is NaN or infinite; gives copies of the actions away.

    :param venv: the environments
    :param model: that learns in them
    """

    def __init__(self, venv: VecEnv, model: OnPolicyAlgorithm):
        super().__init__(venv)
        self.model = model

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        self.venv.step_async(actions.copy())  # what is stored are the actions: the environments may change theirs

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = self.venv.step_wait()
        check_step(observations, rewards, infos, self.model.num_timesteps)  # type: ignore[arg-type]
        normalize = self.model.get_vec_normalize_env()
        if normalize is not None:  # normalizing clips what is infinite
            check_step(normalize.get_original_obs(), normalize.get_original_reward(), [], self.model.num_timesteps)
        return observations, rewards, dones, infos


class CheckedRollouts(OnPolicyAlgorithm):
    """Base of on-policy algorithms that refuse what is not finite before it is stored, as ``CheckedOffPolicyAlgorithm``."""

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        assert self.env is not None
        keep_last_observations(self.env)
        prepared = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        check_reset(self._last_obs, self._vec_normalize_env, self.num_timesteps)  # type: ignore[arg-type]
        return prepared

    def train(self) -> None:
        super().train()
        detach_distributions(self.policy)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        return super().collect_rollouts(CheckedVecEnv(env, self), callback, rollout_buffer, n_rollout_steps)
