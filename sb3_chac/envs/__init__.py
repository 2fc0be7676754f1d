"""Driving environments. Importing this module registers them with gymnasium (an installed package does it unasked)."""

from gymnasium.envs.registration import register, registry

# Name -> where it is
ENVIRONMENTS = {
    "SafeDrive-v0": "sb3_chac.envs.safedrive:SafeDriveEnv",
    "MetaDriveSafety-v0": "sb3_chac.envs.metadrive:MetaDriveSafetyEnv",
}
# Name -> keyword arguments for evaluations while something is being trained or tuned, on maps that are neither those of the
# training (100-119) nor those of the final test (1000-1049)
VALIDATION = {name: {"start_scenario": 2000, "num_scenarios": 50} for name in ENVIRONMENTS}
# Of which a process can have one only
ONE_PER_PROCESS = {"MetaDriveSafety-v0"}

# For rehearsals (no maps for validation)
REHEARSALS = {
    "RoadTest-v0": "sb3_chac.envs.roadtest:RoadTestEnv",
    "RemoteVehicle-v0": "sb3_chac.deploy.remote:RemoteVehicle",
}

for _name, _entry_point in (ENVIRONMENTS | REHEARSALS).items():
    if _name not in registry:
        register(_name, entry_point=_entry_point)
