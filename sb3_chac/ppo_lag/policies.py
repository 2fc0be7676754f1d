"""Policies of PPO-Lag, with a value function of the cost."""

from functools import partial

import numpy as np
import torch as th
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    BasePolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn


class CostActorCriticPolicy(ActorCriticPolicy):
    """
    SB3's ``ActorCriticPolicy``, whose parameters it has, with a value of the cost: a network built as that of the reward is,
    on the same features, and learned by the same optimizer.
    """

    cost_value_net: nn.Sequential

    def _build_mlp_extractor(self) -> None:
        super()._build_mlp_extractor()
        hidden = self.net_arch.get("vf", []) if isinstance(self.net_arch, dict) else self.net_arch
        self.cost_value_net = nn.Sequential(*create_mlp(self.features_dim, 1, hidden, self.activation_fn))
        if self.ortho_init:
            self.cost_value_net[:-1].apply(partial(self.init_weights, gain=np.sqrt(2)))
            self.init_weights(self.cost_value_net[-1], gain=1)

    def predict_cost_values(self, obs: PyTorchObs) -> th.Tensor:
        """
        Predict the costs to come.

        :param obs: batch of observations
        :return: discounted costs to come, shape (batch_size, 1)
        """
        return self.cost_value_net(BasePolicy.extract_features(self, obs, self.vf_features_extractor))

    def evaluate_actions_and_costs(
        self, obs: PyTorchObs, actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor | None]:
        """
        ``evaluate_actions`` and ``predict_cost_values``, with the features extracted once.

        :param obs: batch of observations
        :param actions: shape (batch_size, *action_shape)
        :return: values and cost values, both of shape (batch_size, 1), log likelihood of the actions and entropy of the action
            distribution (None if it has no analytical form), both of shape (batch_size,)
        """
        features = self.extract_features(obs)
        pi_features, vf_features = features if isinstance(features, tuple) else (features, features)
        distribution = self._get_action_dist_from_latent(self.mlp_extractor.forward_actor(pi_features))
        values = self.value_net(self.mlp_extractor.forward_critic(vf_features))
        return values, self.cost_value_net(vf_features), distribution.log_prob(actions), distribution.entropy()


MlpPolicy = CostActorCriticPolicy


class CnnPolicy(CostActorCriticPolicy, ActorCriticCnnPolicy):
    """Policy for image observations: ``CostActorCriticPolicy`` with the CNN of the DQN Nature paper as features extractor."""


class MultiInputPolicy(CostActorCriticPolicy, MultiInputActorCriticPolicy):
    """Policy for Dict observations: ``CostActorCriticPolicy`` with one features extractor per key."""
