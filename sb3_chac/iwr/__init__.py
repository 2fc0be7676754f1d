"""Intervention weighted regression (IWR)."""

from sb3_chac.bc.policies import CnnPolicy, MlpPolicy
from sb3_chac.iwr.iwr import IWR

__all__ = ["IWR", "CnnPolicy", "MlpPolicy"]
