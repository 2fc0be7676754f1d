"""
Observations and actions over UDP: the packets, and the vehicle's end of the link.

All numbers are little endian. A packet ends with the CRC-32 of what stands before it; what does not fit is dropped. Sequence
numbers grow by one per packet; copies of a packet, and those that come after a newer one, are dropped.

Observation, vehicle to policy::

    4 bytes "SBO1"   u32 session   u32 sequence   u16 flags   u16 n   f64 stamp   f32 reward   f32 cost   n * f32 executed
    the observation: the bytes of its tensors in the order of the policy's file, in their dtypes

Action, policy to vehicle::

    4 bytes "SBA1"   u32 session   u32 sequence   u32 observation   f64 stamp   u8 state   u8 flags   u16 faults   u16 n
    f32 confidence   f32 latency   n * f32 action

``stamp`` is the vehicle's clock [s] when the observation was made, in an action that of the observation behind it.
"""

import math
import secrets
import socket
import struct
import zlib
from collections.abc import Sequence
from enum import IntFlag
from typing import Any, NamedTuple

import numpy as np

from sb3_chac.deploy.address import parse_address, resolve
from sb3_chac.deploy.fallback import RouteFallback
from sb3_chac.deploy.gate import Decision, Fault, Gate, Given, Limits, State
from sb3_chac.deploy.metadata import Input, Metadata, NotDeployable
from sb3_chac.deploy.runtime import fallback_action

MAX_PACKET = 65_507  # [bytes] that UDP carries
OBSERVATION, ACTION = b"SBO1", b"SBA1"
_OBSERVATION, _ACTION, _CRC = struct.Struct("<4sIIHHdff"), struct.Struct("<4sIIIdBBHHff"), struct.Struct("<I")
SESSIONS_REMEMBERED = 16
OFFSET_LEAK = 1e-4  # by which clocks may drift from each other, per second


class Flag(IntFlag):
    """Flags of an observation packet."""

    NONE = 0
    OVERRIDE = 1  # a person drives
    EXECUTED = 2  # what was executed since the observation before is there
    BY_HUMAN = 4  # a person did that
    START = 8  # the first of an episode
    TERMINATED = 16  # the last of an episode
    TRUNCATED = 32  # alike, but it might have gone on
    SUCCESS = 64
    REWARD = 128  # there is one
    COST = 256
    GUIDED_ONLY = 512  # the human-guided policy is to act alone
    RESUME = 1024  # go on after a long BRAKE


class Observed(NamedTuple):
    """An observation packet. ``executed`` is None, ``reward`` and ``cost`` NaN if they are not there."""

    session: int
    sequence: int
    flags: Flag
    stamp: float
    observation: Any
    executed: tuple[float, ...] | None = None
    reward: float = math.nan
    cost: float = math.nan


class Commanded(NamedTuple):
    """An action packet. ``self_drives`` is None and ``confidence`` NaN without shared control."""

    session: int
    sequence: int
    observation: int
    stamp: float
    state: State
    faults: Fault
    action: tuple[float, ...]
    engaged: bool = True
    self_drives: bool | None = None
    confidence: float = math.nan
    latency: float = 0.0


def pack_observation(packet: Observed, inputs: Sequence[Input]) -> bytes:
    """
    Pack an observation.

    :param inputs: of the policy
    :raises NotDeployable: if the observation does not fit them, or into a packet
    """
    parts = packet.observation if isinstance(packet.observation, dict) else {"": packet.observation}
    executed = packet.executed or ()
    flags = packet.flags | (Flag.EXECUTED if packet.executed is not None else Flag.NONE)
    head = _OBSERVATION.pack(
        OBSERVATION, packet.session, packet.sequence, flags, len(executed), packet.stamp, packet.reward, packet.cost
    )
    body = [head, struct.pack(f"<{len(executed)}f", *executed)]
    for entry in inputs:
        values = np.ascontiguousarray(parts[entry.key], np.dtype(entry.dtype).newbyteorder("<"))
        if values.shape != entry.shape:
            raise NotDeployable(f"{entry.tensor} must have shape {entry.shape}, got {values.shape}.")
        body.append(values.tobytes())
    return _sealed(b"".join(body))


def unpack_observation(data: bytes, inputs: Sequence[Input]) -> Observed | None:
    """
    Unpack an observation.

    :param inputs: of the policy
    :return: None for anything but an intact observation packet of such a policy
    """
    if not _is_intact(data, OBSERVATION, _OBSERVATION):
        return None
    _, session, sequence, flags, n, stamp, reward, cost = _OBSERVATION.unpack_from(data)
    start = _OBSERVATION.size + 4 * n
    if len(data) != start + sum(entry.nbytes for entry in inputs) + _CRC.size:
        return None
    executed = struct.unpack_from(f"<{n}f", data, _OBSERVATION.size) if flags & Flag.EXECUTED else None
    parts = {}
    for entry in inputs:
        dtype = np.dtype(entry.dtype)
        values = np.frombuffer(data, dtype.newbyteorder("<"), entry.size, start).astype(dtype)
        parts[entry.key] = values.reshape(entry.shape)
        start += entry.nbytes
    observation = parts if inputs[0].key else parts[""]
    return Observed(session, sequence, Flag(flags), stamp, observation, executed, reward, cost)


def pack_action(packet: Commanded) -> bytes:
    """Make the bytes of an action packet."""
    flags = packet.engaged | (packet.self_drives is not None) << 1 | bool(packet.self_drives) << 2
    head = _ACTION.pack(
        ACTION, packet.session, packet.sequence, packet.observation, packet.stamp, packet.state, flags, packet.faults,
        len(packet.action), packet.confidence, packet.latency,
    )  # fmt: skip
    return _sealed(head + struct.pack(f"<{len(packet.action)}f", *packet.action))


def unpack_action(data: bytes) -> Commanded | None:
    """
    Unpack an action.

    :return: None for anything but an intact action packet
    """
    if not _is_intact(data, ACTION, _ACTION):
        return None
    _, session, sequence, observation, stamp, state, flags, faults, n, confidence, latency = _ACTION.unpack_from(data)
    if len(data) != _ACTION.size + 4 * n + _CRC.size or state > max(State):
        return None
    action = struct.unpack_from(f"<{n}f", data, _ACTION.size)
    self_drives = bool(flags & 4) if flags & 2 else None
    return Commanded(
        session, sequence, observation, stamp, State(state), Fault(faults), action, bool(flags & 1), self_drives,
        confidence, latency,
    )  # fmt: skip


def _sealed(body: bytes) -> bytes:
    packet = body + _CRC.pack(zlib.crc32(body))
    if len(packet) > MAX_PACKET:
        raise NotDeployable(
            f"an observation of {len(packet)} bytes does not fit into a UDP packet ({MAX_PACKET}): use the class Runtime."
        )
    return packet


def _is_intact(data: bytes, magic: bytes, head: struct.Struct) -> bool:
    if len(data) < head.size + _CRC.size or data[:4] != magic:
        return False
    return _CRC.unpack_from(data, len(data) - _CRC.size)[0] == zlib.crc32(data[: -_CRC.size])


class Newest:
    """Filter that tells new packets from copies and old ones."""

    def __init__(self) -> None:
        self.session: int | None = None
        self.sequence = -1
        self._ended: list[int] = []

    def is_new(self, session: int, sequence: int) -> bool:
        """Tell whether a packet is newer than all before it. A new session is a sender that was started again."""
        if session in self._ended:
            return False
        if session != self.session:
            if self.session is not None:
                self._ended = [*self._ended[1 - SESSIONS_REMEMBERED :], self.session]
            self.session, self.sequence = session, -1
        if sequence <= self.sequence:
            return False
        self.sequence = sequence
        return True


class RemoteClock:
    """
    Clock that tells how old a packet is, though the clocks of both ends have nothing to do with each other: against the packet
    that came through fastest.
    """

    def __init__(self) -> None:
        self._offset, self._at = math.inf, math.nan

    def age(self, stamp: float, now: float) -> float:
        """
        Estimate the age of a packet.

        :param stamp: [s] of the sender's clock
        :param now: [s] of ours, when the packet arrived
        :return: [s] at least 0; NaN if the stamp is not finite
        """
        if not math.isfinite(stamp):
            return math.nan
        if self._offset < math.inf:
            self._offset += OFFSET_LEAK * max(now - self._at, 0.0)
        self._at = now
        self._offset = min(self._offset, now - stamp)
        return now - stamp - self._offset


class VehicleLink:
    """
    The vehicle's end: sends observations, receives actions, and passes them through a gate of its own, which brakes when the
    link is cut. No thread: ``step`` has to be called often (100 times a second), whatever the rate of the observations.

    :param metadata: of the policy
    :param policy_address: host and port of ``sb3-chac run``
    :param limits: of the gate, by default those of the file
    :param copies: how many times each packet is sent
    :param fallback: steers during BRAKE, by default along the route, if the observation has one
    :param sock: a bound, non-blocking UDP socket, made if None
    :raises NotDeployable: without ``sock``, for an address that is none, or of no host
    """

    def __init__(
        self,
        metadata: Metadata,
        policy_address: tuple[str, int],
        limits: Limits | None = None,
        copies: int = 2,
        fallback: RouteFallback | None = None,
        sock: Any = None,
    ) -> None:
        self.metadata, self.address, self.copies = metadata, policy_address, copies
        self.gate = Gate(limits or Limits.of(metadata))
        self.fallback = fallback or RouteFallback.of(metadata)
        if sock is None:
            host, port = parse_address("policy_address", ":".join(map(str, policy_address)), low=1)
            self.address = resolve("policy_address", host), port
            sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sock.bind(("", 0))
            sock.setblocking(False)
        self.sock = sock
        self.session, self.sequence = secrets.randbits(32), 0
        self.command: Commanded | None = None
        self._newest = Newest()
        self._heard = -math.inf
        self._last = math.nan

    def observe(
        self,
        observation: Any,
        now: float,
        flags: Flag = Flag.NONE,
        executed: Sequence[float] | None = None,
        reward: float = math.nan,
        cost: float = math.nan,
    ) -> None:
        """
        Send an observation.

        :param observation: as the environment gives it
        :param now: [s] of the vehicle's clock
        :param flags: what else there is to tell. Who drives is known from ``step``
        :param executed: action since the observation before
        :param reward: of it, alike ``cost``
        """
        if self.gate.state in (State.GUIDED, State.BRAKE, State.HUMAN):
            flags |= Flag.GUIDED_ONLY
        if self.gate.state == State.HUMAN:
            flags |= Flag.OVERRIDE | Flag.BY_HUMAN
        if math.isfinite(reward):
            flags |= Flag.REWARD
        if math.isfinite(cost):
            flags |= Flag.COST
        told = None if executed is None else tuple(float(value) for value in executed)
        packet = Observed(self.session, self.sequence, flags, now, observation, told, reward, cost)
        data = pack_observation(packet, self.metadata.inputs)
        self.sequence += 1
        for _ in range(self.copies):
            send(self.sock, data, self.address)
        if self.fallback is not None and np.isfinite(observation).all():
            self.fallback.observe(observation)

    def step(
        self,
        now: float,
        override: bool = False,
        human_action: Sequence[float] | None = None,
        resume: bool = False,
    ) -> Decision:
        """
        Receive what has arrived and decide what the actuators get.

        :param now: [s] of the vehicle's clock
        :param override: whether a person drives
        :param human_action: what the person wants, None if the vehicle gets that by itself
        :param resume: whether somebody allows to go on after a long BRAKE
        """
        for data in received(self.sock):
            command = unpack_action(data)
            if command is not None and self._newest.is_new(command.session, command.sequence):
                self.command, self._heard = command, now
        if self.fallback is not None:
            self.fallback.advance(self.gate.action, now - self._last)
        self._last = now
        command = self.command
        given = Given(
            action=None if command is None else command.action,
            age=math.inf if command is None else now - command.stamp,
            silence=now - self._heard,
            latency=0.0 if command is None else command.latency,
            observation_ok=command is not None and not command.faults & Fault.OBSERVATION,
            override=override,
            human_action=human_action,
            resume=resume,
            fallback=fallback_action(self.fallback, self.gate),
        )
        return self.gate.step(now, given)

    def close(self) -> None:
        """Close the socket."""
        self.sock.close()


def send(sock: Any, data: bytes, address: tuple[str, int]) -> None:
    """Send a packet. One that the network does not take is lost, as others are."""
    try:
        sock.sendto(data, address)
    except OSError:
        pass


def received(sock: Any) -> list[bytes]:
    """Return the packets that wait in a socket that does not block."""
    return [data for data, _ in received_from(sock)]


def received_from(sock: Any) -> list[tuple[bytes, Any]]:
    """Return the packets that wait in a socket that does not block, with their senders."""
    packets = []
    while True:
        try:
            packets.append(sock.recvfrom(MAX_PACKET))
        except OSError:  # nothing waits, or the network has something to complain of
            return packets
