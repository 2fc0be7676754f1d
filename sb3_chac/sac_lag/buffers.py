"""SB3's replay buffers, with the cost of each transition."""

import copy
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

from sb3_chac.common.costs import step_costs


class CostReplayBufferSamples(NamedTuple):
    """A batch. All but the observations have the shape (batch_size, 1) or (batch_size, action_dim)."""

    observations: th.Tensor | TensorDict
    actions: th.Tensor
    next_observations: th.Tensor | TensorDict
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None  # None if they are gamma for all
    costs: th.Tensor  # never normalised
    cost_discounts: th.Tensor | None  # None if they are cost_gamma for all


class CostReplayBuffer(ReplayBuffer):
    """
    SB3's ``ReplayBuffer``, whose parameters it has, with ``info["cost"]`` of each transition.

    Whatever SB3 makes of rewards (the choice of environments, n-step returns) it makes of costs: rows are drawn a second time,
    with the same random numbers, from a copy of the buffer in which costs stand where rewards do.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.costs = np.zeros((self.buffer_size, self.n_envs), dtype=np.float32)

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Add a transition as SB3 does.

        :raises ValueError: if a cost is missing; then nothing is stored
        """
        self.costs[self.pos] = step_costs(infos)
        super().add(obs, next_obs, action, reward, done, infos)

    def _of_costs(self) -> Any:
        """
        View the buffer as one of costs.

        :return: a copy that shares all arrays, with costs in place of rewards
        """
        of_costs = copy.copy(self)
        of_costs.rewards = self.costs
        return of_costs

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> Any:
        random_state = np.random.get_state()
        samples = super()._get_samples(batch_inds, env)
        np.random.set_state(random_state)
        costs = super(CostReplayBuffer, self._of_costs())._get_samples(batch_inds)
        return CostReplayBufferSamples(*samples, costs.rewards, costs.discounts)


class CostDictReplayBuffer(CostReplayBuffer, DictReplayBuffer):
    """``CostReplayBuffer`` for Dict observations."""


class CostNStepReplayBuffer(CostReplayBuffer, NStepReplayBuffer):
    """
    ``CostReplayBuffer`` of n-step returns.

    The parameters are those of SB3's ``NStepReplayBuffer``, and ``cost_gamma``.

    :param cost_gamma: discount factor of costs
    """

    def __init__(self, *args: Any, cost_gamma: float = 0.99, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.cost_gamma = cost_gamma

    def _of_costs(self) -> Any:
        of_costs = super()._of_costs()
        of_costs.gamma = self.cost_gamma
        return of_costs


def default_buffer_class(observation_space: spaces.Space, n_steps: int) -> type[CostReplayBuffer]:
    """
    Choose the replay buffer.

    :param n_steps: number of rewards in a return
    :return: the buffer for these observations
    :raises ValueError: for Dict observations and ``n_steps`` above 1
    """
    if not isinstance(observation_space, spaces.Dict):
        return CostReplayBuffer if n_steps == 1 else CostNStepReplayBuffer
    if n_steps > 1:
        raise ValueError(f"n_steps must be 1 for Dict observations (as in SB3), got {n_steps}.")
    return CostDictReplayBuffer
