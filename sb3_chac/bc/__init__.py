"""Behaviour cloning (BC)."""

from sb3_chac.bc.bc import BC
from sb3_chac.bc.policies import CnnPolicy, MlpPolicy

__all__ = ["BC", "CnnPolicy", "MlpPolicy"]
