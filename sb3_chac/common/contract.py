"""
The contract between environment, wrapper, data and algorithm about takeovers: which entry of ``info`` says that the human
acted, which one holds the action and in which units, and how algorithms talk to the wrapper in which the human is asked.
"""

from collections.abc import Sequence
from enum import Enum
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_chac.common.checks import UnsupportedActionSpace, is_finite, real_numbers

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

# Keys of ``info``. The first of each list that is there, and not None, counts.
TAKEOVER, TAKEOVER_START = "takeover", "takeover_start"
APPLIED_ACTION, NOVICE_ACTION, RECEIVED_ACTION = "applied_action", "novice_action", "received_action"
FLAGS = (TAKEOVER, "is_intervention")  # ours; that of gym-hil and LeRobot
# Ours; that of HIL-SERL, gym-hil, LeRobot. Without a flag, the latter say by being there that the human acted
REPORTED_ACTIONS = ("intervene_action", "action_intervention", "teleop_action")
ACTIONS = (*REPORTED_ACTIONS, APPLIED_ACTION)  # ours, which only a flag makes a report, may be the environment's own

TOLERANCE = 1e-4  # of actions scaled to [-1, 1], for rounding


class Report(NamedTuple):
    """
    Report of ``info`` on one step.

    :param takeover: whether the human acted
    :param action: what was executed, if the human acted, in the units of the environment that reports it
    :param says_so: whether ``info`` tells at all who acted: a human is in the loop
    """

    takeover: bool
    action: np.ndarray | None
    says_so: bool


def read_report(info: dict[str, Any], action_space: spaces.Space, env_idx: int = 0) -> Report:
    """
    Read who acted. The flag decides; only where there is none does the presence of an action. None is as good as not there.

    :param info: of one step
    :param action_space: of the actions
    :param env_idx: the environment, for the message
    :return: what it says, the action as a copy of the shape of ``action_space``
    :raises ValueError: if the human acted and the action is missing, of another shape, or NaN or infinite; names the key
    """
    flag = _first(info, FLAGS)
    takeover = truth(*flag, env_idx) if flag else _first(info, REPORTED_ACTIONS) is not None
    if not takeover:
        return Report(False, None, flag is not None or any(key in info for key in REPORTED_ACTIONS))
    found = _first(info, ACTIONS)
    if found is None:
        assert flag is not None
        raise ValueError(
            f"info[{flag[0]!r}] of environment {env_idx} says that the human acted, but what was executed is missing: add it "
            f"as info[{APPLIED_ACTION!r}] or info[{REPORTED_ACTIONS[0]!r}], in the units of the action space."
        )
    key, values = found
    action = real_numbers(values)
    if action is None or not is_finite(action) or action.size != np.prod(action_space.shape or (1,)):
        raise ValueError(
            f"info[{key!r}] of environment {env_idx}, the human's action, must be finite numbers of shape "
            f"{action_space.shape}, got {values!r}: mend the environment. Nothing of this step was stored."
        )
    return Report(True, action.reshape(action_space.shape or ()), True)


def _first(info: dict[str, Any], keys: Sequence[str]) -> tuple[str, Any] | None:
    """
    Find the first key that has a value.

    :return: the first of the keys whose value is there and not None, with it. LeRobot's keys are members of an Enum
    """
    named = {key.value if isinstance(key, Enum) else key: value for key, value in info.items()}
    return next(((key, named[key]) for key in keys if named.get(key) is not None), None)


def truth(key: str, value: Any, env_idx: int) -> bool:
    """
    Read a flag.

    :param key: of ``info``, for the message
    :param value: of it
    :raises ValueError: for what is neither a boolean nor 0 or 1, nor an array of them
    """
    array = np.asarray(value)
    if array.dtype != bool and not (np.issubdtype(array.dtype, np.number) and np.isin(array, (0, 1)).all()):
        raise ValueError(
            f"info[{key!r}] of environment {env_idx} must be a boolean, got {value!r}: mend the environment. Nothing of this "
            "step was stored."
        )
    return bool(np.any(array))


def scale_action(action: np.ndarray, action_space: spaces.Box) -> np.ndarray:
    """
    Scale an action.

    :param action: in the units of the environment
    :param action_space: a Box with finite bounds
    :return: ``action`` with the bounds mapped to -1 and 1, in float64
    """
    low, high = action_space.low.astype(np.float64), action_space.high.astype(np.float64)
    return 2 * (np.asarray(action, dtype=np.float64) - low) / (high - low) - 1


def scaled(action: np.ndarray, action_space: spaces.Space, env_idx: int) -> np.ndarray:
    """
    Scale the human's action.

    :param action: the human's, in the units of ``action_space``, a Box with finite bounds
    :return: scaled to [-1, 1], of the same shape
    :raises ValueError: if it is outside of the bounds
    """
    assert isinstance(action_space, spaces.Box)
    values = scale_action(action, action_space)
    if np.any(np.abs(values) > 1 + TOLERANCE):
        raise ValueError(
            f"The human's action of environment {env_idx} is out of bounds, {action} is not in {action_space}: clip it, or "
            "report it in the units of the outermost action space. Nothing of this step was stored."
        )
    return np.clip(values, -1, 1)


def changed_action(env_idx: int, sent: np.ndarray, received: np.ndarray) -> ValueError:
    """
    Make the error for an action that was changed on its way.

    :param sent: by the algorithm
    :param received: where the human takes over
    """
    return ValueError(
        f"A wrapper of environment {env_idx} changes actions between the algorithm, which sent {sent}, and the takeover, "
        f"where {received} arrived: the human's actions would be stored in the wrong units. Put the "
        "InterventionWrapper outside of that wrapper. Nothing of this step was stored."
    )


class TakeoverWrapper(gym.Wrapper):
    """
    Base of the wrapper in which the human is asked. Algorithms find it by this class and reach it by one method, whose name is
    nobody else's: whatever methods a user's environment has, they are left alone.
    """

    def sb3_chac_takeovers(self, method: str, *args: Any) -> Any:
        """
        Call a method of this wrapper by its name.

        :param method: of this wrapper
        :return: what it returns
        """
        return getattr(self, method)(*args)

    budget: int | None

    def takeover_budget(self) -> int | None:
        """Return the number of steps that the human drives at most."""
        return self.budget

    def takeover_space(self) -> spaces.Space:
        """Return the space of the actions that are replaced in a takeover."""
        return self.action_space


class Guidance(NamedTuple):
    """Directions of an environment for a person: the way ahead; None and "" stand for what is not known."""

    turn: str = ""  # at the next junction, "goal" if there is none before it
    distance: float | None = None  # [m] to it, 0 inside of a junction
    speed_limit: float | None = None  # [m/s]

    def __str__(self) -> str:
        if self.distance is None:
            return "-"
        return f"{self.turn} now" if self.distance == 0 else f"{self.turn} {self.distance:.0f} m"


class TakeoverDisplay:
    """
    Base of environments whose pictures show what wrappers want to have shown (``hud``: name -> value), in a box of numbers
    unless ``panel`` is False: then whoever shows the picture shows them beside it, with the ``guidance``. Those that can paint
    the corridors of their observation do so if ``show_corridors`` is True, which is None for those that cannot.
    """

    hud: dict[str, Any]
    panel: bool = True
    show_corridors: bool | None = None

    @property
    def guidance(self) -> Guidance:
        """Tell the way ahead, as a navigation system would."""
        return Guidance()


class _ActionWrapperAboveTakeover(type):
    """``VecEnv.env_is_wrapped`` asks each wrapper, also in other processes, by ``isinstance``."""

    def __instancecheck__(cls, wrapper: Any) -> bool:
        changes_actions = isinstance(wrapper, gym.ActionWrapper)
        while changes_actions and isinstance(wrapper, gym.Wrapper):
            wrapper = wrapper.env
            if isinstance(wrapper, TakeoverWrapper):
                return True
        return False


class ActionWrapperAboveTakeover(metaclass=_ActionWrapperAboveTakeover):
    """Class of all wrappers that change actions on their way to a ``TakeoverWrapper`` below."""


def action_wrapper_above_report(env: gym.Env) -> gym.Wrapper | None:
    """
    Find a wrapper that changes actions above the one that reports takeovers.

    :param env: reports takeovers, somewhere among its wrappers
    :return: the wrapper that changes actions above all that may report them, None if there is none
    """
    while isinstance(env, gym.Wrapper):
        if _may_report(type(env)):
            return None
        if isinstance(env, gym.ActionWrapper):
            return env
        env = env.env
    return None


def _may_report(wrapper: type) -> bool:
    """
    Tell whether a wrapper may report takeovers: whether anything in its class speaks of them.

    :param wrapper: class of it
    """
    words = ("interven", "teleop", TAKEOVER, APPLIED_ACTION)
    for owner in wrapper.__mro__:
        if owner.__module__.partition(".")[0] in ("gymnasium", "stable_baselines3", "typing", "builtins"):
            continue
        for member in vars(owner).values():
            member = getattr(member, "fget", None) or getattr(member, "__func__", member)
            pending = [member.__code__] if hasattr(member, "__code__") else []
            while pending:
                code = pending.pop()
                pending += [constant for constant in code.co_consts if hasattr(constant, "co_consts")]
                texts = [*code.co_names, *(constant for constant in code.co_consts if isinstance(constant, str))]
                texts += [word for part in code.co_consts if isinstance(part, tuple) for word in part if isinstance(word, str)]
                if any(word in text.lower() for text in texts for word in words):
                    return True
    return False


class _ReportsBelow:
    """``VecEnv.env_is_wrapped`` asks each wrapper, the outermost first, which answers for all. Good for one environment."""

    is_asked = False

    def __instancecheck__(self, wrapper: Any) -> bool:
        is_first, self.is_asked = not self.is_asked, True
        return is_first and action_wrapper_above_report(wrapper) is not None


def check_reports(env: "VecEnv", idx: int) -> None:
    """
    Check the units of reported actions.

    :param env: training environments
    :param idx: of one that reports a takeover
    :raises UnsupportedActionSpace: if one can see that it does so in other units than those of the algorithm
    """
    base: Any = env.unwrapped
    if base.action_space != env.action_space:
        raise _wrong_order(base.action_space, env.action_space, "a VecEnvWrapper")
    if hasattr(base, "envs"):  # in this process: the message names more
        check_report_order(base.envs[idx])
    elif base.env_is_wrapped(_ReportsBelow(), indices=idx)[0]:
        raise _wrong_order("a space of its own", env.action_space, f"a wrapper of environment {idx}")


def check_report_order(env: gym.Env) -> None:
    """
    Check the units of the actions that an environment reports.

    :param env: reports takeovers, somewhere among its wrappers
    :raises UnsupportedActionSpace: if what it reports is not in the units of its action space
    """
    changer = action_wrapper_above_report(env)
    if changer is not None:
        raise _wrong_order(changer.env.action_space, env.action_space, type(changer).__name__)


def _wrong_order(takeover_space: spaces.Space | str, action_space: spaces.Space, changer: str) -> UnsupportedActionSpace:
    return UnsupportedActionSpace(
        f"env: the human takes over in {takeover_space}, but the algorithm acts in {action_space}, and {changer} between them "
        "changes the actions. The human's actions would be stored in the wrong units: take over outside of what changes "
        "actions, e.g. InterventionWrapper(RescaleAction(env, ...)) in place of RescaleAction(InterventionWrapper(env), ...)."
    )


def check_takeover_order(env: gym.Env) -> None:
    """
    Check that no wrapper changes actions above a takeover.

    :param env: an environment, with its wrappers
    :raises UnsupportedActionSpace: if one of them changes actions above a ``TakeoverWrapper``
    """
    wrapper = env
    while isinstance(wrapper, gym.Wrapper):
        if isinstance(wrapper, ActionWrapperAboveTakeover):
            raise _wrong_order(wrapper.env.action_space, env.action_space, type(wrapper).__name__)
        wrapper = wrapper.env


def wrapped_indices(env: "VecEnv") -> list[int]:
    """
    Find the environments with a ``TakeoverWrapper``.

    :return: indices of the environments that have a ``TakeoverWrapper``
    """
    return [idx for idx, wrapped in enumerate(env.env_is_wrapped(TakeoverWrapper)) if wrapped]


def ask_wrappers(env: "VecEnv", indices: Sequence[int], method: str, *args: Any) -> list[Any]:
    """
    Call a method of the ``TakeoverWrapper`` of some environments.

    :param indices: of environments that have a ``TakeoverWrapper``
    :param method: of it
    :return: what each returns
    """
    return env.env_method("sb3_chac_takeovers", method, *args, indices=indices) if indices else []


def check_order(env: "VecEnv") -> None:
    """
    Check that no wrapper of the training environments changes actions above a takeover.

    :param env: training environments
    :raises UnsupportedActionSpace: if actions are changed between the algorithm and the takeover
    """
    indices = wrapped_indices(env)
    found = ask_wrappers(env, indices, "takeover_space")
    changed = env.env_is_wrapped(ActionWrapperAboveTakeover)  # type: ignore[arg-type]
    for idx, space in zip(indices, found, strict=True):
        if space != env.action_space or changed[idx]:
            raise _wrong_order(space, env.action_space, f"a wrapper of environment {idx}")
