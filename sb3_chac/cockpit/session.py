"""Session state shared by the UI, driving and learner threads: clock, pause, quit, what is displayed, and totals."""

import threading
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sb3_chac.cockpit.devices import Command
from sb3_chac.cockpit.meter import Lesson
from sb3_chac.cockpit.person import Person
from sb3_chac.common.contract import Guidance

TO_BEGIN = "Ready: P begins"


class SessionEnded(Exception):
    """Raised in the driving thread when the person has quit. The environment has not made the step."""


@dataclass(frozen=True)
class Novice:
    """
    State of the novice, as it tells it.

    :param stage: of the training, to read
    :param self_drives: C-HAC in stage 2: whether the self-learning policy acts
    :param confidence: C-HAC in stage 2: P(Q_r > Q_g)
    :param risk: rank of the value of what it is about to do, see ``GuidanceMeter``
    :param asks: whether it asks for help
    :param lesson: what the last takeover taught, None before the first, and for algorithms without Q_g
    """

    stage: str = ""
    self_drives: bool | None = None
    confidence: float | None = None
    risk: float | None = None
    asks: bool = False
    lesson: Lesson | None = None


@dataclass(frozen=True)
class Display:
    """
    Picture and numbers of the last step.

    :param picture: of the environment, shape (height, width, 3), uint8
    :param number: of the picture
    :param speed: [m/s], None if the environment does not tell
    :param route: share of the route that is driven, None if the environment does not tell
    :param guidance: what the environment tells of the way ahead
    :param takeover: whether the person drove
    :param brakes: whether the vehicle was braked because nobody is at the wheel
    :param proposed: by the novice: steering (-1 left to 1 right) and pedals (-1 brake to 1 throttle)
    :param applied: what was executed
    :param novice: what the learning driver says of itself
    """

    picture: np.ndarray | None = None
    number: int = 0
    speed: float | None = None
    route: float | None = None
    guidance: Guidance = field(default_factory=Guidance)
    takeover: bool = False
    brakes: bool = False
    proposed: tuple[float, float] = (0.0, 0.0)
    applied: tuple[float, float] = (0.0, 0.0)
    novice: Novice = Novice()


@dataclass(frozen=True)
class Totals:
    """
    Sums over a drive, or over the whole training: those are the model's counts.

    :param total_steps: of the training
    :param human_steps: of them driven by the person
    :param seconds: [s] driven in the training, without pauses
    :param episode: number of the episode in this drive
    :param cost: safety cost of this drive
    :param collisions: of this drive
    """

    total_steps: int = 0
    human_steps: int = 0
    seconds: float = 0.0
    episode: int = 0
    cost: float = 0.0
    collisions: int = 0

    @property
    def takeover_rate(self) -> float:
        """Share of the steps that the person drove."""
        return self.human_steps / self.total_steps if self.total_steps else 0.0


class Session:
    """
    One drive. The driving thread waits in ``wait_for_tick``; everything else may be called from any thread.

    :param person: at the wheel
    :param rate: [1/s] steps in real time, at most
    :param query: risk from which the novice asks for help, see ``GuidanceMeter``; None never to ask
    :param meter: whether the guidance meter is shown
    :param learns: whether the novice learns from what is driven
    """

    def __init__(
        self, person: Person, rate: float = 10.0, query: float | None = None, meter: bool = True, learns: bool = True
    ) -> None:
        self.person = person
        self.query, self.meter, self.learns = query, meter, learns
        self.period = 1 / rate
        self.display = Display()  # replaced as a whole, as are the totals
        self.totals = Totals()
        self.lag = 0  # gradient steps that the learner owes
        self.corridors: bool | None = None  # whether the picture shows them, None if it cannot
        self.busy = ""  # why the car waits though nobody paused
        self.message = TO_BEGIN
        self.paused = True
        self.ended = False
        self._skip = False
        self._verdict: bool | None = None
        self._changed = threading.Condition()
        self._next_tick = time.monotonic()

    # What the person wants

    def pause(self, message: str = "Paused: P goes on") -> None:
        """
        Stop the clock.

        :param message: why
        """
        with self._changed:
            self.paused, self.message = True, message
            self._changed.notify_all()

    def go_on(self) -> None:
        """End a pause, unless there is nothing to take over with."""
        if not self.person.read().connected:
            self.pause(lost_message(self.person.device.name))
            return
        with self._changed:
            self.paused, self.message = False, ""
            self._changed.notify_all()

    def toggle_pause(self) -> None:
        """Pause, or go on."""
        self.go_on() if self.paused else self.pause()

    def skip(self, verdict: bool | None = None) -> None:
        """
        Make the next step the last of the episode. If it is paused, the next episode waits.

        :param verdict: whether it was a success, None if the person does not say
        """
        with self._changed:
            self._skip, self._verdict = True, verdict
            self._changed.notify_all()

    def quit(self) -> None:
        """End the drive before its next step."""
        with self._changed:
            self.ended = True
            self._changed.notify_all()

    def obey(self, command: Command | None) -> None:
        """
        Carry out a command of the person.

        :param command: of the person; those that concern the display alone are left to it
        """
        match command:
            case Command.PAUSE:
                self.toggle_pause()
            case Command.SKIP:
                self.skip()
            case Command.SUCCESS | Command.FAILURE:
                self.skip(verdict=command is Command.SUCCESS)
            case Command.QUIT:
                self.quit()
            case Command.CORRIDORS if self.corridors is not None:
                self.corridors = not self.corridors

    @property
    def notice(self) -> str:
        """Message to the person, "" for none."""
        return "Saving: please wait" if self.ended else self.busy or self.message

    # For the driving thread

    def wait_for_tick(self) -> None:
        """
        Wait until the next step is due, ``period`` after the last one at the earliest; in a pause, when it is over.

        :raises SessionEnded: if the person has quit
        """
        with self._changed:
            while True:
                if self.ended:
                    raise SessionEnded
                if self.paused and not self._skip:
                    self._changed.wait()
                    continue
                remaining = self._next_tick - time.monotonic()
                if remaining <= 0:
                    break
                self._changed.wait(remaining)
            # From now, not from when it was due: what was late is not caught up by being too fast
            self._next_tick = time.monotonic() + self.period
            self._changed.notify_all()

    def take_skip(self) -> tuple[bool, bool | None]:
        """
        Tell once whether the episode is to end.

        :return: whether the episode is to end, and whether the person calls it a success, None if it does not say
        """
        with self._changed:
            skip, verdict = self._skip, self._verdict
            self._skip, self._verdict = False, None
        return skip, verdict

    def show(self, **changes: Any) -> None:
        """
        Change what is displayed.

        :param changes: of ``display``
        """
        self.display = replace(self.display, **changes)

    def count(self, **totals: Any) -> None:
        """
        Change the totals.

        :param totals: new values of ``totals``
        """
        self.totals = replace(self.totals, **totals)

    # For those who work beside it

    def time_to_tick(self) -> float:
        """
        Return the time that is left before the next step.

        :return: [s] until the next step, infinite in a pause
        """
        return float("inf") if self.paused else self._next_tick - time.monotonic()

    def wait_for_room(self, seconds: float) -> None:
        """
        Keep the moment of the next step free: wait until there are ``seconds`` before it, or the step is under way.

        :param seconds: [s] that are needed; with more than most of a period there is no point in waiting
        """
        if seconds > 0.8 * self.period:
            return
        with self._changed:
            while not self.ended and 0 < (remaining := self.time_to_tick()) < seconds:
                self._changed.wait(remaining + 0.001)


def lost_message(device: str) -> str:
    """
    Word the message for a device that is gone.

    :param device: its name
    :return: what to tell a person whose device is gone
    """
    if device == "browser":
        return "Nobody is at the wheel: open the page, or click into it; then Begin or P goes on"
    if device == "keyboard":
        return "The window has lost the keyboard: click into it, then P goes on"
    return f"No {device}: plug it in, or press K for the keyboard; then P goes on"


def who_drives(display: Display, is_manned: bool) -> str:
    """
    Tell who drives.

    :param is_manned: whether somebody is at the wheel now
    :return: "person", "brake" or "novice": never a person where nobody is
    """
    if display.brakes:
        return "brake"
    return ("person" if is_manned else "brake") if display.takeover else "novice"


def asks_for_help(display: Display, driver: str) -> bool:
    """
    Tell whether the person should hear that help is wanted.

    :param driver: see ``who_drives``
    :return: whether the novice asks for help and has none yet
    """
    return display.novice.asks and driver == "novice"


TAKEOVER = {"person": "YOU DRIVE", "brake": "nobody", "novice": "no"}
FOR_OTHERS = "a person"  # what those see who only watch


def indicators(
    display: Display, totals: Totals, lag: int, is_manned: bool = True, watches: bool = False
) -> list[tuple[str, str]]:
    """
    Collect the indicators of the paper's display.

    :param totals: of the drive
    :param lag: gradient steps that the learner owes
    :param is_manned: whether somebody is at the wheel now
    :param watches: whether it is shown to somebody who is not at the wheel
    :return: names and values of what the paper's display shows, and how far the learner lags behind
    """
    novice, driver = display.novice, who_drives(display, is_manned)
    risk = "-" if novice.risk is None else f"{novice.risk:.0%}"
    acts = "in use" if novice.self_drives and driver == "novice" else "no"
    minutes, seconds = divmod(int(totals.seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return [
        ("speed", _speed(display.speed, display.guidance.speed_limit)),
        ("takeover", FOR_OTHERS if driver == "person" and watches else TAKEOVER[driver]),
        ("route", "-" if display.route is None else f"{display.route:.0%}"),
        ("next", str(display.guidance)),
        ("total step", f"{totals.total_steps}"),
        ("total time", f"{hours}:{minutes:02}:{seconds:02}"),
        ("takeover rate", f"{totals.takeover_rate:.1%}"),
        ("stage", novice.stage or "-"),
        ("self-learning", "-" if novice.self_drives is None else acts),
        ("confidence", "-" if novice.confidence is None else f"{novice.confidence:.2f}"),
        ("risk", f"HELP {risk}" if asks_for_help(display, driver) else risk),
        ("taught", "-" if novice.lesson is None else str(novice.lesson)),
        ("cost", f"{totals.cost:g}"),
        ("episode", f"{totals.episode}"),
        ("updates behind", f"{lag}" if lag else "none"),
    ]


def _speed(speed: float | None, limit: float | None) -> str:
    """
    Word the speed and its limit.

    :param speed: [m/s], likewise ``limit``; None if it is not known
    """
    if speed is None:
        return "-"
    return f"{3.6 * speed:.0f} km/h" if limit is None else f"{3.6 * speed:.0f}/{3.6 * limit:.0f} km/h"
