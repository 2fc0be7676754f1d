"""Tells which algorithm saved a model: several store the same arguments and networks, and would learn on from each other's."""

import io
import json
import pathlib
import zipfile
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import open_path
from stable_baselines3.common.type_aliases import GymEnv

SelfNamed = TypeVar("SelfNamed", bound="NamedAlgorithm")


class NamedAlgorithm(BaseAlgorithm):
    """Base of all our algorithms: what they save names them, and what another one saved is refused."""

    def save(self, *args: Any, **kwargs: Any) -> None:
        """Save as SB3 does."""
        self.saved_by = algorithm_name(type(self))
        super().save(*args, **kwargs)

    @classmethod
    def load(
        cls: type[SelfNamed],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfNamed:
        """
        Load as SB3 does.

        :raises ValueError: if another algorithm saved the model
        """
        saver = saved_by(path)
        if saver not in (None, algorithm_name(cls)):
            raise ValueError(
                f"path: {saver} saved this model, load it with {saver}.load(...), not with {cls.__name__}.load(...)."
            )
        return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)


def algorithm_name(algorithm: type[BaseAlgorithm]) -> str:
    """
    Name an algorithm.

    :param algorithm: one of ours, or derived from one
    :return: name of ours, the one that is defined in ``sb3_chac.<algorithm>.<algorithm>``
    """
    for base in algorithm.__mro__:
        package, _, module = base.__module__.partition(".")
        if package == "sb3_chac" and len(set(module.split("."))) == 1 and module.count(".") == 1:
            return base.__name__
    return algorithm.__name__


def saved_by(path: str | pathlib.Path | io.BufferedIOBase) -> str | None:
    """
    Find out who saved a model.

    :param path: of the model, or an open file
    :return: name of the class, None if it does not tell: it is older, or none of ours
    """
    try:
        with zipfile.ZipFile(open_path(path, "r", verbose=0, suffix="zip")) as archive:
            return name_in(json.loads(archive.read("data")))
    except (zipfile.BadZipFile, KeyError, ValueError):  # SB3 says what is wrong with it
        return None


def name_in(data: dict[str, Any]) -> str | None:
    """
    Read the name of an algorithm.

    :param data: stored in a model
    :return: name of the class that saved it, None if it does not tell
    """
    name = data.get("saved_by")
    return name if isinstance(name, str) else None
