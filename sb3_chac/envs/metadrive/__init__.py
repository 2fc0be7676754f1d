"""MetaDriveSafety-v0."""

from sb3_chac.envs.metadrive.env import PRESETS, MetaDriveSafetyEnv

__all__ = ["PRESETS", "MetaDriveSafetyEnv"]
