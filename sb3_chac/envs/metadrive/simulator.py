"""MetaDrive itself: that it is there, that it has what it needs, and that a process has one engine only."""

import importlib.util
import logging
import os
import threading
import weakref
from typing import TYPE_CHECKING, Any

import gymnasium as gym

if TYPE_CHECKING:
    from metadrive.envs.safe_metadrive_env import SafeMetaDriveEnv

HEADLESS_VARIABLE = "SB3_CHAC_METADRIVE_HEADLESS"
VERSION = "0.4.3"

_owner: "weakref.ReferenceType[Any] | None" = None  # of this process's engine


class MissingAssets(gym.error.DependencyNotInstalled):
    """Raised if MetaDrive's models and textures are not installed, and nobody asked to go without."""


class EngineInUse(gym.error.Error):
    """Raised if this process has an environment with MetaDrive's engine already: there is one engine in a process."""


def check_installed() -> None:
    """
    Check that MetaDrive is installed.

    :raises DependencyNotInstalled: unless MetaDrive and the pygame that it imports are there
    """
    if importlib.util.find_spec("metadrive") is None:
        raise gym.error.DependencyNotInstalled(
            f"MetaDriveSafety-v0 needs MetaDrive {VERSION} (Python 3.11): pip install metadrive-simulator==0.4.3."
        )
    import pygame

    if not hasattr(pygame, "Surface"):  # pygame and pygame-ce share a folder: who uninstalls one takes the other's files away
        raise gym.error.DependencyNotInstalled(
            "pygame is damaged, as it is after one of pygame and pygame-ce was uninstalled: "
            "pip install --force-reinstall --no-deps pygame-ce."
        )


def is_headless(headless: bool | None) -> bool:
    """
    Decide whether to go without MetaDrive's assets.

    :param headless: what the user said, None to let the environment variable decide
    """
    return os.environ.get(HEADLESS_VARIABLE, "0") not in ("", "0") if headless is None else headless


def prepare(headless: bool) -> None:
    """
    See to it that MetaDrive neither downloads anything nor waits for a download.

    :param headless: go without assets; physics, sensors and pictures from above do not need them
    :raises MissingAssets: if they are missing otherwise
    """
    from metadrive.engine.asset_loader import AssetLoader
    from metadrive.engine.base_engine import BaseEngine

    if not headless and (not os.path.exists(AssetLoader.file_path("version.txt")) or AssetLoader.should_update_asset()):
        raise MissingAssets(
            f"MetaDrive's assets (models and textures, version {VERSION}) are not installed. Download them with "
            "`python -m metadrive.pull_asset --update`, or go without: physics, lidar and pictures from above are the same. "
            f"For that set {HEADLESS_VARIABLE}=1 in the shell, or pass headless=True (RL-Zoo3: --env-kwargs headless:True "
            "--eval-env-kwargs headless:True)."
        )
    BaseEngine.try_pull_asset = staticmethod(lambda: None)


def make_simulator(owner: Any, config: dict[str, Any]) -> "SafeMetaDriveEnv":
    """
    Make MetaDrive's environment.

    :param owner: the environment that the engine is for, until it calls ``release`` or is garbage
    :param config: what differs from SafeMetaDriveEnv's defaults
    :raises EngineInUse: if another environment of this process has the engine
    """
    global _owner
    from metadrive.engine.engine_utils import close_engine, engine_initialized

    if (_owner and _owner() is not None) or (_owner is None and engine_initialized()):
        raise EngineInUse(
            "MetaDrive has one engine per process, and this process has a MetaDrive environment already. Close that one first "
            "(env.close()), or run each in a process of its own: stable_baselines3.common.vec_env.SubprocVecEnv with one "
            "environment each for training and for evaluation; RL-Zoo3: --vec-env subproc."
        )
    close_engine()  # of an owner that was lost without being closed
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    from metadrive.envs.safe_metadrive_env import SafeMetaDriveEnv

    if threading.current_thread() is not threading.main_thread():
        from direct.task import Task

        Task.signal = None  # Panda3D would set a signal handler in each step, which only the main thread may
    simulator = SafeMetaDriveEnv(config | {"log_level": logging.ERROR})
    root.handlers, root.level = handlers, level  # MetaDrive's modules call logging.basicConfig
    _owner = weakref.ref(owner)
    return simulator


def release(owner: Any) -> None:
    """Close the engine, if it is ``owner``'s."""
    global _owner
    if _owner is not None and _owner() is owner:
        from metadrive.engine.engine_utils import close_engine

        close_engine()
        _owner = None
