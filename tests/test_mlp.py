"""An MLP in one node of the graph is the MLP of its layers, and the algorithms learn the same with either."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.logger import configure
from torch import nn

from sb3_chac import CHAC, DPVP, DSAC
from sb3_chac.common import actors, mlp
from sb3_chac.common import linear as linear_module
from sb3_chac.common.linear import StackedLinear
from sb3_chac.common.mlp import FastMLP, use_fast_mlps


@pytest.fixture(params=[False, True], autouse=True)
def use_onednn(request, monkeypatch):
    """Both ways on every processor, whichever is the faster one there."""
    if request.param and not hasattr(th.ops.mkldnn, "_linear_pointwise"):
        pytest.skip("this build of torch has no oneDNN")
    monkeypatch.setattr(linear_module, "USE_ONEDNN", request.param)


def layers(activation: type[nn.Module], n_stack: int | None, ends_with_activation: bool) -> list[nn.Module]:
    def linear(n_in: int, n_out: int) -> nn.Module:
        return nn.Linear(n_in, n_out) if n_stack is None else StackedLinear(n_stack, n_in, n_out)

    return [linear(7, 16), activation(), linear(16, 33), activation(), linear(33, 2), *[activation()] * ends_with_activation]


@pytest.mark.parametrize("needed", ["all", "parameters", "actions"])
@pytest.mark.parametrize("ends_with_activation", [False, True])
@pytest.mark.parametrize("n_stack", [None, 1, 2])
@pytest.mark.parametrize("activation", list(mlp.ACTIVATIONS))
def test_values_and_gradients_are_those_of_the_layers(activation, n_stack, ends_with_activation, needed) -> None:
    th.manual_seed(0)
    plain = nn.Sequential(*layers(activation, n_stack, ends_with_activation))
    holder = nn.ModuleList([nn.Sequential(*plain)])
    use_fast_mlps(holder)
    fast, parameters = holder[0], list(plain.parameters())
    assert type(fast) is FastMLP and all(a is b for a, b in zip(parameters, fast.parameters(), strict=True))
    features, actions = th.randn(40, 5), th.randn(40, 2)
    wanted = {"all": [features, actions, *parameters], "parameters": parameters, "actions": [actions]}[needed]
    for tensor in (features, actions, *parameters):
        tensor.requires_grad_(any(tensor is one for one in wanted))
    ours, theirs = fast(features, actions), plain(th.cat([features, actions], dim=1))
    assert "MLPFunction" in type(ours.grad_fn).__name__
    th.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-5)
    weights = th.randn_like(ours)
    grads = (th.autograd.grad(values, wanted, weights) for values in (ours, theirs))
    for our_grad, their_grad in zip(*grads, strict=True):
        th.testing.assert_close(our_grad, their_grad, atol=1e-4, rtol=1e-4)
    with th.no_grad():
        th.testing.assert_close(fast(features, actions), theirs, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    "others",
    [
        lambda: [nn.Linear(3, 4), nn.ELU(), nn.Linear(4, 2)],
        lambda: [nn.Linear(3, 4), nn.GELU(approximate="tanh"), nn.Linear(4, 2)],
        lambda: [nn.Linear(3, 4), nn.ReLU(), nn.Dropout(), nn.Linear(4, 2)],
        lambda: [nn.Linear(3, 4), nn.LayerNorm(4), nn.ReLU()],
        lambda: [nn.Linear(3, 4, bias=False), nn.ReLU()],
        lambda: [nn.ReLU(), nn.Linear(3, 4)],
        lambda: [nn.Linear(3, 4), nn.ReLU(), nn.ReLU()],
        list,
    ],
)
def test_other_architectures_stay_what_they_are(others) -> None:
    sequential = nn.Sequential(*others())
    use_fast_mlps(nn.ModuleList([sequential]))
    assert type(sequential) is nn.Sequential


def test_samples_and_likelihoods_are_those_of_sb3() -> None:
    mean, log_std = th.randn(256, 2, requires_grad=True), th.linspace(-5, 1, 512).view(256, 2).requires_grad_()
    weights, results = th.randn(256, 2), []
    for distribution in (SquashedDiagGaussianDistribution(2), actors.FastSquashedGaussian(2)):
        th.manual_seed(0)
        action, log_prob = distribution.log_prob_from_params(mean, log_std)
        objective = (action * weights).sum() + (log_prob * weights[:, 0]).sum()
        results.append((action, log_prob, *th.autograd.grad(objective, (mean, log_std))))
    for ours, theirs in zip(*results, strict=True):
        th.testing.assert_close(ours, theirs, atol=1e-3, rtol=1e-4)


class Spaces(gym.Env):
    """Only there for its spaces."""

    observation_space, action_space = spaces.Box(-1, 1, (6,), np.float32), spaces.Box(-1, 1, (2,), np.float32)


def trained(algorithm, **kwargs):
    """A model after 100 gradient steps on made-up transitions, with half of them the human's where one takes over."""
    policy_kwargs = {"net_arch": [32, 32], "activation_fn": kwargs.pop("activation_fn", nn.GELU)}
    model = algorithm("MlpPolicy", Spaces(), policy_kwargs=policy_kwargs, seed=0, device="cpu", buffer_size=500, **kwargs)
    rng = np.random.default_rng(0)
    for i in range(200):
        observations, actions = rng.uniform(-1, 1, (2, 1, 6)), rng.uniform(-1, 1, (2, 1, 2))
        info = {"takeover": i % 2 == 0, "novice_action": actions[1][0]}
        model.replay_buffer.add(*observations, actions[0], rng.normal(size=1), np.array([i % 20 == 0]), [info])
    model.set_logger(configure(None, []))
    model.train(100, batch_size=64)
    return model


@pytest.mark.parametrize("activation_fn", [nn.ReLU, nn.GELU])
@pytest.mark.parametrize(
    "algorithm, kwargs",
    [(DSAC, {}), (DSAC, {"policy_delay": 1}), (DPVP, {}), (CHAC, {})],
    ids=["dsac", "dsac-delay-1", "dpvp", "chac"],
)
def test_the_ordinary_path_learns_the_same(algorithm, kwargs, activation_fn, monkeypatch) -> None:
    fast = trained(algorithm, activation_fn=activation_fn, **kwargs)
    monkeypatch.setattr(mlp, "is_covered", lambda module: False)
    monkeypatch.setattr(actors, "FastSquashedGaussian", SquashedDiagGaussianDistribution)
    ordinary = trained(algorithm, activation_fn=activation_fn, **kwargs)
    assert any(type(module) is FastMLP for module in fast.policy.modules())
    assert not any(type(module) is FastMLP for module in ordinary.policy.modules())
    parameters = fast.policy.state_dict(), ordinary.policy.state_dict()
    for name, ours in parameters[0].items():
        th.testing.assert_close(ours, parameters[1][name], atol=1e-5, rtol=1e-5, msg=lambda text, name=name: f"{name}: {text}")
