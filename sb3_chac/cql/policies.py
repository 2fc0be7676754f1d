"""Policies of CQL."""

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac import policies as sac
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from sb3_chac.common.actors import use_fast_actor
from sb3_chac.common.mlp import use_fast_mlps


class CQLPolicy(SACPolicy):
    """
    SB3's SACPolicy, see there for the parameters. It also holds the logarithms of the entropy coefficient and of the
    conservative term's weight, so that ``get_parameters()`` and ``set_parameters()`` carry all that was learned.
    """

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        # Set and, if so wanted, learned by the algorithm
        self.log_ent_coef = nn.Parameter(th.zeros(1, device=self.device))
        self.log_conservative_weight = nn.Parameter(th.zeros(1, device=self.device))

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        actor = super().make_actor(features_extractor)
        use_fast_actor(actor)
        return actor

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        critic = super().make_critic(features_extractor)
        use_fast_mlps(critic)
        return critic


MlpPolicy = CQLPolicy


class CnnPolicy(CQLPolicy, sac.CnnPolicy):
    """Policy for image observations: ``CQLPolicy`` with the CNN of the DQN Nature paper as features extractor."""
