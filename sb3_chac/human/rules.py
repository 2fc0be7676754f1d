"""Takeover rules: when the human drives, from the observation and from what novice and expert would do."""

import copy
import math
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_chac.common.arguments import checked
from sb3_chac.common.checks import check_action_space, check_integer, check_range, number_or_nan
from sb3_chac.common.contract import scale_action
from sb3_chac.common.naming import is_name, named_object

RULE_NAMES = ("risk", "disagreement", "always", "never")


@runtime_checkable
class TakeoverRule(Protocol):
    """Rule that decides who drives. One object serves one environment, as it may remember."""

    def reset(self) -> None:
        """Forget: a new episode starts, or the human is asked again after a break."""

    def __call__(self, observation: Any, novice_action: np.ndarray, expert_action: np.ndarray, human_driving: bool) -> bool:
        """
        Decide whether the human drives this step.

        :param observation: what the environment returned last
        :param novice_action: in the units of the environment
        :param expert_action: in the units of the environment
        :param human_driving: whether the human drove the step before
        """


class RiskRule:
    """
    The human takes over when the novice is about to get into trouble, and hands back when it is well out of it.

    What the novice does is smoothed, ``m <- smoothing m + (1 - smoothing) a``, and the predictor says after how many seconds
    it would end badly. Two thresholds (hysteresis) and the three counts below keep the takeovers from flickering. With the
    defaults, trouble in steps 0 and 1 leads to a takeover from step 1 on, which lasts ten steps at least.

    :param time_to_trouble: (observation, action) -> time in seconds until trouble if ``action`` were held, inf for none
    :param take_over_below: predicted time, in seconds, below which the human wants to take over
    :param hand_back_above: predicted time, in seconds, above which the novice is safe
    :param delay: how many consecutive steps of trouble pass before the human acts (the reaction time)
    :param hold: the least number of steps of a takeover
    :param safe: hand back with this many consecutive steps in which the novice is safe, the present one included
    :param smoothing: share of the past in the smoothed action, 0 (none) to 0.99
    :raises ValueError: for an argument out of its range, or a prediction that is NaN
    """

    @checked
    def __init__(
        self,
        time_to_trouble: Callable[[Any, np.ndarray], float],
        take_over_below: float = 1.2,
        hand_back_above: float = 2.0,
        delay: int = 1,
        hold: int = 10,
        safe: int = 5,
        smoothing: float = 0.5,
    ):
        if not callable(time_to_trouble):
            raise ValueError(f"time_to_trouble must be a function (observation, action) -> seconds, got {time_to_trouble!r}.")
        check_range("take_over_below", take_over_below, low=0.0, exclusive_low=True)
        check_range("hand_back_above", hand_back_above, low=take_over_below)
        check_integer("delay", delay, low=0)
        check_integer("hold", hold, low=1)
        check_integer("safe", safe, low=1)
        check_range("smoothing", smoothing, low=0.0, high=0.99)
        self.time_to_trouble = time_to_trouble
        self.take_over_below = take_over_below
        self.hand_back_above = hand_back_above
        self.delay = delay
        self.hold = hold
        self.safe = safe
        self.smoothing = smoothing
        self.reset()

    def reset(self) -> None:
        self.smoothed_action: np.ndarray | None = None
        self.steps_in_trouble = 0
        self.steps_driven = 0
        self.steps_safe = 0

    def __call__(self, observation: Any, novice_action: np.ndarray, expert_action: np.ndarray, human_driving: bool) -> bool:
        action = np.asarray(novice_action, dtype=np.float64)
        if self.smoothed_action is not None:
            action = self.smoothing * self.smoothed_action + (1 - self.smoothing) * action
        self.smoothed_action = action
        answer = self.time_to_trouble(observation, action)
        time = number_or_nan(answer)
        if math.isnan(time):
            raise ValueError(
                f"time_to_trouble returned {answer!r:.80}: return the time in seconds until trouble, math.inf for none."
            )

        if human_driving:
            self.steps_safe = self.steps_safe + 1 if time > self.hand_back_above else 0
            drives = self.steps_driven < self.hold or self.steps_safe < self.safe
        else:
            self.steps_driven = self.steps_safe = 0
            self.steps_in_trouble = self.steps_in_trouble + 1 if time < self.take_over_below else 0
            drives = self.steps_in_trouble > self.delay
        if drives:
            self.steps_driven += 1
            self.steps_in_trouble = 0
        return drives


class DisagreementRule:
    """
    The human drives each step in which the novice would act otherwise than the expert. It has no memory and flickers.

    :param threshold: root mean square of the difference of the actions, both scaled to [-1, 1], above which the human drives
    :param action_space: of the environment
    :raises ValueError: for a negative threshold, or an action space that is not a bounded Box
    """

    @checked
    def __init__(self, threshold: float, action_space: spaces.Box):
        check_range("threshold", threshold, low=0.0)
        check_action_space(action_space)
        self.threshold = threshold
        self.action_space = action_space

    def reset(self) -> None:
        pass

    def __call__(self, observation: Any, novice_action: np.ndarray, expert_action: np.ndarray, human_driving: bool) -> bool:
        difference = scale_action(novice_action, self.action_space) - scale_action(expert_action, self.action_space)
        return bool(np.sqrt(np.mean(difference**2)) > self.threshold)


class FunctionRule:
    """
    A function without memory.

    :param function: (observation, novice action, expert action) -> whether the human drives
    """

    def __init__(self, function: Callable[[Any, np.ndarray, np.ndarray], bool]):
        self.function = function

    def reset(self) -> None:
        pass

    def __call__(self, observation: Any, novice_action: np.ndarray, expert_action: np.ndarray, human_driving: bool) -> bool:
        return self.function(observation, novice_action, expert_action)


def always(observation: Any, novice_action: np.ndarray, expert_action: np.ndarray) -> bool:
    """The human drives every step, as when demonstrations are collected."""
    return True


def never(observation: Any, novice_action: np.ndarray, expert_action: np.ndarray) -> bool:
    """The human only watches: steps and what the expert would do are counted, the novice drives."""
    return False


def make_rule(rule: Any, env: gym.Env, expert: Any, rule_kwargs: dict[str, Any] | None = None) -> TakeoverRule:
    """
    Make a rule of a name or a function.

    :param rule: "risk" (``RiskRule`` with the expert's predictor), "disagreement" (``DisagreementRule`` with threshold 0.3),
        "always", "never", a ``TakeoverRule`` (of a ``RiskRule`` each environment gets its own copy), a function
        (observation, novice action, expert action) -> bool, or "package.module:name", which names one of these or a class, of
        which each environment gets an object of its own: ``Class(**rule_kwargs)``
    :param env: the environment, for its action space
    :param expert: the expert of the environment, from ``make_expert``
    :param rule_kwargs: of "risk" (e.g. take_over_below) or "disagreement" (threshold)
    :raises ValueError: for anything else, and for "risk" if the expert has no ``time_to_trouble``
    """
    check_rule(rule, expert, rule_kwargs)
    if is_name(rule):
        rule = named_object("rule", rule)
        if isinstance(rule, type):
            rule = rule(**(rule_kwargs or {}))
        check_rule(rule, expert)
    if isinstance(rule, str) and rule in CONFIGURABLE:
        return CONFIGURABLE[rule](getattr(expert, "time_to_trouble", None), env.action_space, **(rule_kwargs or {}))
    if isinstance(rule, RiskRule):
        return copy.copy(rule)
    if isinstance(rule, TakeoverRule):
        return rule
    return FunctionRule({"always": always, "never": never}[rule] if isinstance(rule, str) else rule)


# Rules that take rule_kwargs: name -> (time_to_trouble, action space, rule_kwargs) -> rule
CONFIGURABLE: dict[str, Callable[..., TakeoverRule]] = {
    "risk": lambda time_to_trouble, action_space, **kwargs: RiskRule(time_to_trouble, **kwargs),
    "disagreement": lambda time_to_trouble, action_space, threshold=0.3: DisagreementRule(threshold, action_space),
}


def check_rule(rule: Any, expert: Any, rule_kwargs: dict[str, Any] | None = None) -> None:
    """
    Check what can be checked without building anything: the predictor of a scripted driver that is still a name is not.

    :param rule: see ``make_rule``
    :param expert: see ``make_expert``
    :param rule_kwargs: see ``make_rule``
    :raises ValueError: see ``make_rule``
    """
    if is_name(rule):
        found = named_object("rule", rule)
        if not isinstance(found, type):
            check_rule(found, expert, rule_kwargs)
        return
    if isinstance(rule, type) or not (callable(rule) or (isinstance(rule, str) and rule in RULE_NAMES)):
        raise ValueError(
            f"rule must be one of {', '.join(map(repr, RULE_NAMES))}, a TakeoverRule, a function (observation, novice "
            f'action, expert action) -> bool or the name of one, "package.module:function", got {rule!r}.'
        )
    if isinstance(rule, str) and rule == "risk" and not (isinstance(expert, str) or hasattr(expert, "time_to_trouble")):
        raise ValueError(
            "rule: 'risk' needs an expert that predicts trouble (a method time_to_trouble), and this one has none. Pass "
            "rule=RiskRule(time_to_trouble=...), a function (observation, action) -> seconds, or rule='disagreement'."
        )
    if rule_kwargs:
        if not isinstance(rule, str) or rule not in CONFIGURABLE:
            raise ValueError(f"rule_kwargs: only {' and '.join(map(repr, CONFIGURABLE))} take any, got rule={rule!r}.")
        try:  # on anything
            CONFIGURABLE[rule](len, spaces.Box(-1.0, 1.0), **rule_kwargs)
        except TypeError as error:
            raise ValueError(f"rule_kwargs: {rule_kwargs} do not fit rule={rule!r}: {error}.") from None
