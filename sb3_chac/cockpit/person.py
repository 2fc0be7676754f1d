"""The person at the wheel, as an expert and a takeover rule of ``InterventionWrapper``."""

import threading
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_chac.cockpit.devices import Command, Device, DriverInput
from sb3_chac.common.contract import scale_action


class NotDrivable(ValueError):
    """Raised for an environment that nobody can drive in the cockpit; says why."""


def check_drivable(env: gym.Env) -> None:
    """
    Check that a person can drive an environment in the cockpit.

    :raises NotDrivable: unless actions are a Box of two numbers and pictures can be had
    """
    space = env.action_space
    if not (isinstance(space, spaces.Box) and space.shape == (2,) and np.isfinite([space.low, space.high]).all()):
        raise NotDrivable(
            f"env: driving needs two bounded actions, steering and throttle or brake, {env.unwrapped} has {space}."
        )
    modes = env.metadata.get("render_modes") or []
    if "rgb_array" not in modes:
        raise NotDrivable(
            f"env: the cockpit needs pictures, an environment with render_mode 'rgb_array', this one has {modes}."
        )


class Person:
    """
    Person whose device says what to do. ``InterventionWrapper`` takes it as its expert and ``drives`` as its rule. Events
    come from the thread of the window or the server, ``look`` from the one that drives.

    :param device: that the person holds
    :param may_take_over: whether it may drive, or only watch
    """

    def __init__(self, device: Device, may_take_over: bool = True) -> None:
        self.device, self.may_take_over = device, may_take_over
        self.lock = threading.Lock()  # held while the device is used
        self.input = DriverInput(0.0, 0.0, False, True)  # of the present step
        self.sit_in(spaces.Box(-1.0, 1.0, (2,)))

    def sit_in(self, box: spaces.Box, steers_left: bool = False) -> None:
        """
        Prepare for the actions of an environment.

        :param box: action space, shape (2,): steering, then throttle (its upper bound) or brake (its lower bound)
        :param steers_left: whether the greatest first action is fully to the left
        """
        self._box, self.steers_left = box, steers_left

    def handle(self, event: Any) -> Command | None:
        """
        Hand an event to the device.

        :param event: for the device
        :return: what the person wants to be done
        """
        with self.lock:
            return self.device.handle(event)

    def look(self) -> DriverInput:
        """Note and return what the person wants in the step that is about to be made."""
        self.input = self.read()
        return self.input

    def read(self) -> DriverInput:
        """Return what the person wants now."""
        with self.lock:
            now = self.device.read()
        return now if self.may_take_over else now._replace(takeover=False)

    def hand_back(self) -> None:
        """End the takeover, if there is one."""
        with self.lock:
            self.device.hand_back()

    def hold(self, device: Device) -> None:
        """
        Change the device.

        :param device: to drive with from now on
        """
        with self.lock:
            self.device = device

    @property
    def brake(self) -> np.ndarray:
        """The action that brings the vehicle to a stand, shape (2,)."""
        return self.action(0.0, -1.0)

    def action(self, steering: float, pedals: float) -> np.ndarray:
        """
        Convert steering and pedals to an action.

        :param steering: -1 (left) to 1 (right)
        :param pedals: -1 (brake) to 1 (throttle)
        :return: the action in the units of the environment, shape (2,)
        """
        scaled = np.array([-steering if self.steers_left else steering, pedals])
        low, high = self._box.low.astype(float), self._box.high.astype(float)
        return low + (scaled + 1) / 2 * (high - low)

    def as_input(self, action: np.ndarray) -> tuple[float, float]:
        """
        Convert an action to steering and pedals.

        :param action: in the units of the environment, shape (2,)
        :return: steering (-1 left to 1 right) and pedals (-1 brake to 1 throttle)
        """
        steering, pedals = scale_action(action, self._box)
        return float(-steering if self.steers_left else steering), float(pedals)

    # Expert and rule

    def reset(self, seed: int | None = None) -> None:
        """A person has no seed."""

    def __call__(self, observation: Any) -> np.ndarray:
        return self.action(self.input.steering, self.input.pedals)

    def drives(self, observation: Any, novice_action: np.ndarray, expert_action: np.ndarray) -> bool:
        """The takeover rule: the person drives while it says so."""
        return self.input.takeover
