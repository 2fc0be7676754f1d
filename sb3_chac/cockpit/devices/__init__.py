"""Devices to drive with: keyboard, gamepad, steering wheel, a page in a browser."""

from sb3_chac.cockpit.devices.base import Clock, Command, Device, DeviceError, DriverInput
from sb3_chac.cockpit.devices.calibration import Calibration
from sb3_chac.cockpit.devices.config import (
    G29,
    GAMEPAD,
    WHEEL,
    JoystickConfig,
    Pedal,
    Steering,
    is_wheel,
    load_config,
    save_config,
)
from sb3_chac.cockpit.devices.feedback import Spring
from sb3_chac.cockpit.devices.joystick import Joystick
from sb3_chac.cockpit.devices.keyboard import Keyboard, Ramps

__all__ = [
    "G29",
    "GAMEPAD",
    "WHEEL",
    "Calibration",
    "Clock",
    "Command",
    "Device",
    "DeviceError",
    "DriverInput",
    "Joystick",
    "JoystickConfig",
    "Keyboard",
    "Pedal",
    "Ramps",
    "Spring",
    "Steering",
    "is_wheel",
    "load_config",
    "save_config",
]
