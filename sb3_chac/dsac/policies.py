"""Policies of DSAC."""

from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from sb3_chac.common.actors import use_fast_actor
from sb3_chac.common.critics import DistributionalCritic


class DSACPolicy(SACPolicy):
    """
    Actor (the tanh-Gaussian of SB3's SAC), distributional critics, and target copies of both.
    The entropy coefficient lives here too, so that ``get_parameters()`` and ``set_parameters()`` carry all that was learned.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule of the actor and the critics
    :param net_arch: Hidden layers of actor and critics, [256, 256, 256] by default, or ``dict(pi=[...], qf=[...])``
    :param activation_fn: Activation function
    :param use_sde: Whether to use State Dependent Exploration
    :param log_std_init: Initial value for the log standard deviation (gSDE)
    :param use_expln: Use ``expln()`` instead of ``exp()`` for a positive standard deviation (gSDE)
    :param clip_mean: Clip the mean output (gSDE)
    :param features_extractor_class: Features extractor to use, by default the one that fits the observations
    :param features_extractor_kwargs: Keyword arguments of the features extractor
    :param normalize_images: Whether to divide images by 255
    :param optimizer_class: Optimizer of the actor and the critics
    :param optimizer_kwargs: Additional keyword arguments of the optimizer; for Adam and AdamW ``fused=True`` unless given
    :param n_critics: Number of critics
    :param share_features_extractor: Whether actor and critics share the features extractor (learned by the actor's loss)
    """

    default_features_extractor: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor
    actor_target: Actor
    critic: DistributionalCritic  # type: ignore[assignment]
    critic_target: DistributionalCritic  # type: ignore[assignment]

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.GELU,
        use_sde: bool = False,
        log_std_init: float = -3,
        use_expln: bool = False,
        clip_mean: float = 2.0,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
        share_features_extractor: bool = False,
    ):
        if optimizer_class in (th.optim.Adam, th.optim.AdamW):
            optimizer_kwargs = {"fused": True, **(optimizer_kwargs or {})}
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            [256, 256, 256] if net_arch is None else net_arch,
            activation_fn,
            use_sde,
            log_std_init,
            use_expln,
            clip_mean,
            features_extractor_class or self.default_features_extractor,
            features_extractor_kwargs,
            normalize_images,
            optimizer_class,
            optimizer_kwargs,
            n_critics,
            share_features_extractor,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.actor_target = self.make_actor()
        self.actor_target.load_state_dict(self.actor.state_dict())
        self.actor_target.set_training_mode(False)
        # Set and, if "auto", learned by the algorithm
        self.log_ent_coef = nn.Parameter(th.zeros(1, device=self.device))

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        actor = super().make_actor(features_extractor)
        use_fast_actor(actor)
        return actor

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> DistributionalCritic:  # type: ignore[override]
        critic_kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return DistributionalCritic(**critic_kwargs).to(self.device)

    def reset_noise(self, batch_size: int = 1) -> None:
        self.actor.reset_noise(batch_size=batch_size)
        self.actor_target.reset_noise(batch_size=batch_size)


MlpPolicy = DSACPolicy


class CnnPolicy(DSACPolicy):
    """Policy for image observations: ``DSACPolicy`` with the CNN of the DQN Nature paper as features extractor."""

    default_features_extractor = NatureCNN


class MultiInputPolicy(DSACPolicy):
    """Policy for Dict observations: ``DSACPolicy`` with one features extractor per key."""

    default_features_extractor = CombinedExtractor
