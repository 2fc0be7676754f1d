"""Proxy value propagation (PVP)."""

from stable_baselines3.td3.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

from sb3_chac.pvp.pvp import PVP

__all__ = ["PVP", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
