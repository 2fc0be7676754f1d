"""The gate: whatever it is given, only checked actions leave it, and a person wins within one step."""

import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_chac.deploy.gate import Decision, Fault, Gate, Given, Limits, State
from sb3_chac.deploy.metadata import Metadata, NotDeployable

LIMITS = Limits((-1.0, -1.0), (1.0, 0.8), (None, -1.0), (None, 0.0), (5.0, 10.0), guided_for=0.3)
GOOD = Given((0.1, 0.5), (0.0, 0.2))


def drive(gate, start, seconds, given=GOOD, dt=0.04):
    """:return: the decisions of some time, and when it ended"""
    steps = round(seconds / dt)
    return [gate.step(start + i * dt, given) for i in range(1, steps + 1)], start + steps * dt


def nominal(limits=LIMITS):
    """A gate that has been in NOMINAL for a while, and its time."""
    gate = Gate(limits)
    decisions, now = drive(gate, 0.0, 2.0)
    assert decisions[-1] == Decision((0.1, 0.5), State.NOMINAL, Fault.NONE)
    return gate, now


def test_it_begins_with_the_brake_and_the_guided_policy():
    gate = Gate(LIMITS)
    assert gate.step(0.0, Given()) == Decision((0.0, -1.0), State.BRAKE, Fault.ACTION)
    states = [decision.state for decision in drive(gate, 0.0, 0.6)[0]]
    assert states[0] == State.GUIDED and states[-1] == State.NOMINAL
    assert not gate.step(0.7, Given(age=99.0)).faults & Fault.LATCHED  # waiting at the start latches nothing


@pytest.mark.parametrize(
    "bad, fault",
    [
        (GOOD._replace(observation_ok=False), Fault.OBSERVATION),
        (GOOD._replace(age=9.0), Fault.AGE),
        (GOOD._replace(age=-0.1), Fault.AGE),
        (GOOD._replace(silence=math.nan), Fault.SILENCE),
        (GOOD._replace(latency=math.inf), Fault.DEADLINE),
        (GOOD._replace(action=None, guided_action=None), Fault.ACTION),
        (GOOD._replace(action=(math.nan, 0.0), guided_action=(0.0, math.inf)), Fault.ACTION),
        (GOOD._replace(action=(0.0, 0.0, 0.0), guided_action=()), Fault.ACTION),
        (GOOD._replace(action=(1.1, 0.0), guided_action=None), Fault.ACTION),
    ],
)
def test_every_fault_leads_to_hold_then_brake_then_back(bad, fault):
    gate, now = nominal()
    decisions, now = drive(gate, now, 0.5, bad)
    assert {decision.faults for decision in decisions} == {fault}
    states = [decision.state for decision in decisions]
    assert states == [State.HOLD] * 2 + [State.BRAKE] * 10  # 0.1 s at 25 Hz
    assert decisions[0].action == (0.1, 0.0)  # no acceleration
    assert decisions[-1].action == (0.1, -1.0)  # steering held
    back, _ = drive(gate, now, 0.5)
    assert back[0].state == State.GUIDED and back[-1].state == State.NOMINAL


def test_a_long_brake_ends_only_when_somebody_says_so():
    gate, now = nominal()
    _, now = drive(gate, now, 2.0, GOOD._replace(silence=9.0))
    decisions, now = drive(gate, now, 1.0)
    assert {(d.state, d.faults) for d in decisions} == {(State.BRAKE, Fault.LATCHED)}
    resumed = gate.step(now + 0.05, GOOD._replace(resume=True))
    assert resumed.state == State.GUIDED
    assert gate.step(now + 0.1, GOOD).state == State.GUIDED


def test_a_person_who_takes_over_unlatches():
    gate, now = nominal()
    _, now = drive(gate, now, 2.0, GOOD._replace(silence=9.0))
    assert gate.step(now + 0.05, GOOD._replace(override=True)).state == State.HUMAN
    assert gate.step(now + 0.1, GOOD).state == State.GUIDED


def test_a_person_gets_what_they_want():
    gate, now = nominal()
    assert gate.step(now + 0.01, GOOD._replace(override=True, human_action=(-1.0, 0.8))) == Decision(
        (-1.0, 0.8), State.HUMAN, Fault.NONE
    )
    assert not gate.step(now + 0.02, GOOD._replace(override=True)).engaged
    broken = gate.step(now + 0.03, GOOD._replace(override=True, human_action=(math.nan, 0.0)))
    assert (broken.state, broken.action[1], broken.engaged) == (State.HUMAN, -1.0, True)


def test_the_fallback_steers_while_braking():
    gate, now = nominal()
    _, now = drive(gate, now, 0.1, Given(fallback=(0.5, 0.8)))
    decisions, _ = drive(gate, now, 0.2, Given(fallback=(0.5, 0.8)))
    assert decisions[0].action == (pytest.approx(0.3), -1.0) and decisions[-1].action == (0.5, -1.0)


def test_an_invalid_shared_action_leaves_the_guided_one():
    gate, now = nominal()
    decision = gate.step(now + 1.0, GOOD._replace(action=(math.nan, 0.0)))
    assert decision == Decision((0.0, 0.2), State.GUIDED, Fault.ACTION)
    assert gate.step(now + 2.0, GOOD._replace(guided_only=True)).action == (0.0, 0.2)


def test_a_clock_that_stands_still_brakes():
    gate, now = nominal()
    for stuck in (now, now - 1.0, math.nan, math.inf):
        assert gate.step(stuck, GOOD) == Decision((0.1, -1.0), State.BRAKE, Fault.CLOCK)


numbers = st.one_of(st.floats(-1.2, 1.2), st.sampled_from([math.nan, math.inf, -math.inf, 1e300, 0.0]))
actions = st.one_of(st.none(), st.lists(numbers, min_size=2, max_size=2), st.lists(numbers, max_size=3))
times = st.one_of(st.floats(0, 0.5), st.sampled_from([math.nan, math.inf, -1.0, 0.0]))
rarely = st.sampled_from([False] * 7 + [True])
anything = st.builds(Given, actions, actions, times, times, times, st.booleans(), rarely, actions, rarely, rarely, actions)
good = st.builds(lambda x, y: Given((x, y), (y, x)), st.floats(-1, 0.8), st.floats(-1, 0.8))
steps = st.lists(
    st.tuples(st.one_of(st.floats(0.001, 0.2), st.sampled_from([0.0, -1.0, math.nan])), st.one_of(good, anything)), max_size=30
)


@given(steps)
@settings(max_examples=300, derandomize=True, suppress_health_check=list(HealthCheck))
def test_no_sequence_of_faults_leads_to_an_unchecked_action(sequence):
    gate, now, valid_at = Gate(LIMITS), 0.0, -math.inf
    last = gate.step(now, Given()).action
    for dt, told in sequence:
        advanced = dt > 0
        now = now + dt if advanced else now
        action, state, faults, engaged = gate.step(now if advanced else dt, told)
        # Finite and within the bounds, always
        assert all(low <= value <= high for value, low, high in zip(action, LIMITS.low, LIMITS.high, strict=True))
        # A person wins at once, and only a person is HUMAN
        assert (state == State.HUMAN) == told.override
        # The policy passes only if all checks do
        if state in (State.NOMINAL, State.GUIDED):
            assert advanced and told.observation_ok and not faults & ~Fault.ACTION
            assert 0 <= told.age <= LIMITS.max_age and 0 <= told.silence <= LIMITS.max_silence
            assert 0 <= told.latency <= LIMITS.deadline
            valid_at = now
        if state == State.NOMINAL:
            assert faults == Fault.NONE and not told.guided_only
        # Hold is short and never accelerates
        if state == State.HOLD:
            assert now - valid_at <= LIMITS.hold_for and action[1] <= 0
        if state == State.BRAKE:
            assert action[1] == -1
        # What a policy or the fallback changes, it changes slowly
        if state != State.HUMAN:
            allowed = LIMITS.max_rate[0] * max(dt, 0.0) if advanced else 0.0
            assert abs(action[0] - last[0]) <= allowed + 1e-9
        assert engaged or (state == State.HUMAN and told.human_action is None)
        last = action


@pytest.mark.parametrize(
    "wrong, named",
    [
        ({"high": (1.0, math.inf)}, "high"),
        ({"low": (1.0, -1.0)}, "below"),
        ({"brake": (None,)}, "brake"),
        ({"brake": (None, -2.0)}, "brake"),
        ({"max_rate": (0.0, 1.0)}, "max_rate"),
        ({"hold_for": math.nan}, "hold_for"),
        ({"max_age": -1.0}, "max_age"),
    ],
)
def test_limits_are_checked(wrong, named):
    right = {"low": (-1.0, -1.0), "high": (1.0, 1.0), "brake": (None, -1.0), "coast": (None, 0.0), "max_rate": (1.0, 1.0)}
    with pytest.raises(NotDeployable, match=named):
        Limits(**(right | wrong))


def test_limits_of_a_policy():
    described = Metadata((), [-1.0], [1.0], brake=[-1.0])
    assert Limits.of(described, hold_for=0.2) == Limits((-1.0,), (1.0,), (-1.0,), (None,), (20.0,), hold_for=0.2)
    with pytest.raises(NotDeployable, match="which action stops"):
        Limits.of(Metadata((), [-1.0], [1.0]))
