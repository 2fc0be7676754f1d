"""Our linear layers are torch's, only faster."""

import pytest
import torch as th
from torch import nn

from sb3_chac.common.linear import FastLinear, StackedLinear, linear, use_fast_linear


@pytest.mark.parametrize("batch_size, in_features, out_features", [(1, 3, 2), (32, 23, 64), (256, 265, 256)])
def test_linear_and_its_gradients_are_torchs(batch_size, in_features, out_features):
    th.manual_seed(0)
    tensors = [th.randn(batch_size, in_features), th.randn(out_features, in_features), th.randn(out_features)]
    tensors = [tensor.requires_grad_() for tensor in tensors]
    ours, torchs = linear(*tensors), nn.functional.linear(*tensors)
    assert th.allclose(ours, torchs, atol=1e-4)
    weights = th.randn_like(ours)
    for ours_grad, torchs_grad in zip(
        th.autograd.grad(ours, tensors, weights), th.autograd.grad(torchs, tensors, weights), strict=True
    ):
        assert th.allclose(ours_grad, torchs_grad, atol=1e-3)


@pytest.mark.parametrize("dtype, shape", [(th.float64, (4, 3)), (th.float32, (2, 4, 3)), (th.float32, (3,))])
def test_linear_falls_back_where_onednn_does_not_apply(dtype, shape):
    inputs, weight, bias = th.randn(shape, dtype=dtype), th.randn(5, 3, dtype=dtype), th.randn(5, dtype=dtype)
    assert th.equal(linear(inputs, weight, bias), nn.functional.linear(inputs, weight, bias))


def test_stacked_linear_is_independent_linear_layers():
    stacked, inputs = StackedLinear(3, 5, 4), th.randn(3, 8, 5)
    outputs = stacked(inputs)
    for idx in range(3):
        assert th.allclose(outputs[idx], nn.functional.linear(inputs[idx], stacked.weight[idx], stacked.bias[idx]), atol=1e-6)
    batched = th.baddbmm(stacked.bias.unsqueeze(1), inputs, stacked.weight.transpose(1, 2))  # what other devices compute
    assert th.allclose(outputs, batched, atol=1e-6)


def test_use_fast_linear_keeps_the_parameters():
    module = nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 2, bias=False))
    inputs, before = th.randn(5, 3), list(module.parameters())
    expected = module(inputs)
    use_fast_linear(module)
    assert type(module[0]) is FastLinear and type(module[2]) is nn.Linear
    assert all(a is b for a, b in zip(before, module.parameters(), strict=True))
    assert th.allclose(module(inputs), expected, atol=1e-6)
