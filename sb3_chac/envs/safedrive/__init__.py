"""SafeDrive-v0."""

from sb3_chac.envs.safedrive.env import SafeDriveEnv

__all__ = ["SafeDriveEnv"]
