"""The gate between a policy and a vehicle: the only place from which actions leave. ``cpp/gate.hpp`` is the same in C++."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntEnum, IntFlag
from typing import Any, NamedTuple

from sb3_chac.deploy.metadata import Metadata, NotDeployable


class State(IntEnum):
    """
    States of the gate, by who determines what leaves it.

    ======== =========================================================================================
    NOMINAL  the policy, with shared control if it has that
    GUIDED   the human-guided policy alone: on request, after BRAKE or HUMAN for a while, or if the
             action of shared control is invalid and the guided one is not
    HOLD     the last action, without acceleration: what the policy wants is missing, late or invalid
    BRAKE    full braking, steering by the fallback or held: HOLD has lasted too long
    HUMAN    a person
    ======== =========================================================================================
    """

    NOMINAL = 0
    GUIDED = 1
    HOLD = 2
    BRAKE = 3
    HUMAN = 4


class Fault(IntFlag):
    """Reasons for which an action of the policy was not taken."""

    NONE = 0
    OBSERVATION = 1  # invalid: shape, NaN, out of range
    AGE = 2  # made from an observation that is too old
    SILENCE = 4  # nothing has arrived for too long
    DEADLINE = 8  # the decision took too long
    ACTION = 16  # missing, NaN, infinite or out of range
    CLOCK = 32  # time did not go on
    LATCHED = 64  # braked for so long that somebody must say that it may go on


class Given(NamedTuple):
    """
    Input of the gate at one step. Times in seconds.

    :param action: what the policy wants, shape (action_dim,), None if there is nothing
    :param guided_action: what the human-guided policy alone wants, None if that is not known
    :param age: since the observation that ``action`` was decided on
    :param silence: since anything arrived from the other side
    :param latency: that the decision took
    :param observation_ok: whether the observation passed its checks
    :param override: whether a person drives
    :param human_action: what the person wants, None if the vehicle gets that by itself
    :param guided_only: whether the human-guided policy is to act alone
    :param resume: whether somebody allows to go on after a long BRAKE
    :param fallback: action of a local controller that stops the vehicle on its way, None if there is none
    """

    action: Sequence[float] | None = None
    guided_action: Sequence[float] | None = None
    age: float = 0.0
    silence: float = 0.0
    latency: float = 0.0
    observation_ok: bool = True
    override: bool = False
    human_action: Sequence[float] | None = None
    guided_only: bool = False
    resume: bool = False
    fallback: Sequence[float] | None = None


class Decision(NamedTuple):
    """
    Output of the gate at one step.

    :param action: finite and within the bounds, whatever the gate was given
    :param state: who determined it
    :param faults: why it is not the policy's, if it is not
    :param engaged: False if a person drives by means of the vehicle's own and ``action`` is to be ignored
    """

    action: tuple[float, ...]
    state: State
    faults: Fault
    engaged: bool = True


@dataclass(frozen=True)
class Limits:
    """
    Limits of what the gate lets pass. The defaults are for a vehicle's side of a link at 10 Hz: BRAKE begins within .19 s of
    the last packet, and throttle ends within .09 s.

    :param low: least action, shape (action_dim,)
    :param high: greatest action
    :param brake: action of BRAKE, None for elements that keep their value
    :param coast: upper bounds of elements in HOLD, None for elements without one
    :param max_rate: greatest change of each element per second, other than by a person or to brake
    :param max_age: [s] of the observation
    :param max_silence: [s] without a packet
    :param deadline: [s] that a decision may take
    :param hold_for: [s] after the last valid step that HOLD lasts at most
    :param guided_for: [s] of GUIDED after BRAKE and HUMAN
    :param latch_after: [s] of BRAKE after which only ``resume``, or a person who takes over, ends it
    :param tolerance: by which actions may exceed their bounds, as a share of the distance between them
    :raises NotDeployable: for values that are not finite or do not fit together
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    brake: tuple[float | None, ...]
    coast: tuple[float | None, ...]
    max_rate: tuple[float, ...]
    max_age: float = 0.35
    max_silence: float = 0.09
    deadline: float = 0.05
    hold_for: float = 0.1
    guided_for: float = 1.0
    latch_after: float = 1.0
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        n = len(self.low)
        for name in ("low", "high", "brake", "coast", "max_rate"):
            values = getattr(self, name)
            if len(values) != n or n == 0:
                raise NotDeployable(f"{name} must have as many elements as low, at least one, got {values!r}.")
            if not all(value is None or math.isfinite(value) for value in values):
                raise NotDeployable(f"{name} must be finite, got {values!r}.")
        for i, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            if not low < high:
                raise NotDeployable(f"low must be below high, got {low} and {high}.")
            for name in ("brake", "coast"):
                value = getattr(self, name)[i]
                if value is not None and not low <= value <= high:
                    raise NotDeployable(f"{name} must be within the bounds {low} and {high}, got {value}.")
        if not all(rate > 0 for rate in self.max_rate):
            raise NotDeployable(f"max_rate must be above 0, got {self.max_rate}.")
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.type is float and not (math.isfinite(value) and value >= 0):
                raise NotDeployable(f"{entry.name} must be a finite number of at least 0, got {value!r}.")

    @classmethod
    def of(
        cls,
        metadata: Metadata,
        brake: Sequence[float | None] | None = None,
        coast: Sequence[float | None] | None = None,
        max_rate: Sequence[float] | None = None,
        **times: Any,
    ) -> "Limits":
        """
        Limits for an exported policy.

        :param brake: as in ``Limits``, by default as the file says
        :param coast: alike
        :param max_rate: alike, by default from one bound to the other in .1 s
        :param times: other arguments of ``Limits``
        :raises NotDeployable: if nobody says how the vehicle brakes
        """
        brake = metadata.brake if brake is None else brake
        if brake is None:
            raise NotDeployable("brake: the file does not say which action stops the vehicle, give it (such as hold,-1).")
        coast = metadata.coast if coast is None else coast
        if coast is None:
            coast = [None] * metadata.action_dim
        if max_rate is None:
            max_rate = [10.0 * (high - low) for low, high in zip(metadata.low, metadata.high, strict=True)]
        bounds = tuple(metadata.low), tuple(metadata.high)
        return cls(*bounds, tuple(brake), tuple(coast), tuple(max_rate), **times)


class Gate:
    """
    Gate that checks what a policy wants and decides what the vehicle gets, once per step. It begins in BRAKE, until the first
    valid step.

    :param limits: see there
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        limits = self.limits
        self.state = State.BRAKE
        self.action = tuple(
            min(max(0.0, low), high) if brake is None else brake
            for low, high, brake in zip(limits.low, limits.high, limits.brake, strict=True)
        )
        self._now = -math.inf
        self._valid_at = -math.inf  # when an action of the policy last passed
        self._guided_until = -math.inf
        self._brakes_since = math.inf  # inf: not at all, or nothing has passed yet
        self._latched = False

    def step(self, now: float, given: Given) -> Decision:
        """
        Decide what the vehicle gets.

        :param now: [s] of a clock that never goes back
        :param given: what is known
        """
        limits = self.limits
        dt = now - self._now if self._now > -math.inf else 0.0
        if math.isfinite(now) and now > self._now:
            self._now = now
            faults = Fault.NONE
        else:
            dt, faults = 0.0, Fault.CLOCK
        faults |= self._faults(given)
        self._latched = self._latched and not (given.resume or given.override)
        faults |= Fault.LATCHED if self._latched else Fault.NONE

        wanted = self._valid(given.action)
        guided = wanted if given.guided_action is None else self._valid(given.guided_action)
        is_nominal = wanted is not None and not given.guided_only and self._now >= self._guided_until
        chosen = wanted if is_nominal else guided
        faults |= Fault.ACTION if wanted is None or chosen is None else Fault.NONE

        if given.override:
            state = State.HUMAN
        elif chosen is not None and faults in (Fault.NONE, Fault.ACTION):
            state = State.NOMINAL if is_nominal else State.GUIDED
        elif not faults & Fault.CLOCK and self.state != State.BRAKE and self._now - self._valid_at <= limits.hold_for:
            state = State.HOLD
        else:
            state = State.BRAKE
        self._remember(state)
        return self._leave(chosen, given, dt, faults)

    def _faults(self, given: Given) -> Fault:
        """Compare the times with their limits. What is not a number, or negative, is too long."""
        limits = self.limits
        faults = Fault.NONE if given.observation_ok else Fault.OBSERVATION
        for fault, value, limit in (
            (Fault.AGE, given.age, limits.max_age),
            (Fault.SILENCE, given.silence, limits.max_silence),
            (Fault.DEADLINE, given.latency, limits.deadline),
        ):
            if not 0 <= value <= limit:
                faults |= fault
        return faults

    def _valid(self, action: Sequence[float] | None) -> tuple[float, ...] | None:
        """Return an action clipped to its bounds, None if it is none, not finite, or far out of its bounds."""
        limits = self.limits
        if action is None or len(action) != len(limits.low):
            return None
        values = []
        for value, low, high in zip(action, limits.low, limits.high, strict=True):
            slack = limits.tolerance * (high - low)
            if not low - slack <= value <= high + slack:  # NaN, too
                return None
            values.append(min(max(float(value), low), high))
        return tuple(values)

    def _remember(self, state: State) -> None:
        """Take the new state, with the times that count from it."""
        now = self._now
        if state in (State.NOMINAL, State.GUIDED):
            self._valid_at = now
        if state in (State.BRAKE, State.HUMAN):
            self._guided_until = now + self.limits.guided_for
        if state != State.BRAKE:
            self._brakes_since = math.inf
        elif self.state != State.BRAKE:
            self._brakes_since = now
        elif now - self._brakes_since > self.limits.latch_after:
            self._latched = True
        self.state = state

    def _leave(self, chosen: tuple[float, ...] | None, given: Given, dt: float, faults: Fault) -> Decision:
        """Make the action that the state stands for."""
        limits, state = self.limits, self.state
        human = self._valid(given.human_action)
        fallback = self._valid(given.fallback)
        engaged = True
        if state in (State.NOMINAL, State.GUIDED) and chosen is not None:
            self.action = self._towards(chosen, dt)
        elif state == State.HUMAN and given.human_action is None:
            engaged = False
            self.action = self._coasting()
        elif state == State.HUMAN and human is not None:
            self.action = human
        elif state == State.HOLD:
            self.action = self._coasting()
        else:  # also if what a person wants is invalid
            faults |= Fault.ACTION if state == State.HUMAN else Fault.NONE
            held = self.action if fallback is None else self._towards(fallback, dt)
            self.action = tuple(value if brake is None else brake for value, brake in zip(held, limits.brake, strict=True))
        return Decision(self.action, state, faults, engaged)

    def _towards(self, action: tuple[float, ...], dt: float) -> tuple[float, ...]:
        """Go from the last action towards another one, as fast as allowed."""
        return tuple(
            min(max(value, last - rate * dt), last + rate * dt)
            for value, last, rate in zip(action, self.action, self.limits.max_rate, strict=True)
        )

    def _coasting(self) -> tuple[float, ...]:
        """Return the last action without acceleration."""
        return tuple(
            value if bound is None else min(value, bound) for value, bound in zip(self.action, self.limits.coast, strict=True)
        )
