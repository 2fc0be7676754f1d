"""Relapses of C-HAC's stage 2, and the best policy."""

import math
from collections import deque
from typing import Any, NamedTuple

import numpy as np
import torch as th


class Score(NamedTuple):
    """Mean over episodes, and its standard error."""

    mean: float
    error: float


class RelapseWatch:
    """
    Watch over stage 2: tells from the scores of the training's episodes if it forgets what was learned before.

    The latest ``window`` episodes of stage 1 are the first best. In stage 2, the mean of every ``window`` episodes is compared
    with the best so far: it is the new best if it is higher, and a relapse if it is lower by more than ``N_ERRORS`` standard
    errors of the difference. Few, so that chance does not raise the alarm: in stage 2 there are many windows to compare.

    :param window: episodes that are judged together, at least 2
    """

    N_ERRORS = 4.0

    def __init__(self, window: int):
        self.scores: deque[float] = deque(maxlen=window)
        self.best: Score | None = None
        self.best_parameters: dict[str, th.Tensor] = {}
        self.relapsed = False

    def begin(self, policy: th.nn.Module) -> None:
        """Stage 1 is over: what it has reached is the best so far."""
        if len(self.scores) > 1:
            self._keep(_score(self.scores), policy)
        self.scores.clear()

    def add(self, score: float) -> None:
        """
        Note the score of an episode.

        :param score: of an episode that is over
        """
        self.scores.append(score)

    def judge(self, policy: th.nn.Module) -> bool:
        """
        Call it in stage 2, after ``add``.

        :return: whether a relapse begins
        """
        if len(self.scores) < (self.scores.maxlen or 0):
            return False
        latest, before = _score(self.scores), self.relapsed
        self.scores.clear()
        if self.best is None or latest.mean >= self.best.mean:
            self._keep(latest, policy)
        else:
            noise = self.N_ERRORS * math.hypot(latest.error, self.best.error)
            self.relapsed = self.best.mean - latest.mean > noise
        return self.relapsed and not before

    def restore(self, policy: th.nn.Module) -> None:
        """Make the policy the best one again."""
        policy.load_state_dict(self.best_parameters)
        self.relapsed = False
        self.scores.clear()

    def _keep(self, score: Score, policy: th.nn.Module) -> None:
        self.best, self.relapsed = score, False
        self.best_parameters = {name: tensor.detach().clone() for name, tensor in policy.state_dict().items()}


def _score(values: Any) -> Score:
    return Score(float(np.mean(values)), float(np.std(values, ddof=1) / len(values) ** 0.5))
