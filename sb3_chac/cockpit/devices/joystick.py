"""Gamepads and steering wheels."""

import math
import time
from collections.abc import Callable
from typing import Any

from sb3_chac.cockpit.devices.base import Clock, Command, DriverInput
from sb3_chac.cockpit.devices.config import JoystickConfig


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
