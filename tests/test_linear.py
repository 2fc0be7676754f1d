"""Our linear layers are torch's, only faster."""

import pytest
import torch as th
from torch import nn

from sb3_chac.common import linear as linear_module
from sb3_chac.common.linear import FastLinear, StackedLinear, linear, use_fast_linear


@pytest.fixture(params=[False, True], autouse=True)
def use_onednn(request, monkeypatch):
    """Both ways on every processor, whichever is the faster one there."""
    if request.param and not hasattr(th.ops.mkldnn, "_linear_pointwise"):
        pytest.skip("this build of torch has no oneDNN")
    monkeypatch.setattr(linear_module, "USE_ONEDNN", request.param)


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
    stacked, inputs = StackedLinear(3, 5, 4), th.randn(3, 40, 5)
    outputs = stacked(inputs)
    for idx in range(3):
        assert th.allclose(outputs[idx], nn.functional.linear(inputs[idx], stacked.weight[idx], stacked.bias[idx]), atol=1e-6)


def test_use_fast_linear_keeps_the_parameters():
    module = nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 2, bias=False))
    inputs, before = th.randn(5, 3), list(module.parameters())
    expected = module(inputs)
    use_fast_linear(module)
    assert type(module[0]) is FastLinear and type(module[2]) is nn.Linear
    assert all(a is b for a, b in zip(before, module.parameters(), strict=True))
    assert th.allclose(module(inputs), expected, atol=1e-6)


@pytest.mark.parametrize("vendor, expected", [("GenuineIntel", False), ("AuthenticAMD", True)])
def test_who_gets_onednn(vendor, expected, tmp_path, monkeypatch):
    (tmp_path / "cpuinfo").write_text(f"processor\t: 0\nvendor_id\t: {vendor}\n")
    monkeypatch.setattr(linear_module, "Path", lambda _: tmp_path / "cpuinfo")
    monkeypatch.setattr(th.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    assert linear_module.mkl_is_held_back() == expected
    monkeypatch.setattr(th.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    assert not linear_module.mkl_is_held_back()
