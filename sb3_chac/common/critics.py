"""Twin Gaussian return distributions as one module."""

from contextlib import nullcontext
from itertools import pairwise

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_chac.common.linear import StackedLinear
from sb3_chac.common.mlp import FastMLP, use_fast_mlps

# Keeps sigma positive where softplus underflows
MIN_STD = 1e-6


class DistributionalCritic(BaseModel):
    """
    ``n_critics`` independent return distributions Z_i(s, a) ~ N(Q_i(s, a), sigma_i(s, a)^2). Each is one MLP with two
    outputs, the mean Q and the raw standard deviation, sigma = softplus(raw).

    :param observation_space: Observation space
    :param action_space: Action space
    :param net_arch: Sizes of the hidden layers
    :param features_extractor: Network to extract features
    :param features_dim: Number of features
    :param activation_fn: Activation function
    :param normalize_images: Whether to divide images by 255
    :param n_critics: Number of critics
    :param share_features_extractor: Whether the features extractor is the actor's (and learned by its loss alone)
    """

    action_space: spaces.Box
    features_extractor: BaseFeaturesExtractor
    # Running mean of sigma per critic, b in DSAC-T's equations; 0 until the first batch. Shape (n_critics, 1)
    mean_std: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.GELU,
        normalize_images: bool = True,
        n_critics: int = 2,
        share_features_extractor: bool = False,
    ):
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.share_features_extractor = share_features_extractor
        self.n_critics = n_critics
        layers: list[nn.Module] = []
        sizes = [features_dim + get_action_dim(action_space), *net_arch]
        for in_features, out_features in pairwise(sizes):
            layers += [StackedLinear(n_critics, in_features, out_features), activation_fn()]
        self.z_networks = nn.Sequential(*layers, StackedLinear(n_critics, sizes[-1], 2))
        use_fast_mlps(self)
        self.register_buffer("mean_std", th.zeros(n_critics, 1))

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Compute mean and standard deviation of the return.

        :param obs: batch of observations
        :param actions: scaled to [-1, 1], shape (batch_size, action_dim)
        :return: Q and sigma, both of shape (n_critics, batch_size)
        """
        # A shared extractor is learned by the actor's loss alone (as in SB3's SAC)
        with th.no_grad() if self.share_features_extractor else nullcontext():
            features = self.extract_features(obs, self.features_extractor)
        if isinstance(self.z_networks, FastMLP):
            outputs = self.z_networks(features, actions)
        else:
            outputs = self.z_networks(th.cat([features, actions], dim=1))
        q_values, raw_stds = outputs.unbind(dim=2)
        return q_values, nn.functional.softplus(raw_stds) + MIN_STD

    def pessimistic(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Mean and standard deviation of the critic whose mean is the smaller one, for each sample.

        :param obs: batch of observations
        :param actions: scaled to [-1, 1], shape (batch_size, action_dim)
        :return: Q and sigma, both of shape (batch_size,)
        """
        q_values, stds = self(obs, actions)
        smaller = q_values.argmin(dim=0, keepdim=True)
        return q_values.gather(0, smaller).squeeze(0), stds.gather(0, smaller).squeeze(0)

    @th.no_grad()
    def update_mean_std(self, stds: th.Tensor, tau: float) -> th.Tensor:
        """
        ``b <- (1 - tau) b + tau mean(sigma)``; the first batch initialises b.

        :param stds: sigma of a batch, shape (n_critics, batch_size)
        :return: the new b, shape (n_critics, 1)
        """
        batch_mean = stds.mean(dim=1, keepdim=True)
        self.mean_std.copy_(th.where(self.mean_std == 0, batch_mean, th.lerp(self.mean_std, batch_mean, tau)))
        return self.mean_std
