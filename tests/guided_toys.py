"""Small models and environments for the tests of the algorithms that learn from takeovers."""

import math

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv
from takeover_toys import Integrator, Script, bits, constant

from sb3_chac import CHAC, DPVP, PVP
from sb3_chac.common.buffers import DualReplayBufferSamples
from sb3_chac.human import InterventionWrapper

ALGORITHMS = [PVP, DPVP, CHAC]


class Limited(Integrator):
    """An Integrator whose episodes are cut off by a time limit, unless they end before; its actions are in [low, high]."""

    observation_space: spaces.Space = spaces.Box(-1e6, 1e6, (2,), np.float32)

    def __init__(self, length=1000, limit=1000, low=-1.0, high=1.0, infos=None):
        super().__init__(length, infos)
        self.limit = limit
        self.action_space = spaces.Box(np.float32(low), np.float32(high), (2,), np.float32)

    def step(self, action):
        obs, _, terminated, _, infos = super().step(action)
        return obs, float(self.steps), terminated, self.steps == self.limit, dict(infos)


class Witness(Script):
    """A script that remembers what the novice proposed."""

    def __init__(self, text):
        super().__init__(bits(text))
        self.proposed = []

    def __call__(self, observation, novice_action, expert_action, human_driving):
        self.proposed.append(novice_action.copy())
        return super().__call__(observation, novice_action, expert_action, human_driving)


class Tracking(gym.Env):
    """The best action is a fixed function of where one is, and one is somewhere else at each step."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.jump(), {}

    def jump(self):
        self.obs = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.obs.copy()

    def step(self, action):
        cost = float(np.abs(action - tracking_expert(self.obs)).mean())
        self.steps += 1
        return self.jump(), -cost, False, self.steps >= 25, {"cost": cost}


def tracking_expert(obs):
    """:param obs: shape (..., 2)"""
    x, y = obs[..., 0], obs[..., 1]
    return np.stack([0.6 * np.sin(math.pi * x), 0.5 * y - 0.3 * x], axis=-1).astype(np.float32)


def scripted(*texts, expert=constant, budget=None, normalize=None, **kwargs):
    """Vectorised Integrators, each with a human who follows a script: "0110" is a takeover of two steps after the first."""

    def make(text):
        return lambda: InterventionWrapper(Limited(**kwargs), expert, Witness(text), budget)

    return DummyVecEnv([make(text) for text in texts])


def wrapper(model, idx=0):
    return model.get_env().envs[idx]


def make_guided(algorithm, env=None, **kwargs):
    """A small model; it learns from step 20 on."""
    kwargs = {"learning_starts": 20, "batch_size": 8, "buffer_size": 500, "seed": 0, "policy_kwargs": {}, **kwargs}
    kwargs["policy_kwargs"] = dict(net_arch=[8]) | kwargs["policy_kwargs"]
    if algorithm is CHAC:
        kwargs = {"prefit_steps": 3} | kwargs
    return algorithm(kwargs.pop("policy", "MlpPolicy"), scripted("01" * 500) if env is None else env, **kwargs)


def silent(model):
    model.set_logger(configure(None, []))
    return model


def column(store, name):
    """The filled rows of one column, in the order in which they came (as long as the ring is not full)."""
    array = store.arrays[name][: len(store)]
    return array[:, 0] if array.shape[1:] == (1,) else array


def parameters(model, prefix=""):
    return {name: param.clone() for name, param in model.policy.state_dict().items() if name.startswith(prefix)}


def same(a, b):
    return a.keys() == b.keys() and all(th.equal(a[name], b[name]) for name in a)


def make_batch(observations, actions, takeovers, **columns):
    """A batch whose other columns, one value a row, are zero (novice_actions: the executed actions)."""
    n_rows = len(actions)
    zeros = th.zeros(n_rows, 1)
    as_column = {name: th.as_tensor(value, dtype=th.float32).reshape(n_rows, -1) for name, value in columns.items()}
    actions = th.as_tensor(actions, dtype=th.float32).reshape(n_rows, -1)
    observations = th.as_tensor(observations, dtype=th.float32).reshape(n_rows, -1)
    return DualReplayBufferSamples(
        observations,
        actions,
        as_column.get("next_observations", observations),
        as_column.get("dones", zeros),
        as_column.get("rewards", zeros),
        as_column.get("discounts"),
        as_column.get("novice_actions", actions),
        th.as_tensor(takeovers, dtype=th.float32).reshape(n_rows, 1),
        as_column.get("takeover_starts", zeros),
        as_column.get("costs", zeros),
        as_column.get("takeovers_follow", zeros),
    )
