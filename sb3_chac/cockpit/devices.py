"""What a person drives with: keyboard, gamepad, steering wheel. Everything is told by events, nothing is polled."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import yaml

Clock = Callable[[], float]


class DeviceError(ValueError):
    """Raised for a device that is not there, or a configuration that cannot be used; says what to do."""


class DriverInput(NamedTuple):
    """What the person at the wheel wants, at one moment."""

    steering: float  # -1 (left) to 1 (right)
    pedals: float  # -1 (full brake) to 1 (full throttle)
    takeover: bool  # whether the person drives
    connected: bool  # whether the device can be trusted
    time: float = -math.inf  # [s] of the clock, when the newest event in it came


class Command(StrEnum):
    """What a person may want besides driving."""

    PAUSE = "pause"  # or go on
    SKIP = "skip"  # to the next episode
    QUIT = "quit"
    HELP = "help"
    KEYBOARD = "keyboard"  # to drive with from now on


class Device(Protocol):
    """One device: events in, ``DriverInput`` out. Not to be used by two threads at once, see ``Person``."""

    name: str

    def handle(self, event: Any) -> Command | None:
        """
        Take in an event.

        :param event: of pygame, or a message of the browser; those of others are left alone
        :return: what is to be done, None for nothing
        """

    def read(self) -> DriverInput:
        """What the person wants now."""

    def hand_back(self) -> None:
        """The takeover is over, whatever the person holds."""


class Ramps:
    """
    What held keys do to steering and pedals: they move steadily, and back when a key is let go. The brake is stronger than
    the throttle, and throttle and brake never act together.

    :param clock: [s]
    """

    STEER, CENTRE = 2.2, 4.5  # [1/s] towards a side, and back to the middle
    THROTTLE, BRAKE, RELEASE = 2.0, 5.0, 5.0  # [1/s]

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self.clock = clock
        self.held: frozenset[str] = frozenset()  # of "left", "right", "up", "down"
        self.steering = self.pedals = 0.0
        self._moved_at = clock()

    def hold(self, keys: frozenset[str]) -> None:
        """
        Set the keys that are held.

        :param keys: those that are held from now on
        """
        self.move()
        self.held = keys

    def move(self) -> tuple[float, float]:
        """
        Move towards the keys that are held.

        :return: steering and pedals now
        """
        now = self.clock()
        seconds, self._moved_at = max(now - self._moved_at, 0.0), now
        wanted = ("right" in self.held) - ("left" in self.held)
        if wanted * self.steering < 0:
            self.steering = 0.0  # countersteering begins in the middle
        rate = self.STEER if wanted else self.CENTRE
        self.steering = _towards(self.steering, wanted, rate * seconds)
        if "down" in self.held:
            self.pedals = _towards(min(self.pedals, 0.0), -1.0, self.BRAKE * seconds)
        elif "up" in self.held:
            self.pedals = _towards(max(self.pedals, 0.0), 1.0, self.THROTTLE * seconds)
        else:
            self.pedals = _towards(self.pedals, 0.0, self.RELEASE * seconds)
        return self.steering, self.pedals

    def stop(self) -> None:
        """No key is held, everything is in its middle."""
        self.held, self.steering, self.pedals = frozenset(), 0.0, 0.0


def _towards(value: float, target: float, most: float) -> float:
    return min(value + most, target) if target > value else max(value - most, target)


class Keyboard:
    """
    Hold the arrow keys (or W, A, S, D) to drive; pressing one takes over. Space takes over and hands back.

    :param clock: [s]
    """

    name = "keyboard"

    def __init__(self, clock: Clock = time.monotonic) -> None:
        import pygame

        self._pygame = pygame
        self.clock = clock
        self.ramps = Ramps(clock)
        self.takeover, self.connected, self.time = False, True, -math.inf
        self._driving = {
            **dict.fromkeys((pygame.K_LEFT, pygame.K_a), "left"),
            **dict.fromkeys((pygame.K_RIGHT, pygame.K_d), "right"),
            **dict.fromkeys((pygame.K_UP, pygame.K_w), "up"),
            **dict.fromkeys((pygame.K_DOWN, pygame.K_s), "down"),
        }
        self._held_keys: set[int] = set()

    def handle(self, event: Any) -> Command | None:
        pygame = self._pygame
        if event.type == pygame.WINDOWFOCUSLOST:  # what is let go now, we would not hear of
            self._held_keys.clear()
            self.ramps.stop()
            self.connected = False
        elif event.type == pygame.WINDOWFOCUSGAINED:
            self.connected = True
        elif event.type in (pygame.KEYDOWN, pygame.KEYUP):
            down = event.type == pygame.KEYDOWN
            self.connected = True  # who sends keys has the focus
            self.time = self.clock()
            if event.key in self._driving:
                (self._held_keys.add if down else self._held_keys.discard)(event.key)
                self.ramps.hold(frozenset(self._driving[key] for key in self._held_keys))
                self.takeover |= down
            elif down and event.key == pygame.K_SPACE:
                self.takeover = not self.takeover
        return None

    def read(self) -> DriverInput:
        return DriverInput(*self.ramps.move(), self.takeover, self.connected, self.time)

    def hand_back(self) -> None:
        self.takeover = False


@dataclass(frozen=True)
class Steering:
    """
    An axis for the steering, as the raw values that the device reports in its three positions.

    :param axis: number
    :param dead_zone: share of the way to a side that does nothing
    :param exponent: above 1 it is finer near the middle
    """

    axis: int = 0
    left: float = -1.0
    centre: float = 0.0
    right: float = 1.0
    dead_zone: float = 0.02
    exponent: float = 1.0

    def value(self, raw: float) -> float:
        """
        Convert a raw axis to steering.

        :return: -1 (left) to 1 (right)
        """
        to_right = (raw - self.centre) / (self.right - self.centre)
        to_left = (raw - self.centre) / (self.left - self.centre)
        share, sign = (to_right, 1.0) if to_right >= 0 else (to_left, -1.0)
        share = min(max(share - self.dead_zone, 0.0) / (1 - self.dead_zone), 1.0)
        return sign * share**self.exponent


@dataclass(frozen=True)
class Pedal:
    """
    An axis for a pedal or trigger, as the raw values that the device reports.

    :param axis: number
    :param dead_zone: share of the way down that does nothing
    """

    axis: int
    released: float
    pressed: float
    dead_zone: float = 0.03

    def value(self, raw: float) -> float:
        """
        Convert a raw axis to a pedal.

        :return: 0 (released) to 1 (pressed)
        """
        share = (raw - self.released) / (self.pressed - self.released)
        return min(max(share - self.dead_zone, 0.0) / (1 - self.dead_zone), 1.0)


@dataclass(frozen=True)
class JoystickConfig:
    """
    Which axes and buttons of a gamepad or wheel do what.

    :param name: what to call it
    :param takeover: buttons that take over and hand back
    :param pause: buttons that pause and go on
    :param skip: buttons that skip the episode
    """

    name: str
    steering: Steering
    throttle: Pedal
    brake: Pedal
    takeover: tuple[int, ...]
    pause: tuple[int, ...] = ()
    skip: tuple[int, ...] = ()


# Xbox layout, and Logitech's G29 (both as Linux reports them; 'drive --calibrate' finds out others). A paddle takes over
GAMEPAD = JoystickConfig(
    "gamepad", Steering(0, dead_zone=0.12, exponent=1.5), Pedal(5, -1.0, 1.0), Pedal(2, -1.0, 1.0), (0,), (7,), (6,)
)
WHEEL = JoystickConfig("wheel", Steering(0), Pedal(2, 1.0, -1.0), Pedal(3, 1.0, -1.0), (4, 5), (9,), (8,))
WHEEL_NAMES = ("wheel", "g25", "g27", "g29", "g920", "g923", "racing", "driving force", "t150", "t248", "t300", "fanatec")


class Joystick:
    """
    A gamepad or a steering wheel with pedals: all that SDL calls a joystick. The first one that is plugged in is taken. A
    button takes over and hands back. Axes that were not moved yet count as centred, pedals as released.

    :param config: what its axes and buttons do
    :param clock: [s]
    :param open_joystick: SDL's number of a new device -> the open device, ``pygame.joystick.Joystick`` if None
    """

    def __init__(
        self, config: JoystickConfig, clock: Clock = time.monotonic, open_joystick: Callable[[int], Any] | None = None
    ) -> None:
        import pygame

        self._pygame = pygame
        self.config, self.clock = config, clock
        self.name = config.name
        self._open = open_joystick or pygame.joystick.Joystick
        self._joystick: Any = None  # SDL reports nothing of one that nobody holds
        self.hand_back()
        self._release()

    def _release(self) -> None:
        self.connected, self.time = False, -math.inf
        self._axes: dict[int, float] = {}

    def hand_back(self) -> None:
        self.takeover = False

    def handle(self, event: Any) -> Command | None:
        pygame = self._pygame
        if event.type == pygame.JOYDEVICEADDED and not self.connected:
            self._joystick = self._open(event.device_index)
            self.connected = True
        elif self._joystick is None or getattr(event, "instance_id", None) != self._joystick.get_instance_id():
            return None
        elif event.type == pygame.JOYDEVICEREMOVED:
            self._joystick = None
            self._release()
        elif event.type == pygame.JOYAXISMOTION:
            self.time = self.clock()
            self._axes[event.axis] = event.value
        elif event.type == pygame.JOYBUTTONDOWN:
            self.time = self.clock()
            if event.button in self.config.takeover:
                self.takeover = not self.takeover
            elif event.button in self.config.pause:
                return Command.PAUSE
            elif event.button in self.config.skip:
                return Command.SKIP
        return None

    def read(self) -> DriverInput:
        config, axes = self.config, self._axes
        steering = config.steering.value(axes.get(config.steering.axis, config.steering.centre))
        throttle, brake = (pedal.value(axes.get(pedal.axis, pedal.released)) for pedal in (config.throttle, config.brake))
        return DriverInput(steering, -brake if brake > 0 else throttle, self.takeover, self.connected, self.time)


def is_wheel(name: str) -> bool:
    """
    Tell steering wheels from gamepads by their name.

    :param name: that a device gives itself
    """
    return any(part in name.lower() for part in WHEEL_NAMES)


# Configuration files


def save_config(file: Path, config: JoystickConfig) -> None:
    """
    Write the configuration of a device.

    :param file: YAML, is overwritten
    """
    data: dict[str, Any] = {"name": config.name}
    for part in ("steering", "throttle", "brake"):
        values = vars(getattr(config, part))
        data[part] = {name: round(value, 4) for name, value in values.items()}
    data |= {name: list(getattr(config, name)) for name in ("takeover", "pause", "skip")}
    text = "# Written by 'sb3-chac drive --calibrate': raw values of axes in their positions, and numbers of buttons\n"
    file.write_text(text + yaml.safe_dump(data, sort_keys=False))


def load_config(file: Path) -> JoystickConfig:
    """
    Read the configuration of a device.

    :param file: as ``save_config`` writes it; dead zones, exponent, pause and skip may be left out
    :raises DeviceError: names what is wrong in it
    """
    try:
        data = yaml.safe_load(file.read_text())
    except OSError as error:
        raise DeviceError(f"{file} cannot be read: {error.strerror}. 'sb3-chac drive --calibrate {file}' makes it.") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DeviceError(f"{file} is no YAML: {error}") from error
    if not isinstance(data, dict):
        raise DeviceError(
            f"{file} must hold name, steering, throttle, brake and takeover: 'sb3-chac drive --calibrate {file}'."
        )
    _check_keys(str(file), data, {"name", "steering", "throttle", "brake", "takeover"}, {"pause", "skip"})
    parts: dict[str, Any] = {}
    for part, kind in (("steering", Steering), ("throttle", Pedal), ("brake", Pedal)):
        parts[part] = _part(f"{file}: {part}", data[part], kind)
    for name in ("takeover", "pause", "skip"):
        buttons = data.get(name, [])
        if not isinstance(buttons, list) or not all(type(button) is int and button >= 0 for button in buttons):
            raise DeviceError(f"{file}: {name} must be a list of numbers of buttons, got {buttons!r}.")
        parts[name] = tuple(buttons)
    if not parts["takeover"]:
        raise DeviceError(f"{file}: takeover must name a button, without one nobody can take over.")
    return JoystickConfig(str(data["name"]), **parts)


def _check_keys(where: str, data: dict[str, Any], needed: set[str], allowed: set[str]) -> None:
    missing, unknown = sorted(needed - data.keys()), sorted(map(str, data.keys() - needed - allowed))
    if missing or unknown:
        problem = f"lacks {', '.join(missing)}" if missing else f"has {', '.join(unknown)}, which mean nothing here"
        raise DeviceError(f"{where} {problem}.")


def _part(where: str, data: Any, kind: type) -> Any:
    names = {field.name for field in fields(kind)}
    if not isinstance(data, dict):
        raise DeviceError(f"{where} must hold {', '.join(sorted(names))}.")
    optional = {"dead_zone", "exponent"}
    _check_keys(where, data, names - optional, optional & names)
    for name, value in data.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise DeviceError(f"{where}: {name} must be a number, got {value!r}.")
    if type(data["axis"]) is not int or data["axis"] < 0:
        raise DeviceError(f"{where}: axis must be the number of an axis, got {data['axis']!r}.")
    part = kind(**data)
    if not 0 <= part.dead_zone <= 0.9:
        raise DeviceError(f"{where}: dead_zone must be from 0 to 0.9, got {part.dead_zone}.")
    if isinstance(part, Steering):
        if not (part.left < part.centre < part.right or part.left > part.centre > part.right):
            raise DeviceError(
                f"{where}: centre must lie between left and right, got {part.left}, {part.centre}, {part.right}."
            )
        if part.exponent <= 0:
            raise DeviceError(f"{where}: exponent must be positive, got {part.exponent}.")
    elif part.released == part.pressed:
        raise DeviceError(f"{where}: released and pressed must differ, both are {part.pressed}.")
    return part


class Calibration:
    """
    Finds out what the axes and buttons of a device report: one question after the other, each is answered by ``answer()``
    when the person has done as asked. Buttons answer by being pressed.

    :param name: of the device
    """

    QUESTIONS = (
        ("left", "Turn the steering fully to the left and hold it"),
        ("right", "Turn the steering fully to the right and hold it"),
        ("centre", "Let the steering go back to its middle, and all pedals up"),
        ("throttle", "Press the throttle fully and hold it"),
        ("released", "Let all pedals go"),
        ("brake", "Press the brake fully and hold it"),
        ("takeover", "Press the button that shall take over and hand back"),
    )

    def __init__(self, name: str) -> None:
        import pygame

        self._pygame = pygame
        self.name = name
        self._axes: dict[int, float] = {}
        self._noted: dict[str, dict[int, float]] = {}
        self._button: int | None = None

    @property
    def step(self) -> str | None:
        """Name of the question that waits for an answer, None at the end."""
        return next((name for name, _ in self.QUESTIONS if name not in self._noted), None)

    @property
    def question(self) -> str | None:
        """What the person is to do, None at the end."""
        return dict(self.QUESTIONS)[self.step] if self.step else None

    def handle(self, event: Any) -> None:
        """
        Take in an event of the device.

        :param event: of pygame
        """
        if event.type == self._pygame.JOYAXISMOTION:
            self._axes[event.axis] = event.value
        elif event.type == self._pygame.JOYBUTTONDOWN:
            self._button = event.button
            self.answer()

    def answer(self) -> None:
        """
        The person has done as asked. For the pedals a moment later, when they are down.

        :raises DeviceError: if nothing moved, the question is asked again
        """
        step = self.step
        if step is None or (step == "takeover" and self._button is None):
            return
        if step == "right" and self._moved(self._noted["left"], self._axes)[1] < 0.5:
            raise DeviceError("No axis moved from the left to the right. Turn it fully to the right.")
        if step in ("throttle", "brake") and self._moved(self._rest(step), self._axes, step)[1] < 0.3:
            raise DeviceError(f"No axis moved: press the {step} fully.")
        self._noted[step] = dict(self._axes)
        self._button = None if step != "takeover" else self._button

    def _rest(self, step: str) -> dict[int, float]:
        return self._noted["centre" if step == "throttle" else "released"]

    def _moved(self, before: dict[int, float], after: dict[int, float], step: str = "") -> tuple[int, float]:
        """
        Find the axis that moved.

        :return: the axis that moved most, and by how much. Where it was before its first event is not known: what is
            seen later tells
        """
        steering = self._moved(self._noted["left"], self._noted["right"])[0] if step else None
        # A pedal that was never touched: SDL tells nothing of it; its other end is taken
        distances = {
            axis: abs(value - before.get(axis, -math.copysign(1.0, value)))
            for axis, value in after.items()
            if axis != steering
        }
        axis = max(distances, key=lambda axis: distances[axis], default=0)
        return axis, distances.get(axis, 0.0)

    def config(self) -> JoystickConfig:
        """
        Return the configuration that the answers make.

        :return: what was found out
        :raises DeviceError: if a question is open
        """
        if self.step is not None:
            raise DeviceError(f"The calibration is not finished: {self.question}.")
        noted = self._noted
        axis, _ = self._moved(noted["left"], noted["right"])
        left, right = noted["left"][axis], noted["right"][axis]
        centre = noted["centre"].get(axis, 0.0)
        if not min(left, right) < centre < max(left, right):
            centre = (left + right) / 2
        pedals = {}
        for step in ("throttle", "brake"):
            pedal, _ = self._moved(self._rest(step), noted[step], step)
            pressed = noted[step][pedal]
            # When it is let go it tells where it rests
            rests = (self._noted["released"] if step == "throttle" else self._rest(step)).get(pedal)
            released = rests if rests is not None and abs(rests - pressed) > 0.3 else -math.copysign(1.0, pressed)
            pedals[step] = Pedal(pedal, released, pressed)
        if pedals["throttle"].axis == pedals["brake"].axis and (pedals["throttle"].pressed == pedals["brake"].pressed):
            raise DeviceError("Throttle and brake moved the same axis the same way. Calibrate again.")
        assert self._button is not None
        steering = replace(WHEEL.steering, axis=axis, left=left, centre=centre, right=right)
        return JoystickConfig(self.name, steering, pedals["throttle"], pedals["brake"], (self._button,))
