"""A drive along a line that costs next to nothing to simulate, with all that an evaluation asks of a driving environment."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np


class ToyDriver:
    """
    Full throttle, until it has driven ``stop_after`` metres.
    """

    def __init__(self, env: "ToyDrive", stop_after: float) -> None:
        self.env = env
        self.stop_after = stop_after

    def reset(self, seed: int) -> None:
        self.seed = seed

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        assert self.seed == self.env.seed_of_reset
        return np.array([1.0 if self.env.position[0] < self.stop_after else 0.0], dtype=np.float32)


class ToyDrive(gym.Env):
    """
    Scenario k is a road of ``length`` + k % 3 metres with an obstacle at 2 m, which costs 1; 1 m/step at full throttle.
    """

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, length: int = 4, reward: float = 1.0, render_mode: str | None = None) -> None:
        self.length, self.reward, self.render_mode = length, reward, render_mode
        self.observation_space = gym.spaces.Box(-10.0, 10.0, (2,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.seed_of_reset, self.scenario = seed, options["scenario"] if options else 0
        self.position, self.n_steps, self.collisions = np.zeros(2), 0, 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        assert self.action_space.contains(action)
        before, self.n_steps = self.position[0], self.n_steps + 1
        self.position += [float(action[0]), 0.1]
        end = self.length + self.scenario % 3
        hit = before < 2.0 <= self.position[0]
        self.collisions += hit
        arrived = bool(self.position[0] >= end)
        info = {
            "cost": float(hit),
            "is_success": arrived,
            "route_completion": min(1.0, self.position[0] / end),
            "collisions": np.int64(self.collisions),
            "noise": self.np_random.random(),
            "undefined": np.nan,
            "lidar": np.zeros(3),
        }
        return self._observation(), self.reward, arrived, self.n_steps >= 10, info

    def _observation(self) -> np.ndarray:
        return np.array([self.position[0], self.n_steps / 10], dtype=np.float32)

    def scripted_driver(self, name: str) -> ToyDriver:
        return ToyDriver(self, {"scripted": np.inf, "lazy": 5.0}[name])

    def plot_map(self, axes: Any) -> None:
        axes.plot([0, self.length + self.scenario % 3], [0, 0], color="lightgrey", linewidth=8)

    def render(self) -> np.ndarray:
        image = np.zeros((33, 65, 3), dtype=np.uint8)
        image[:, 5 * int(self.position[0]) :] = 200
        return image


class BlindDrive(gym.Env):
    """One step, no scenarios, no info, discrete actions."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        assert options is None
        return self.np_random.uniform(-1, 1, 2).astype(np.float32), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        return np.zeros(2, np.float32), {0: 0.0, 1: 2.0}[action], True, False, {}


class StillDrive(gym.Env):
    """The spaces of ToyDrive, but nothing to draw."""

    observation_space = gym.spaces.Box(-10.0, 10.0, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}


gym.register("ToyDrive-v0", ToyDrive)
gym.register("StillDrive-v0", "toy_env:StillDrive")
gym.register("BlindDrive-v0", "toy_env:BlindDrive")
