"""Takeovers at the borders: wrappers armed before, keys of the environment's own, arrays in use, records of reports."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from eleven import ALL, GUIDED, OFFLINE, Walk, make_any
from gymnasium import spaces
from gymnasium.wrappers import RescaleAction, TimeLimit
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecNormalize

from sb3_chac.common.checks import UnsupportedActionSpace
from sb3_chac.common.contract import read_report
from sb3_chac.common.demonstrations import load_demonstrations
from sb3_chac.datasets.recording import record
from sb3_chac.human import InterventionWrapper

HUMAN = np.array([0.25, -0.25])
each_guided = pytest.mark.parametrize("name", GUIDED)


def human(observation):
    return HUMAN


class Told(Walk):
    """The person drives steps 2 and 3 of each episode; ``info`` tells ``tell(whether the person drives)``."""

    def __init__(self, tell):
        self.tell = tell

    def step(self, action):
        drives = self.steps in (2, 3)
        observation, reward, terminated, truncated, info = super().step(HUMAN if drives else action)
        return observation, reward, terminated, truncated, info | self.tell(drives)


def hil_serl(drives):
    return {"intervene_action": HUMAN} if drives else {}


def gym_hil(drives):
    return {"is_intervention": drives, "action_intervention": HUMAN}


# --- Wrappers that are armed already


class Evaluate(BaseCallback):
    def _on_step(self):
        if self.n_calls == 7:
            self.seen = []
            see = lambda local, _: self.seen.append(local["info"]["takeover"])  # noqa: E731
            evaluate_policy(self.model, self.training_env, 2, callback=see, warn=False)
        return True


@each_guided
def test_wrappers_that_are_armed_already_are_no_exception(name):
    env = DummyVecEnv([lambda: InterventionWrapper(Walk(), human, "always", budget=20, armed=True)] * 2)
    callback = Evaluate()
    model = make_any(name, env).learn(60, callback=callback)
    assert len(callback.seen) >= 12 and not any(callback.seen)
    assert model.counts["human_steps"] == sum(env.get_attr("human_steps")) == len(model.replay_buffer.human) == 20


# --- Keys of ``info`` that are the environment's own


@pytest.mark.parametrize("watched", ["alone", "watched"])
@pytest.mark.parametrize("key", ["received_action", "applied_action", "novice_action"])
@pytest.mark.parametrize("own", [np.array([55.0, 0.9]), np.array([0.9, 0.9]), "left"], ids=["torques", "in bounds", "text"])
@each_guided
def test_what_else_an_environment_tells_is_left_alone(name, own, key, watched):
    env = Told(lambda drives: gym_hil(drives) | {key: own})
    if watched == "watched":
        env = InterventionWrapper(env, human, "never")
    model = make_any(name, env, **({"switch_after": 12} if name == "CHAC" else {})).learn(24)
    actions = model.replay_buffer.human.arrays["action"][: len(model.replay_buffer.human)]
    assert len(actions) >= 4 and np.allclose(actions, HUMAN)


ODD_EVENTS = {"array": np.array([True, False]), "number": 2, "NumPy's": np.bool_(True), "None": None, "no": np.zeros(2)}


@pytest.mark.parametrize("key", ["collision", "crashed", "out_of_road"])
@pytest.mark.parametrize("value", ODD_EVENTS.values(), ids=ODD_EVENTS)
def test_events_of_any_kind_are_counted(value, key):
    model = make_any("PVP", Told(lambda drives: gym_hil(drives) | ({key: value} if drives else {key: None}))).learn(24)
    name = "departures" if key == "out_of_road" else "collisions"
    times = 0 if value is None or not np.any(value) else 8
    assert model.counts[name] == (times / 2 if key == "crashed" else times)  # which lasts for the two steps
    assert (name in model.measured) == (value is not None)


@pytest.mark.parametrize("key", ["collision", "crashed", "out_of_road", "takeover_start"])
@pytest.mark.parametrize("value", ["no", np.nan, b"", {}, 1j], ids=str)
@each_guided
def test_events_that_are_no_truth_values_are_refused(name, value, key):
    model = make_any(name, Told(lambda drives: gym_hil(drives) | {key: value}))
    with pytest.raises(ValueError, match=rf"^info\['{key}'\] of environment 0 must be a boolean, got"):
        model.learn(24)
    assert len(model.replay_buffer.human) + len(model.replay_buffer.novice) <= 2


@each_guided
def test_a_takeover_begins_where_the_human_takes_over_only(name):
    model = make_any(name, Told(lambda drives: gym_hil(drives) | {"takeover_start": np.array([True])})).learn(24)
    assert model.counts["takeovers"] == model.counts["human_steps"] == 8
    assert not model.replay_buffer.novice.arrays["takeover_start"].any()


class Forgetful(gym.Wrapper):
    def step(self, action):
        *step, _ = self.env.step(action)
        return *step, {}


class VecForgetful(VecEnvWrapper):
    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards, dones, [{"TimeLimit.truncated": True} for _ in infos]


@pytest.mark.parametrize(
    "wrap",
    [
        lambda make: Forgetful(make()),
        lambda make: VecForgetful(DummyVecEnv([make])),
        lambda make: SubprocVecEnv([lambda: Forgetful(make())]),
    ],
    ids=["gymnasium's", "VecEnvWrapper", "in another process"],
)
@each_guided
def test_wrappers_that_drop_what_is_told_are_refused(name, wrap):
    model = make_any(name, wrap(lambda: InterventionWrapper(Walk(), human, "always")))
    with pytest.raises(ValueError, match=r"^info of environment 0 lacks what the InterventionWrapper told"):
        model.learn(24)
    assert len(model.replay_buffer.human) == len(model.replay_buffer.novice) == 0
    model.get_env().close()


# --- Units of reports, where the wrappers are out of sight


class Rescaling(VecEnvWrapper):
    def __init__(self, venv):
        super().__init__(venv, action_space=spaces.Box(0, 1, (2,)))

    def reset(self):
        return self.venv.reset()

    def step_async(self, actions):
        self.venv.step_async(2 * actions - 1)

    def step_wait(self):
        return self.venv.step_wait()


def rescaled():
    return RescaleAction(Told(gym_hil), np.float32(-0.5), np.float32(1))


class Silent(gym.Wrapper):
    """Overrides step, and has nothing to do with takeovers."""

    def step(self, action):
        return self.env.step(action)


class Telling(gym.Wrapper):
    """Tells of takeovers in its own units, those of what stands outside."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        info = {key: value for key, value in info.items() if "interven" not in key}
        return observation, reward, terminated, truncated, info | {"intervene_action": np.array([0.25, 0.5])}


def test_a_wrapper_that_reports_above_an_action_wrapper_is_believed():
    model = make_any("PVP", Telling(rescaled())).learn(12)
    assert len(model.replay_buffer.human) == 12


@pytest.mark.parametrize(
    "make_env",
    [
        lambda: DummyVecEnv([rescaled]),
        lambda: SubprocVecEnv([rescaled]),
        lambda: Rescaling(DummyVecEnv([lambda: Told(gym_hil)])),
        lambda: DummyVecEnv([lambda: Silent(rescaled())]),
        lambda: DummyVecEnv([lambda: TimeLimit(Silent(Silent(rescaled())), 5)]),
        lambda: SubprocVecEnv([lambda: Silent(rescaled())]),
    ],
    ids=["here", "in another process", "VecEnvWrapper", "below a wrapper", "below three", "below one, in another process"],
)
def test_reports_in_other_units_are_refused(make_env):
    model = make_any("PVP", make_env())
    with pytest.raises(UnsupportedActionSpace, match="wrong units"):
        model.learn(12)
    assert len(model.replay_buffer.human) == 0
    model.get_env().close()


# --- Arrays that the environment goes on using


class Reusing(Told):
    """With ``reuses``, it has one array for observations, one ``info``, one action of the person, and zeroes actions."""

    def __init__(self, action_space, reuses):
        super().__init__(hil_serl)
        self.action_space, self.reuses = action_space, reuses
        self.array, self.info, self.person = np.zeros(2, np.float32), {}, np.zeros(2)

    def handed_out(self, observation):
        if not self.reuses:
            return observation
        self.array[:] = observation
        return self.array

    def reset(self, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return self.handed_out(observation), info

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(np.array(action, np.float32))
        if self.reuses:
            action[...] = 0
            self.info.clear()
            self.info |= info
            if "intervene_action" in info:
                self.person[:] = HUMAN
                self.info["intervene_action"] = self.person
            else:
                self.person[:] = 99
            info = self.info
        return self.handed_out(observation), reward, terminated, truncated, info


def stored(thing):
    """All arrays in a buffer, also in its parts."""
    for value in thing.values() if isinstance(thing, dict) else vars(thing).values():
        if isinstance(value, np.ndarray):
            yield value
        elif isinstance(value, dict) or type(value).__name__ == "TransitionStore":
            yield from stored(value)


CASES = [(name, Walk.action_space) for name in ALL if name not in OFFLINE]
CASES += [("PPOLag", spaces.MultiDiscrete([3, 3])), ("PPOLag", spaces.MultiBinary(2))]


@pytest.mark.parametrize("normalized", [False, True], ids=["raw", "normalized"])
@pytest.mark.parametrize("name, action_space", CASES, ids=[f"{name}-{type(space).__name__}" for name, space in CASES])
def test_environments_may_go_on_using_their_arrays(name, action_space, normalized):
    results = []
    for reuses in (False, True):
        env = DummyVecEnv([lambda reuses=reuses: Reusing(action_space, reuses)])
        model = make_any(name, VecNormalize(env) if normalized else env).learn(36)
        arrays = list(stored(getattr(model, "replay_buffer", None) or model.rollout_buffer))
        results.append((arrays, model.policy.state_dict()))
    (arrays, weights), (others, other_weights) = results
    assert arrays and all(np.array_equal(*pair) for pair in zip(arrays, others, strict=True))
    assert all(th.equal(value, other_weights[key]) for key, value in weights.items())


# --- Records of environments that report takeovers


def recorded(folder, env, steps=6):
    path = record(folder / "walk-v0", lambda observation: np.full(2, 0.5), lambda: env, steps)
    return load_demonstrations(path, Walk.observation_space, Walk.action_space)


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("tell", [hil_serl, gym_hil])
def test_records_tell_who_drove(tell, first, tmp_path):
    env = Told(lambda drives: tell(drives or (first and env.steps == 1)))
    data = recorded(tmp_path, env)
    by_person = np.array([first, False, True, True, False, False])
    assert data.takeovers.tolist() == by_person.tolist()
    assert np.allclose(data.actions, np.where(by_person[:, None], HUMAN, 0.5)) and np.allclose(data.novice_actions, 0.5)


@pytest.mark.parametrize("value, costs", [(None, None), (0.25, [0, 0, 0.25, 0.25, 0, 0])], ids=["None", "at times"])
def test_records_of_costs_that_are_not_always_told(value, costs, tmp_path):
    class Costly(Told):
        def step(self, action):
            *step, info = super().step(action)
            del info["cost"]
            return *step, info | self.tell(self.steps in (3, 4))

    data = recorded(tmp_path, Costly(lambda drives: {"cost": value, "is_success": True} if drives else {}))
    assert data.costs is None if costs is None else data.costs.tolist() == costs


class Halving(gym.ActionWrapper):
    def action(self, action):
        return action / 2


@pytest.mark.parametrize(
    "env, message",
    [
        (Halving(Told(gym_hil)), "Halving between them"),
        (Halving(InterventionWrapper(Walk(), human, "always", armed=True)), "Halving between them"),
        (Told(lambda drives: {"is_intervention": drives, "teleop_action": 9 * HUMAN}), "out of bounds"),
        (Told(lambda drives: {"cost": np.nan}), r"info\['cost'\]"),
    ],
    ids=["above reports", "above the takeover", "out of bounds", "cost"],
)
def test_what_a_record_must_not_hold_is_refused(env, message, tmp_path):
    with pytest.raises(ValueError, match=message), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        recorded(tmp_path, env)
    assert not (tmp_path / "walk-v0").exists()


@pytest.mark.parametrize("flag", ["False", "no", b"0", float("nan"), {"a": 1}, 0.5])
def test_a_flag_that_is_no_boolean_is_refused(flag):
    with pytest.raises(ValueError, match=r"info\['is_intervention'\] of environment 0 must be a boolean"):
        read_report({"is_intervention": flag, "intervene_action": np.zeros(2)}, Walk.action_space)


@pytest.mark.parametrize(("flag", "takeover"), [(1, True), (0.0, False), (np.array([True]), True), (np.bool_(False), False)])
def test_flags(flag, takeover):
    assert read_report({"is_intervention": flag, "intervene_action": np.zeros(2)}, Walk.action_space).takeover is takeover
