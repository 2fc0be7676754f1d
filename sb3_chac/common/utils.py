"""Small tensor helpers shared by the algorithms."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch as th
from stable_baselines3.common.utils import get_parameters_by_name
from torch import nn


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
