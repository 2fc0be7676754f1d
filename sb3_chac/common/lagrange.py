"""A Lagrange multiplier on the cost of an episode, and what the algorithms that it constrains share."""

import math
from collections import deque
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from torch import nn

from sb3_chac.common.checks import check_integer, check_range
from sb3_chac.common.costs import EpisodeCosts, record_costs, step_costs
from sb3_chac.common.own_steps import NoticesOthers


class PIDLagrangian(nn.Module):
    """
    Lagrange multiplier of the constraint "the mean cost of an episode is at most ``cost_limit``", moved by a PID controller.

    Paper: "Responsive Safety in Reinforcement Learning by PID Lagrangian Methods" (Stooke et al. 2020),
    https://arxiv.org/abs/2007.03964

    With J the cost of an episode, or the mean cost of several, and ema a running mean that starts at the first J::

        I <- max(0, I + ki (J - limit))
        lambda = max(0, kp (ema(J)_t - limit) + I + kd max(0, ema(J)_t - ema(J)_{t - delay}))

    The last term is 0 at the first update and compares with the first J until there are ``pid_delay`` updates. What changes is
    held in tensors (float64), which SB3 saves, loads and sets beside those of the networks; the arguments are not among them.

    :param cost_limit: that the mean cost of an episode is to stay below
    :param pid_kp: gain of the proportional term
    :param pid_ki: gain of the integral I; alone it makes the usual Lagrange multiplier, with this learning rate
    :param pid_kd: gain of the derivative term, which answers rising costs only
    :param pid_tau: coefficient of the running mean: weight of the newest J
    :param pid_delay: number of updates between the two costs of the derivative term
    :param lagrange_init: I and lambda before the first update
    :param lagrange_max: upper bound of I and lambda, None for none
    :raises ValueError: for an argument out of its range
    """

    multiplier: th.Tensor
    integral: th.Tensor
    mean_costs: th.Tensor
    n_updates: th.Tensor

    def __init__(
        self,
        cost_limit: float,
        pid_kp: float = 0.1,
        pid_ki: float = 0.01,
        pid_kd: float = 0.01,
        pid_tau: float = 0.05,
        pid_delay: int = 10,
        lagrange_init: float = 0.0,
        lagrange_max: float | None = None,
    ):
        check_range("cost_limit", cost_limit, low=0.0)
        for name, gain in (("pid_kp", pid_kp), ("pid_ki", pid_ki), ("pid_kd", pid_kd)):
            check_range(name, gain, low=0.0)
        check_range("pid_tau", pid_tau, low=0.0, high=1.0, exclusive_low=True)
        check_integer("pid_delay", pid_delay, low=1)
        if lagrange_max is not None:
            check_range("lagrange_max", lagrange_max, low=0.0)
        self.maximum = math.inf if lagrange_max is None else lagrange_max
        check_range("lagrange_init", lagrange_init, low=0.0, high=self.maximum)
        super().__init__()
        self.cost_limit = cost_limit
        self.kp, self.ki, self.kd = pid_kp, pid_ki, pid_kd
        self.tau = pid_tau
        self.register_buffer("multiplier", th.tensor(float(lagrange_init), dtype=th.float64))
        self.register_buffer("integral", self.multiplier.clone())
        # ema(J), the newest first
        self.register_buffer("mean_costs", th.zeros(pid_delay + 1, dtype=th.float64))
        self.register_buffer("n_updates", th.zeros((), dtype=th.float64))

    @property
    def value(self) -> float:
        """Lambda."""
        return self.multiplier.item()

    def update(self, episode_cost: float) -> float:
        """
        Update the multiplier.

        :param episode_cost: J
        :return: the new multiplier, also ``value``
        """
        if self.n_updates == 0:
            self.mean_costs.fill_(episode_cost)
        self.n_updates += 1
        mean_cost = self.mean_costs[0].item()
        mean_cost += self.tau * (episode_cost - mean_cost)
        self.mean_costs.copy_(self.mean_costs.roll(1))
        self.mean_costs[0] = mean_cost
        rise = max(0.0, mean_cost - self.mean_costs[-1].item())
        integral = self._bounded(self.integral.item() + self.ki * (episode_cost - self.cost_limit))
        self.integral.fill_(integral)
        self.multiplier.fill_(self._bounded(self.kp * (mean_cost - self.cost_limit) + integral + self.kd * rise))
        return self.value

    def _bounded(self, multiplier: float) -> float:
        return min(max(0.0, multiplier), self.maximum)


def constrained_actor_loss(
    log_prob: th.Tensor, q_values: th.Tensor, cost_q_values: th.Tensor, ent_coef: th.Tensor | float, multiplier: float
) -> th.Tensor:
    """
    Compute the actor's loss ``mean[ (alpha log pi - min Q + lambda max Q_c) / (1 + lambda) ]``.

    :param log_prob: log pi of the actor's actions, shape (batch_size,)
    :param q_values: of the reward's critics for these actions, shape (batch_size, n_critics)
    :param cost_q_values: of the cost's critics, same shape
    :param ent_coef: alpha
    :param multiplier: lambda
    :return: the loss, a scalar
    """
    rewards, costs = q_values.min(dim=1).values, cost_q_values.max(dim=1).values
    return (ent_coef * log_prob - rewards + multiplier * costs).mean() / (1 + multiplier)


def constrained_advantages(advantages: th.Tensor, cost_advantages: th.Tensor, multiplier: float, normalize: bool) -> th.Tensor:
    """
    Combine the advantages of reward and cost, ``(A_r - lambda A_c) / (1 + lambda)``.

    :param advantages: A_r, of the reward, shape (batch_size,)
    :param cost_advantages: A_c, of the cost, shape (batch_size,)
    :param multiplier: lambda
    :param normalize: scale A_r to mean 0 and standard deviation 1, as PPO does, and shift A_c to mean 0. A_c keeps its scale:
        where costs are rare and small, it is to weigh little, and the multiplier is to say how much
    :return: shape (batch_size,)
    """
    # Normalization does not make sense if mini batchsize == 1, see GH issue #325
    if normalize and len(advantages) > 1:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        cost_advantages = cost_advantages - cost_advantages.mean()
    return (advantages - multiplier * cost_advantages) / (1 + multiplier)


class CostConstrainedAlgorithm(NoticesOthers):
    """
    Base of the algorithms under a constraint on the cost. It counts what the environments report in ``info["cost"]``, as it is
    (``VecNormalize`` leaves it alone), and holds the multiplier. To be derived from before an algorithm of SB3, which calls
    ``_set_constraint`` in its constructor and ``_setup_constraint`` in ``_setup_model``.
    """

    gamma: float

    def _set_constraint(
        self,
        cost_limit: float,
        cost_gamma: float | None,
        lagrange_init: float,
        lagrange_max: float | None,
        pid_kp: float,
        pid_ki: float,
        pid_kd: float,
        pid_tau: float,
        pid_delay: int,
    ) -> None:
        """
        Store the arguments of the constructor that are about costs: those of ``PIDLagrangian`` and ``cost_gamma``.

        :param cost_gamma: discount factor of costs; ``gamma`` if None
        """
        self.cost_limit = cost_limit
        self.cost_gamma = cost_gamma
        self.lagrange_init = lagrange_init
        self.lagrange_max = lagrange_max
        self.pid_kp = pid_kp
        self.pid_ki = pid_ki
        self.pid_kd = pid_kd
        self.pid_tau = pid_tau
        self.pid_delay = pid_delay

    def _setup_constraint(self) -> None:
        """
        Called on creation and on loading, before anything is built.

        :raises ValueError: names the argument and the remedy
        """
        check_range("gamma", self.gamma, low=0.0, high=1.0)
        if self.cost_gamma is not None:
            check_range("cost_gamma", self.cost_gamma, low=0.0, high=1.0)
        self.multiplier = PIDLagrangian(
            self.cost_limit,
            self.pid_kp,
            self.pid_ki,
            self.pid_kd,
            self.pid_tau,
            self.pid_delay,
            self.lagrange_init,
            self.lagrange_max,
        )
        if not hasattr(self, "ep_cost_buffer"):  # else it was loaded
            self.ep_cost_buffer: deque[float] = deque(maxlen=self._stats_window_size)
            self.safety_cost = 0.0
        self.episode_costs = EpisodeCosts(self.n_envs)

    @property
    def cost_discount(self) -> float:
        """The discount factor of costs."""
        return self.gamma if self.cost_gamma is None else self.cost_gamma

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if reset_num_timesteps:
            self.ep_cost_buffer.clear()
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    def _forget_episodes(self) -> None:
        super()._forget_episodes()
        self.episode_costs = EpisodeCosts(self.n_envs)

    def _count_costs(self, infos: list[dict[str, Any]], dones: np.ndarray) -> tuple[np.ndarray, list[float]]:
        """
        Count the costs of one step.

        :param infos: of one step
        :param dones: shape (n_envs,)
        :return: costs of this step, shape (n_envs,), and those of the episodes that end with it
        :raises ValueError: if one is missing; then nothing is counted
        """
        costs = step_costs(infos)
        self.safety_cost += float(costs.sum())
        finished = self.episode_costs.add(costs, dones)
        self.ep_cost_buffer.extend(finished)
        return costs, finished

    def _record_costs(self) -> None:
        record_costs(self.logger, self.safety_cost, self.ep_cost_buffer)

    def _record_multiplier(self) -> None:
        self.logger.record("train/lagrange_multiplier", self.multiplier.value)
        self.logger.record("train/cost_limit", self.cost_limit)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "episode_costs"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        return [*state_dicts, "multiplier"], variables
