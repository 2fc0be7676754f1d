"""Links that lose and delay packets: for rehearsals in one process with a clock of its own, and around real sockets."""

import heapq
import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from sb3_chac.deploy.metadata import NotDeployable


class Channel:
    """
    One direction of a link.

    :param rng: source of chance
    :param latency: [s] least delay of a packet
    :param jitter: [s] that the greatest delay is longer; uniform between the two, independent for each packet, so that packets
        overtake each other
    :param loss: share of the packets that are lost, independent of each other
    :raises NotDeployable: for values out of their range
    """

    def __init__(self, rng: np.random.Generator, latency: float = 0.0, jitter: float = 0.0, loss: float = 0.0) -> None:
        for name, value, high in [("latency", latency, math.inf), ("jitter", jitter, math.inf), ("loss", loss, 1.0)]:
            if not 0 <= value <= high or not math.isfinite(value):
                raise NotDeployable(
                    f"{name} must be a finite number of at least 0{', at most 1' * (high == 1)}, got {value!r}."
                )
        self.rng, self.latency, self.jitter, self.loss = rng, latency, jitter, loss
        self.is_cut = False
        self._waiting: list[tuple[float, int, Any]] = []
        self._numbers = itertools.count()

    def put(self, packet: Any, now: float) -> None:
        """
        Send a packet.

        :param now: [s] of the clock that ``ready`` is asked with
        """
        lost, delay = self.rng.random() < self.loss, self.latency + self.jitter * self.rng.random()
        if not lost and not self.is_cut:
            heapq.heappush(self._waiting, (now + delay, next(self._numbers), packet))

    def ready(self, now: float) -> list[Any]:
        """Return the packets that have arrived, each once."""
        packets = []
        while self._waiting and self._waiting[0][0] <= now:
            packets.append(heapq.heappop(self._waiting)[2])
        return packets

    def cut(self) -> None:
        """Lose everything from now on, what is under way, too."""
        self.is_cut = True
        self._waiting.clear()


class SimulatedSocket:
    """
    An end of a link without a network, for ``VehicleLink`` and ``PolicyServer``.

    :param outgoing: where packets go
    :param incoming: where they come from
    :param clock: [s]
    """

    PEER = ("peer", 0)

    def __init__(self, outgoing: Channel, incoming: Channel, clock: Callable[[], float]) -> None:
        self.outgoing, self.incoming, self.clock = outgoing, incoming, clock
        self._arrived: list[bytes] = []

    def sendto(self, data: bytes, address: Any) -> None:
        """Send a packet to the other end, whatever the address."""
        self.outgoing.put(data, self.clock())

    def recvfrom(self, size: int) -> tuple[bytes, Any]:
        """
        Receive a packet.

        :raises BlockingIOError: if nothing has arrived
        """
        self._arrived += self.incoming.ready(self.clock())
        if not self._arrived:
            raise BlockingIOError
        return self._arrived.pop(0), self.PEER

    def close(self) -> None:
        """Close nothing."""


class DegradedSocket:
    """
    A real socket with a worse link in both directions. What waits is sent and received when ``recvfrom`` is called.

    :param sock: bound UDP socket that does not block
    :param outgoing: of the packets that are sent
    :param incoming: of those that arrive
    :param clock: [s]
    """

    def __init__(self, sock: Any, outgoing: Channel, incoming: Channel, clock: Callable[[], float]) -> None:
        self.sock, self.outgoing, self.incoming, self.clock = sock, outgoing, incoming, clock
        self._arrived: list[tuple[bytes, Any]] = []

    def sendto(self, data: bytes, address: Any) -> None:
        """Send a packet, some time."""
        self.outgoing.put((data, address), self.clock())
        self._flush()

    def recvfrom(self, size: int) -> tuple[bytes, Any]:
        """
        Receive a packet.

        :raises BlockingIOError: if nothing has arrived
        """
        self._flush()
        try:
            while True:
                self.incoming.put(self.sock.recvfrom(size), self.clock())
        except OSError:  # nothing waits
            pass
        self._arrived += self.incoming.ready(self.clock())
        if not self._arrived:
            raise BlockingIOError
        return self._arrived.pop(0)

    def _flush(self) -> None:
        for data, address in self.outgoing.ready(self.clock()):
            self.sock.sendto(data, address)

    def fileno(self) -> int:
        """Return the real socket's."""
        return self.sock.fileno()

    def close(self) -> None:
        """Close the real socket."""
        self.sock.close()
