from sb3_chac.envs.roadtest.env import RoadTestEnv

__all__ = ["RoadTestEnv"]
