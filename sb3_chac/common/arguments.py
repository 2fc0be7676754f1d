"""Arguments of constructors and of ``learn``, checked by what their signatures say of them, before anything is changed."""

import collections.abc
import functools
import inspect
import math
import numbers
import os
import types
import typing
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv

Method = TypeVar("Method", bound=Callable[..., Any])


class Range(NamedTuple):
    """Numbers from ``low`` (with ``exclusive``: above it) to ``high``."""

    low: float
    high: float = math.inf
    exclusive: bool = False

    def __contains__(self, value: Any) -> bool:
        return self.low <= value <= self.high and not (self.exclusive and value == self.low)

    def __str__(self) -> str:
        limit = f"{'above' if self.exclusive else 'of at least'} {self.low:g}"
        return limit + (f" and at most {self.high:g}" if math.isfinite(self.high) else "")


# Of SB3's arguments that SB3 takes as they come. Each class checks its own
RANGES = {
    "n_steps": Range(1),
    "n_epochs": Range(1),
    "batch_size": Range(1),
    "gamma": Range(0, 1),
    "gae_lambda": Range(0, 1),
    "clip_range": Range(0, exclusive=True),
    "clip_range_vf": Range(0, exclusive=True),
    "ent_coef": Range(0),
    "vf_coef": Range(0),
    "max_grad_norm": Range(0, exclusive=True),
    "target_kl": Range(0, exclusive=True),
    "train_freq": Range(1),
    "stats_window_size": Range(1),
    "verbose": Range(0),
    "seed": Range(0, 2**32 - 1),
    "n_envs": Range(1),
    "total_timesteps": Range(0),
    "log_interval": Range(1),
}


SCHEDULES = ("clip_range", "clip_range_vf")  # that nobody else checks; they may end at 0


def checked(method: Method) -> Method:
    """
    Decorate a constructor or ``learn``, so that its arguments are checked against their annotations.

    :param method: ``__init__`` of a class, or its ``learn``. What does not fit the annotation of an argument, or is NaN or
        infinite, raises a ``ValueError`` that begins with its name. Models that are being loaded get the arguments of their
        constructor later and are left alone
    """
    signature = inspect.signature(method)
    hints: dict[str, Any] = {}

    @functools.wraps(method)
    def call(self: Any, *args: Any, **kwargs: Any) -> Any:
        if kwargs.get("_init_setup_model", True):
            if not hints:  # now, as they may name what is defined after the class
                hints.update(annotations(method))
            for name, value in signature.bind(self, *args, **kwargs).arguments.items():
                if name in hints:
                    check_argument(name, value, hints[name])
                    check_name(type(self), name, value)
        return method(self, *args, **kwargs)

    return typing.cast(Method, call)


def annotations(method: Callable[..., Any]) -> dict[str, Any]:
    """Collect the annotations of the arguments of a method, by name."""
    # SB3's GymEnv names the first, a Dataset of demonstrations the others, which say themselves what is wrong with one
    return typing.get_type_hints(method, localns={"VecEnv": VecEnv, "Demonstrations": Any, "MinariDataset": Any})


def check_argument(name: str, value: Any, hint: Any) -> None:
    """
    Check one argument against its annotation.

    :param name: of the argument
    :param value: that it has
    :param hint: its annotation
    :raises ValueError: unless they fit, and numbers are finite and within ``RANGES``
    """
    if name == "total_timesteps" and isinstance(value, float | np.floating) and value.is_integer():
        value = int(value)  # such as 1e5, which SB3 takes, too
    if not fits(value, hint):
        raise ValueError(f"{name} must be {describe(hint)}, got {value!r:.80}.")
    limits = RANGES.get(name)
    for number in numbers_in(value):
        if limits is not None and number not in limits:
            kind = "a finite number" if fits(0.5, hint) else "an integer"
            raise ValueError(f"{name} must be {kind} {limits}, got {value!r}.")
    if name in SCHEDULES and callable(value):
        start, end = ends_of_schedule(name, value)
        if start not in RANGES[name] or not 0 <= end < math.inf:
            raise ValueError(f"{name} must be a schedule of numbers {RANGES[name]}, got one from {start} to {end}.")
    if name == "sde_sample_freq" and value != -1 and value < 1:
        raise ValueError(f"sde_sample_freq must be an integer of at least 1, or -1 (once a rollout), got {value!r}.")
    if name == "train_freq" and isinstance(value, tuple) and value[1] not in ("step", "episode"):
        raise ValueError(f"train_freq must count in 'step' or 'episode', got {value!r}.")


NETWORKS = ("pi", "qf", "vf")  # actor, critic of actions, critic of states


def check_policy_kwargs(name: str, owner: type, kwargs: dict[str, Any] | None, networks: tuple[str, ...] = ("pi",)) -> None:
    """
    Check the keyword arguments of a policy, or of a part of it.

    :param name: of the argument ("policy_kwargs"), for the message
    :param owner: class that the keyword arguments are for
    :param kwargs: to be checked
    :param networks: that have hidden layers of their own if ``net_arch`` is a dict, of ``NETWORKS``
    :raises ValueError: for one that ``owner`` does not take, or that is none of what its signature says; names it
    """
    kwargs = kwargs or {}
    hints, defaults = keywords(owner)
    if "vf" in networks:
        hints.pop("use_sde", None)  # SB3's PPO hands it over by itself
    for key, value in kwargs.items():
        check_keyword(name, owner, key, hints)
        if key == "net_arch":
            check_net_arch(name, value, networks)
        elif not fits(value, hints[key]):
            raise ValueError(f"{name}: {key} must be {describe(hints[key])}, got {value!r:.80}.")
    if kwargs.get("n_critics", 1) < 1:
        raise ValueError(f"{name}: n_critics must be an integer of at least 1, got {kwargs['n_critics']!r}.")
    for part, given in (("features_extractor", "observation_space"), ("optimizer", "lr")):
        default = defaults.get(f"{part}_class") or getattr(owner, f"default_{part}", None)
        part_owner = kwargs.get(f"{part}_class") or default
        if isinstance(part_owner, type):
            parameters, _ = keywords(part_owner)
            parameters.pop(given, None)
            for key in kwargs.get(f"{part}_kwargs") or {}:
                check_keyword(f"{name}: {part}_kwargs", part_owner, key, parameters)


def check_keyword(name: str, owner: type, key: str, hints: dict[str, Any]) -> None:
    """
    Check that a keyword argument is one of those of a class.

    :param hints: the keyword arguments that ``owner`` takes
    :raises ValueError: unless ``key`` is one of them
    """
    if key not in hints:
        known = ", ".join(sorted(hints)) or "none"
        raise ValueError(f"{name}: {key!r} is no argument of {owner.__name__}, which has {known}.")


def check_net_arch(name: str, value: Any, networks: tuple[str, ...]) -> None:
    """
    Check the sizes of hidden layers.

    :param name: of the argument that holds it
    :param value: the sizes of the hidden layers, or of those of each network
    :param networks: that there are: of an actor alone what a dict says of critics is ignored, PPO's may leave one out
    :raises ValueError: unless the sizes are integers of at least 1, and networks have the names that they have
    """
    if "vf" in networks and isinstance(value, list) and len(value) == 1 and isinstance(value[0], dict):
        value = value[0]  # SB3's former spelling, which it still takes, with a warning
    layers, named = [value], True
    if isinstance(value, dict):
        layers = list(value.values())
        allowed, needed = (NETWORKS if networks == ("pi",) else networks), (() if "vf" in networks else networks)
        named = set(needed) <= set(value) <= set(allowed)
    sized = all(isinstance(sizes, list) and all(fits(size, int) and size > 0 for size in sizes) for sizes in layers)
    if value is not None and not (named and sized):
        example = ", ".join(f"{key}=[64, 64]" for key in networks)
        raise ValueError(
            f"{name}: net_arch must be a list of layer sizes such as [64, 64], or dict({example}), got {value!r:.80}."
        )


def keywords(owner: type) -> tuple[dict[str, Any], dict[str, Any]]:
    """
    Collect the keyword arguments of a class.

    :return: annotations and defaults of the keyword arguments of a class, by name: also of those that it hands on to its bases
    """
    found: dict[str, Any] = {}
    defaults: dict[str, Any] = {}
    for base in owner.__mro__:
        if "__init__" not in vars(base):
            continue
        parameters = list(inspect.signature(vars(base)["__init__"]).parameters.values())[1:]
        try:
            hints = typing.get_type_hints(vars(base)["__init__"])
        except (NameError, TypeError):  # a user's class, whose annotations name what is not there
            hints = {}
        for parameter in parameters:
            if parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
                found.setdefault(parameter.name, hints.get(parameter.name, Any))
                defaults.setdefault(parameter.name, parameter.default)
        if all(parameter.kind is not parameter.VAR_KEYWORD for parameter in parameters):
            break
    return {key: hint for key, hint in found.items() if key not in GIVEN}, defaults


GIVEN = ("observation_space", "action_space", "lr_schedule")  # to policies, by the algorithms


def ends_of_schedule(name: str, schedule: Callable[[float], Any]) -> tuple[float, float]:
    """
    Evaluate a schedule at its start and its end.

    :param name: of the argument
    :param schedule: of the remaining progress
    :raises ValueError: if it fails, or its values are no numbers
    """
    try:
        return float(schedule(1.0)), float(schedule(0.0))
    except Exception as error:  # it is the user's
        problem = f"{type(error).__name__}: {error}"
        raise ValueError(f"{name} must be a schedule of numbers, but it raised {problem}.") from error


def check_name(owner: type, name: str, value: Any) -> None:
    """
    Check that a policy, environment or device exists.

    :param owner: class whose argument it is
    :raises ValueError: for a policy, an environment or a device that does not exist
    """
    if not isinstance(value, str):
        return
    if name == "policy" and value not in (aliases := getattr(owner, "policy_aliases", {value: None})):
        raise ValueError(f"policy must be one of {', '.join(aliases)}, or a class of policies, got {value!r}.")
    known = {*gym.registry, *(entry.rpartition("-v")[0] for entry in gym.registry)}  # gymnasium finds the version by itself
    if name == "env" and ":" not in value and value not in known:
        raise ValueError(f"env must be an environment or the id of one that gymnasium knows, got {value!r}.")
    if name == "device" and value != "auto":
        try:
            th.device(value)
        except RuntimeError as error:
            raise ValueError(f"device must be 'auto', 'cpu', 'cuda' or another of PyTorch's, got {value!r}.") from error


def numbers_in(value: Any) -> list[float]:
    """
    Find the number in an argument.

    :return: a number itself, the first of a train_freq; none of anything else
    """
    if isinstance(value, tuple) and value:
        value = value[0]
    return [value] if isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_) else []  # type: ignore[list-item]


def fits(value: Any, hint: Any) -> bool:
    """
    Tell whether a value fits an annotation.

    :param hint: an annotation; what is none of the kinds below fits anything
    """
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any or isinstance(hint, TypeVar):
        return True
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, part) for part in parts)
    if hint is type(None) or hint is None:
        return value is None
    if hint is bool:
        return isinstance(value, bool | np.bool_)
    if hint is int:
        return isinstance(value, numbers.Integral) and not isinstance(value, bool) and abs(int(value)) < 2**63
    if hint is float:
        return isinstance(value, int | float | np.number) and not isinstance(value, bool) and is_finite_number(value)
    if hint is str:
        return isinstance(value, str | os.PathLike)
    if origin is tuple:
        return isinstance(value, tuple) and len(value) == len(parts) and all(map(fits, value, parts))
    if origin is type:
        return isinstance(value, type) and (not isinstance(parts[0], type) or issubclass(value, parts[0]))
    if origin is collections.abc.Callable:
        return callable(value)
    kind = origin or hint
    if not isinstance(kind, type) or getattr(kind, "_is_protocol", False):
        return True
    return isinstance(value, kind)


def is_finite_number(value: Any) -> bool:
    """Tell whether a value is a finite number."""
    try:
        return math.isfinite(value)
    except (OverflowError, TypeError):  # an int of hundreds of digits, a complex number
        return False


WORDS = {int: "an integer", float: "a finite number", bool: "True or False", str: "text", dict: "a dict", type(None): "None"}


def describe(hint: Any) -> str:
    """
    Word an annotation for a message.

    :param hint: an annotation
    :return: what it asks for, to read
    """
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(describe, parts)))
    if hint in WORDS:
        return WORDS[hint]
    if origin is type:
        return f"a subclass of {parts[0].__name__}" if isinstance(parts[0], type) else "a class"
    if origin is tuple:
        return f"a tuple ({', '.join(map(describe, parts))})"
    if origin is collections.abc.Callable:
        return "a function"
    return f"a {getattr(origin or hint, '__name__', hint)}"
