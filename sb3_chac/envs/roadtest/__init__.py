"""RoadTest-v0, a rehearsal of the paper's road test."""

from sb3_chac.envs.roadtest.env import RoadTestEnv

__all__ = ["RoadTestEnv"]
