"""A person at the wheel in a browser: the messages of the page, and the device that they make."""

import json
import math
import time
from typing import Any, Literal, NamedTuple

from sb3_chac.cockpit.devices import GAMEPAD, Clock, Command, DriverInput, Pedal, Ramps

KEYS = {"left", "right", "up", "down"}
WISHES = {"pause", "skip", "success", "failure", "quit", "corridors", "takeover", "wheel", "hand_over", "away"}
COMMANDS: dict[str, Command] = {command.value: command for command in Command if command.value in WISHES}
STALE = 0.3  # [s] without a message; the page sends every 50 ms
TRIGGER = Pedal(0, 0.0, 1.0)  # as browsers report them
MOMENT = 1.0  # [s] from the last touch until a takeover that began with one is handed back


class BadMessage(ValueError):
    """Raised for a message that the page does not send."""


class Held(NamedTuple):
    """
    Controls that the driver holds: keys, a gamepad if there is one (stick to the right, right trigger, left trigger), and
    while the screen is touched, steering (-1 left to 1 right) and pedals (-1 brake to 1 throttle) of its pads.
    """

    keys: frozenset[str]
    gamepad: tuple[float, ...] | None
    touch: tuple[float, ...] | None = None


class Wish(NamedTuple):
    """Anything else that the page asks for; ``number`` is that of a ping."""

    name: Literal["pause", "skip", "success", "failure", "quit", "corridors", "takeover", "wheel", "hand_over", "away", "ping"]
    number: int = 0


def read_json(text: str) -> Any:
    """
    Read what the page says.

    :raises BadMessage: if it is no JSON
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadMessage("no JSON") from error


def parse(text: str) -> Held | Wish:
    """
    Parse a message of the page.

    :param text: JSON, ``{"keys": [...], "gamepad": null or [x, y, z]}``, also with ``"touch": null or [x, y]``,
        ``{"wish": name}`` or ``{"ping": number}``
    :raises BadMessage: for everything else
    """
    match data := read_json(text):
        case {"keys": list(keys), "gamepad": gamepad, **more} if set(more) <= {"touch"}:
            if len(keys) > len(KEYS) or not all(isinstance(key, str) and key in KEYS for key in keys):
                raise BadMessage("unknown keys")
            return Held(frozenset(keys), _axes(gamepad, 3, "a gamepad"), _axes(more.get("touch"), 2, "a touch"))
        case {"wish": str(name)} if len(data) == 1 and name in WISHES:
            return Wish(name)  # type: ignore[arg-type]
        case {"ping": int(number)} if len(data) == 1 and not isinstance(number, bool) and 0 <= number < 2**53:
            return Wish("ping", number)
    raise BadMessage("unknown message")


def _axes(values: Any, count: int, name: str) -> tuple[float, ...] | None:
    if values is None:
        return None
    if not isinstance(values, list) or len(values) != count:
        raise BadMessage(f"{name} has {count} values")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float) or not -1 <= value <= 1:
            raise BadMessage(f"values of {name} are from -1 to 1")
    return tuple(map(float, values))


class Browser:
    """
    The device of who drives in a browser: nobody at first. It is lost if nothing was heard of the driver for ``STALE``.

    Pressing a driving key and touching a pad take over. A takeover that began with a touch is handed back ``MOMENT`` after the
    last thumb has left the screen, so that a thumb may move from one place to another; any other one by the driver's wish.

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

    def change_driver(self) -> None:
        """The wheel goes from one person to the next, who has ``STALE`` to be heard. To be called while nobody takes over."""
        self.leave()
        self.sit_down()
        self.heard_at = self.clock()

    def leave(self) -> None:
        """Note that nobody is there any more. A takeover is not over by that."""
        self.taken, self.heard_at, self.time = False, -math.inf, -math.inf
        self.go_away()

    def go_away(self) -> None:
        """Take it that whoever is there looks elsewhere, until the next message."""
        self.ramps.stop()
        self.gamepad: tuple[float, ...] | None = None
        self.touch: tuple[float, ...] | None = None
        self.by_touch = False  # whether the takeover began with a touch
        self.released_at = math.inf  # when the last thumb left the screen, if the takeover depends on it
        self.heard_at = -math.inf

    def handle(self, event: Any) -> Command | None:
        """
        Take in an event of the person at the wheel.

        :param event: ``Held`` or ``Wish`` of who sits at the wheel
        """
        now = self.clock()
        if isinstance(event, Held):
            if event.keys - self.ramps.held:
                self.takeover, self.by_touch, self.released_at = True, False, math.inf
            if (event.keys, event.gamepad, event.touch) != (self.ramps.held, self.gamepad, self.touch):
                self.time = now
            self._feel(event.touch, now)
            self.ramps.hold(event.keys)
            self.gamepad = event.gamepad
            self.heard_at = now
        elif isinstance(event, Wish):
            if event.name == "away":
                self.go_away()
            elif event.name == "takeover":
                self.takeover, self.time = not self.takeover, now
                self.by_touch, self.released_at = False, math.inf
            return COMMANDS.get(event.name)
        return None

    def _feel(self, touch: tuple[float, ...] | None, now: float) -> None:
        self._hand_back_in_time(now)
        if touch is not None and self.touch is None:
            self.by_touch |= not self.takeover
            self.takeover, self.released_at = True, math.inf
        elif touch is None and self.touch is not None and self.by_touch:
            self.released_at = now
        self.touch = touch

    def _hand_back_in_time(self, now: float) -> None:
        if now - self.released_at >= MOMENT:
            self.hand_back()

    def read(self) -> DriverInput:
        self._hand_back_in_time(self.clock())
        steering, pedals = self.ramps.move()
        if self.gamepad is not None and not self.ramps.held:
            stick, throttle, brake = self.gamepad
            steering, braking = GAMEPAD.steering.value(stick), TRIGGER.value(brake)
            pedals = -braking if braking > 0 else TRIGGER.value(throttle)
        if self.touch is not None and not self.ramps.held:
            steering, pedals = self.touch
        connected = self.taken and self.clock() - self.heard_at < STALE
        return DriverInput(steering, pedals, self.takeover, connected, self.time)

    def hand_back(self) -> None:
        self.takeover, self.by_touch, self.released_at = False, False, math.inf
