"""Small tensor helpers shared by the algorithms."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch as th


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
