"""Confidence-guided human-AI collaboration (C-HAC)."""

from sb3_chac.chac.chac import CHAC
from sb3_chac.chac.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CHAC", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
