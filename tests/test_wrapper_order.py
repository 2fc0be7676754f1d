"""
Whatever wrappers are above and below the takeover, in whatever order: what is stored is what was executed, or it is refused.

``python tests/test_wrapper_order.py`` goes through all orders of up to two wrappers and prints how many rows were compared.
"""

import itertools
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import ClipAction, RescaleAction, TimeLimit, TransformAction, TransformObservation

from sb3_chac import PVP
from sb3_chac.human import InterventionWrapper

STEPS = 24


class Line(gym.Env):
    """Notes the actions that arrive, in its units."""

    observation_space = gym.spaces.Box(-9, 9, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self):
        self.arrived = []

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.arrived.append(np.array(action, np.float64))
        self.steps += 1
        return np.full(2, self.steps, np.float32), 0.0, self.steps == 7, False, {}


class Halving(gym.ActionWrapper):
    """The space stays."""

    def action(self, action):
        return np.asarray(action) / 2


class Stepping(gym.Wrapper):
    """Likewise, but no ``ActionWrapper``: nobody sees it but by what arrives."""

    def step(self, action):
        return self.env.step(np.asarray(action) / 2)


class Reporting(gym.Wrapper):
    """Every other step the human acts, and it is reported."""

    def __init__(self, env):
        super().__init__(env)
        self.rng, self.human = np.random.default_rng(1), False

    def step(self, action):
        self.human = not self.human
        low, high = np.maximum(self.action_space.low, -5), np.minimum(self.action_space.high, 5)
        executed = self.rng.uniform(low, high).astype(np.float32) if self.human else action
        observation, reward, terminated, truncated, info = self.env.step(executed)
        return observation, reward, terminated, truncated, info | {"is_intervention": self.human, "intervene_action": executed}


def asked(env):
    rng = np.random.default_rng(1)
    low, high = np.maximum(env.action_space.low, -5), np.minimum(env.action_space.high, 5)

    def expert(observation):
        return rng.uniform(low, high).astype(np.float32)

    return InterventionWrapper(env, expert, lambda *_: bool(rng.random() < 0.5))


WRAPPERS = {
    "to [0, 1]": lambda env: RescaleAction(env, np.float32(0), np.float32(1)),
    "to [-3, 3]": lambda env: RescaleAction(env, np.float32(-3), np.float32(3)),
    "clip": ClipAction,
    "negate": lambda env: TransformAction(env, np.negative, env.action_space),
    "halve": Halving,
    "halve unseen": Stepping,
    "time limit": lambda env: TimeLimit(env, 5),
    "observation": lambda env: TransformObservation(env, lambda observation: observation / 2, env.observation_space),
}
HARMLESS = ("time limit", "observation")
SOURCES = {"asked": asked, "reported": Reporting}
# Inner and outer wrappers, in their order
STACKS = [(inner, outer) for n in range(3) for both in itertools.product(WRAPPERS, repeat=n) for inner, outer in
          ((both[:k], both[k:]) for k in range(n + 1))]  # fmt: skip


def arrives(env, action):
    """
    :param action: handed to the outermost wrapper
    :return: what it is when it arrives at ``Line``
    """
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.ActionWrapper):
            action = env.action(action)
        elif isinstance(env, Stepping):
            action = np.asarray(action) / 2
        env = env.env
    return action


def rows_of(source, inner, outer):
    """
    :param source: of the takeovers, key of ``SOURCES``
    :param inner: wrappers below the takeover, the innermost first
    :param outer: wrappers above it
    :return: how many rows were stored and found right, and the complaint if there was one
    """
    env = line = Line()
    model = None
    kwargs = {"policy_kwargs": {"net_arch": [4]}, "buffer_size": 100, "learning_starts": 1000, "seed": 0, "device": "cpu"}
    try:
        for wrap in (*map(WRAPPERS.get, inner), SOURCES[source], *map(WRAPPERS.get, outer)):
            env = wrap(env)
        model = PVP("MlpPolicy", env, **kwargs)
        model.learn(STEPS)
        complaint = ""
    except ValueError as error:
        complaint = str(error)
    if model is None:
        return 0, complaint
    buffer = model.replay_buffer
    # The order of the stores is that of the steps: by who drove
    human = [row for row in buffer.human.arrays["action"][: len(buffer.human)]]
    novice = [row for row in buffer.novice.arrays["action"][: len(buffer.novice)]]
    stored = [model.policy.unscale_action(np.asarray(row)) for row in (*human, *novice)]
    expected = sorted(tuple(np.round(arrives(env, action), 4)) for action in stored)
    executed = sorted(tuple(np.round(action, 4)) for action in line.arrived[: len(stored)])
    np.testing.assert_allclose(expected, executed, atol=2e-3)
    assert complaint or (len(human) > 3 and len(novice) > 3)
    return len(stored), complaint


def check(source, inner, outer):
    """
    :return: number of rows that were stored, all of them right
    """
    rows, complaint = rows_of(source, inner, outer)
    changing = [name for name in outer if name not in HARMLESS]
    if not changing and "clip" not in inner:  # whose bounds are infinite
        assert rows == STEPS and not complaint, complaint
    else:
        assert rows == 0 and complaint, f"{rows} rows stored"
        # The last one is gymnasium's: RescaleAction above ClipAction, whose bounds are infinite
        named = ("takes over in", "changes actions between", "must have finite bounds", "For unbounded components")
        assert any(words in complaint for words in named), complaint
    return rows


def can_be_seen(source, outer):
    """Of a report it cannot be told whether a wrapper with a ``step`` of its own above it made it, or changes actions."""
    return source != "reported" or "halve unseen" not in outer


CASES = [(source, *stack) for source in SOURCES for stack in STACKS if can_be_seen(source, stack[1])]
FEW = [case for case in CASES if len(case[1]) + len(case[2]) < 2] + CASES[::17]


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.filterwarnings("ignore")
def test_what_is_stored_is_what_was_executed(source):
    rows = [check(*case) for case in FEW if case[0] == source]
    assert len(rows) >= 15 and sum(rows) >= 8 * STEPS and rows.count(0) >= 4


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    counts = {case: check(*case) for case in CASES}
    refused = sum(count == 0 for count in counts.values())
    print(f"{len(counts)} orders: {refused} refused, in the others all {sum(counts.values())} rows stored as executed")
