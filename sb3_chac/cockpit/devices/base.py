"""Protocol of a device. Everything is told by events, nothing is polled."""

import math
from collections.abc import Callable
from enum import StrEnum
from typing import Any, NamedTuple, Protocol

Clock = Callable[[], float]


class DeviceError(ValueError):
    """Raised for a device that is not there, or a configuration that cannot be used; says what to do."""


class DriverInput(NamedTuple):
    """Input of the person at the wheel, at one moment."""

    steering: float  # -1 (left) to 1 (right)
    pedals: float  # -1 (full brake) to 1 (full throttle)
    takeover: bool  # whether the person drives
    connected: bool  # whether the device can be trusted
    time: float = -math.inf  # [s] of the clock, when the newest event in it came


class Command(StrEnum):
    """Commands of a person besides driving."""

    PAUSE = "pause"  # or go on
    SKIP = "skip"  # to the next episode
    SUCCESS = "success"  # ends the episode, and says how
    FAILURE = "failure"
    QUIT = "quit"
    CORRIDORS = "corridors"  # to be painted, or not
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
        """Return what the person wants now."""

    def hand_back(self) -> None:
        """End the takeover, whatever the person holds."""
