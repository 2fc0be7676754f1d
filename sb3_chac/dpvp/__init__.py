"""Distributional proxy value propagation (D-PVP)."""

from sb3_chac.dpvp.dpvp import DPVP
from sb3_chac.dpvp.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["DPVP", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
