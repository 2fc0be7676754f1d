"""Axes and buttons of gamepads and steering wheels, and files that hold them."""

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from sb3_chac.cockpit.devices.base import DeviceError


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

    def raw(self, steering: float) -> float:
        """
        Convert steering to where the axis is then.

        :param steering: -1 (left) to 1 (right)
        """
        share = abs(steering) ** (1 / self.exponent)
        way = self.dead_zone + (1 - self.dead_zone) * share if share else 0.0
        return self.centre + way * ((self.right if steering > 0 else self.left) - self.centre)


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
    Axes and buttons of a gamepad or wheel, and what they do.

    :param name: what to call it
    :param takeover: buttons that take over and hand back
    :param pause: buttons that pause and go on
    :param skip: buttons that skip the episode
    :param hold: whether a takeover lasts as long as its button is held
    """

    name: str
    steering: Steering
    throttle: Pedal
    brake: Pedal
    takeover: tuple[int, ...]
    pause: tuple[int, ...] = ()
    skip: tuple[int, ...] = ()
    hold: bool = False


# Xbox layout, and Logitech's G29 (both as Linux reports them; 'drive --calibrate' finds out others). A paddle takes over
GAMEPAD = JoystickConfig(
    "gamepad", Steering(0, dead_zone=0.12, exponent=1.5), Pedal(5, -1.0, 1.0), Pedal(2, -1.0, 1.0), (0,), (7,), (6,)
)
WHEEL = JoystickConfig("wheel", Steering(0), Pedal(2, 1.0, -1.0), Pedal(3, 1.0, -1.0), (4, 5), (9,), (8,))
# The G29 as MetaDrive reads it, the paper's simulator: two thirds of the way are the whole steering, who holds a paddle drives
G29 = JoystickConfig(
    "wheel",
    Steering(0, left=-2 / 3, right=2 / 3, dead_zone=0.0),
    Pedal(2, 1.0, -1.0, dead_zone=0.0),
    Pedal(3, 1.0, -1.0, dead_zone=0.0),
    (4, 5),
    (9,),
    (8,),
    hold=True,
)
WHEEL_NAMES = ("wheel", "g25", "g27", "g29", "g920", "g923", "racing", "driving force", "t150", "t248", "t300", "fanatec")


def is_wheel(name: str) -> bool:
    """
    Tell steering wheels from gamepads by their name.

    :param name: that a device gives itself
    """
    return any(part in name.lower() for part in WHEEL_NAMES)


def save_config(file: Path, config: JoystickConfig) -> None:
    """
    Write the configuration of a device.

    :param file: YAML, is overwritten
    """
    data: dict[str, Any] = {"name": config.name}
    for part in ("steering", "throttle", "brake"):
        values = vars(getattr(config, part))
        data[part] = {name: round(value, 4) for name, value in values.items()}
    data |= {name: list(getattr(config, name)) for name in ("takeover", "pause", "skip")} | {"hold": config.hold}
    text = "# Written by 'sb3-chac drive --calibrate': raw values of axes in their positions, and numbers of buttons\n"
    file.write_text(text + yaml.safe_dump(data, sort_keys=False))


def load_config(file: Path) -> JoystickConfig:
    """
    Read the configuration of a device.

    :param file: as ``save_config`` writes it; dead zones, exponent, pause, skip and hold may be left out
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
    _check_keys(str(file), data, {"name", "steering", "throttle", "brake", "takeover"}, {"pause", "skip", "hold"})
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
    parts["hold"] = data.get("hold", False)
    if not isinstance(parts["hold"], bool):
        raise DeviceError(f"{file}: hold must be true or false, got {parts['hold']!r}.")
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
