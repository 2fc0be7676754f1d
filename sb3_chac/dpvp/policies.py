"""Policies of D-PVP."""

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor

from sb3_chac.dsac.policies import DSACPolicy


class DPVPPolicy(DSACPolicy):
    """
    ``DSACPolicy`` and an average of the actor's parameters over time, which acts when ``deterministic``.

    The parameters are those of ``DSACPolicy``, but for the default of ``optimizer_class``.

    :param optimizer_class: Optimizer of the actor and the critics; AdamW, whose ``weight_decay`` the algorithm sets
    """

    averaged_actor: Actor

    def __init__(self, *args: Any, optimizer_class: type[th.optim.Optimizer] = th.optim.AdamW, **kwargs: Any):
        super().__init__(*args, optimizer_class=optimizer_class, **kwargs)  # type: ignore[misc]

    def _build(self, lr_schedule: Schedule) -> None:
        if self.optimizer_class is th.optim.AdamW:
            self.optimizer_kwargs = {"weight_decay": 0.0, **self.optimizer_kwargs}
        super()._build(lr_schedule)
        self.averaged_actor = self.make_actor()
        self.averaged_actor.load_state_dict(self.actor.state_dict())
        self.averaged_actor.set_training_mode(False)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.averaged_actor(observation, deterministic) if deterministic else self.actor(observation)


MlpPolicy = DPVPPolicy


class CnnPolicy(DPVPPolicy):
    """Policy for image observations: ``DPVPPolicy`` with the CNN of the DQN Nature paper as features extractor."""

    default_features_extractor: ClassVar[type[BaseFeaturesExtractor]] = NatureCNN


class MultiInputPolicy(DPVPPolicy):
    """Policy for Dict observations: ``DPVPPolicy`` with one features extractor per key."""

    default_features_extractor: ClassVar[type[BaseFeaturesExtractor]] = CombinedExtractor
