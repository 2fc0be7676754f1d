"""What is NaN, infinite or too large gets into no store and no network, whatever it is and whichever algorithm learns."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from eleven import ALL, GUIDED, OFFLINE, Walk, demonstrations, make_any
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_chac.common.checkpoints import ResumableCheckpoint
from sb3_chac.common.checks import check_finite
from sb3_chac.evaluation.episodes import NotEvaluable
from sb3_chac.evaluation.models import find_normalization

# What breaks -> what the message names
SOURCES = {
    "observation": "observation of environment 0",
    "first observation": "observation of environment 0",
    "very first observation": "observation of environment 0",
    "terminal observation": "terminal observation of environment 0",
    "reward": "reward of environment 0",
    "cost": r"info\['cost'\] of environment 0",
}
OF_TAKEOVERS = {key: rf"info\['{key}'\] of environment 0" for key in ("intervene_action", "applied_action", "takeover_cost")}
IN_DATASETS = ("observations", "next_observations", "actions", "rewards", "costs", "novice_actions")
VALUES = {"nan": np.nan, "inf": np.inf, "too large": -1e39}
BREAKS_AT = 18  # the end of an episode: of its third


class Broken(Walk):
    """In step ``BREAKS_AT``, or in the reset after it, something is ``value``."""

    observation_space = spaces.Box(-100, 100, (2,), np.float64)

    def __init__(self, source, value):
        self.source, self.value, self.count = source, value, 0

    def reset(self, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        observation = observation.astype(np.float64)
        if (self.source, self.count) in (("first observation", BREAKS_AT), ("very first observation", 0)):
            observation[1] = self.value
        return observation, info

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(np.nan_to_num(action))
        observation = observation.astype(np.float64)
        self.count += 1
        human = self.count % 2 == 0
        key = "applied_action" if self.source == "applied_action" else "intervene_action"
        info |= {key: np.zeros(2), "is_intervention": True} if human else {}
        at = BREAKS_AT - 2 if self.source == "observation" else BREAKS_AT  # not the last one of the episode
        if self.count == at:
            if self.source in ("observation", "terminal observation"):
                observation[1] = self.value
            elif self.source == "reward":
                reward = self.value
            elif self.source in ("cost", "takeover_cost"):
                info[self.source] = self.value
            elif self.source in OF_TAKEOVERS:
                info[self.source] = np.array([0.0, self.value])
        return observation, reward, terminated, truncated, info


def floats(thing):
    """All arrays of numbers in a buffer, also in its parts."""
    for value in thing.values() if isinstance(thing, dict) else vars(thing).values():
        if isinstance(value, np.ndarray) and np.issubdtype(value.dtype, np.floating):
            yield value
        elif isinstance(value, dict) or type(value).__name__ == "TransitionStore":
            yield from floats(value)


def assert_finite(model):
    assert all(param.isfinite().all() for param in model.policy.state_dict().values())
    buffer = getattr(model, "replay_buffer", None) or getattr(model, "rollout_buffer", None)
    arrays = list(floats(buffer)) if buffer is not None else []
    assert all(np.isfinite(array).all() for array in arrays) and (arrays or buffer is None)
    assert all(np.isfinite(value) for value in getattr(model, "counts", {}).values())


def in_turn(cases, values):
    """Each case with one of the values, by turns; the others are slow."""
    for i, case in enumerate(cases):
        for j, value in enumerate(values):
            marks = () if i % len(values) == j else pytest.mark.slow
            yield pytest.param(*case, VALUES[value], marks=marks, id="-".join((*case, value)))


CASES = [(name, source) for name in ALL if name not in OFFLINE for source in SOURCES]
CASES += [(name, source) for name in GUIDED for source in OF_TAKEOVERS]


@pytest.mark.parametrize("name, source, value", in_turn(CASES, VALUES))
def test_steps_that_are_not_finite_are_refused(name, source, value):
    kwargs = {"dataset": float64_demonstrations()} if name == "GAIL" else {}
    model = make_any(name, Broken(source, value), **kwargs)
    with pytest.raises(ValueError, match=(SOURCES | OF_TAKEOVERS)[source]), np.errstate(over="ignore"):
        model.learn(60)
    assert model.num_timesteps <= BREAKS_AT
    assert_finite(model)


NO_NUMBERS = {"complex": 0.5j, "NumPy's complex": np.complex128(0.5 + 1j), "array of complex": np.array([1j]), "text": "0.5"}
NO_NUMBERS |= {"two": [0.1, 0.2], "dict": {}}


@pytest.mark.parametrize("value", NO_NUMBERS.values(), ids=NO_NUMBERS)
@pytest.mark.parametrize("name", [name for name in ALL if name not in OFFLINE])
def test_a_cost_that_is_no_real_number_is_refused(name, value):
    kwargs = {"dataset": float64_demonstrations()} if name == "GAIL" else {}
    model = make_any(name, Broken("cost", value), **kwargs)
    with warnings.catch_warnings():
        warnings.simplefilter("error", np.exceptions.ComplexWarning)
        with pytest.raises(ValueError, match=SOURCES["cost"] + " must be a finite number at every step, got"):
            model.learn(60)
    assert_finite(model)


@pytest.mark.parametrize("source", ["intervene_action", "applied_action"])
@pytest.mark.parametrize("name", GUIDED)
def test_a_reported_action_that_is_complex_is_refused(name, source):
    model = make_any(name, Broken(source, 1j))
    with pytest.raises(ValueError, match=OF_TAKEOVERS[source] + ", the human's action, must be finite numbers"):
        model.learn(60)
    assert_finite(model)


@pytest.mark.parametrize("values", [np.array([1j]), np.array(["1.0"]), np.array([None])], ids=["complex", "text", "object"])
def test_what_is_no_real_number_is_named_with_its_type(values):
    with pytest.raises(ValueError, match=rf"reward of environment 0 is no real number \({values.dtype}\) at step 3"):
        check_finite("reward", values, 3)


def float64_demonstrations(**columns):
    as_double = {key: getattr(demonstrations(), key).astype(np.float64) for key in ("observations", "next_observations")}
    return demonstrations(**(as_double | {"observation_space": Broken.observation_space} | columns))


IN_NORMALIZED = ("observation", "very first observation", "first observation", "terminal observation", "reward")
NORMALIZED = [(name, source) for name in ALL if name not in OFFLINE for source in IN_NORMALIZED]


@pytest.mark.parametrize("training", (True, False), ids=("moving", "fixed"))
@pytest.mark.parametrize("name, source, value", in_turn(NORMALIZED, ("nan", "inf")))
def test_normalizing_hides_nothing(name, source, value, training):
    """VecNormalize clips what is infinite, and what is NaN would stay in its statistics for good."""
    env = VecNormalize(DummyVecEnv([lambda: Broken(source, value)]), training=training)
    kwargs = {"dataset": float64_demonstrations()} if name == "GAIL" else {}
    model = make_any(name, env, **kwargs)
    for _ in range(2):  # a second learn() puts no second check around the environments
        with pytest.raises(ValueError, match=SOURCES[source]):
            model.learn(60)
        env.venv.envs[0].unwrapped.count = 0
    assert_finite(model)
    for statistics in (env.obs_rms, env.ret_rms):
        assert np.isfinite(statistics.mean).all() and np.isfinite(statistics.var).all()
    assert env.venv.venv is env.unwrapped


LEARN_FROM_DATASETS = [(name, column) for name in (*OFFLINE, "GAIL", *GUIDED) for column in IN_DATASETS]


@pytest.mark.parametrize("name, column, value", in_turn(LEARN_FROM_DATASETS, VALUES))
def test_datasets_that_are_not_finite_are_refused(name, column, value):
    good = float64_demonstrations()
    values = np.zeros((36, 2)[: 1 + (column not in ("costs", "rewards"))])
    values[7] = value
    broken = replace(good, **{column: values})
    env = Broken(None, 0.0)
    with pytest.raises(ValueError, match=f"{column} are NaN or infinite at step 7"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if name in GUIDED:
            make_any(name, env).store_demonstrations(broken)
        else:
            make_any(name, env, dataset=broken)


@pytest.mark.parametrize("name", ALL)
def test_no_checkpoint_of_a_model_that_is_not_finite(name, tmp_path):
    model = make_any(name, Walk())
    checkpoint = ResumableCheckpoint(1, tmp_path, "Walk")
    checkpoint.init_callback(model)
    checkpoint.save()
    (kept,) = checkpoint.folder.iterdir()
    next(model.policy.parameters()).data.view(-1)[0] = np.inf
    model.num_timesteps = 5
    with pytest.raises(ValueError, match=r"^model: \S+ is NaN or infinite at step 5: no checkpoint"):
        checkpoint.save()
    assert list(checkpoint.folder.iterdir()) == [kept]


def test_no_checkpoint_of_statistics_that_are_not_finite(tmp_path):
    env = VecNormalize(DummyVecEnv([Walk]))
    checkpoint = ResumableCheckpoint(1, tmp_path, "Walk")
    checkpoint.init_callback(make_any("DSAC", env))
    checkpoint.save()
    (kept,) = checkpoint.folder.iterdir()
    env.obs_rms.var[0] = np.nan
    checkpoint.model.num_timesteps = 5
    with pytest.raises(
        ValueError, match=r"^model: vecnormalize.pkl, var of observation is NaN or infinite at step 5: no check"
    ):
        checkpoint.save()
    assert list(checkpoint.folder.iterdir()) == [kept]


def test_no_evaluation_with_statistics_that_are_not_finite(tmp_path):
    env = VecNormalize(DummyVecEnv([Walk]))
    env.obs_rms.mean[0] = np.inf
    (tmp_path / "Walk").mkdir()
    env.save(str(tmp_path / "Walk" / "vecnormalize.pkl"))
    with pytest.raises(NotEvaluable, match=r"statistics that are NaN or infinite \(vecnormalize.pkl, mean of observation\)"):
        find_normalization(tmp_path / "model.zip", "Walk", Walk())
