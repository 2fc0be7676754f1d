"""Gamepads and steering wheels."""

import logging
import math
import time
from collections.abc import Callable
from typing import Any

from sb3_chac.cockpit.devices.base import Clock, Command, DeviceError, DriverInput
from sb3_chac.cockpit.devices.config import JoystickConfig
from sb3_chac.cockpit.devices.feedback import Spring

logger = logging.getLogger(__name__)


class Joystick:
    """
    A gamepad or a steering wheel with pedals: all that SDL calls a joystick. The first one that is plugged in is taken. A
    button takes over and hands back, or drives as long as it is held. Axes that were not moved yet count as centred, pedals as
    released.

    :param config: what its axes and buttons do
    :param clock: [s]
    :param open_joystick: SDL's number of a new device -> the open device, ``pygame.joystick.Joystick`` if None
    :param spring: for force feedback, None for none
    """

    def __init__(
        self,
        config: JoystickConfig,
        clock: Clock = time.monotonic,
        open_joystick: Callable[[int], Any] | None = None,
        spring: Spring | None = None,
    ) -> None:
        import pygame

        self._pygame = pygame
        self.config, self.clock, self.spring = config, clock, spring
        self.name = config.name
        self._open = open_joystick or pygame.joystick.Joystick
        self._joystick: Any = None  # SDL reports nothing of one that nobody holds
        self.hand_back()
        self._release()

    def _release(self) -> None:
        self.connected, self.time = False, -math.inf
        self._axes: dict[int, float] = {}
        self._held: set[int] = set()  # buttons that take over

    def hand_back(self) -> None:
        self.takeover = False

    def handle(self, event: Any) -> Command | None:
        pygame = self._pygame
        if event.type == pygame.JOYDEVICEADDED and not self.connected:
            self._joystick = self._open(event.device_index)
            self.connected = True
            self._attach_spring()
        elif self._joystick is None or getattr(event, "instance_id", None) != self._joystick.get_instance_id():
            return None
        elif event.type == pygame.JOYDEVICEREMOVED:
            self._joystick = None
            self._release()
            if self.spring is not None:
                self.spring.detach()
        elif event.type == pygame.JOYAXISMOTION:
            self.time = self.clock()
            self._axes[event.axis] = event.value
        elif event.type == pygame.JOYBUTTONDOWN:
            self.time = self.clock()
            if event.button in self.config.takeover:
                self._held.add(event.button)
                self.takeover = self.config.hold or not self.takeover
            elif event.button in self.config.pause:
                return Command.PAUSE
            elif event.button in self.config.skip:
                return Command.SKIP
        elif event.type == pygame.JOYBUTTONUP:
            self._held.discard(event.button)
            if self.config.hold and not self._held:
                self.takeover, self.time = False, self.clock()
        return None

    def _attach_spring(self) -> None:
        if self.spring is not None:
            try:
                self.spring.attach(self._joystick)
            except DeviceError as error:  # another one than at the beginning: it can be driven with
                logger.warning("%s", error)

    def feel(self, steering: float | None) -> None:
        """
        Turn the wheel, where there is force feedback.

        :param steering: to where, -1 (left) to 1 (right); None leaves it free
        """
        if self.spring is not None:
            self.spring.let_go() if steering is None else self.spring.pull(self.config.steering.raw(steering))

    def read(self) -> DriverInput:
        config, axes = self.config, self._axes
        steering = config.steering.value(axes.get(config.steering.axis, config.steering.centre))
        throttle, brake = (pedal.value(axes.get(pedal.axis, pedal.released)) for pedal in (config.throttle, config.brake))
        return DriverInput(steering, -brake if brake > 0 else throttle, self.takeover, self.connected, self.time)
