"""The discriminator of GAIL."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim, is_image_space, preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor, NatureCNN, create_mlp
from stable_baselines3.common.type_aliases import Schedule
from torch import nn
from torch.nn import functional as F


class Discriminator(nn.Module):
    """
    Network that tells the expert's (observation, action) from the policy's: ``D(s, a) = sigmoid(logit)`` is the probability
    that they are the expert's.

    :param observation_space: Observation space, a Box
    :param action_space: Action space, a bounded Box or Discrete
    :param lr_schedule: Learning rate schedule
    :param net_arch: Hidden layers, [256, 256] by default
    :param activation_fn: Activation function
    :param features_extractor_class: Features extractor of the observations, by default the one that fits them
    :param features_extractor_kwargs: Keyword arguments of the features extractor
    :param optimizer_class: Optimizer
    :param optimizer_kwargs: Additional keyword arguments of the optimizer, excluding the learning rate
    """

    obs_mean: th.Tensor
    obs_std: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box | spaces.Discrete,
        lr_schedule: Schedule,
        net_arch: list[int] | None = None,
        activation_fn: type[nn.Module] = nn.Tanh,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        super().__init__()
        self.observation_space, self.action_space = observation_space, action_space
        self.is_image = is_image_space(observation_space)
        default_extractor = NatureCNN if self.is_image else FlattenExtractor
        self.features_extractor = (features_extractor_class or default_extractor)(
            observation_space, **(features_extractor_kwargs or {})
        )
        n_actions = int(action_space.n) if isinstance(action_space, spaces.Discrete) else get_action_dim(action_space)
        in_features = self.features_extractor.features_dim + n_actions
        self.logits = nn.Sequential(*create_mlp(in_features, 1, [256, 256] if net_arch is None else net_arch, activation_fn))
        # Of the demonstrations, images are divided by 255 instead
        shape = (1,) if self.is_image else observation_space.shape
        self.register_buffer("obs_mean", th.zeros(shape))
        self.register_buffer("obs_std", th.ones(shape))
        self.optimizer = optimizer_class(self.parameters(), lr=lr_schedule(1), **(optimizer_kwargs or {}))  # type: ignore[call-arg]

    def normalize_by(self, observations: np.ndarray) -> None:
        """
        Scale observations from now on so that these have mean 0 and standard deviation 1, per entry.

        :param observations: shape (n, *observation_shape), not images
        """
        mean, std = observations.mean(axis=0, dtype=np.float64), observations.std(axis=0, dtype=np.float64)
        self.obs_mean.copy_(th.as_tensor(mean))
        self.obs_std.copy_(th.as_tensor(np.where(std < 1e-6, 1.0, std)))

    def inputs(self, observations: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Prepare observations and actions for the network.

        :param observations: shape (batch_size, *observation_shape)
        :param actions: in the units of a Box, shape (batch_size, *action_shape); numbers from 0 on if they are discrete, shape
            (batch_size,)
        :return: both as the network takes them: scaled, actions as one-hot vectors if they are discrete
        """
        if self.is_image:
            scaled: Any = preprocess_obs(observations, self.observation_space)
        else:
            scaled = ((observations.float() - self.obs_mean) / self.obs_std).clamp(-10.0, 10.0)
        if isinstance(self.action_space, spaces.Discrete):
            return scaled, F.one_hot(actions.long().flatten(), int(self.action_space.n)).float()
        low, high = (th.as_tensor(bound, device=actions.device) for bound in (self.action_space.low, self.action_space.high))
        actions = 2.0 * (actions.clamp(low, high) - low) / (high - low) - 1.0
        return scaled, actions.float().flatten(start_dim=1)

    def forward(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Compute the logits.

        :param observations: from ``inputs``
        :param actions: from ``inputs``
        :return: logits of D, shape (batch_size,)
        """
        return self.logits(th.cat([self.features_extractor(observations), actions], dim=1)).flatten()


def imitation_rewards(logits: th.Tensor) -> th.Tensor:
    """
    Compute the rewards of imitation.

    :param logits: of D, any shape
    :return: ``-log(1 - D)``, above 0: the more the expert would have done so, the greater
    """
    return F.softplus(logits)


def discriminator_loss(expert_logits: th.Tensor, policy_logits: th.Tensor) -> th.Tensor:
    """
    Compute the loss of the discriminator.

    :param expert_logits: shape (batch_size,)
    :param policy_logits: shape (batch_size,)
    :return: ``-(mean log D(expert) + mean log(1 - D(policy))) / 2``
    """
    return 0.5 * (F.softplus(-expert_logits).mean() + F.softplus(policy_logits).mean())
