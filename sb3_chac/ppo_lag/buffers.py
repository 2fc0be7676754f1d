"""SB3's rollout buffers, with costs, their values and their advantages."""

import copy
from collections.abc import Generator
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

COST_ARRAYS = ("costs", "cost_values", "cost_advantages", "cost_returns")


class CostRolloutBufferSamples(NamedTuple):
    """A batch. All but the observations and actions have the shape (batch_size,)."""

    observations: th.Tensor | TensorDict
    actions: th.Tensor
    old_values: th.Tensor
    old_log_prob: th.Tensor
    advantages: th.Tensor
    returns: th.Tensor
    cost_advantages: th.Tensor
    cost_returns: th.Tensor


class CostRolloutBuffer(RolloutBuffer):
    """
    SB3's ``RolloutBuffer``, whose parameters it has, with the cost of each step, the value of the costs to come, and what GAE
    makes of them. The arrays have the shape (n_steps, n_envs) until ``get`` flattens them.
    """

    costs: np.ndarray
    cost_values: np.ndarray
    cost_advantages: np.ndarray
    cost_returns: np.ndarray

    def reset(self) -> None:
        for name in COST_ARRAYS:
            setattr(self, name, np.zeros((self.buffer_size, self.n_envs), dtype=np.float32))
        super().reset()

    def add_costs(self, costs: np.ndarray, cost_values: th.Tensor) -> None:
        """
        Add the costs of a step; to be called before ``add``.

        :param costs: shape (n_envs,)
        :param cost_values: estimated value of the current state, shape (n_envs, 1)
        """
        self.costs[self.pos] = costs
        self.cost_values[self.pos] = cost_values.cpu().numpy().flatten()

    def compute_cost_returns_and_advantage(
        self, last_cost_values: th.Tensor, dones: np.ndarray, cost_gamma: float, cost_gae_lambda: float
    ) -> None:
        """
        Compute returns and advantages of the costs: SB3's method is applied to a copy in which costs stand in place of
        rewards.

        :param last_cost_values: value of the state after the last step, shape (n_envs, 1)
        :param dones: whether an episode ended with it, shape (n_envs,)
        :param cost_gamma: discount factor
        :param cost_gae_lambda: trade-off of bias and variance
        """
        of_costs = copy.copy(self)
        of_costs.rewards, of_costs.values, of_costs.advantages = self.costs, self.cost_values, self.cost_advantages
        of_costs.gamma, of_costs.gae_lambda = cost_gamma, cost_gae_lambda
        of_costs.compute_returns_and_advantage(last_cost_values, dones)
        self.cost_returns = of_costs.returns

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        if not self.generator_ready:
            for name in COST_ARRAYS:
                setattr(self, name, self.swap_and_flatten(getattr(self, name)))
        yield from super().get(batch_size)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> Any:
        costs = (self.to_torch(array[batch_inds].flatten()) for array in (self.cost_advantages, self.cost_returns))
        return CostRolloutBufferSamples(*super()._get_samples(batch_inds, env), *costs)


class CostDictRolloutBuffer(CostRolloutBuffer, DictRolloutBuffer):
    """``CostRolloutBuffer`` for Dict observations."""
