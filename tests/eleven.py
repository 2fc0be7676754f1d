"""A small model of each of the eleven algorithms, for the tests that ask the same of all of them."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

import sb3_chac
from sb3_chac.common.demonstrations import Demonstrations
from sb3_chac.zoo.algorithms import ALGORITHMS

GUIDED = ("PVP", "DPVP", "CHAC", "HGDagger", "IWR")
OFFLINE = ("BC", "CQL")
ON_POLICY = ("PPOLag", "GAIL")
ALL = tuple(ALGORITHMS.values())


class Walk(gym.Env):
    """The position is the sum of a tenth of the actions. Episodes of 6 steps; ``info`` has a cost."""

    observation_space: spaces.Space = spaces.Box(-100, 100, (2,), np.float32)
    action_space: spaces.Space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.steps = self.np_random.uniform(-1, 1, 2).astype(np.float32), 0
        return self.position.copy(), {}

    def step(self, action):
        self.position = self.position + np.float32(0.1) * np.asarray(action, np.float32)
        self.steps += 1
        return self.position.copy(), -float(np.abs(self.position).max()), False, self.steps == 6, {"cost": 0.5}


def demonstrations(n=36, **columns):
    rng = np.random.default_rng(0)
    observations = rng.uniform(-1, 1, (n, 2)).astype(np.float32)
    ends = np.arange(n) % 6 == 5
    arrays = {
        "observations": observations,
        "actions": np.clip(-observations, -1, 1),
        "next_observations": observations * np.float32(0.9),
        "rewards": np.zeros(n),
        "terminations": np.zeros(n, bool),
        "truncations": ends,
        "episodes": np.arange(n) // 6,
    }
    spaces_of = {"observation_space": Walk.observation_space, "action_space": Walk.action_space}
    return Demonstrations(**(spaces_of | arrays | columns))


def make_any(name, env, policy="MlpPolicy", **kwargs):
    """:param name: of the class; it learns within few steps"""
    sizes = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "seed": 0, "device": "cpu"}
    if name in (*OFFLINE, "GAIL"):
        sizes["dataset"] = demonstrations()
    if name in ON_POLICY:
        sizes |= {"n_steps": 12, "n_epochs": 2}
    elif name not in OFFLINE:
        sizes |= {"buffer_size": 300}
    if name in ("HGDagger", "IWR"):
        sizes |= {"warm_up_steps": 8, "round_human_steps": 8, "n_rounds": None, "n_epochs": 1}
    elif name not in (*OFFLINE, *ON_POLICY):
        sizes |= {"learning_starts": 10}
    if name == "CHAC":
        sizes |= {"prefit_steps": 2}
    if name == "GAIL":
        sizes |= {"disc_batch_size": 8, "n_disc_updates": 2}
    if name in ("SACLag", "PPOLag"):
        sizes |= {"cost_limit": 1.0}
    return getattr(sb3_chac, name)(policy, env, **(sizes | kwargs))
