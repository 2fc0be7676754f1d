"""Small tensor helpers shared by the algorithms."""

import math
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.utils import get_parameters_by_name
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_chac.common.checks import check_range


@th.no_grad()
def polyak_update(params: Iterable[th.Tensor], target_params: Iterable[th.Tensor], tau: float) -> None:
    """
    ``target <- (1 - tau) target + tau param``, in place, in one call for all tensors (SB3's loops over them).

    :param params: online parameters
    :param target_params: target parameters, in the same order
    :param tau: soft update coefficient, between 0 and 1
    """
    targets = list(target_params)
    if targets:
        th._foreach_lerp_(targets, list(params), tau)


class TargetUpdate:
    """
    Soft update of a target network. Batch norm statistics are copied, not averaged (as in SB3, GH issue #996).

    :param online: the network that learns
    :param target: its target copy
    """

    def __init__(self, online: nn.Module, target: nn.Module):
        self.params, self.target_params = list(online.parameters()), list(target.parameters())
        self.statistics = get_parameters_by_name(online, ["running_"])
        self.target_statistics = get_parameters_by_name(target, ["running_"])

    def __call__(self, tau: float) -> None:
        """
        Update all targets.

        :param tau: the soft update coefficient, between 0 and 1
        """
        polyak_update(self.params, self.target_params, tau)
        polyak_update(self.statistics, self.target_statistics, 1.0)


def minimize(loss: th.Tensor, optimizer: th.optim.Optimizer) -> None:
    """One step of ``optimizer`` down the gradient of ``loss``."""
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


@contextmanager
def frozen(params: Iterable[th.Tensor]) -> Iterator[None]:
    """
    Compute no gradients for ``params`` inside the block, only through them: half the backward pass of a critic when
    the actor is updated.
    """
    params = [param for param in params if param.requires_grad]
    for param in params:
        param.requires_grad_(False)
    try:
        yield
    finally:
        for param in params:
            param.requires_grad_(True)


class FixedStatistics(RunningMeanStd):
    """
    Statistics of what a model is fitted to. They stand still: an environment that is stepped does not move them away.

    :param values: shape (n, ...)
    """

    def __init__(self, values: np.ndarray):
        super().__init__(shape=values.shape[1:])
        super().update(values)

    def update(self, arr: np.ndarray) -> None:
        pass


def fix_statistics(normalize: VecNormalize | None, observations: np.ndarray) -> None:
    """
    Fix the statistics of a normalization to those of a dataset.

    :param normalize: of an environment; if it is in training, it normalizes by the statistics of ``observations`` from now on
    :param observations: that a model is about to be fitted to, not normalized, shape (n, *observation_shape)
    """
    if normalize is not None and normalize.training and normalize.norm_obs:
        normalize.obs_rms = FixedStatistics(observations)  # type: ignore[assignment]


def detach_distributions(policy: nn.Module) -> None:
    """
    Cut what the action distributions of a policy remember of the last batch off its graph, which would keep the policy from
    being copied (``copy.deepcopy``) and traced.
    """
    distributions = [module.action_dist for module in policy.modules() if hasattr(module, "action_dist")]
    for distribution in distributions:
        # Itself, and the torch distributions that it holds
        for holder in (distribution, *vars(distribution).values()):
            if isinstance(holder, Distribution | th.distributions.Distribution):
                for name, value in vars(holder).items():
                    if isinstance(value, th.Tensor) and value.grad_fn is not None:
                        setattr(holder, name, value.detach())


def target_entropy(argument: str | float, n_actions: int) -> float:
    """
    Return the entropy that a learned coefficient holds: a number is one, "auto" is -1 per action, "auto_8" -8 per action.

    :param n_actions: dimension of the action space
    :raises ValueError: for another text, or a number that is not finite
    """
    if not isinstance(argument, str):
        check_range("target_entropy", argument)
        return float(argument)
    matched = re.fullmatch(r"auto(?:_(\d+(?:\.\d+)?))?", argument)
    if matched is None:
        raise ValueError(f"target_entropy must be a number, 'auto' or such as 'auto_8' (-8 per action), got {argument!r}.")
    return -float(matched[1] or 1) * n_actions


@contextmanager
def policy_arguments(model: BaseAlgorithm, **defaults: Any) -> Iterator[None]:
    """
    Add arguments to those of the policy inside the block, where it is built. They are not stored with the model: SB3's
    ``load`` compares what is stored with what is given to it.

    :param defaults: arguments; those that ``policy_kwargs`` holds go first
    """
    given = model.policy_kwargs
    model.policy_kwargs = {**defaults, **given}
    try:
        yield
    finally:
        model.policy_kwargs = given


def safe_log(value: float) -> float:
    """
    Return a finite logarithm, also of 0 and of what 32 bits cannot hold.

    :param value: of at least 0
    """
    return math.log(max(value, float(th.finfo(th.float32).tiny)))


def initial_ent_coef(ent_coef: str | float) -> float:
    """
    Parse the entropy coefficient.

    :param ent_coef: the argument of an algorithm
    :return: alpha at the start: 1 for 'auto', x for 'auto_x' and for the number x
    :raises ValueError: for anything else
    """
    if not isinstance(ent_coef, str):
        check_range("ent_coef", ent_coef, low=0.0)
        return float(ent_coef)
    kind, _, value = ent_coef.partition("_")
    try:
        initial = float(value) if value else 1.0
    except ValueError:
        initial = -1.0
    if kind != "auto" or initial <= 0:
        raise ValueError(f"ent_coef must be 'auto', 'auto_0.1' (0.1 to start with) or a number, got {ent_coef!r}.")
    return initial
