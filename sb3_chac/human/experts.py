"""Experts, which drive during a takeover: a scripted driver, a trained model or any function of the observation."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecNormalize, VecTransposeImage

from sb3_chac.common.naming import is_name, named_object


class Expert(Protocol):
    """Driver in the human's place. It may also have ``time_to_trouble(observation, action)``, see ``RiskRule``."""

    def reset(self, seed: int | None = None) -> None:
        """
        Called at the start of an episode and whenever the expert is asked again after a break.

        :param seed: seed of its random numbers; with None they go on where they were
        """

    def __call__(self, observation: Any) -> np.ndarray:
        """
        Act.

        :param observation: what the environment returned last, one environment's, not batched
        :return: the action in the units of the environment, of the shape of its action space
        """


class FunctionExpert:
    """
    A function of the observation, without memory.

    :param function: observation -> action; its ``time_to_trouble`` is kept if it has one
    """

    def __init__(self, function: Callable[[Any], Any]):
        self.function = function
        if hasattr(function, "time_to_trouble"):
            self.time_to_trouble = function.time_to_trouble

    def reset(self, seed: int | None = None) -> None:
        pass

    def __call__(self, observation: Any) -> np.ndarray:
        return self.function(observation)


class ModelExpert:
    """
    A model of SB3, sb3-contrib or this package, asked for its deterministic action; recurrent ones keep their state.

    :param model: anything with SB3's ``predict``
    :param normalize: statistics that observations are normalized with, for a model that was trained with VecNormalize
    """

    def __init__(self, model: PolicyPredictor, normalize: VecNormalize | None = None):
        self.model = model
        self.normalize = normalize
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        self.state: tuple[np.ndarray, ...] | None = None
        self.episode_start = np.ones(1, dtype=bool)

    def __call__(self, observation: Any) -> np.ndarray:
        if self.normalize is not None:
            observation = self.normalize.normalize_obs(observation)
        action, self.state = self.model.predict(
            observation, state=self.state, episode_start=self.episode_start, deterministic=True
        )
        self.episode_start = np.zeros(1, dtype=bool)
        return action[()]  # a discrete action as a number


def make_expert(expert: Any, env: gym.Env) -> Expert:
    """
    Make an expert of a name, a model or a function.

    :param expert: a name of a scripted driver that ``env`` has ("scripted", "scripted-ideal"), a loaded model (anything
        with SB3's ``predict``), an ``Expert``, a function observation -> action, or "package.module:name", which names one of
        these or a class, of which ``env`` gets an object of its own: ``Class(env)``
    :param env: the environment that the expert is to drive
    :return: an expert with ``reset``
    :raises ValueError: for anything else, and for a model whose spaces are not those of ``env``
    """
    check_expert(expert, env)
    if is_name(expert):
        expert = named_object("expert", expert)
        if isinstance(expert, type):
            expert = expert(env)
        check_expert(expert, env)
    elif isinstance(expert, str):
        expert = env.unwrapped.scripted_driver(expert)  # type: ignore[attr-defined]
    if hasattr(expert, "reset"):
        return expert
    return ModelExpert(expert) if hasattr(expert, "predict") else FunctionExpert(expert)


def check_expert(expert: Any, env: gym.Env) -> None:
    """
    Check what can be checked without building the expert; whether ``env`` knows a name shows in ``make_expert``.

    :raises ValueError: see ``make_expert``
    """
    if isinstance(expert, os.PathLike) or (isinstance(expert, str) and (expert.endswith(".zip") or Path(expert).is_file())):
        raise ValueError(
            f"expert: {os.fspath(expert)!r} is a file. Load the model first with its class and pass it, "
            f"e.g. expert=SAC.load({os.fspath(expert)!r})."
        )
    if is_name(expert):
        found = named_object("expert", expert)
        if not isinstance(found, type):
            check_expert(found, env)
    elif isinstance(expert, str):
        if not hasattr(env.unwrapped, "scripted_driver"):
            raise ValueError(
                f"expert: {type(env.unwrapped).__name__} has no scripted driver, so expert={expert!r} does not exist. "
                "Pass a trained model (expert=SAC.load(...)), a function observation -> action, or the name of one, "
                '"package.module:function", instead.'
            )
    elif isinstance(expert, type) or not (callable(expert) or hasattr(expert, "predict")):
        raise ValueError(
            "expert must be the name of a scripted driver, a loaded model (with predict) or a function "
            f"observation -> action, got {expert!r}."
        )
    elif hasattr(expert, "predict") and not _is_expert(expert):
        for name in ("observation_space", "action_space"):
            model_space, env_space = getattr(expert, name, None), getattr(env, name)
            if model_space is not None and not _fits(model_space, env_space):
                raise ValueError(
                    f"expert: the {name.replace('_', ' ')} of the {expert_name(expert)} is {model_space}, the environment's "
                    f"is {env_space}. Pass a model that was trained on this environment with these wrappers."
                )


def expert_name(expert: Any) -> str:
    """
    Name an expert for a message.

    :return: what to call ``expert`` in a message
    """
    if isinstance(expert, str):
        return f"expert {expert!r}"
    if hasattr(expert, "predict") and not _is_expert(expert):
        return f"{type(expert).__name__} model"
    return f"expert {getattr(expert, '__qualname__', type(expert).__name__)}"


def _is_expert(expert: Any) -> bool:
    return callable(expert) and hasattr(expert, "reset")


def _fits(model_space: spaces.Space, env_space: spaces.Space) -> bool:
    # Models learn from images with the channels first and transpose others themselves
    if model_space != env_space and isinstance(env_space, spaces.Box) and is_image_space(env_space):
        return model_space == VecTransposeImage.transpose_space(env_space)
    return model_space == env_space
