"""Generative adversarial imitation learning (GAIL)."""

from stable_baselines3.ppo.policies import CnnPolicy, MlpPolicy

from sb3_chac.gail.gail import GAIL

__all__ = ["GAIL", "CnnPolicy", "MlpPolicy"]
