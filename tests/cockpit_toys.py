"""A drive without a window: a car that is a point, and what stands around it."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_chac.cockpit.person import Person
from sb3_chac.cockpit.recording import CrashSafeRecorder
from sb3_chac.cockpit.session import Session
from sb3_chac.cockpit.wrapper import Cockpit
from sb3_chac.human import InterventionWrapper


class Car(gym.Env):
    """A point on a line: the pedals are its acceleration. ``executed`` lists the actions."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space = spaces.Box(-1e6, 1e6, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (2,), np.float32)
    render_mode = "rgb_array"

    def __init__(self, length=30):
        self.length, self.executed = length, []

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.speed, self.steps = 3.0, 0
        return self.obs(), {"speed": self.speed}

    def obs(self):
        return np.array([self.speed, self.steps], np.float32)

    def step(self, action):
        self.executed.append(np.array(action))
        self.speed = max(self.speed + float(action[1]), 0.0)
        self.steps += 1
        return self.obs(), 1.0, self.steps == self.length, False, {"speed": self.speed, "cost": 0.5}

    def render(self):
        return np.zeros((6, 8, 3), np.uint8)


def cockpit(tmp_path, device, car=None, rate=1000.0):
    drive = Session(Person(device), rate)
    car = car or Car()
    watched = InterventionWrapper(car, drive.person, drive.person.drives)
    env = Cockpit(watched, drive, CrashSafeRecorder(tmp_path, car, str(tmp_path / "drive-v0"), "test", 0.1))
    drive.go_on()
    return env, drive, car
