"""Finding out what the axes and buttons of a device report."""

import math
from dataclasses import replace
from typing import Any

from sb3_chac.cockpit.devices.base import DeviceError
from sb3_chac.cockpit.devices.config import WHEEL, JoystickConfig, Pedal


class Calibration:
    """
    Dialogue that finds out what the axes and buttons of a device report: one question after the other, each is answered by
    ``answer()`` when the person has done as asked. Buttons answer by being pressed.

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
        """Instruction to the person, None at the end."""
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
        Find the axis that moved most, and by how much.

        Where it was before its first event is not known: what is seen later tells.
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
