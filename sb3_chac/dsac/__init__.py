"""Distributional soft actor-critic (DSAC)."""

from sb3_chac.dsac.dsac import DSAC
from sb3_chac.dsac.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["DSAC", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
