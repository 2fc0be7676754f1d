"""The count of safety costs: ``info["cost"]`` of the training environments, in one place for all algorithms."""

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import safe_mean

from sb3_chac.common.checks import is_finite, number_in, number_or_nan

TOTAL, EPISODE_MEAN = "safety/safety_cost", "rollout/ep_cost_mean"  # of the logger


class EpisodeCosts:
    """
    Sums of the safety cost of the episodes under way.

    :param n_envs: number of environments
    """

    def __init__(self, n_envs: int) -> None:
        self.sums = np.zeros(n_envs)

    def add(self, costs: Sequence[float | None] | np.ndarray, dones: np.ndarray) -> list[float]:
        """
        Add the costs of one step.

        :param costs: one per environment, None where there is none
        :param dones: whether the episode ends with this step, shape (n_envs,)
        :return: sums of the episodes that end
        """
        self.sums += [cost or 0.0 for cost in costs]
        is_over = dones.astype(bool)
        finished = self.sums[is_over].tolist()
        self.sums[is_over] = 0.0
        return finished


def step_costs(infos: list[dict[str, Any]]) -> np.ndarray:
    """
    Read the costs of one step for an algorithm that cannot do without.

    :param infos: one per environment
    :return: their ``info["cost"]``, shape (n_envs,)
    :raises ValueError: if one has none, or none that is a finite number
    """
    costs = np.zeros(len(infos))
    for idx, info in enumerate(infos):
        costs[idx] = number_or_nan(info.get("cost"))
        if not is_finite(costs[idx]):
            raise ValueError(
                f"info['cost'] of environment {idx} must be a finite number at every step, got {info.get('cost', 'none')!r}: "
                "take an environment that reports its safety cost (SafeDrive-v0 does), or wrap this one to put it there. "
                "Nothing of this step was stored; the model can still be saved."
            )
    return costs


def measured_costs(infos: list[dict[str, Any]]) -> list[float | None]:
    """
    Read the costs of one step where they are optional.

    :param infos: one per environment
    :return: their ``info["cost"]``, None where it is not measured
    :raises ValueError: for one that is not a finite number
    """
    return [number_in(info, "cost", idx) for idx, info in enumerate(infos)]


def record_costs(logger: Logger, total: float | None, episode_costs: deque[float]) -> None:
    """
    Log the costs.

    :param logger: of the model
    :param total: since the start of the training, None if it is not measured: nothing is logged then
    :param episode_costs: of the latest episodes
    """
    if total is not None:
        logger.record(TOTAL, total)
    if episode_costs:
        logger.record(EPISODE_MEAN, safe_mean(episode_costs))
