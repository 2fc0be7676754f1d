"""Refuses steps of the environments that are not finite, for the algorithms that learn from rollouts."""

from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_chac.common.checked_env import CheckedLearning, CheckedVecEnv
from sb3_chac.common.utils import detach_distributions


class CheckedRollouts(CheckedLearning, OnPolicyAlgorithm):
    """Base of on-policy algorithms that refuse what is not finite before it is stored, as ``CheckedOffPolicyAlgorithm``."""

    def train(self) -> None:
        super().train()
        detach_distributions(self.policy)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        return super().collect_rollouts(CheckedVecEnv(env, self), callback, rollout_buffer, n_rollout_steps)
