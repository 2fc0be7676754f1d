"""Checks of what users hand in. Each raises one exception that names the argument and the remedy."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_chac.common.arguments import ends_of_schedule, is_finite_number

FLOAT32_MAX = float(np.finfo(np.float32).max)


class UnsupportedActionSpace(ValueError, AssertionError):
    """Raised for action spaces that an algorithm cannot act in (an ``AssertionError`` too, as in SB3)."""


class MismatchedParameters(ValueError, RuntimeError):
    """Raised for parameters of another algorithm or network (SB3 and torch raise one or the other of its bases)."""


def check_action_space(action_space: spaces.Space) -> None:
    """
    Check that actions are bounded.

    :raises UnsupportedActionSpace: unless ``action_space`` is a Box with finite bounds, low < high
    """
    if not isinstance(action_space, spaces.Box):
        raise UnsupportedActionSpace(
            f"env: the action space must be continuous (gymnasium.spaces.Box), got {action_space}. "
            "Use an algorithm for discrete actions (DQN, PPO), or wrap the environment to take continuous ones."
        )
    if not np.all(np.isfinite(action_space.low) & np.isfinite(action_space.high) & (action_space.low < action_space.high)):
        raise UnsupportedActionSpace(
            f"env: the action space must have finite bounds with low < high, got {action_space}. "
            "Give the environment's action_space finite bounds, and leave out gymnasium.wrappers.ClipAction, which takes them "
            "away: no action leaves them."
        )


def check_policy(algorithm: type, policy: type, required: type) -> None:
    """
    Check the class of a policy.

    :param algorithm: that is to have it
    :param required: class that it must derive from
    :raises ValueError: unless it does
    """
    if not issubclass(policy, required):
        raise ValueError(
            f"policy: {algorithm.__name__} needs a {required.__name__}, got {policy.__name__} (of {policy.__module__}). If it "
            "came from a checkpoint, load that with the class that saved it."
        )


def check_driving_action(action: Any) -> None:
    """
    Check the action of a driving task.

    :param action: [steering, acceleration], handed to an environment
    :raises ValueError: unless it is two finite numbers
    """
    numbers = real_numbers(action)
    if numbers is None or numbers.shape != (2,) or not np.isfinite(numbers).all():
        raise ValueError(
            f"action must be two finite numbers, [steering, acceleration], got {action!r}. The environment did not make a "
            "step: look for the NaN or the shape where the action comes from."
        )


def check_range(name: str, value: Any, low: float = -math.inf, high: float = math.inf, exclusive_low: bool = False) -> None:
    """
    Check the range of a number.

    :param name: name of the argument, for the message
    :param value: a number
    :param exclusive_low: whether ``low`` itself is refused
    :raises ValueError: unless ``value`` is a finite number between ``low`` and ``high``
    """
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool) and is_finite_number(value)
    if not is_number or not low <= value <= high or (exclusive_low and value == low):
        left = "above" if exclusive_low else "of at least"
        limits = f"{left} {low:g}" + (f" and at most {high:g}" if math.isfinite(high) else "")
        raise ValueError(f"{name} must be a finite number {limits}, got {value!r}.")


def check_integer(name: str, value: Any, low: int) -> None:
    """
    Check an integer.

    :raises ValueError: unless ``value`` is an integer of at least ``low``
    """
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < low:
        raise ValueError(f"{name} must be an integer of at least {low}, got {value!r}.")


def check_learning_rate(name: str, value: float | Callable[[float], float]) -> None:
    """
    Zero is allowed: RL-Zoo3's ``enjoy`` loads every model with it.

    :param value: a number, or a schedule of the remaining progress (1 to 0)
    :raises ValueError: if it is negative or not finite, at the start or at the end of a schedule
    """
    for rate in ends_of_schedule(name, value) if callable(value) else (value,):
        try:
            check_range(name, rate, low=0.0)
        except ValueError as error:
            raise ValueError(f"{error} Pass a rate such as 3e-4, or a schedule that stays positive.") from None


REAL = "biuf"  # kinds of dtypes: truth values, integers, floating point numbers


def real_numbers(values: Any) -> np.ndarray | None:
    """
    Read real numbers of unknown origin. NumPy would make numbers of text, and drop the imaginary part of complex ones.

    :param values: a number, an array or nested lists
    :return: a copy in float64, None for anything else, such as text, None, complex numbers and rows of different lengths
    """
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):
        return None
    return array.astype(np.float64) if array.dtype.kind in REAL else None


def number_or_nan(value: Any) -> float:
    """
    Read a real number of unknown origin.

    :param value: a number, or an array that holds one
    :return: the number, NaN if it is none
    """
    numbers = real_numbers(value)
    return math.nan if numbers is None or numbers.size != 1 else numbers.item()


def is_finite(values: Any) -> bool:
    """
    Tell whether numbers are finite.

    :param values: a number or an array of any kind
    :return: whether all are real, and none is NaN, infinite, or too large for the 32 bits that numbers are stored in
    """
    array = np.asarray(values)
    return array.dtype.kind in REAL and (array.dtype.kind != "f" or bool((np.abs(array) <= FLOAT32_MAX).all()))


def number_in(info: dict[str, Any], key: str, env_idx: int) -> float | None:
    """
    Read an optional number from ``info``.

    :param info: of one step
    :return: the number under ``key``, None if there is none: it is not measured
    :raises ValueError: if it is no finite number
    """
    value = info.get(key)
    if value is None:
        return None
    number = number_or_nan(value)
    if not is_finite(number):
        raise ValueError(
            f"info[{key!r}] of environment {env_idx} must be a finite number at every step, got {value!r}: mend the "
            "environment. Nothing of this step was stored; the model can still be saved."
        )
    return number


def happened_in(info: dict[str, Any], key: str, env_idx: int = 0) -> bool | None:
    """
    Read from ``info`` whether something happened.

    :param info: of one step
    :return: whether the truth value, or the number of times, under ``key`` is not zero, or any of an array of them; None if
        there is none: it is not measured
    :raises ValueError: if it is anything else, such as text, of which any but the empty one would be true, or NaN
    """
    value = info.get(key)
    if value is None:
        return None
    if not is_finite(value):
        raise ValueError(
            f"info[{key!r}] of environment {env_idx} must be a boolean, got {value!r}: mend the environment. Nothing of this "
            "step was stored; the model can still be saved."
        )
    return bool(np.any(value))


def check_step(
    observations: np.ndarray | dict[str, np.ndarray], rewards: np.ndarray, infos: list[dict[str, Any]], step: int
) -> None:
    """
    Check that all numbers of a step are finite.

    :param observations: what followed, shape (n_envs, ...), or a dictionary of such arrays
    :param rewards: shape (n_envs,)
    :param infos: with the terminal observations and costs, if there are any
    :param step: total number of steps so far, for the message
    :raises ValueError: if anything is NaN or infinite; names what, and the environment
    """
    check_finite("reward", rewards, step)
    check_finite("observation", observations, step)
    for idx, info in enumerate(infos):
        if info.get("terminal_observation") is not None:
            check_finite("terminal observation", info["terminal_observation"], step, env_idx=idx)
        number_in(info, "cost", idx)


def check_finite(name: str, values: np.ndarray | dict[str, np.ndarray], step: int, env_idx: int | None = None) -> None:
    """
    Check that numbers are finite.

    :param name: what the values are ("observation", "reward"), for the message
    :param values: shape (n_envs, ...), or a dictionary of such arrays
    :param step: total number of steps so far, for the message
    :param env_idx: the environment that ``values`` come from, if they have no first dimension for it
    :raises ValueError: if any value is NaN or infinite; names the environment and the key
    """
    for key, value in values.items() if isinstance(values, dict) else [(None, values)]:
        array = np.asarray(value)
        if is_finite(array):
            continue
        if env_idx is None:
            env_idx = next(idx for idx, row in enumerate(array) if not is_finite(row))
        problem = "NaN or infinite" if array.dtype.kind in REAL else f"no real number ({array.dtype})"
        raise ValueError(
            f"{name}{'' if key is None else f' {key!r}'} of environment {env_idx} is {problem} at step {step}: "
            "mend the environment (stable_baselines3.common.vec_env.VecCheckNan finds the origin). "
            "Nothing of this step was stored; the model and its replay buffer can still be saved."
        )
