"""Policies of SAC-Lag, with critics of the cost."""

from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac import policies as sac
from stable_baselines3.sac.policies import SACPolicy


class SACLagPolicy(SACPolicy):
    """
    SB3's ``SACPolicy``, whose parameters it has, with critics of the cost built as those of the reward are, and target copies
    of them.
    """

    cost_critic: ContinuousCritic
    cost_critic_target: ContinuousCritic

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.cost_critic = self.make_critic(self.actor.features_extractor if self.share_features_extractor else None)
        self.cost_critic_target = self.make_critic()
        self.cost_critic_target.load_state_dict(self.cost_critic.state_dict())
        self.cost_critic_target.set_training_mode(False)
        # A shared extractor is learned by the actor's loss alone (as in SB3's SAC)
        parameters = [
            parameter
            for name, parameter in self.cost_critic.named_parameters()
            if not (self.share_features_extractor and "features_extractor" in name)
        ]
        self.cost_critic.optimizer = self.optimizer_class(parameters, lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def set_training_mode(self, mode: bool) -> None:
        super().set_training_mode(mode)
        self.cost_critic.set_training_mode(mode)


MlpPolicy = SACLagPolicy


class CnnPolicy(SACLagPolicy, sac.CnnPolicy):
    """Policy for image observations: ``SACLagPolicy`` with the CNN of the DQN Nature paper as features extractor."""


class MultiInputPolicy(SACLagPolicy, sac.MultiInputPolicy):
    """Policy for Dict observations: ``SACLagPolicy`` with one features extractor per key."""
