"""Run folders of RL-Zoo3: the command and the checkpoint that a training goes on from."""

import argparse
import json
import shlex
import sys
import zipfile
from pathlib import Path

from sb3_chac.common.checkpoint_files import FOLDER, checkpoints, sound_checkpoint


class NotResumable(ValueError):
    """Raised for a folder from which no training can go on; says what to do."""


def find_training(run_folder: Path) -> tuple[list[str], Path]:
    """
    Find what a training in a run folder goes on from.

    :param run_folder: of RL-Zoo3, e.g. logs/chac/SafeDrive-v0_1
    :return: arguments of ``rl_zoo3 train``, and the model of the newest checkpoint
    :raises NotResumable: if one of them is not there, or the training was started elsewhere
    """
    if not run_folder.is_dir():
        raise NotResumable(f"{run_folder}: there is no such folder.")
    files = list(run_folder.glob("*/argv.json"))
    if len(files) != 1:
        raise NotResumable(
            f"{run_folder} is not the folder of a run, such as logs/chac/SafeDrive-v0_1, of 'rl_zoo3 train' with an algorithm "
            "of sb3_chac: it holds no <environment>/argv.json."
        )
    try:
        command = json.loads(files[0].read_text())
        if not isinstance(command, list) or not command or not all(isinstance(argument, str) for argument in command):
            raise ValueError(f"it must hold the arguments of a command, not {command!r:.60}.")
    except (OSError, ValueError, TypeError) as error:
        raise NotResumable(f"{files[0]} cannot be read: {error}") from error
    checkpoint, problems = sound_checkpoint(run_folder / FOLDER)
    if checkpoint is None:
        none = f"no checkpoint that is sound: {' '.join(problems)}" if problems else "no checkpoint yet."
        again = f"sb3-chac {shlex.join(command)}" if command[:1] == ["drive"] else f"rl_zoo3 train {shlex.join(command)}"
        raise NotResumable(
            f"{run_folder} holds {none} If it was itself resumed, resume the run before it; else start anew with\n  {again}"
        )
    if problems:
        newest = checkpoints(run_folder / FOLDER)[0]
        lost = int(newest.name) - int(checkpoint.name)
        print(f"{' '.join(problems)} Going on from {checkpoint} instead, which costs {lost} steps.", file=sys.stderr)
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("-f", "--log-folder", default="logs")
    log_folder = Path(parser.parse_known_args(command)[0].log_folder)
    if log_folder.resolve() != run_folder.resolve().parents[1]:
        raise NotResumable(
            f"{run_folder} was written to the log folder {log_folder}, which from here is {log_folder.resolve()}: "
            "change to the folder where the training was started."
        )
    return command, checkpoint / f"{files[0].parent.name}.zip"


def steps(model: Path) -> tuple[int, int]:
    """
    Read how far a training has come.

    :param model: of a checkpoint
    :return: how many steps were made, and how many were to be made in all
    :raises NotResumable: if it cannot be read
    """
    try:
        with zipfile.ZipFile(model) as archive:
            data = json.loads(archive.read("data"))
        return int(data["num_timesteps"]), int(data["_total_timesteps"])
    except (OSError, zipfile.BadZipFile, KeyError, ValueError, TypeError) as error:
        raise NotResumable(f"{model} cannot be read: {error}") from error
