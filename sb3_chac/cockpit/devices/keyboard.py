"""Keyboard, and what held keys do."""

import math
import time
from typing import Any

from sb3_chac.cockpit.devices.base import Clock, Command, DriverInput


class Ramps:
    """
    Steering and pedals of held keys: they move steadily, and back when a key is let go. The brake is stronger than
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
