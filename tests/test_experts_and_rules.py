"""Which expert drives and when: rules step by step, models, and what happens to bad ones."""

import functools
import math
import queue
import threading

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from shell import wait_until
from stable_baselines3 import SAC
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

from sb3_chac import CHAC, DPVP, IWR, PVP, HGDagger
from sb3_chac.human import (
    ControlState,
    DisagreementRule,
    ExpertError,
    InterventionWrapper,
    ModelExpert,
    RiskRule,
    RuleError,
    make_expert,
    make_rule,
)

# Rules


def test_a_function_as_rule():
    def far_apart(observation, novice_action, expert_action):
        return novice_action[0] - expert_action[0] > 0.9

    env = armed(far_apart)
    assert [env.step(np.array([x, 0.0]))[4]["takeover"] for x in (0.3, 0.5, -1.0)] == [False, True, False]


def test_disagreement_is_in_scaled_units():
    space = spaces.Box(np.array([0.0, -10.0]), np.array([1.0, 10.0]), dtype=np.float64)
    rule = DisagreementRule(0.25, space)
    expert = np.array([0.5, 0.0])
    # scaled by half the range, the differences are 2 x and y / 10; their root mean square is divided by sqrt(2)
    just_below, just_above = 0.25 * math.sqrt(2) * 0.999, 0.25 * math.sqrt(2) * 1.001
    for difference, drives in [(just_below, False), (just_above, True)]:
        assert rule(None, expert + np.array([difference / 2, 0]), expert, False) is drives
        assert rule(None, expert + np.array([0, -10 * difference]), expert, True) is drives


def test_disagreement_by_name():
    env = armed("disagreement")
    near, far = EXPERT + 0.1, EXPERT + 0.5
    assert [env.step(action)[4]["takeover"] for action in (near, far, near)] == [False, True, False]


def risky(times, **kwargs):
    times = iter(times)
    return RiskRule(lambda observation, action: next(times), **kwargs)


@pytest.mark.parametrize(
    "times, kwargs, expected",
    [
        ("LLLLLLLL", dict(delay=3, hold=10), "00011111"),  # the human reacts after three steps of trouble
        ("LLLHLLLL", dict(delay=3, hold=10), "00000001"),  # they are consecutive
        ("LLLMLLLL", dict(delay=3, hold=10), "00000001"),  # between the thresholds is no trouble
        ("LH", dict(delay=0), "11"),
        ("LHHHHHHH", dict(delay=0, hold=4, safe=2), "11110000"),  # held for 4 steps although safe after 2
        ("LMHMHHHH", dict(delay=0, hold=1, safe=2), "11111000"),  # safe steps are consecutive, M is not safe
        ("LHHHHHHH", dict(delay=0, hold=1, safe=1), "10000000"),
        ("LLHHLLLL", dict(delay=1, hold=1, safe=2), "01100111"),  # after a takeover, the delay counts anew
        ("LHHLHHH", dict(delay=0, hold=2, safe=1), "1101100"),  # and so do the held steps
        ("LHHLHHH", dict(delay=0, hold=1, safe=2), "1101100"),  # and the safe ones
        ("LLLLLHHHHHHHHHHH", dict(), "0111111111100000"),  # the defaults: steps 1 to 10 are held
    ],
)
def test_risk_rule_steps(times, kwargs, expected):
    seconds = {"L": 1.0, "M": 1.5, "H": math.inf}
    assert drive(armed(risky([seconds[time] for time in times], **kwargs)), len(times)) == bits(expected)


def test_risk_rule_smooths_the_action():
    seen = []
    rule = RiskRule(lambda observation, action: seen.append(float(action[0])) or math.inf, smoothing=0.75)
    env = armed(rule)
    for x in (0.0, 1.0, 1.0):
        env.step(np.array([x, 0.0]))
    env.reset()
    env.step(np.array([1.0, 0.0]))
    assert seen == [0.0, 0.25, 0.4375, 1.0]


def test_risk_by_name_uses_the_experts_predictor():
    env = armed("risk", "scripted", DrivenIntegrator())
    assert drive(env, 5) == bits("01111")  # the novice's x is positive
    with pytest.raises(ValueError, match=r"time_to_trouble.*RiskRule\(time_to_trouble=\.\.\.\)"):
        armed("risk", "scripted-ideal", DrivenIntegrator())


def test_environments_do_not_share_a_risk_rule():
    rule = RiskRule(lambda observation, action: 0.0, delay=1)
    first, second = armed(rule), armed(rule)
    assert [drive(first, 1), drive(second, 1), drive(first, 1), drive(second, 1)] == [[False], [False], [True], [True]]


def test_make_rule_keeps_rule_objects():
    script = Script([])
    assert make_rule(script, Integrator(), constant) is script


def test_a_rule_that_raises():
    decisions = iter([True, None, True])

    def rule(observation, novice_action, expert_action):
        decision = next(decisions)
        if decision is None:
            raise ZeroDivisionError
        return decision

    env = armed(rule)
    drive(env, 1)
    with pytest.raises(RuleError, match="rule raised ZeroDivisionError"):
        env.step(NOVICE)
    assert len(env.unwrapped.executed) == 1 and env.state is ControlState.AUTONOMOUS and env.total_steps == 1
    with pytest.raises(ResetNeeded):
        env.step(NOVICE)
    env.reset()
    assert drive(env, 1, "takeover_start") == [True]


def test_rules_must_answer_true_or_false():
    with pytest.raises(RuleError, match=r"rule .* must return True or False, got None"):
        drive(armed(lambda *args: None), 1)
    with pytest.raises(RuleError, match="time_to_trouble returned nan"):
        drive(armed(risky([math.nan])), 1)


# Experts


@pytest.mark.parametrize("env_class, policy", [(Integrator, "MlpPolicy"), (DictIntegrator, "MultiInputPolicy")])
def test_a_model_as_expert(env_class, policy):
    model = SAC(policy, env_class(), policy_kwargs=dict(net_arch=[8]), buffer_size=10, seed=0)
    env = armed("always", model, env_class())
    observation, _ = env.reset(seed=1)
    info = env.step(NOVICE)[4]
    np.testing.assert_array_equal(info["applied_action"], model.predict(observation, deterministic=True)[0])
    with pytest.raises(ValueError, match=r"observation space of the SAC model is .* trained on this environment"):
        InterventionWrapper(OtherShape(), model, "always")
    with pytest.raises(ValueError, match="SAC model is"):
        InterventionWrapper(gym.make("Pendulum-v1"), model, "always")


def test_recurrent_models_keep_their_state():
    class Counter:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            count = 0 if state is None or episode_start[0] else state[0] + 1
            return np.array([count / 10, 0.0]), (count,)

    expert = make_expert(Counter(), Integrator())
    assert isinstance(expert, ModelExpert)
    assert [expert(None)[0] for _ in range(3)] == [0.0, 0.1, 0.2]
    expert.reset()
    assert expert(None)[0] == 0.0


def test_models_of_images():
    class Images(Integrator):
        observation_space = spaces.Box(0, 255, (36, 36, 3), np.uint8)

        def obs(self):
            return np.full((36, 36, 3), 7, np.uint8)

    model = SAC("CnnPolicy", Images(), policy_kwargs=dict(net_arch=[8]), buffer_size=10)
    assert model.observation_space.shape == (3, 36, 36)
    assert drive(armed("always", model, Images()), 1) == [True]


def raises(observation):
    raise KeyError("lane")


@pytest.mark.parametrize(
    "expert, message",
    [
        (raises, "expert raises raised KeyError: 'lane'"),
        (lambda observation: np.array([np.nan, 0.0]), "NaN or infinite"),
        (lambda observation: np.array([np.inf, 0.0]), "NaN or infinite"),
        (lambda observation: np.zeros(3), r"shape \(3,\).* \(2,\)"),
        (lambda observation: 0.0, r"shape \(\)"),
        (lambda observation: None, "returned no real numbers, but None"),
        (lambda observation: "left", "returned no real numbers, but 'left'"),
        (lambda observation: ["0.1", "0.2"], r"returned no real numbers, but \['0.1', '0.2'\]"),
        (lambda observation: [0.1, None], "returned no real numbers"),
        (lambda observation: [0.1, 1j], "returned no real numbers"),
        (lambda observation: np.array([0.1, 1j]), "returned no real numbers"),
        (lambda observation: [[0.1], [0.2, 0.3]], "returned no real numbers"),
        (lambda observation: {}, r"returned no real numbers, but \{\}"),
        (lambda observation: np.array([1.00001, 0.0]), "out of bounds"),
        (lambda observation: np.array([0.0, -3.0]), "out of bounds"),
    ],
)
def test_bad_experts_never_reach_the_environment(expert, message):
    calls = []

    @functools.wraps(expert)  # the name in the message
    def sometimes_bad(observation):
        return expert(observation) if calls else constant(observation)

    env = armed(Script([True] * 9), sometimes_bad)
    drive(env, 1)
    calls.append(None)
    with pytest.raises(ExpertError, match=f"(?s){message}.*Mend the expert") as error:
        env.step(NOVICE)
    assert isinstance(error.value.__cause__, KeyError) == (expert is raises)
    assert len(env.unwrapped.executed) == env.human_steps == env.total_steps == 1
    assert env.state is ControlState.AUTONOMOUS
    with pytest.raises(ResetNeeded):
        env.step(NOVICE)
    calls.clear()
    env.reset()
    assert drive(env, 1, "takeover_start") == [True]


@pytest.mark.parametrize("time", [np.nan, None, "2.0", 1j, np.complex128(2), [1.0, 2.0]], ids=repr)
def test_a_prediction_of_trouble_that_is_no_time(time):
    rule = RiskRule(lambda observation, action: time)
    with pytest.raises(ValueError, match=r"^time_to_trouble returned .*: return the time in seconds"):
        rule(None, NOVICE, NOVICE, False)


def test_an_expert_whose_reset_fails():
    class Broken(NoisyDriver):
        def reset(self, seed=None):
            raise OSError("no map")

    env = InterventionWrapper(Integrator(), Broken(), "always")
    env.reset()
    with pytest.raises(ExpertError, match="Broken raised OSError in its reset: no map") as error:
        env.arm()
    assert isinstance(error.value.__cause__, OSError)
    assert not env.armed and drive(env, 1) == [False]
    env = InterventionWrapper(Integrator(), Broken(), "always", armed=True)
    with pytest.raises(ExpertError):
        env.reset()
    with pytest.raises(ResetNeeded):
        env.step(NOVICE)


def test_rounding_is_clipped():
    env = armed(expert=lambda observation: np.array([1 + 5e-7, -1 - 5e-7]))
    assert env.step(NOVICE)[4]["applied_action"].tolist() == [1.0, -1.0]


# Arguments


class NoActions(Integrator):
    action_space = spaces.Discrete(2)


class OtherShape(Integrator):
    observation_space = spaces.Box(-1, 1, (3,), np.float32)


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(expert="scripted"), "expert: Integrator has no scripted driver.*'scripted'.*function observation -> action"),
        (dict(expert="model.zip"), r"expert: 'model.zip' is a file.*SAC\.load"),
        (dict(expert=__file__), "is a file"),
        (dict(expert=3), "expert must be"),
        (dict(expert=NoisyDriver), "expert must be"),
        (dict(rule="often"), "rule must be one of 'risk', 'disagreement', 'always', 'never'.*'often'"),
        (dict(rule=None), "rule must be"),
        (dict(rule=RiskRule), "rule must be"),
        (dict(rule="risk"), "rule: 'risk' needs an expert that predicts"),
        (dict(budget=-1), "budget must be an integer of at least 0"),
        (dict(budget=1.5), "budget must be"),
        (dict(env=NoActions()), "env: the action space must be continuous"),
    ],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        InterventionWrapper(**{"env": Integrator(), "expert": constant, "rule": "always", **kwargs})


@pytest.mark.parametrize(
    "name, value",
    [
        ("time_to_trouble", 1.0),
        ("take_over_below", 0.0),
        ("hand_back_above", 1.0),
        ("delay", -1),
        ("hold", 0),
        ("safe", 0),
        ("smoothing", 1.0),
    ],
)
def test_bad_arguments_of_risk_rule(name, value):
    with pytest.raises(ValueError, match=name):
        RiskRule(**{"time_to_trouble": lambda observation, action: math.inf, name: value})


@pytest.mark.parametrize("threshold, space", [(-0.1, Integrator.action_space), (0.1, spaces.Discrete(2))])
def test_bad_arguments_of_disagreement_rule(threshold, space):
    with pytest.raises(ValueError, match=r"threshold|action.space"):
        DisagreementRule(threshold, space)


def test_rules_can_be_configured():
    env = DrivenIntegrator()
    rule = make_rule("risk", env, env.scripted_driver("scripted"), {"take_over_below": 1.8, "hold": 3})
    assert isinstance(rule, RiskRule) and (rule.take_over_below, rule.hold, rule.hand_back_above) == (1.8, 3, 2.0)
    assert make_rule("disagreement", env, constant, {"threshold": 0.7}).threshold == 0.7
    wrapped = InterventionWrapper(env, rule="risk", rule_kwargs={"hold": 4}, armed=True)
    assert wrapped.get_wrapper_attr("_supervisor").rule.hold == 4
    wrapped.reset(seed=0)
    wrapped.set_rule("never")
    wrapped.set_rule()
    assert wrapped.get_wrapper_attr("_supervisor").rule.hold == 4
    with pytest.raises(ValueError, match=r"^rule_kwargs: .*do not fit rule='risk'.*holds"):
        InterventionWrapper(env, rule_kwargs={"holds": 4})
    with pytest.raises(ValueError, match=r"^hold must be"):
        InterventionWrapper(env, rule_kwargs={"hold": 0})
    with pytest.raises(ValueError, match=r"^rule_kwargs: only 'risk' and 'disagreement' take any, got rule='never'"):
        InterventionWrapper(env, rule="never", rule_kwargs={"hold": 4})


# Deadlines and failures of both, while learning


asleep = threading.Event()


def never_answers(*args):
    asleep.set()
    threading.Event().wait()


class Answers(queue.Queue):
    """Of a thread: the time is over as soon as it sleeps, and not before, however slow the machine is."""

    def get(self, timeout):
        wait_until(lambda: self.qsize() or asleep.is_set())
        return super().get(block=False)


def not_in_time(*args):
    raise KeyError("lost")


@pytest.mark.parametrize(
    "expert, rule, error, problem",
    [
        (never_answers, "always", ExpertError, "expert never_answers .*no answer within 0.2 s"),
        (constant, never_answers, RuleError, "rule never_answers .*no answer within 0.2 s"),
        (not_in_time, "always", ExpertError, "expert not_in_time raised KeyError: 'lost'"),
        (constant, not_in_time, RuleError, "rule not_in_time raised KeyError: 'lost'"),
        (lambda observation: [np.nan, 0], "always", ExpertError, "NaN or infinite"),
        (lambda observation: [0.1], "always", ExpertError, r"returned shape \(1,\)"),
        (constant, lambda *args: np.nan, RuleError, "must return True or False, got nan"),
        (constant, lambda *args: [True], RuleError, r"must return True or False, got \[True\]"),
    ],
)
@pytest.mark.parametrize("algorithm", [PVP, DPVP, CHAC, HGDagger, IWR])
def test_who_fails_is_named_and_the_model_can_be_saved(tmp_path, monkeypatch, algorithm, expert, rule, error, problem):
    asleep.clear()
    monkeypatch.setattr("sb3_chac.human.supervisor.queue.SimpleQueue", Answers)
    env = InterventionWrapper(Integrator(), expert=expert, rule=rule, deadline=0.2)
    model = algorithm("MlpPolicy", env, buffer_size=50, policy_kwargs={"net_arch": [8]})
    if algorithm in (HGDagger, IWR):
        model.warm_up_steps = 0  # there the rule is "always"
    with pytest.raises(error, match=problem):
        model.learn(20)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    assert algorithm.load(tmp_path / "model").num_timesteps == model.num_timesteps


def test_an_action_that_cannot_be_written_to_is_one():
    action = np.array([0.5, 0.25])
    action.flags.writeable = False
    env = InterventionWrapper(Integrator(), expert=lambda observation: action, rule="always", armed=True)
    env.reset(seed=0)
    assert np.allclose(env.step(NOVICE)[4]["applied_action"], action)
