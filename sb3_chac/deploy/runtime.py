"""An exported policy behind the gate, as a class for ``sb3-chac run``, a ROS 2 node or a loop of your own."""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_chac.deploy.fallback import RouteFallback
from sb3_chac.deploy.gate import Decision, Gate, Given, Limits, State
from sb3_chac.deploy.policy import OnnxPolicy, Proposal, check_observation

# On the policy's side nothing but observations arrives, once per period
MAX_SILENCE, HOLD_FOR = 0.25, 0.2  # [s]


class Step(NamedTuple):
    """
    One decision and what led to it.

    :param time: [s] of the runtime's clock
    :param observation: None if none had arrived since the last decision
    :param problem: why the observation is invalid, None if it is valid
    :param proposal: of the policy, None without a valid observation so far
    :param given: what the gate was given
    :param decision: what it decided
    """

    time: float
    observation: Any
    problem: str | None
    proposal: Proposal | None
    given: Given
    decision: Decision


class Runtime:
    """
    Decide once per period. Not thread-safe.

    ::

        runtime = Runtime("policy.onnx")
        step = runtime.decide(observation)  # once per period, with None if nothing new has arrived
        steering, acceleration = step.decision.action

    :param policy: exported policy, or its file
    :param limits: of the gate; by default those of the file, for a policy's side
    :param fallback: steers during BRAKE; by default along the route, if the observation has one
    :param clock: [s], never goes back
    :param warm_up: decisions that are made and thrown away, as the first ones take longer
    """

    def __init__(
        self,
        policy: OnnxPolicy | str | Path,
        limits: Limits | None = None,
        fallback: RouteFallback | None = None,
        clock: Callable[[], float] = time.monotonic,
        warm_up: int = 50,
    ) -> None:
        self.policy = policy if isinstance(policy, OnnxPolicy) else OnnxPolicy(policy)
        metadata = self.policy.metadata
        self.limits = limits or Limits.of(metadata, max_silence=MAX_SILENCE, hold_for=HOLD_FOR)
        self.gate = Gate(self.limits)
        self.fallback = fallback or RouteFallback.of(metadata)
        self.clock = clock
        zeros = {entry.key: np.zeros(entry.shape, entry.dtype) for entry in metadata.inputs}
        for _ in range(warm_up):
            self.policy(zeros if metadata.inputs[0].key else zeros[""])
        self.reset()

    def reset(self) -> None:
        """Begin anew, in BRAKE."""
        self.gate.reset()
        self._proposal: Proposal | None = None
        self._problem: str | None = "there has been no observation"
        self._observed = self._heard = -math.inf
        self._latency = 0.0
        self._last = math.nan

    def decide(
        self,
        observation: Any = None,
        age: float = 0.0,
        *,
        override: bool = False,
        human_action: Sequence[float] | None = None,
        guided_only: bool = False,
        resume: bool = False,
    ) -> Step:
        """
        Make one decision.

        :param observation: the newest one, None if none has arrived since the last decision
        :param age: [s] of it
        :param override: whether a person drives
        :param human_action: what the person wants, None if the vehicle gets that by itself
        :param guided_only: whether the human-guided policy is to act alone
        :param resume: whether somebody allows to go on after a long BRAKE
        """
        start = self.clock()
        if self.fallback is not None:
            self.fallback.advance(self.gate.action, start - self._last)
        if observation is not None:
            self._heard, self._observed = start, start - age
            self._problem = check_observation(observation, self.policy.metadata)
            if self._problem is None:
                self._proposal = self.policy(observation)
                if self.fallback is not None:
                    self.fallback.observe(observation)
                    self.fallback.advance(self.gate.action, age)
            self._latency = self.clock() - start
        self._last = now = self.clock()
        proposal = self._proposal
        given = Given(
            action=None if proposal is None else proposal.action.ravel().tolist(),
            guided_action=None
            if proposal is None or proposal.guided_action is None
            else proposal.guided_action.ravel().tolist(),
            age=now - self._observed,
            silence=now - self._heard,
            latency=self._latency,
            observation_ok=self._problem is None,
            override=override,
            human_action=human_action,
            guided_only=guided_only,
            resume=resume,
            fallback=fallback_action(self.fallback, self.gate),
        )
        return Step(now, observation, self._problem, proposal, given, self.gate.step(now, given))


def flat(action: np.ndarray | None) -> list[float] | None:
    """Return the elements as Python's numbers, None for None."""
    return None if action is None else action.ravel().tolist()


def fallback_action(fallback: RouteFallback | None, gate: Gate) -> tuple[float, float] | None:
    """Ask the fallback where it may be needed next: after HOLD and BRAKE. None if there is none."""
    return fallback() if fallback is not None and gate.state in (State.HOLD, State.BRAKE) else None
