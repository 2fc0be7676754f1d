"""The guidance meter: how much what the novice is about to do needs a person, as the critics tell it."""

from collections import deque

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
