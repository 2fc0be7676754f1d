"""Checkpoints from which a training that was killed goes on, see ``sb3-chac resume``."""

import io
import os
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

FOLDER = "checkpoints"  # of a run
BLOCK = 2**16  # bytes


class ResumableCheckpoint(BaseCallback):
    """
    Keeps the newest state of a training in ``<run folder>/checkpoints/<number of steps>``: the model, its replay buffer and
    the running statistics of ``VecNormalize``, named as RL-Zoo3's ``-i`` expects them.

    It is written between two rollouts, when everything collected is stored and learned from, and after the last one. The
    folder is filled under another name and renamed once it is on the disk: whenever the process is killed, a complete one is
    left. If it cannot be written (the disk is full), a warning is given, the older one is kept and the training goes on.

    :param save_freq: number of steps (of all environments) after which the next one is written
    :param run_folder: of RL-Zoo3, e.g. logs/chac/SafeDrive-v0_1
    :param env_name: name of the environment as in RL-Zoo3's file names
    :param verbose: Verbosity level: 0 for no output, 1 for a line per checkpoint
    """

    def __init__(self, save_freq: int, run_folder: str | Path, env_name: str, verbose: int = 0):
        super().__init__(verbose)
        self.save_freq = save_freq
        self.folder = Path(run_folder) / FOLDER
        self.env_name = env_name
        self.tried_at = 0  # number of steps; a training that goes on writes its first one at once
        self.is_stored = False  # whether the transitions of the last rollout are

    def _on_rollout_start(self) -> None:
        self.is_stored = False
        if self.model.num_timesteps - self.tried_at >= self.save_freq:
            self.save()

    def _on_step(self) -> bool:
        return True  # too early: the transition is not stored yet

    def _on_rollout_end(self) -> None:
        self.is_stored = True

    def _on_training_end(self) -> None:
        if self.is_stored and self.model.num_timesteps >= self.model._total_timesteps:
            self.save()

    def save(self) -> None:
        """Writes a checkpoint and removes all others."""
        self.tried_at = self.model.num_timesteps
        final = self.folder / str(self.tried_at)
        if final.exists():
            return
        check_finite_model(self.model)
        temporary = self.folder / f"{self.tried_at}.tmp"
        try:
            self._write(temporary)
            temporary.rename(final)
            sync(self.folder)
        except OSError as error:
            shutil.rmtree(temporary, ignore_errors=True)
            older = newest_checkpoint(self.folder)
            left = f"Should it be killed, {older} is there to resume from." if older else "There is none yet to resume from."
            warnings.warn(
                f"No checkpoint at step {self.tried_at}, {self.folder} cannot be written: {error}. The training goes on, the "
                f"next attempt is in {self.save_freq} steps. {left}"
            )
            return
        for other in self.folder.iterdir():
            if other != final:  # older, or left behind by a process that was killed
                shutil.rmtree(other, ignore_errors=True)
        if self.verbose > 0:
            print(f"Saved checkpoint {final}")

    def _write(self, folder: Path) -> None:
        """
        :param folder: is made, and on the disk when this returns
        """
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        with (folder / f"{self.env_name}.zip").open("wb") as file:
            self.model.save(file)
        if getattr(self.model, "replay_buffer", None) is not None:
            with SparseWriter((folder / "replay_buffer.pkl").open("wb", buffering=0)) as file:
                self.model.save_replay_buffer(file)  # type: ignore[attr-defined]
        normalize = self.model.get_vec_normalize_env()
        if normalize is not None:
            (folder / self.env_name).mkdir()
            normalize.save(str(folder / self.env_name / "vecnormalize.pkl"))
        for path in [*folder.rglob("*"), folder]:
            sync(path)


def check_finite_model(model: BaseAlgorithm) -> None:
    """
    :raises ValueError: if a parameter is NaN or infinite; names it
    """
    for name, values in model.policy.state_dict().items():
        if not values.isfinite().all():
            raise ValueError(
                f"model: {name} is NaN or infinite at step {model.num_timesteps}: no checkpoint was written, the older one is "
                "kept. Look for values that are too large in observations, rewards and costs, or lower the learning rate."
            )


class SparseWriter(io.BufferedWriter):
    """
    A file in which blocks of zeros are left out (they are read as zeros): SB3's ReplayBuffer is stored with the rows that are
    not in use yet, which may be gigabytes. The last byte written must not be zero; that of a pickle never is.
    """

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        for start in range(0, len(view), BLOCK):
            block = view[start : start + BLOCK]
            if np.frombuffer(block, dtype=bool).any():
                super().write(block)
            else:
                self.seek(len(block), os.SEEK_CUR)
        return len(view)


def sync(path: Path) -> None:
    """
    :param path: a file or folder, what is in it is on the disk when this returns (Windows cannot do so with folders)
    """
    if path.is_dir() and os.name == "nt":
        return
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def newest_checkpoint(folder: Path) -> Path | None:
    """
    :param folder: of a ``ResumableCheckpoint``
    :return: the newest complete one in it, None if there is none
    """
    if not folder.is_dir():
        return None
    return max((path for path in folder.iterdir() if path.name.isdigit()), key=lambda path: int(path.name), default=None)


def checkpoint_step(model: str | Path) -> int | None:
    """
    :param model: path of a saved model
    :return: number of steps that were made if it is that of a ``ResumableCheckpoint``, else None
    """
    path = Path(model).resolve()
    folder = path.parent
    is_checkpoint = path.suffix == ".zip" and folder.name.isdigit() and folder.parent.name == FOLDER
    return int(folder.name) if is_checkpoint else None
