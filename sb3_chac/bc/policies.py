"""Policies that are fitted to demonstrations, of BC, HG-DAgger and IWR."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor, NatureCNN, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn
from torch.nn import functional as F

from sb3_chac.common.utils import policy_arguments

LOSSES = ("mse", "nll")
LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0


def check_loss(loss: str) -> None:
    """
    Check the argument ``loss``.

    :raises ValueError: if it is not one of ``LOSSES``
    """
    if loss not in LOSSES:
        raise ValueError(f"loss must be one of {', '.join(LOSSES)}, got {loss!r}.")


@contextmanager
def imitating_policy(model: BaseAlgorithm, loss: str, weight_decay: float) -> Iterator[None]:
    """
    Build the policy of an algorithm that imitates inside the block.

    :param model: whose policy it is
    :param loss: of ``LOSSES``; the policy is stochastic for "nll"
    :param weight_decay: of its optimizer
    """
    model.policy_kwargs = {key: value for key, value in model.policy_kwargs.items() if key != "stochastic"}  # once stored
    with policy_arguments(model, stochastic=loss == "nll"):
        yield
    for group in model.policy.optimizer.param_groups:
        group["weight_decay"] = weight_decay


class BCPolicy(BasePolicy):
    """
    A network that imitates: of Box actions it gives the mean, scaled to [-1, 1] and clipped there, and if it is stochastic
    the logarithm of the standard deviation of a Gaussian; of Discrete ones their logits.

    The mean is not squashed by tanh, as that of SAC is: demonstrations often hold actions at the bounds.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule
    :param stochastic: whether to give a standard deviation; without, it acts deterministically. Set by BC's ``loss``
    :param net_arch: Hidden layers, [256, 256] by default; or a dict that has them as "pi"
    :param activation_fn: Activation function
    :param features_extractor_class: Features extractor to use, by default the one that fits the observations
    :param features_extractor_kwargs: Keyword arguments of the features extractor
    :param normalize_images: Whether to divide images by 255
    :param optimizer_class: Optimizer
    :param optimizer_kwargs: Additional keyword arguments of the optimizer, excluding learning rate and weight decay
    """

    default_features_extractor: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor
    optimizer: th.optim.Optimizer

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box | spaces.Discrete,
        lr_schedule: Schedule,
        stochastic: bool = False,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.AdamW,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class or self.default_features_extractor,
            features_extractor_kwargs,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=isinstance(action_space, spaces.Box),  # predict() scales the actions back
        )
        self.stochastic = stochastic
        self.net_arch = [256, 256] if net_arch is None else net_arch["pi"] if isinstance(net_arch, dict) else net_arch
        self.activation_fn = activation_fn
        self.features_extractor = self.make_features_extractor()
        features_dim = self.features_extractor.features_dim
        self.latent_pi = nn.Sequential(*create_mlp(features_dim, -1, self.net_arch, activation_fn))
        latent_dim = self.net_arch[-1] if self.net_arch else features_dim
        if isinstance(action_space, spaces.Discrete):
            self.logits = nn.Linear(latent_dim, int(action_space.n))
        else:
            self.mu = nn.Linear(latent_dim, get_action_dim(action_space))
            if stochastic:
                self.log_std = nn.Linear(latent_dim, get_action_dim(action_space))
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _latent(self, observations: PyTorchObs) -> th.Tensor:
        return self.latent_pi(self.extract_features(observations, self.features_extractor))

    def action_logits(self, observations: PyTorchObs) -> th.Tensor:
        """
        Compute the logits of discrete actions.

        :return: shape (batch_size, n_actions), for Discrete actions
        """
        return self.logits(self._latent(observations))

    def action_mean(self, observations: PyTorchObs) -> th.Tensor:
        """
        Compute the mean of continuous actions.

        :return: scaled to [-1, 1], not clipped, shape (batch_size, action_dim), for Box actions
        """
        return self.mu(self._latent(observations))

    def action_mean_and_log_std(self, observations: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """
        Compute mean and logarithmic standard deviation of continuous actions.

        :return: scaled to [-1, 1], not clipped, both of shape (batch_size, action_dim), for Box actions if ``stochastic``
        """
        latent = self._latent(observations)
        return self.mu(latent), self.log_std(latent).clamp(LOG_STD_MIN, LOG_STD_MAX)

    def losses(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """
        Compute the loss of each demonstrated action.

        :param actions: demonstrated, scaled to [-1, 1], shape (batch_size, action_dim); if discrete, from 0 on, shape
            (batch_size,)
        :return: "nll" if the policy is stochastic, else "mse", shape (batch_size,)
        """
        if isinstance(self.action_space, spaces.Discrete):
            return F.cross_entropy(self.action_logits(observations), actions, reduction="none")
        if self.stochastic:
            return gaussian_nll(*self.action_mean_and_log_std(observations), actions)
        return squared_errors(self.action_mean(observations), actions)

    def forward(self, observations: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(observations, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if isinstance(self.action_space, spaces.Discrete):
            logits = self.action_logits(observation)
            actions = logits.argmax(dim=1) if deterministic else th.distributions.Categorical(logits=logits).sample()
            return actions + int(self.action_space.start)
        if not self.stochastic or deterministic:
            return self.action_mean(observation).clamp(-1.0, 1.0)
        mean, log_std = self.action_mean_and_log_std(observation)
        return th.normal(mean, log_std.exp()).clamp(-1.0, 1.0)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            lr_schedule=self._dummy_schedule,  # not needed for loading the policy alone
            stochastic=self.stochastic,
            net_arch=self.net_arch,
            activation_fn=self.activation_fn,
            features_extractor_class=self.features_extractor_class,
            features_extractor_kwargs=self.features_extractor_kwargs,
            optimizer_class=self.optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
        )
        return data


MlpPolicy = BCPolicy


class CnnPolicy(BCPolicy):
    """Policy for image observations: ``BCPolicy`` with the CNN of the DQN Nature paper as features extractor."""

    default_features_extractor = NatureCNN


def squared_errors(means: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """
    Compute the squared error of each action.

    :param means: shape (batch_size, action_dim)
    :param actions: same shape
    :return: mean over the dimensions of (mean - action)^2, shape (batch_size,)
    """
    return (means - actions).square().mean(dim=1)


def gaussian_nll(means: th.Tensor, log_stds: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """
    Compute the negative log-likelihood of each action under a Gaussian.

    :param means: shape (batch_size, action_dim)
    :param log_stds: same shape
    :param actions: same shape
    :return: ``-log N(action; mean, std^2)``, summed over the dimensions, shape (batch_size,)
    """
    errors = (actions - means) * (-log_stds).exp()
    return (0.5 * errors.square() + log_stds + 0.5 * math.log(2 * math.pi)).sum(dim=1)
