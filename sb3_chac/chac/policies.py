"""Policies of C-HAC, with shared control."""

from typing import Any, ClassVar, NamedTuple

import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor

from sb3_chac.common.critics import DistributionalCritic
from sb3_chac.common.distributional import probability_of_improvement
from sb3_chac.common.linear import is_traced
from sb3_chac.dpvp.policies import DPVPPolicy

CONTROLS = ("guided", "self", "shared")


class Choice(NamedTuple):
    """Decisions of shared control in ``batch_size`` states."""

    actions: th.Tensor  # executed, shape (batch_size, action_dim)
    self_drives: th.Tensor  # whether they are pi_r's, shape (batch_size,), as all below
    confidence: th.Tensor  # P(Q_r > Q_g)
    q_self: th.Tensor
    q_guided: th.Tensor
    std_self: th.Tensor
    std_guided: th.Tensor


class CHACPolicy(DPVPPolicy):
    """
    The two policies of C-HAC and what decides between them. To ``DPVPPolicy`` (pi_g is its ``actor``, Z_g its ``critic``) it
    adds the confidence return distribution Z_c (``confidence_critic``), the self-learning policy pi_r (``self_actor``),
    target copies of both, and the average of pi_r's parameters that acts when ``deterministic``.

    In stage 1, and as ``control="guided"``, pi_g acts; as ``control="self"``, pi_r; as ``control="shared"``, pi_r where::

        P(Q_r > Q_g) = Phi( (Q_c(s, a_r) - Q_c(s, a_g)) / sqrt(sigma_c(s, a_r)^2 + sigma_c(s, a_g)^2) ) > 1 - delta

    and pi_g elsewhere. The parameters are those of ``DPVPPolicy``, and by name:

    :param delta: accepted probability that pi_r does worse, 0 (pi_g always acts) to 1
    :param sigma_scale: factor of sigma_c in the confidence
    :param max_deviation: of pi_r's action from pi_g's in each dimension, both scaled to [-1, 1], when it acts; 2: no limit
    :param control: who acts in stage 2: "guided", "self" or "shared"
    """

    confidence_critic: DistributionalCritic
    confidence_critic_target: DistributionalCritic
    self_actor: Actor
    self_actor_target: Actor
    averaged_self_actor: Actor
    stage: th.Tensor

    def __init__(
        self,
        *args: Any,
        delta: float = 0.15,
        sigma_scale: float = 1.0,
        max_deviation: float = 2.0,
        control: str = "shared",
        **kwargs: Any,
    ):
        super().__init__(*args, **kwargs)
        self.delta = delta
        self.sigma_scale = sigma_scale
        self.max_deviation = max_deviation
        self.control = control
        self.last_choice: Choice | None = None
        # Saved with the parameters: a loaded policy acts as it did
        self.register_buffer("stage", th.tensor(1.0, device=self.device))

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.confidence_critic, self.confidence_critic_target = (self.make_critic() for _ in range(2))
        self.self_actor, self.self_actor_target, self.averaged_self_actor = (self.make_actor() for _ in range(3))
        self.confidence_critic_target.load_state_dict(self.confidence_critic.state_dict())
        # Its features extractor is its own, whatever the critic of pi_g does: nothing but the loss of Z_c teaches it
        self.confidence_critic.share_features_extractor = False
        for network in (self.confidence_critic, self.self_actor):
            network.optimizer = self.optimizer_class(
                network.parameters(),
                lr=lr_schedule(1),  # type: ignore[call-arg]
                **self.optimizer_kwargs,
            )
        for copy in (self.confidence_critic_target, self.self_actor_target, self.averaged_self_actor):
            copy.set_training_mode(False)

    def start_stage_2(self) -> None:
        """pi_g is its average from now on. pi_r goes on from there, with a fresh optimizer."""
        for actor in (self.actor, self.self_actor, self.self_actor_target, self.averaged_self_actor):
            actor.load_state_dict(self.averaged_actor.state_dict())
        self.self_actor.optimizer.state.clear()
        self.stage.fill_(2)

    def choose(self, observation: PyTorchObs, self_actions: th.Tensor, critic: DistributionalCritic) -> Choice:
        """
        Decide which policy acts in each state (T_c).

        :param observation: batch of observations
        :param self_actions: of pi_r, shape (batch_size, action_dim); as near to a_g, the mode of pi_g, as ``max_deviation``
            asks, they are a_r
        :param critic: Z_c, or its target copy
        """
        guided_actions = self.actor(observation, deterministic=True)
        self_actions = self._near(self_actions, guided_actions)
        q_self, std_self = critic.pessimistic(observation, self_actions)
        q_guided, std_guided = critic.pessimistic(observation, guided_actions)
        scaled = self.sigma_scale * std_self, self.sigma_scale * std_guided
        confidence = probability_of_improvement(q_self, scaled[0], q_guided, scaled[1])
        # For delta 1 also where the confidence is too small for a float
        self_drives = confidence > 1 - self.delta if self.delta < 1 else th.ones_like(confidence, dtype=th.bool)
        actions = th.where(self_drives.unsqueeze(1), self_actions, guided_actions)
        return Choice(actions, self_drives, confidence, q_self, q_guided, std_self, std_guided)

    def _near(self, self_actions: th.Tensor, guided_actions: th.Tensor) -> th.Tensor:
        """Limit the deviation of pi_r's actions from pi_g's; both and the result of shape (batch_size, action_dim)."""
        return guided_actions + (self_actions - guided_actions).clamp(-self.max_deviation, self.max_deviation)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if is_traced() and self.control != "guided":  # a branch on a tensor would be lost
            guided_actions = super()._predict(observation, deterministic)
            actions, _ = self._predict_in_stage_2(observation, deterministic)
            return th.where(self.stage == 1, guided_actions, actions)
        if self.control == "guided" or self.stage == 1:
            return super()._predict(observation, deterministic)
        actions, self.last_choice = self._predict_in_stage_2(observation, deterministic)
        return actions

    def _predict_in_stage_2(self, observation: PyTorchObs, deterministic: bool) -> tuple[th.Tensor, Choice | None]:
        """
        Act in stage 2, by pi_r or by shared control.

        :return: the actions of pi_r, or of shared control with what it decided
        """
        self_actions = self.averaged_self_actor(observation, True) if deterministic else self.self_actor(observation)
        if self.control == "self":
            return self._near(self_actions, self.actor(observation, deterministic=True)), None
        choice = self.choose(observation, self_actions, self.confidence_critic)
        return choice.actions, choice

    def reset_noise(self, batch_size: int = 1) -> None:
        super().reset_noise(batch_size)
        self.self_actor.reset_noise(batch_size=batch_size)
        self.self_actor_target.reset_noise(batch_size=batch_size)

    def set_training_mode(self, mode: bool) -> None:
        super().set_training_mode(mode)
        self.confidence_critic.set_training_mode(mode)
        self.self_actor.set_training_mode(mode)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in ("delta", "sigma_scale", "max_deviation", "control")}
        return super()._get_constructor_parameters() | own


MlpPolicy = CHACPolicy


class CnnPolicy(CHACPolicy):
    """Policy for image observations: ``CHACPolicy`` with the CNN of the DQN Nature paper as features extractor."""

    default_features_extractor: ClassVar[type[BaseFeaturesExtractor]] = NatureCNN


class MultiInputPolicy(CHACPolicy):
    """Policy for Dict observations: ``CHACPolicy`` with one features extractor per key."""

    default_features_extractor: ClassVar[type[BaseFeaturesExtractor]] = CombinedExtractor
