"""Refuses steps of the environments that are not finite, for the algorithms that learn from rollouts."""

import copy
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_chac.common.checked_env import CheckedLearning, CheckedVecEnv
from sb3_chac.common.own_steps import NoticesOthers
from sb3_chac.common.saved_by import NamedAlgorithm
from sb3_chac.common.utils import detach_distributions


class CheckedRollouts(CheckedLearning, NamedAlgorithm, NoticesOthers, OnPolicyAlgorithm):
    """Base of on-policy algorithms that refuse what is not finite before it is stored, as ``CheckedOffPolicyAlgorithm``."""

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        if self.others_moved:
            assert dones is not None
            self._cut_off_episodes(infos, dones)

    def _cut_off_episodes(self, infos: list[dict[str, Any]], dones: np.ndarray) -> None:
        """
        Let the step that was just made be the last one of its episode, cut off, as the environments have been moved since.

        :param infos: of the step
        :param dones: whether its episode ends with it, shape (n_envs,)
        """
        assert self._own_steps is not None
        new_obs = self._own_steps.locals["new_obs"]  # that of SB3's loop, which goes on with it
        for idx in np.flatnonzero(~dones):
            last = {key: values[idx] for key, values in new_obs.items()} if isinstance(new_obs, dict) else new_obs[idx]
            infos[idx].update({"terminal_observation": copy.deepcopy(last), "TimeLimit.truncated": True})
        dones[:] = True
        first = self._begin_episodes()
        for key in new_obs if isinstance(new_obs, dict) else [...]:
            new_obs[key] = first[key]

    def train(self) -> None:
        super().train()
        detach_distributions(self.policy)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        return super().collect_rollouts(CheckedVecEnv(env, self), callback, rollout_buffer, n_rollout_steps)
