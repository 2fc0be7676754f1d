"""Environments with a cost in ``info``, for the tests of the algorithms that it constrains."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class SpeedLimit(gym.Env):
    """
    The action is the speed driven and the reward; the observation is the limit, which changes at each step. It costs 1 to
    exceed it. Episodes of 20 steps: full speed always returns 20 and costs 20, keeping to the limit returns 0 and costs 0.
    """

    observation_space: spaces.Space = spaces.Box(-1, 1, (1,), np.float32)
    action_space: spaces.Space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.next_limit(), {}

    def next_limit(self):
        self.limit = self.np_random.uniform(-1, 1)
        return self.obs()

    def obs(self):
        return np.array([self.limit], np.float32)

    def speed(self, action):
        return float(np.squeeze(action))

    def step(self, action):
        speed = self.speed(action)
        cost = float(speed > self.limit)
        self.steps += 1
        return self.next_limit(), speed, False, self.steps >= 20, {"cost": cost}


class SpeedLimitGears(SpeedLimit):
    """Five speeds from -1 to 1."""

    action_space = spaces.Discrete(5)

    def speed(self, action):
        return int(action) / 2 - 1


class SpeedLimitDict(SpeedLimit):
    """The limit under two names."""

    observation_space = spaces.Dict({"sign": SpeedLimit.observation_space, "map": SpeedLimit.observation_space})

    def obs(self):
        return {"sign": super().obs(), "map": super().obs()}


class SpeedLimitPicture(SpeedLimit):
    """The limit as the brightness of an image."""

    observation_space = spaces.Box(0, 255, (36, 36, 1), np.uint8)

    def obs(self):
        return np.full((36, 36, 1), 255 * (self.limit + 1) / 2, np.uint8)


class Bill(gym.Env):
    """
    Costs as given, 0 ever after; the observation is the number of steps so far, 0 if ``blind``. Ends after ``length`` steps,
    by the time limit if ``truncated``.
    """

    observation_space = spaces.Box(0, 100, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, costs=(), length=4, truncated=True, blind=False):
        self.costs, self.length, self.truncated, self.blind = dict(enumerate(costs)), length, truncated, blind

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        cost = self.costs.get(self.steps, 0.0)
        self.steps += 1
        is_over = self.steps == self.length
        info = {} if cost is None else {"cost": cost}
        obs = np.full(1, 0 if self.blind else self.steps, np.float32)
        return obs, 1.0, is_over and not self.truncated, is_over and self.truncated, info
