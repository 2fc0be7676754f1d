"""Small environments, experts and rules for the tests of sb3_chac.human."""

import math

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_chac.common.contract import TakeoverDisplay
from sb3_chac.human import InterventionWrapper, TakeoverRule

NOVICE = np.array([0.5, 0.0], np.float32)
EXPERT = np.array([-0.5, 0.25], np.float32)


class Integrator(gym.Env):
    """The position is the sum of the actions. ``executed`` lists what the environment got, as it got it."""

    observation_space: spaces.Space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, length=1000, infos=None):
        self.length, self.infos, self.executed = length, infos or {}, []

    def obs(self):
        return self.position.copy()

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.position = self.np_random.normal(size=2).astype(np.float32)
        self.steps = 0
        return self.obs(), {}

    def step(self, action):
        self.executed.append(action)
        self.position = self.position + np.asarray(action, np.float32)
        self.steps += 1
        return self.obs(), 0.0, self.steps == self.length, False, self.infos


class DictIntegrator(Integrator):
    observation_space = spaces.Dict({"position": Integrator.observation_space, "speed": spaces.Box(-1, 1, (1,), np.float32)})

    def obs(self):
        return {"position": super().obs(), "speed": np.zeros(1, np.float32)}


class NoisyDriver:
    """Remembers how it was called. The noise comes from its seed."""

    def __init__(self):
        self.seeds, self.observations, self.rng = [], [], np.random.default_rng(0)

    def reset(self, seed=None):
        self.seeds.append(seed)
        if seed is not None:
            self.rng = np.random.default_rng(seed)

    def __call__(self, observation):
        self.observations.append(observation)
        return self.rng.uniform(-1, 1, 2)


class PredictingDriver(NoisyDriver):
    def time_to_trouble(self, observation, action):
        return 0.5 if action[0] > 0 else math.inf


class DrivenIntegrator(Integrator, TakeoverDisplay):
    """Has scripted drivers, as SafeDrive has, and a display."""

    hud = None
    drivers_made = 0

    def scripted_driver(self, name):
        self.drivers_made += 1
        return {"scripted": PredictingDriver, "scripted-ideal": NoisyDriver}[name]()

    def render(self):
        return self.hud


class Script(TakeoverRule):
    """A rule that takes its decisions from a list, and False when it is at its end."""

    def __init__(self, decisions):
        self.decisions, self.resets, self.human_driving = iter(decisions), 0, []

    def reset(self):
        self.resets += 1

    def __call__(self, observation, novice_action, expert_action, human_driving):
        self.human_driving.append(human_driving)
        return next(self.decisions, False)


def constant(observation):
    return EXPERT


def bits(text):
    return [character == "1" for character in text]


def armed(rule="always", expert=constant, env=None, **kwargs):
    wrapped = InterventionWrapper(env or Integrator(), expert, rule, armed=True, **kwargs)
    wrapped.reset(seed=0)
    return wrapped


def drive(env, n_steps, key="takeover"):
    return [env.step(NOVICE)[4][key] for _ in range(n_steps)]
