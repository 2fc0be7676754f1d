"""Driving environments. Importing this module registers them with gymnasium (an installed package does it unasked)."""

from gymnasium.envs.registration import register, registry

# Name -> where it is
ENVIRONMENTS = {"SafeDrive-v0": "sb3_chac.envs.safedrive:SafeDriveEnv"}

for _name, _entry_point in ENVIRONMENTS.items():
    if _name not in registry:
        register(_name, entry_point=_entry_point)
