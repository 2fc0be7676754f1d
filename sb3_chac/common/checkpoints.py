"""Checkpoints from which a training that was killed goes on, see ``sb3-chac resume``."""

import json
import shutil
import signal
import threading
import warnings
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from sb3_chac.common.checkpoint_files import (
    BUFFER,
    CONTENTS,
    FOLDER,
    DamagedCheckpoint,
    checkpoints,
    newest_checkpoint,
    verify,
)
from sb3_chac.common.files import SparseWriter, checksum, sync

KEPT = 2  # checkpoints: the newest, and the one to fall back to


class StopSignals:
    """
    Inside the block, SIGTERM and Ctrl-C are noted and nothing else; whoever looks at ``number`` ends what runs in good order.
    The second one does what it does elsewhere, in case that takes too long. Outside the main thread nothing is changed.
    """

    number: int | None = None

    def __enter__(self) -> "StopSignals":
        self._before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._note) for number in (signal.SIGTERM, signal.SIGINT)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.number = number
        self.__exit__()


class TrainingStopped(BaseException):
    """
    Raised between two rollouts, with a checkpoint behind it (not an ``Exception``: nothing went wrong).

    :param number: of the signal
    :param message: one sentence
    """

    def __init__(self, number: int, message: str):
        super().__init__(message)
        self.exit_code = 128 + number


class ResumableCheckpoint(BaseCallback):
    """
    Keeper of the newest state of a training in ``<run folder>/checkpoints/<number of steps>``: the model, its replay buffer
    and the running statistics of ``VecNormalize``, named as RL-Zoo3's ``-i`` expects them.

    It is written between two rollouts, when everything collected is stored and learned from, and after the last one. The
    folder is filled under another name, read back, and renamed once it is on the disk: whenever the process is killed, a
    complete one is left. Then all but it and the one before it are removed. If it cannot be written (the disk is full), a
    warning is given, the older ones are kept and the training goes on.

    :param save_freq: number of steps (of all environments) after which the next one is written
    :param run_folder: of RL-Zoo3, e.g. logs/chac/SafeDrive-v0_1
    :param env_name: name of the environment as in RL-Zoo3's file names
    :param verbose: Verbosity level: 0 for no output, 1 for a line per checkpoint
    :param signals: once one of them has come, a checkpoint is written and ``TrainingStopped`` raised
    """

    def __init__(
        self,
        save_freq: int,
        run_folder: str | Path,
        env_name: str,
        verbose: int = 0,
        signals: StopSignals | None = None,
    ):
        super().__init__(verbose)
        self.save_freq = save_freq
        self.folder = Path(run_folder) / FOLDER
        self.env_name = env_name
        self.signals = signals
        self.due_at = save_freq  # number of steps
        self.is_stored = False  # whether the transitions of the last rollout are

    def _on_training_start(self) -> None:
        steps = self.model.num_timesteps
        self.due_at = steps if steps else self.save_freq  # a training that goes on writes its first one at once

    def _on_rollout_start(self) -> None:
        self.is_stored = False
        stopped_by = self.signals.number if self.signals is not None else None
        if stopped_by is not None or self.model.num_timesteps >= self.due_at:
            self.save()
        if stopped_by is not None:
            raise TrainingStopped(stopped_by, self.farewell(signal.Signals(stopped_by).name))

    def _on_step(self) -> bool:
        return True  # too early: the transition is not stored yet

    def _on_rollout_end(self) -> None:
        self.is_stored = True

    def _on_training_end(self) -> None:
        if self.is_stored and self.model.num_timesteps >= self.model._total_timesteps:
            self.save()

    def farewell(self, reason: str) -> str:
        """
        Word how to go on.

        :param reason: why it stops
        :return: one sentence that says where the training stopped and how it goes on
        """
        step, newest = self.model.num_timesteps, newest_checkpoint(self.folder)
        if newest is None:
            return f"Stopped by {reason} at step {step}; no checkpoint could be written, nothing is there to resume from."
        lost = step - int(newest.name)
        loss = f", without the last {lost} steps, which could not be written" if lost else ""
        return f"Stopped by {reason} at step {step}; go on{loss}: sb3-chac resume {self.folder.parent}"

    def save(self) -> None:
        """Write a checkpoint and remove all but it and the one before it."""
        step = self.model.num_timesteps
        self.due_at = step + self.save_freq
        final = self.folder / str(step)
        if final.exists():
            return
        check_finite_model(self.model)
        temporary = self.folder / f"{step}.tmp"
        try:
            self._write(temporary)
            verify(temporary)
            temporary.rename(final)
            sync(self.folder)
        except (OSError, RuntimeError, DamagedCheckpoint) as error:  # torch turns some of the first kind into the second
            shutil.rmtree(temporary, ignore_errors=True)
            older = newest_checkpoint(self.folder)
            left = f"Should it be killed, {older} is there to resume from." if older else "There is none yet to resume from."
            warnings.warn(
                f"No checkpoint at step {step}, {self.folder} cannot be written: {error}. The training goes on, the "
                f"next attempt is in {self.save_freq} steps. {left}"
            )
            return
        kept = [path.name for path in checkpoints(self.folder)[:KEPT]]
        for other in self.folder.iterdir():
            if other.name not in kept:  # older, or left behind by a process that was killed
                shutil.rmtree(other, ignore_errors=True)
        if self.verbose > 0:
            print(f"Saved checkpoint {final}")

    def _write(self, folder: Path) -> None:
        """
        Write a checkpoint.

        :param folder: is made, and on the disk when this returns
        """
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        contents: dict[str, Any] = {"steps": self.model.num_timesteps, "model": f"{self.env_name}.zip"}
        with (folder / contents["model"]).open("wb") as file:
            self.model.save(file)
        buffer = getattr(self.model, "replay_buffer", None)
        if buffer is not None:
            with SparseWriter((folder / BUFFER).open("wb", buffering=0)) as file:
                self.model.save_replay_buffer(file)  # type: ignore[attr-defined]
                contents |= {"buffer_bytes": file.tell(), "buffer_crc": file.crc, "buffer_rows": buffer.size()}
        normalize = self.model.get_vec_normalize_env()
        if normalize is not None:
            (folder / self.env_name).mkdir()
            normalize.save(str(folder / self.env_name / "vecnormalize.pkl"))
        others = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != BUFFER)
        contents["files"] = {path.relative_to(folder).as_posix(): checksum(path)[0] for path in others}
        (folder / CONTENTS).write_text(json.dumps(contents) + "\n")
        for path in [*folder.rglob("*"), folder]:
            sync(path)


def check_finite_model(model: BaseAlgorithm) -> None:
    """
    Check the parameters of a model, and the statistics that normalize its observations and rewards.

    :raises ValueError: if one is NaN or infinite; names it
    """
    normalize = model.get_vec_normalize_env()
    numbers = {name: values.cpu().numpy() for name, values in model.policy.state_dict().items()}
    if normalize is not None:
        numbers |= statistics(normalize)
    for name, values in numbers.items():
        if not np.isfinite(values).all():
            raise ValueError(
                f"model: {name} is NaN or infinite at step {model.num_timesteps}: no checkpoint was written, the older one is "
                "kept. Look for values that are too large in observations, rewards and costs, or lower the learning rate."
            )


def statistics(normalize: VecNormalize) -> dict[str, np.ndarray]:
    """
    Name the statistics of normalized environments.

    :return: means and variances of observations (by key if there are any) and of discounted rewards
    """
    of_observations: Any = getattr(normalize, "obs_rms", {})  # none without norm_obs
    named = of_observations if isinstance(of_observations, dict) else {"observation": of_observations}
    return {
        f"vecnormalize.pkl, {part} of {name}": np.asarray(getattr(running, part))
        for name, running in (named | {"returns": normalize.ret_rms}).items()
        for part in ("mean", "var")
    }
