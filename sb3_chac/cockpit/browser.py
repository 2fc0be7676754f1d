"""A person at the wheel in a browser: where the page is served, its messages, and the device that they make."""

import ipaddress
import json
import math
import time
from contextlib import suppress
from typing import Any, Literal, NamedTuple

from sb3_chac.cockpit.devices import GAMEPAD, Clock, Command, DriverInput, Pedal, Ramps

KEYS = {"left", "right", "up", "down"}
COMMANDS = {command.value: command for command in (Command.PAUSE, Command.SKIP, Command.QUIT)}
STALE = 0.3  # [s] without a message; the page sends every 50 ms
TRIGGER = Pedal(0, 0.0, 1.0)  # as browsers report them


class Address(NamedTuple):
    """Where the cockpit is served."""

    host: str
    port: int

    @property
    def is_loopback(self) -> bool:
        return self.host == "localhost" or (is_number(self.host) and ipaddress.ip_address(self.host).is_loopback)

    def url(self, token: str, scheme: str = "http") -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{scheme}://{host}:{self.port}/?token={token}"


def parse_address(text: str) -> Address:
    """
    Parse the address to serve on.

    :param text: HOST:PORT or PORT (then on loopback)
    :raises ValueError: if it is neither
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") or "127.0.0.1"
    if not port.isascii() or not port.isdecimal() or len(port) > 5 or int(port) > 65535:
        raise ValueError(f"--serve must be PORT or HOST:PORT, for example 127.0.0.1:8000, got {text!r}.")
    return Address(host, int(port))


def is_number(host: str) -> bool:
    """
    Tell IP addresses from names.

    :return: whether it is an IP address, not a name
    """
    with suppress(ValueError):
        ipaddress.ip_address(host)
        return True
    return False


class BadMessage(ValueError):
    """Raised for a message that the page does not send."""


class Held(NamedTuple):
    """
    What the driver holds: keys, and a gamepad if there is one (stick to the right, right trigger, left trigger).
    """

    keys: frozenset[str]
    gamepad: tuple[float, float, float] | None


class Wish(NamedTuple):
    """Anything else that the page asks for; ``number`` is that of a ping."""

    name: Literal["pause", "skip", "quit", "takeover", "wheel", "away", "ping"]
    number: int = 0


def parse(text: str) -> Held | Wish:
    """
    Parse a message of the page.

    :param text: JSON, ``{"keys": [...], "gamepad": null or [x, y, z]}``, ``{"wish": name}`` or ``{"ping": number}``
    :raises BadMessage: for everything else
    """
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadMessage("no JSON") from error
    match data:
        case {"keys": list(keys), "gamepad": gamepad} if len(data) == 2:
            if len(keys) > len(KEYS) or not all(isinstance(key, str) and key in KEYS for key in keys):
                raise BadMessage("unknown keys")
            return Held(frozenset(keys), _gamepad(gamepad))
        case {"wish": ("pause" | "skip" | "quit" | "takeover" | "wheel" | "away") as name} if len(data) == 1:
            return Wish(name)
        case {"ping": int(number)} if len(data) == 1 and not isinstance(number, bool) and 0 <= number < 2**53:
            return Wish("ping", number)
    raise BadMessage("unknown message")


def _gamepad(values: Any) -> tuple[float, float, float] | None:
    if values is None:
        return None
    if not isinstance(values, list) or len(values) != 3:
        raise BadMessage("a gamepad has three values")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float) or not -1 <= value <= 1:
            raise BadMessage("values of a gamepad are from -1 to 1")
    return float(values[0]), float(values[1]), float(values[2])


class Browser:
    """
    The device of who drives in a browser: nobody at first. It is lost if nothing was heard of the driver for ``STALE``.

    :param clock: [s]
    """

    name = "browser"

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self.clock = clock
        self.ramps = Ramps(clock)
        self.takeover = False
        self.leave()

    def sit_down(self) -> None:
        """Somebody takes the wheel."""
        self.taken = True

    def leave(self) -> None:
        """Nobody is there any more. A takeover is not over by that."""
        self.taken, self.heard_at, self.time = False, -math.inf, -math.inf
        self.go_away()

    def go_away(self) -> None:
        """Whoever is there looks elsewhere, until the next message."""
        self.ramps.stop()
        self.gamepad: tuple[float, float, float] | None = None
        self.heard_at = -math.inf

    def handle(self, event: Any) -> Command | None:
        """
        Take in an event of the person at the wheel.

        :param event: ``Held`` or ``Wish`` of who sits at the wheel
        """
        now = self.clock()
        if isinstance(event, Held):
            if event.keys - self.ramps.held:
                self.takeover = True
            if event.keys != self.ramps.held or event.gamepad != self.gamepad:
                self.time = now
            self.ramps.hold(event.keys)
            self.gamepad = event.gamepad
            self.heard_at = now
        elif isinstance(event, Wish):
            if event.name == "away":
                self.go_away()
            elif event.name == "takeover":
                self.takeover, self.time = not self.takeover, now
            return COMMANDS.get(event.name)
        return None

    def read(self) -> DriverInput:
        steering, pedals = self.ramps.move()
        if self.gamepad is not None and not self.ramps.held:
            stick, throttle, brake = self.gamepad
            steering, braking = GAMEPAD.steering.value(stick), TRIGGER.value(brake)
            pedals = -braking if braking > 0 else TRIGGER.value(throttle)
        connected = self.taken and self.clock() - self.heard_at < STALE
        return DriverInput(steering, pedals, self.takeover, connected, self.time)

    def hand_back(self) -> None:
        self.takeover = False
