"""The distributional critic's arithmetic, on hand-made numbers and on a return whose distribution is known."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common import utils as sb3_utils
from stable_baselines3.common.logger import configure

from sb3_chac import DSAC
from sb3_chac.common.critics import DistributionalCritic
from sb3_chac.common.distributional import gaussian_nll, gaussian_surrogate_loss
from sb3_chac.common.utils import frozen, polyak_update


def surrogate_gradients(q, sigma, y_q, y_z, b, eta=1.0):
    q_values = th.tensor([[q]], requires_grad=True)
    stds = th.tensor([[sigma]], requires_grad=True)
    loss = gaussian_surrogate_loss(q_values, stds, th.tensor([y_q]), th.tensor([y_z]), th.tensor([[b]]), eta)
    loss.sum().backward()
    return q_values.grad.item(), stds.grad.item()


@pytest.mark.parametrize(
    "q, sigma, y_q, y_z, b, eta, d",
    [
        (1.0, 2.0, 1.5, 3.0, 1.5, 1.0, 2.0),
        (1.0, 0.5, 0.0, -9.0, 1.0, 1.0, -3.0),  # clipped from below at three running stds
        (0.0, 0.5, 0.0, 20.0, 2.0, 1.0, 6.0),  # clipped from above
        (1.0, 2.0, 1.5, 3.0, 1.5, 4.0, 2.0),
    ],
)
def test_surrogate_gradients(q, sigma, y_q, y_z, b, eta, d):
    q_gradient, std_gradient = surrogate_gradients(q, sigma, y_q, y_z, b, eta)
    weight = b**2 + 0.1
    assert q_gradient == pytest.approx(-weight * (y_q - q) / (sigma**2 + 0.1))
    assert std_gradient == pytest.approx(-weight * (d**2 - eta * sigma**2) / (sigma**3 + 0.1))


def test_surrogate_points_where_the_nll_does():
    """Away from clipping and for large sigma the surrogate is the NLL's gradient times b^2."""
    q_values, stds = th.tensor([3.0], requires_grad=True), th.tensor([40.0], requires_grad=True)
    target = th.tensor([20.0])
    gaussian_nll(q_values, stds, target).sum().backward()
    q_gradient, std_gradient = surrogate_gradients(3.0, 40.0, 20.0, 20.0, b=40.0)
    assert q_gradient / 40.0**2 == pytest.approx(q_values.grad.item(), rel=1e-3)
    assert std_gradient / 40.0**2 == pytest.approx(stds.grad.item(), rel=1e-3)


def test_surrogate_keeps_shape_and_leaves_targets_alone():
    q_values, stds = th.randn(2, 5, requires_grad=True), th.rand(2, 5, requires_grad=True)
    targets = th.randn(5, requires_grad=True)
    loss = gaussian_surrogate_loss(q_values, stds, targets, targets, th.ones(2, 1))
    assert loss.shape == (2, 5)
    loss.sum().backward()
    assert targets.grad is None


def test_nll_is_that_of_a_normal_distribution():
    q_values, stds, targets = th.randn(2, 7), th.rand(2, 7) + 0.1, th.randn(7)
    expected = -th.distributions.Normal(q_values, stds).log_prob(targets)
    assert th.allclose(gaussian_nll(q_values, stds, targets), expected, atol=1e-6)


@pytest.fixture
def critic() -> DistributionalCritic:
    return DSAC("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[8], n_critics=3)).critic


def test_critic_outputs(critic):
    q_values, stds = critic(th.randn(6, 3), th.rand(6, 1))
    assert q_values.shape == stds.shape == (3, 6)
    assert (stds > 0).all()
    assert not th.allclose(q_values[0], q_values[1])


def test_running_mean_of_sigma(critic):
    stds = th.tensor([[1.0, 3.0], [4.0, 4.0], [0.5, 0.5]])
    assert th.equal(critic.update_mean_std(stds, tau=0.1), th.tensor([[2.0], [4.0], [0.5]]))  # first batch initialises
    assert th.allclose(critic.update_mean_std(2 * stds, tau=0.1), th.tensor([[2.2], [4.4], [0.55]]))


def test_polyak_update_is_sb3s():
    online, ours = [th.randn(4, 3), th.randn(2)], [th.randn(4, 3), th.randn(2)]
    sb3s = [tensor.clone() for tensor in ours]
    polyak_update(online, ours, 0.3)
    sb3_utils.polyak_update(online, sb3s, 0.3)
    assert all(th.allclose(a, b, atol=1e-6) for a, b in zip(ours, sb3s, strict=True))
    polyak_update([], [], 1.0)


def test_frozen_blocks_gradients_of_parameters_only():
    layer, inputs = th.nn.Linear(2, 1), th.ones(1, 2, requires_grad=True)
    with pytest.raises(ZeroDivisionError), frozen(layer.parameters()):
        layer(inputs).sum().backward()
        raise ZeroDivisionError
    assert layer.weight.grad is None and inputs.grad is not None
    assert all(param.requires_grad for param in layer.parameters())


class NoisyReward(gym.Env):
    """One state that never ends."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)


def test_sigma_is_calibrated():
    """
    The return of r ~ N(0, 1) for ever has the mean 0 and the standard deviation 1 / sqrt(1 - gamma^2) = 7.09, and
    eta = 1 keeps sigma there. The learning rate goes to zero, to measure the fixed point and not its fluctuation.
    """
    gamma = 0.99
    model = DSAC(
        "MlpPolicy",
        NoisyReward(),
        learning_rate=lambda remaining: 1e-2 * remaining,
        buffer_size=50_000,
        gamma=gamma,
        tau=0.1,
        ent_coef=0.0,
        policy_delay=1,
        seed=0,
        policy_kwargs=dict(net_arch=[8]),
    )
    model.set_logger(configure(None, []))
    rewards = np.random.default_rng(0).normal(size=(50_000, 1))
    model.replay_buffer.rewards[:] = (rewards - rewards.mean()) / rewards.std()
    model.replay_buffer.actions[:] = np.random.default_rng(1).uniform(-1, 1, (50_000, 1, 1))
    model.replay_buffer.full = True
    for remaining in np.linspace(1, 0, 25):
        model._current_progress_remaining = float(remaining)
        model.train(gradient_steps=100, batch_size=2048)

    q_values, stds = model.critic(th.zeros(1, 1), th.zeros(1, 1))
    true_std = 1 / np.sqrt(1 - gamma**2)
    assert true_std == pytest.approx(7.09, abs=0.01)
    assert stds.mean().item() == pytest.approx(true_std, rel=0.1)
    assert abs(q_values.mean().item()) < 0.1 * true_std
