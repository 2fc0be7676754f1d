"""The expert and the rule of an ``InterventionWrapper``: both are asked within a deadline, and their answers are checked."""

import copy
import queue
import threading
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_chac.common.checks import real_numbers
from sb3_chac.human.experts import Expert, expert_name, make_expert
from sb3_chac.human.rules import TakeoverRule, check_rule, make_rule


class ExpertError(RuntimeError):
    """Raised when the expert fails or hands in something that is no action. The environment has not made the step."""


class RuleError(RuntimeError):
    """Raised when the rule fails or does not say who drives. The environment has not made the step."""


class Supervisor:
    """
    Stand-in for the human: the expert says how to drive, the rule when. Both are built by ``build``, not before.

    :param expert: see ``make_expert``
    :param rule: see ``make_rule``
    :param rule_kwargs: see ``make_rule``
    :param deadline: seconds that each has for an answer, None for as long as it needs
    :param action_space: of the environment, a bounded Box
    """

    def __init__(
        self, expert: Any, rule: Any, rule_kwargs: dict[str, Any] | None, deadline: float | None, action_space: spaces.Box
    ) -> None:
        self.deadline, self._box = deadline, action_space
        self._expert_argument, self._rule_arguments = expert, (rule, rule_kwargs)
        self._rule_in_force = self._rule_arguments
        self.expert: Expert | None = None
        self.rule: TakeoverRule | None = None

    def build(self, env: gym.Env) -> None:
        """
        Make the expert and the rule, unless it was done before.

        :param env: the environment that they are for
        :raises ValueError: if it does not know the expert, or "risk" is the rule and the expert predicts nothing
        """
        if self.expert is None or self.rule is None:
            expert = make_expert(self._expert_argument, env)
            rule, rule_kwargs = self._rule_in_force
            self.rule = make_rule(rule, env, expert, rule_kwargs)
            self.expert = expert

    def set_rule(self, rule: Any, env: gym.Env) -> None:
        """
        Change the rule.

        :param rule: see ``make_rule``; None for the first one
        :param env: as in ``build``
        :raises ValueError: for a rule that does not fit; nothing is changed then
        """
        rule, rule_kwargs = in_force = self._rule_arguments if rule is None else (rule, None)
        check_rule(rule, self._expert_argument, rule_kwargs)
        if self.expert is not None:
            self.rule = make_rule(rule, env, self.expert, rule_kwargs)
            self.rule.reset()
        self._rule_in_force = in_force

    def reset(self, seed: int | None) -> None:
        """
        Tell expert and rule that they are asked from now on.

        :param seed: of the expert
        :raises ExpertError: if the expert fails or is late
        :raises RuleError: likewise, of the rule
        """
        assert self.expert is not None and self.rule is not None
        try:
            within(self.deadline, self.expert.reset, seed=seed)
        except Exception as error:
            raise self._expert_error(f"raised {type(error).__name__} in its reset: {error}.") from error
        try:
            within(self.deadline, self.rule.reset)
        except Exception as error:
            raise self._rule_error(f"raised {type(error).__name__} in its reset: {error}.") from error

    def act(self, observation: Any) -> np.ndarray:
        """
        Ask the expert for an action and check it.

        :return: the expert's action, within the bounds and of the dtype of the action space
        :raises ExpertError: if it fails, is late, or returns what is no action
        """
        assert self.expert is not None
        try:
            answer = within(self.deadline, self.expert, copy.deepcopy(observation))
            values = real_numbers(answer)
        except Exception as error:
            raise self._expert_error(f"raised {type(error).__name__}: {error}.") from error
        if values is None:
            raise self._expert_error(f"returned no real numbers, but {answer!r:.80}.")
        low, high = self._box.low.astype(np.float64), self._box.high.astype(np.float64)
        if values.shape != self._box.shape:
            raise self._expert_error(f"returned shape {values.shape}, the action space has {self._box.shape}.")
        if not np.isfinite(values).all():
            raise self._expert_error(f"returned an action that is NaN or infinite: {values}.")
        tolerance = 1e-6 * (high - low) / 2  # for rounding
        if np.any((values < low - tolerance) | (values > high + tolerance)):
            raise self._expert_error(f"returned an action out of bounds: {values} is not within {low} and {high}.")
        values = np.clip(values, low, high)
        is_integer = np.issubdtype(self._box.dtype, np.integer)
        return (np.rint(values) if is_integer else values).astype(self._box.dtype)

    def drives(self, observation: Any, novice_action: np.ndarray, expert_action: np.ndarray, was_driving: bool) -> bool:
        """
        Ask the rule whether the human drives this step.

        :raises RuleError: if it fails, is late, or does not answer True or False
        """
        assert self.rule is not None
        # Copies: it may keep or change what it is given
        asked = copy.deepcopy(observation), novice_action.copy(), expert_action.copy(), was_driving
        try:
            takeover = within(self.deadline, self.rule, *asked)
        except Exception as error:
            raise self._rule_error(f"raised {type(error).__name__}: {error}.") from error
        if not isinstance(takeover, bool | np.bool_):
            raise self._rule_error(f"must return True or False, got {takeover!r}.")
        return bool(takeover)

    def _expert_error(self, problem: str) -> ExpertError:
        return ExpertError(
            f"The {expert_name(self._expert_argument)} {problem} The environment did not make a step. Mend the expert or pass "
            "another as expert=..., and go on with reset()."
        )

    def _rule_error(self, problem: str) -> RuleError:
        rule = self._rule_in_force[0]
        name = repr(rule) if isinstance(rule, str) else getattr(rule, "__qualname__", type(rule).__name__)
        return RuleError(
            f"The rule {name} {problem} The environment did not make a step. Mend the rule or pass another as rule=..., and "
            "go on with reset()."
        )


def within(seconds: float | None, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """
    Call a function with a deadline.

    :param seconds: that the function has, None for as long as it needs
    :return: what it returns
    :raises TimeoutError: if it is late; its thread is left to itself
    """
    if seconds is None:
        return function(*args, **kwargs)
    answer: queue.SimpleQueue[tuple[Any, BaseException | None]] = queue.SimpleQueue()

    def ask() -> None:
        try:
            answer.put((function(*args, **kwargs), None))
        except BaseException as error:  # for who waits
            answer.put((None, error))

    threading.Thread(target=ask, daemon=True).start()
    try:
        value, error = answer.get(timeout=seconds)
    except queue.Empty:
        raise TimeoutError(f"there was no answer within {seconds:g} s") from None
    if error is not None:
        raise error
    return value
