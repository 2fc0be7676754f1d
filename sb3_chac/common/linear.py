"""
Linear layers that use oneDNN on the processors where MKL is slow.

torch's CPU build multiplies float32 matrices with MKL, which takes its AVX-512 code on Intel's processors only. oneDNN comes
with torch too and takes it on all: products of 256 x 256 in half the time on AMD's Zen 5. On Intel's, MKL is the faster one
for a training step (benchmarks/NOTES.md).
"""

import math
from pathlib import Path
from typing import Any

import torch as th
from torch import nn


def mkl_is_held_back() -> bool:
    """Tell whether the processor has AVX-512 and is not Intel's (Linux only: elsewhere we do not know, and say no)."""
    cpuinfo = Path("/proc/cpuinfo")
    if not th.backends.cpu.get_cpu_capability().startswith("AVX512") or not cpuinfo.is_file():
        return False
    with cpuinfo.open() as file:
        return "GenuineIntel" not in file.read(1000)  # the first processor's vendor_id


USE_ONEDNN = th.backends.mkldnn.is_available() and hasattr(th.ops.mkldnn, "_linear_pointwise") and mkl_is_held_back()
# Below this many rows the detour costs more than it saves (predict() on one observation)
MIN_BATCH_SIZE = 32


def is_traced() -> bool:
    """Tell whether torch records what is computed (TorchScript, ONNX, ``torch.export``), to run it elsewhere."""
    return th.jit.is_tracing() or th.compiler.is_compiling()


def uses_onednn() -> bool:
    """Tell whether to take the detour."""
    return USE_ONEDNN and not is_traced()


def takes_onednn(left: th.Tensor, right: th.Tensor) -> bool:
    """Tell whether oneDNN computes the product of two matrices."""
    is_float_matrix = left.dim() == 2 and left.dtype == right.dtype == th.float32
    return uses_onednn() and is_float_matrix and left.device.type == "cpu" and len(left) >= MIN_BATCH_SIZE


def product(left: th.Tensor, right: th.Tensor, bias: th.Tensor | None = None) -> th.Tensor:
    """``left @ right.t() + bias``, for use where autograd records nothing."""
    if takes_onednn(left, right):
        return th.ops.mkldnn._linear_pointwise(left, right, bias, "none", [], "")
    return nn.functional.linear(left, right, bias)


class OneDnnLinearFunction(th.autograd.Function):
    """``inputs @ weight.t() + bias`` and its gradients, for float32 matrices on the CPU."""

    @staticmethod
    def forward(ctx: Any, inputs: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
        ctx.save_for_backward(inputs, weight)
        return product(inputs, weight, bias)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: th.Tensor) -> tuple[th.Tensor | None, ...]:
        (inputs, weight), (grad,) = ctx.saved_tensors, grad_outputs
        return (
            product(grad, weight.t()) if ctx.needs_input_grad[0] else None,
            product(grad.t(), inputs.t()) if ctx.needs_input_grad[1] else None,
            grad.sum(dim=0) if ctx.needs_input_grad[2] else None,
        )


def linear(inputs: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
    """
    Apply a linear layer.

    :param inputs: shape (batch_size, in_features)
    :param weight: shape (out_features, in_features)
    :param bias: shape (out_features,)
    :return: ``inputs @ weight.t() + bias``, shape (batch_size, out_features)
    """
    if takes_onednn(inputs, weight):
        return OneDnnLinearFunction.apply(inputs, weight, bias)
    return nn.functional.linear(inputs, weight, bias)


class FastLinear(nn.Linear):
    """``nn.Linear`` (with a bias) on top of :func:`linear`."""

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        return linear(inputs, self.weight, self.bias)


class StackedLinear(nn.Module):
    """
    ``n_stack`` independent linear layers of one shape, evaluated together.

    :param n_stack: number of layers
    :param in_features: size of each input
    :param out_features: size of each output
    """

    def __init__(self, n_stack: int, in_features: int, out_features: int):
        super().__init__()
        self.weight = nn.Parameter(th.empty(n_stack, out_features, in_features))
        self.bias = nn.Parameter(th.empty(n_stack, out_features))
        bound = 1 / math.sqrt(in_features)  # as nn.Linear
        nn.init.uniform_(self.weight, -bound, bound)
        nn.init.uniform_(self.bias, -bound, bound)

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        Apply all layers of the stack.

        :param inputs: shape (n_stack, batch_size, in_features), or (batch_size, in_features) for all layers alike
        :return: shape (n_stack, batch_size, out_features)
        """
        inputs = inputs.expand(len(self.weight), *inputs.shape[-2:])
        if uses_onednn() and inputs.device.type == "cpu":
            return th.stack([linear(*layer) for layer in zip(inputs, self.weight, self.bias, strict=True)])
        return th.baddbmm(self.bias.unsqueeze(1), inputs, self.weight.transpose(1, 2))


def use_fast_linear(module: nn.Module) -> None:
    """Turn every ``nn.Linear`` inside ``module`` into a :class:`FastLinear` that keeps its parameters."""
    for layer in module.modules():
        if type(layer) is nn.Linear and layer.bias is not None:
            layer.__class__ = FastLinear
