"""Tanh-Gaussian actors, as SB3's SAC has them, whose samples and likelihoods take a handful of operations."""

import math

import torch as th
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.sac.policies import Actor

from sb3_chac.common.mlp import use_fast_mlps


class FastSquashedGaussian(SquashedDiagGaussianDistribution):
    """
    SB3's distribution, with the same random numbers. The likelihood of a sample mean + std noise is that of the noise,
    and ``torch.distributions`` with its checks is left out.
    """

    def actions_from_params(self, mean_actions: th.Tensor, log_std: th.Tensor, deterministic: bool = False) -> th.Tensor:
        if deterministic:
            return th.tanh(mean_actions)
        return th.tanh(mean_actions + log_std.exp() * th.randn_like(mean_actions))

    def log_prob_from_params(self, mean_actions: th.Tensor, log_std: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        noise = th.randn_like(mean_actions)
        actions = th.tanh(mean_actions + log_std.exp() * noise)
        log_prob = -(0.5 * noise.square() + log_std + th.log(1 - actions.square() + self.epsilon)).sum(dim=1)
        return actions, log_prob - 0.5 * math.log(2 * math.pi) * mean_actions.shape[1]


def use_fast_actor(actor: Actor) -> None:
    """Make an actor evaluate and sample fast; parameters, their names and what it samples stay the same."""
    use_fast_mlps(actor)
    if type(actor.action_dist) is SquashedDiagGaussianDistribution:
        actor.action_dist = FastSquashedGaussian(actor.action_dist.action_dim, actor.action_dist.epsilon)
