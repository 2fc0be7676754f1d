"""Wrappers, callbacks and normalization among RL-Zoo3's hyperparameters: what cannot be made of them is told by name."""

import math
from collections.abc import Callable
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_chac.common.arguments import check_keyword, describe, fits, keywords
from sb3_chac.common.checks import check_range
from sb3_chac.common.naming import import_named

CLASSES = ("env_wrapper", "vec_env_wrapper", "callback")  # hyperparameters that name classes


def check_classes(hyperparams: dict[str, Any]) -> None:
    """
    Check the classes that hyperparameters name.

    :param hyperparams: of RL-Zoo3
    :raises ValueError: names the one that is none, or whose arguments are none
    """
    for key in CLASSES:
        value = hyperparams.get(key)
        for entry in value if isinstance(value, list) else [] if value is None else [value]:
            name = entry
            if isinstance(entry, dict):
                if len(entry) != 1:
                    raise ValueError(f"{key}: {entry!r:.80} must be one class with its arguments, check the indentation.")
                ((name, kwargs),) = entry.items()
                if not isinstance(kwargs, dict):
                    raise ValueError(f"{key}: the arguments of {name} must be a mapping, got {kwargs!r:.80}.")
            found = named_class(key, name) if isinstance(name, str) else name
            is_one = isinstance(found, type) and issubclass(found, BaseCallback)
            if key == "callback" and not (is_one or isinstance(found, BaseCallback)):
                raise ValueError(f"callback: {name!r} is no callback, which derives from {BaseCallback.__name__}.")
            if key != "callback" and not callable(found):
                raise ValueError(f"{key}: {name!r} is no class of wrappers.")


def named_class(key: str, name: str) -> Any:
    """
    Find what a hyperparameter names.

    :param key: of the hyperparameter, for the message
    :param name: e.g. "package.module.Class"
    :raises ValueError: if it cannot be imported, or is not there
    """
    module, _, attribute = name.rpartition(".")
    try:
        return getattr(import_named(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"{key}: {name!r} is not there ({error}): write package.module.Class, of what is installed."
        ) from error


def checked_wrapper(key: str, wrap: Callable[[Any], Any] | None) -> Callable[[Any], Any] | None:
    """
    Name the hyperparameter in the errors of a wrapper.

    :param key: of the hyperparameter
    :param wrap: that RL-Zoo3 made of it, None for none
    :return: the same, which raises a ValueError that begins with ``key`` for a wrapper that cannot be made or is none
    """
    if wrap is None:
        return None
    kind = VecEnv if key == "vec_env_wrapper" else gym.Env

    def checked(env: Any) -> Any:
        try:
            wrapped = wrap(env)
        except Exception as error:  # of any class, with any arguments
            raise ValueError(f"{key}: {type(error).__name__}: {error}") from error
        if not isinstance(wrapped, kind):
            raise ValueError(f"{key} must give a {kind.__name__}, got {wrapped!r:.80}.")
        space = wrapped.observation_space
        if isinstance(space, spaces.Box) and 0 in space.shape:
            raise ValueError(f"{key} leaves nothing to observe, {space}: mend its arguments.")
        return wrapped

    return checked


def check_normalization(kwargs: Any) -> None:
    """
    Check the arguments of ``VecNormalize``.

    :param kwargs: that ``normalize`` names
    :raises ValueError: names the one that it does not take, or cannot be
    """
    if not isinstance(kwargs, dict):
        raise ValueError(f"normalize must be True, False or the arguments of VecNormalize, got {kwargs!r:.80}.")
    hints, _ = keywords(VecNormalize)
    del hints["venv"]
    for key, value in kwargs.items():
        check_keyword("normalize", VecNormalize, key, hints)
        if key.startswith("clip_") and value == math.inf:
            continue  # nothing is clipped
        if not fits(value, hints[key]):
            raise ValueError(f"normalize: {key} must be {describe(hints[key])}, got {value!r:.80}.")
        if hints[key] is float:
            check_range(f"normalize: {key}", value, 0.0, 1.0 if key == "gamma" else math.inf, exclusive_low=key != "gamma")
