"""Meters of the critics for a person: how much the novice needs help, and what a takeover taught."""

from collections import deque
from typing import NamedTuple

LEAST = 50  # values from which a rank can be told
MEMORY = 1000  # values that a new one is compared with
CALM = 10  # steps below the threshold after which help is no longer asked for


class GuidanceMeter:
    """
    Meter that turns values of a critic into a risk from 0 to 1: the share of the last ``memory`` values that were higher. They
    have no scale of their own (it depends on how often a person took over, and for what), their order is what they tell.

    With a threshold it asks for help as soon as the risk reaches it, until ``CALM`` steps in a row were below.

    :param threshold: risk from which help is asked for, None never to ask
    :param memory: number of values
    """

    def __init__(self, threshold: float | None = None, memory: int = MEMORY) -> None:
        self.threshold = threshold
        self.values: deque[float] = deque(maxlen=memory)
        self.asks = False
        self._calm = 0  # steps below the threshold

    def tell(self, value: float | None) -> float | None:
        """
        Take the next value.

        :param value: of the novice's action, None if there is none yet
        :return: risk, None as long as there are fewer than ``LEAST`` values to compare with
        """
        risk = None
        if value is not None:
            if len(self.values) >= LEAST:
                risk = sum(other > value for other in self.values) / len(self.values)
            self.values.append(value)
        self._ask(risk)
        return risk

    def _ask(self, risk: float | None) -> None:
        if self.threshold is None or risk is None:
            self.asks = False
        elif risk >= self.threshold:
            self.asks, self._calm = True, 0
        else:
            self._calm += 1
            self.asks &= self._calm < CALM


class Lesson(NamedTuple):
    """
    Result of a takeover: how Q_g of the person's action and of the novice's have changed since, where it began.
    """

    person: float  # change of Q_g
    novice: float
    alike: int  # steps since the takeover in which Q_g of what the novice was about to do was not higher than here

    def __str__(self) -> str:
        change = self.person - self.novice
        return f"{change:+.{2 if abs(change) < 9.99 else 0}f}, {min(self.alike, 999)} alike"


class LessonMeter:
    """
    Meter that follows what the last takeover teaches.

    :param values: of the person's and of the novice's action in the state in which it began: Q_g
    """

    def __init__(self, values: tuple[float, float]) -> None:
        self.before = values
        self.alike = 0

    def tell(self, values: tuple[float, float], proposed: float | None) -> Lesson:
        """
        Take the values as they are now.

        :param values: as those of the beginning
        :param proposed: Q_g of what the novice is about to do, None while the person drives
        """
        self.alike += proposed is not None and proposed <= self.before[1]
        return Lesson(values[0] - self.before[0], values[1] - self.before[1], self.alike)
