"""The stand-in human: when it is asked, who drives which step, and what the info says of it."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as gym_check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from takeover_toys import (
    EXPERT,
    NOVICE,
    DictIntegrator,
    DrivenIntegrator,
    Integrator,
    NoisyDriver,
    Script,
    armed,
    bits,
    constant,
    drive,
)

from sb3_chac.human import (
    ControlState,
    InterventionWrapper,
)

AUTONOMOUS, TAKEOVER, PAUSED = ControlState


# Inert until armed


def test_inert_until_armed():
    env = InterventionWrapper(DrivenIntegrator(infos={"cost": 2.0}))
    plain = DrivenIntegrator()
    assert np.array_equal(env.reset(seed=3)[0], plain.reset(seed=3)[0])
    wild = [np.full(2, 7.0), np.array([np.nan, 0.0]), NOVICE]  # not even looked at
    for action in wild:
        observation, *_, info = env.step(action)
        np.testing.assert_array_equal(observation, plain.step(action)[0])
        assert env.unwrapped.executed[-1] is action
        np.testing.assert_array_equal(info["applied_action"], action.astype(np.float32))
        assert not info["takeover"] and "intervene_action" not in info and info["cost"] == 2.0
    assert (env.unwrapped.drivers_made, env.total_steps, env.state, env.armed) == (0, 0, AUTONOMOUS, False)


def test_arming_takes_effect_at_once_and_disarming_too():
    driver = NoisyDriver()
    env = InterventionWrapper(Integrator(), driver, "always")
    first, _ = env.reset(seed=5)
    assert driver.seeds == []
    env.arm()
    env.arm()  # nothing more
    assert driver.seeds == [5] and env.step(NOVICE)[4]["takeover"]
    np.testing.assert_array_equal(driver.observations[0], first)
    env.disarm()
    assert env.state is AUTONOMOUS and drive(env, 2) == [False, False]
    assert (env.human_steps, env.total_steps, len(driver.observations)) == (1, 1, 1)
    env.arm()
    assert driver.seeds == [5, None] and drive(env, 1, "takeover_start") == [True]


def test_arming_before_the_first_reset():
    driver = NoisyDriver()
    env = InterventionWrapper(Integrator(), driver, "always")
    env.arm()
    assert driver.seeds == []
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(NOVICE)
    env.reset(seed=1)
    assert driver.seeds == [1] and drive(env, 1) == [True]


# Who drives, and what the info says


def test_info():
    script = Script(bits("01100"))
    env = armed(script, env=Integrator(infos={"progress": 1.0}))
    infos = [env.step(NOVICE)[4] for _ in range(5)]
    np.testing.assert_array_equal(env.unwrapped.executed, [NOVICE, EXPERT, EXPERT, NOVICE, NOVICE])
    for info, executed in zip(infos, env.unwrapped.executed, strict=True):
        np.testing.assert_array_equal(info["applied_action"], executed)
        assert info["applied_action"].dtype == np.float32 and not np.shares_memory(info["applied_action"], executed)
        assert type(info["takeover"]) is type(info["takeover_start"]) is type(info["is_intervention"]) is bool
        assert type(info["takeover_cost"]) is type(info["takeover_rate"]) is float
        assert type(info["human_steps"]) is type(info["total_steps"]) is int
        assert info["is_intervention"] == info["takeover"] == ("intervene_action" in info)
        assert info["progress"] == 1.0 and "cost" not in info  # what is not measured is not made up
    np.testing.assert_array_equal(infos[1]["intervene_action"], EXPERT)
    assert not np.shares_memory(infos[1]["intervene_action"], infos[1]["applied_action"])
    assert [info["takeover_start"] for info in infos] == bits("01000")
    assert [info["human_steps"] for info in infos] == [0, 1, 2, 2, 2]
    assert [info["total_steps"] for info in infos] == [1, 2, 3, 4, 5]
    assert infos[4]["takeover_rate"] == env.takeover_rate == 0.4
    assert script.human_driving == bits("00110")
    cosine = NOVICE @ EXPERT / np.linalg.norm(NOVICE) / np.linalg.norm(EXPERT)
    assert [info["takeover_cost"] for info in infos] == pytest.approx([0, 1 - cosine, 0, 0, 0], abs=1e-6)
    assert env.unwrapped.infos == {"progress": 1.0}  # the environment's own dictionary is left alone


@pytest.mark.parametrize("novice, cost", [([-0.5, 0.25], 0.0), ([1.0, -0.5], 2.0), ([0.25, 0.5], 1.0), ([0.0, 0.0], 0.0)])
def test_takeover_cost(novice, cost):
    assert armed().step(np.array(novice))[4]["takeover_cost"] == pytest.approx(cost, abs=1e-6)


def test_always_and_never():
    assert drive(armed("always"), 3) == [True] * 3
    env = armed("never")
    assert drive(env, 3) == [False] * 3 and env.total_steps == 3
    assert all(action is NOVICE for action in env.unwrapped.executed)


# States


@pytest.mark.parametrize("make", [lambda: Integrator(length=2), lambda: gym.wrappers.TimeLimit(Integrator(), 2)])
def test_the_end_of_an_episode_ends_the_takeover(make):
    script = Script([True] * 9)
    env = armed(script, env=make())
    assert drive(env, 2) == [True, True] and env.state is AUTONOMOUS
    with pytest.raises(ResetNeeded):
        env.step(NOVICE)
    env.reset()
    assert script.resets == 2
    assert drive(env, 1, "takeover_start") == [True] and env.state is TAKEOVER
    env.reset()
    assert env.state is AUTONOMOUS


def test_pause_and_resume():
    script, driver = Script([True] * 9), NoisyDriver()
    env = armed(script, driver)
    drive(env, 2)
    env.pause()
    env.pause()
    assert env.state is PAUSED and drive(env, 2) == [False, False]
    env.reset(seed=4)
    assert env.state is PAUSED and drive(env, 1) == [False]
    assert (env.total_steps, env.human_steps, len(driver.observations)) == (5, 2, 2)
    env.resume()
    env.resume()
    assert env.state is AUTONOMOUS and driver.seeds == [0, 4]
    assert drive(env, 1, "takeover_start") == [True]


def test_disarming_ends_a_pause():
    env = armed()
    env.pause()
    env.disarm()
    env.arm()
    assert env.state is AUTONOMOUS and drive(env, 1) == [True]


@pytest.mark.parametrize("name", ["pause", "resume"])
def test_pause_and_resume_need_an_armed_wrapper(name):
    with pytest.raises(RuntimeError, match=rf"{name}.*arm\(\)"):
        getattr(InterventionWrapper(Integrator(), constant, "always"), name)()


def test_the_budget_survives_a_restart():
    env = armed(budget=3)
    assert drive(env, 2) == [True, True]
    restarted = InterventionWrapper(Integrator(), constant, "always", budget=3)
    restarted.load_state_dict(env.state_dict())
    restarted.arm()
    restarted.reset()
    assert drive(restarted, 3) == [True, False, False] and restarted.state is PAUSED
    assert (restarted.human_steps, restarted.total_steps) == (3, 5)
    restarted.resume()  # stays so
    restarted.disarm()
    restarted.arm()
    assert restarted.state is PAUSED and drive(restarted, 2) == [False, False]
    env.load_state_dict(restarted.state_dict())
    assert env.state is PAUSED


@settings(max_examples=60)
@given(
    decisions=st.lists(st.booleans(), max_size=40),
    events=st.lists(st.sampled_from(["pause", "resume", "reset", "arm", "disarm", "step", "step", "step"]), max_size=60),
    budget=st.integers(0, 6),
    length=st.integers(1, 8),
)
def test_the_budget_is_never_exceeded(decisions, events, budget, length):
    env = armed(Script(decisions), env=Integrator(length), budget=budget)
    human_steps = total_steps = 0
    done = False
    for event in events:
        if event == "step":
            if done:
                env.reset()
            was_armed, state = env.armed, env.state
            _, _, done, _, info = env.step(NOVICE)
            human_steps += info["takeover"]
            total_steps += was_armed
            assert np.array_equal(env.unwrapped.executed[-1], EXPERT if info["takeover"] else NOVICE)
            assert info["takeover_start"] == (info["takeover"] and state is not TAKEOVER)
            assert not (info["takeover"] and (state is PAUSED or not was_armed))
        elif env.armed or event not in ("pause", "resume"):
            getattr(env, event)()
            done = done and event != "reset"
        assert (env.human_steps, env.total_steps) == (human_steps, total_steps) and human_steps <= budget
        assert env.armed or env.state is AUTONOMOUS
        if env.armed and human_steps == budget:
            assert env.state is PAUSED


# Actions, spaces, other libraries


NO_ACTIONS = ["left", None, [0.1, None], ["0.1", "0.2"], [0.1, 1j], np.array([0.1, 1j]), [[1], [2, 3]]]


@pytest.mark.parametrize("action", [np.array([np.nan, 0.0]), np.array([0.0, np.inf]), np.zeros(3), 0.5, *NO_ACTIONS])
def test_bad_novice_actions(action):
    env = armed(Script(bits("11")))
    drive(env, 1)
    with pytest.raises(ValueError, match=r"action must be finite numbers of shape \(2,\)"):
        env.step(action)
    assert len(env.unwrapped.executed) == 1
    assert drive(env, 1, "takeover_start") == [False]  # the takeover goes on with a good action


@pytest.mark.parametrize(
    "state", [{}, {"human_steps": 1}, {"human_steps": 2, "total_steps": 1}, {"human_steps": -1, "total_steps": 1}]
)
def test_bad_state_dicts(state):
    with pytest.raises(ValueError, match="in state_dict"):
        armed().load_state_dict(state)


@pytest.mark.parametrize("dtype", [np.float64, np.int32])
def test_dtypes_of_actions(dtype):
    class Other(Integrator):
        action_space = spaces.Box(-5, 5, (2,), dtype)

    env = armed(Script(bits("01")), lambda observation: [1.9999999, -5], Other())
    novice, human = (env.step(np.array([2, 3], dtype))[4]["applied_action"] for _ in range(2))
    assert novice.dtype == human.dtype == env.unwrapped.executed[1].dtype == dtype
    np.testing.assert_allclose([novice, human], [[2, 3], [2, -5]], atol=1e-6)


class WithoutCounts(gym.Wrapper):
    """gymnasium compares the infos of the first steps of two episodes, and the counts go on."""

    def step(self, action):
        *result, info = self.env.step(action)
        counts = ("human_steps", "total_steps", "takeover_rate")
        return *result, {key: value for key, value in info.items() if key not in counts}


@pytest.mark.filterwarnings("ignore:.*:UserWarning")
@pytest.mark.parametrize("arm", [False, True])
@pytest.mark.parametrize("make", [lambda: gym.make("Pendulum-v1"), DrivenIntegrator, DictIntegrator])
def test_env_checkers(make, arm):
    env = InterventionWrapper(make(), lambda observation: np.zeros(env.action_space.shape), "always", armed=arm)
    gym_check_env(WithoutCounts(env) if arm else env, skip_render_check=True, skip_close_check=True)
    sb3_check_env(env)
    assert env.human_steps == env.total_steps and (env.total_steps > 0) == arm


def test_the_spec_makes_the_same_environment():
    env = InterventionWrapper(gym.make("Pendulum-v1"), np.zeros_like, "never", budget=7)
    again = gym.make(env.spec)
    assert isinstance(again, InterventionWrapper) and again.budget == 7 and not again.armed


@pytest.mark.parametrize("vec_env_class", [DummyVecEnv, SubprocVecEnv])
def test_through_vec_envs(vec_env_class):
    kwargs = dict(expert="scripted", rule="always", budget=3)
    env = make_vec_env(
        lambda: InterventionWrapper(DrivenIntegrator(length=2), **kwargs), n_envs=2, seed=0, vec_env_cls=vec_env_class
    )
    try:
        env.reset()
        actions = np.stack([NOVICE, NOVICE])
        assert [info["takeover"] for info in env.step(actions)[3]] == [False, False]
        env.env_method("arm", indices=[1])
        infos = [env.step(actions)[3] for _ in range(5)]
        assert [info[0]["takeover"] for info in infos] == [False] * 5
        assert [info[1]["takeover"] for info in infos] == bits("11100")
        assert env.get_attr("human_steps") == [0, 3] and env.get_attr("state") == [AUTONOMOUS, PAUSED]
        env.env_method("disarm")
        assert env.get_attr("armed") == [False, False]
        assert env.env_method("state_dict")[1] == {"human_steps": 3, "total_steps": 5}
    finally:
        env.close()


@pytest.mark.parametrize("late", [False, True])
def test_determinism(late):
    def rollout(seed):
        env = InterventionWrapper(DrivenIntegrator(length=10), "scripted", "risk", armed=not late)
        env.reset(seed=seed)
        if late:
            env.arm()
        observations = []
        for _ in range(30):
            observation, _, done, _, _ = env.step(NOVICE)
            observations.append(observation)
            if done:
                env.reset()
        assert env.human_steps == 27
        return np.array(observations)

    np.testing.assert_array_equal(rollout(1), rollout(1))
    assert not np.allclose(rollout(1), rollout(2))


def test_display():
    env = armed(Script(bits("011")), env=DrivenIntegrator())
    env.set_stage(2)
    drive(env, 2)
    assert env.render() == env.hud == {"takeover": True, "steps": 2, "takeover rate": 0.5, "stage": 2}


class Plain(Integrator):
    def render(self):
        return sorted(vars(self))


def test_environments_without_a_display_are_left_alone():
    assert "hud" not in armed("never", env=Plain()).render()


def test_another_rule_for_a_while():
    env = armed("never")
    assert drive(env, 2) == [False, False]
    env.set_rule("always")
    assert drive(env, 2) == [True, True]
    env.disarm()
    env.set_rule()
    env.arm()
    assert drive(env, 2) == [False, False]
    env.disarm()
    assert not env.armed and drive(env, 1) == [False]
    with pytest.raises(ValueError, match=r"^rule must be one of"):
        env.set_rule("sometimes")
    env.arm()
    assert drive(env, 1) == [False]
    # Before it is armed for the first time, too
    env = InterventionWrapper(Integrator(), constant, "never")
    env.set_rule("always")
    env.reset(seed=0)
    env.arm()
    assert drive(env, 1) == [True]
