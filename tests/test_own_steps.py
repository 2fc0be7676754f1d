"""Whoever else moves the training environments, in a callback or between two calls of learn: nothing wrong is stored."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from eleven import ALL, GUIDED, OFFLINE, ON_POLICY, Walk, make_any
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_chac.common.own_steps import count_calls

HUMAN = np.array([0.25, -0.25], np.float32)
LEARNERS = [name for name in ALL if name not in OFFLINE]
each = pytest.mark.parametrize("name", LEARNERS)


class Told(Walk):
    """It reports itself that a person drives steps 2 and 3 of each episode."""

    def step(self, action):
        drives = self.steps in (2, 3)
        observation, reward, terminated, truncated, info = super().step(HUMAN if drives else action)
        return observation, reward, terminated, truncated, info | {"is_intervention": drives, "intervene_action": HUMAN}


class DictTold(Told):
    observation_space = spaces.Dict({"position": Walk.observation_space})

    def reset(self, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return {"position": observation}, info

    def step(self, action):
        observation, *rest = super().step(action)
        return {"position": observation}, *rest


class Moves(BaseCallback):
    """Somebody does something with the environments after some of the algorithm's own steps."""

    def __init__(self, move, at):
        super().__init__()
        self.move, self.at = move, at

    def _on_step(self):
        if self.n_calls in self.at:
            self.move(self.model)
        return True


def gap(model):
    """
    Read what was stored: an action, or the person's, of whom not all algorithms know, moves by a tenth of it.

    :return: the largest distance between an observation that was stored and where one was
    """
    before, actions, after = stored(model)
    by_person = np.abs(after - before - 0.1 * HUMAN).max(axis=-1)
    return np.minimum(np.abs(after - before - 0.1 * actions).max(axis=-1), by_person).max()


def stored(model):
    """:return: observations, actions and next observations"""
    name = type(model).__name__
    buffer = model.rollout_buffer if name in ON_POLICY else model.replay_buffer
    if name in GUIDED:
        filled = [store for store in (buffer.human, buffer.novice) if len(store)]
        key = "position" if "observation/position" in filled[0].arrays else ""
        for column in (f"observation/{key}", "action", f"next_observation/{key}"):
            yield np.concatenate([store.arrays[column][: len(store)] for store in filled])
        return
    observations, actions = buffer.observations, buffer.actions
    if isinstance(observations, dict):
        observations = observations["position"]
    if name not in ON_POLICY:
        after = buffer.next_observations
        yield from (
            values[: buffer.size()] for values in (observations, actions, getattr(after, "get", lambda _: after)("position"))
        )
        return
    n_steps, n_envs = buffer.episode_starts.shape
    observations, actions = (values.reshape(n_envs, n_steps, 2).swapaxes(0, 1) for values in (observations, actions))
    same_episode = buffer.episode_starts[1:] == 0
    yield from (observations[:-1][same_episode], np.clip(actions[:-1][same_episode], -1, 1), observations[1:][same_episode])


def evaluate(env):
    return lambda model: evaluate_policy(model, env or model.get_env(), 2, warn=False)


MOVES = {
    "its environments": lambda env: evaluate(None),
    "the environment in them": lambda env: evaluate(env),
    "a reset": lambda env: lambda model: model.get_env().reset(),
    "a step": lambda env: lambda model: model.get_env().step(np.zeros((1, 2), np.float32)),
    "a reset of the environment": lambda env: lambda model: env.reset(),
}


@pytest.mark.parametrize("move", MOVES)
@each
def test_the_algorithm_knows_where_its_environments_are(name, move):
    env = Told()
    # Rollouts have 12 steps
    model = make_any(name, env).learn(24, callback=Moves(MOVES[move](env), (2, 12, 16, 21)))
    assert gap(model) < 1e-5
    for _ in range(2):
        MOVES[move](env)(model)
        model.learn(24, reset_num_timesteps=False, callback=Moves(MOVES[move](env), (24,)))
        assert gap(model) < 1e-5


@pytest.mark.parametrize(
    "vec_env, make_env",
    [(DummyVecEnv, Told), (DummyVecEnv, DictTold), (SubprocVecEnv, Told)],
    ids=["here", "Dict observations", "in other processes"],
)
@each
def test_several_environments_of_any_kind(name, vec_env, make_env):
    if make_env is DictTold and name in ("HGDagger", "IWR", "GAIL"):
        pytest.skip("no Dict observations")
    env = vec_env([make_env, make_env])
    callback = [Moves(evaluate(None), (3, 12, 17)), EvalCallback(env, eval_freq=5, verbose=0, warn=False)]
    model = make_any(name, env, "MultiInputPolicy" if make_env is DictTold else "MlpPolicy").learn(48, callback=callback)
    assert gap(model) < 1e-5
    env.close()


@pytest.mark.parametrize("name", [name for name in LEARNERS if name not in ON_POLICY])
def test_what_is_stored_is_not_what_the_evaluation_saw(name):
    """VecNormalize keeps the raw numbers of the last step, whoever made it."""
    env = VecNormalize(DummyVecEnv([Told]))
    model = make_any(name, env).learn(40, callback=Moves(evaluate(None), (2, 15, 16, 31)))
    assert gap(model) < 1e-5


@each
def test_nobody_else_is_there(name):
    """Own resets, at the end of episodes and of learn, are no others'."""
    model = make_any(name, DummyVecEnv([Told, Told]))
    begun = []
    model._begin_episodes = lambda: begun.append(1)
    model.learn(48)
    model.learn(48, reset_num_timesteps=False)
    evaluate_policy(model, Told(), 2, warn=False)  # elsewhere
    model.learn(24, reset_num_timesteps=False)
    assert not begun and not model.others_moved


@pytest.mark.parametrize("name", [name for name in ("DSAC", "SACLag", *GUIDED) if name not in ("HGDagger", "IWR")])
@pytest.mark.parametrize("how", ["moved", "learn again"])
def test_returns_of_several_steps_end_where_new_episodes_begin(name, how):
    class Once(Told):
        """The reward is the number of the episode, which is never over by itself."""

        episode = -1

        def reset(self, seed=None, options=None):
            self.episode += 1
            return super().reset(seed=seed)

        def step(self, action):
            observation, _, _, _, info = super().step(action)
            return observation, 10.0**self.episode, False, False, info

    model = make_any(name, Once(), n_steps=3, gamma=1.0, learning_starts=1000)
    if how == "moved":
        model.learn(14, callback=Moves(lambda model: model.get_env().reset(), (7,)))  # one reset of one's own follows
    else:
        model.learn(7)
        model.learn(7)
    batch = model.replay_buffer.sample(500)
    digits = {len(set(str(int(reward))) - {"0"}) for reward in batch.rewards.ravel()}
    assert digits == {1} and len(set(batch.rewards.ravel().tolist())) > 2


# --- The counting methods


class Proxy(gym.Wrapper):
    """Hands on what is set."""

    def __setattr__(self, name, value):
        if name in ("step", "reset"):
            setattr(self.env, name, value)
        else:
            super().__setattr__(name, value)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copied", "pickled"])
def test_environments_can_be_copied_while_they_are_counted(duplicate):
    env = Proxy(Walk())
    counting = count_calls(DummyVecEnv([lambda: env]))
    env.reset(seed=1)
    other = duplicate(env)
    other.step(np.ones(2, np.float32))
    assert (env.unwrapped.steps, other.unwrapped.steps) == (0, 1)
    assert [method.calls for method in counting] == [0, 1]
    env.step(np.ones(2, np.float32))
    assert [method.calls for method in counting] == [1, 1] == [m.calls for m in count_calls(DummyVecEnv([lambda: env]))]
