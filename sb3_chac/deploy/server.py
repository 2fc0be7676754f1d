"""An exported policy at the end of a network link. Without torch and Stable-Baselines3."""

import math
import secrets
import select
from collections import Counter
from typing import Any

import numpy as np

from sb3_chac.deploy.log import DecisionLog
from sb3_chac.deploy.runtime import Runtime, Step
from sb3_chac.deploy.udp import (
    Commanded,
    Flag,
    Newest,
    Observed,
    RemoteClock,
    pack_action,
    received_from,
    send,
    unpack_observation,
)


class PolicyServer:
    """
    The policy's end of the link.

    :param runtime: decides
    :param sock: bound UDP socket that does not block
    :param period: [s] after which a decision is made though no observation has come
    :param copies: of each packet
    :param allowed: address of the vehicle, None for the first one that sends an observation
    :param log: of decisions, None for none
    """

    def __init__(
        self,
        runtime: Runtime,
        sock: Any,
        period: float,
        copies: int = 2,
        allowed: str | None = None,
        log: DecisionLog | None = None,
    ) -> None:
        self.runtime, self.sock, self.period, self.copies, self.log = runtime, sock, period, copies, log
        self.allowed = allowed
        self.vehicle: Any = None
        self.session, self.sequence = secrets.randbits(32), 0
        self.last: Observed | None = None
        self.states: Counter[str] = Counter()
        self.latencies: list[float] = []
        self._newest, self._remote = Newest(), RemoteClock()

    def serve(self, steps: int | None = None) -> None:
        """
        Decide until ``steps`` decisions are made, or forever.
        """
        due = self.runtime.clock() + self.period
        while steps is None or self.sequence < steps:
            wait = due - self.runtime.clock()
            if wait > 0:
                select.select([self.sock], [], [], wait)
            packet = self.receive()
            now = self.runtime.clock()
            if packet is None and (now < due or self.vehicle is None):
                due = due if now < due else now + self.period
                continue
            self.answer(packet, now)
            due = now + self.period

    def receive(self) -> Observed | None:
        """Receive the newest observation that waits, None if there is none."""
        newest = None
        for data, sender in received_from(self.sock):
            if sender[0] != (self.allowed or (self.vehicle or sender)[0]):
                continue
            packet = unpack_observation(data, self.runtime.policy.metadata.inputs)
            if packet is not None and self._newest.is_new(packet.session, packet.sequence):
                if packet.session != (self.last or packet).session:
                    self._remote = RemoteClock()
                newest, self.vehicle = packet, sender
                self.last = packet
        return newest

    def answer(self, packet: Observed | None, now: float) -> Step:
        """
        Decide and send the action.

        :param packet: the observation, None if none has come in time
        :param now: [s] of the runtime's clock
        """
        last = packet or self.last
        flags = Flag.NONE if last is None else last.flags
        step = self.runtime.decide(
            None if packet is None else packet.observation,
            0.0 if packet is None else self._remote.age(packet.stamp, now),
            override=bool(flags & Flag.OVERRIDE),
            guided_only=bool(flags & Flag.GUIDED_ONLY),
            resume=packet is not None and bool(flags & Flag.RESUME),
        )
        decision, proposal = step.decision, step.proposal
        command = Commanded(
            self.session,
            self.sequence,
            0 if last is None else last.sequence,
            math.nan if last is None else last.stamp,
            decision.state,
            decision.faults,
            decision.action,
            decision.engaged,
            None if proposal is None else proposal.self_drives,
            math.nan if proposal is None or proposal.confidence is None else proposal.confidence,
            step.given.latency,
        )
        self.sequence += 1
        data = pack_action(command)
        for _ in range(self.copies):
            send(self.sock, data, self.vehicle)
        self.states[decision.state.name] += 1
        if packet is not None:
            self.latencies.append(step.given.latency)
        if self.log is not None:
            self.log.add(step, packet)
        return step

    def summary(self) -> str:
        """Return how often each state occurred, and how long decisions took."""
        if not self.latencies:
            return "No observation has come."
        counts = ", ".join(f"{name} {count}" for name, count in self.states.most_common())
        median, worst = 1e3 * np.quantile(self.latencies, [0.5, 0.999])
        return f"{self.sequence} decisions: {counts}. They took {median:.2f} ms, {worst:.2f} ms at the 99.9th percentile."
