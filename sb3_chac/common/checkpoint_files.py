"""Checkpoints on the disk: which there are, and whether they are what was written. ``common.checkpoints`` writes them."""

import io
import json
import pickle
import zipfile
import zlib
from pathlib import Path
from typing import Any

import torch as th

from sb3_chac.common.files import checksum

FOLDER = "checkpoints"  # of a run
CONTENTS = "contents.json"  # of a checkpoint: what was written, to be compared with what is read
BUFFER = "replay_buffer.pkl"


class DamagedCheckpoint(ValueError):
    """Raised for a checkpoint that no training can go on from; says why."""


def checkpoints(folder: Path) -> list[Path]:
    """
    List the complete checkpoints of a folder.

    :param folder: of a ``ResumableCheckpoint``
    :return: those in it that got their name, which is a number, the newest first; a folder with nothing of one is none
    """
    if not folder.is_dir():
        return []
    named = [path for path in folder.iterdir() if is_number(path.name)]
    named = [path for path in named if any(path.glob("*.zip")) or (path / CONTENTS).is_file()]
    return sorted(named, key=lambda path: int(path.name), reverse=True)


def is_number(name: str) -> bool:
    """Tell whether the name of a folder is a number."""
    return name.isascii() and name.isdecimal()


def newest_checkpoint(folder: Path) -> Path | None:
    """
    Find the newest complete checkpoint.

    :param folder: of a ``ResumableCheckpoint``
    :return: the newest complete one in it, None if there is none
    """
    return next(iter(checkpoints(folder)), None)


def sound_checkpoint(folder: Path) -> tuple[Path | None, list[str]]:
    """
    Find the newest checkpoint that is not damaged.

    :param folder: of a ``ResumableCheckpoint``
    :return: the newest one in it that a training can go on from, None if there is none; and what is wrong with newer ones
    """
    problems: list[str] = []
    for path in checkpoints(folder):
        try:
            verify(path)
            return path, problems
        except DamagedCheckpoint as error:
            problems.append(str(error))
    return None, problems


def verify(folder: Path) -> None:
    """
    Read a checkpoint and compare it with what was written.

    :param folder: of the checkpoint
    :raises DamagedCheckpoint: if a file is missing or damaged, or a weight is not finite
    """
    try:
        written = json.loads((folder / CONTENTS).read_text()) if (folder / CONTENTS).exists() else {}
        for name, crc in written.get("files", {}).items():
            if checksum(folder / name)[0] != crc:
                raise DamagedCheckpoint(f"{folder / name} is damaged: it is not what was written.")
        models = list(folder.glob("*.zip"))
        if len(models) != 1 or written.get("model", models[0].name) != models[0].name:
            raise DamagedCheckpoint(f"{folder} does not hold one model, but {len(models)}.")
        data = verify_model(models[0])
        if written and not written["steps"] == data.get("num_timesteps") == int(folder.stem):  # "300.tmp" is of step 300, too
            raise DamagedCheckpoint(f"{models[0]} is of step {data.get('num_timesteps')}, not of {folder.stem}.")
        # Without a list of contents (older versions), the model says whether it has a buffer
        if "buffer_crc" in written or (not written and data.get("buffer_size") is not None):
            verify_buffer(folder / BUFFER, written)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        if isinstance(error, DamagedCheckpoint):
            raise
        raise DamagedCheckpoint(f"{folder} cannot be read: {error}") from error


def verify_model(model: Path) -> dict[str, Any]:
    """
    Check the file of a model.

    :param model: saved by SB3
    :return: its attributes, as JSON holds them
    :raises DamagedCheckpoint: if it is damaged, or a weight is not finite
    """
    try:
        with zipfile.ZipFile(model) as archive:
            damaged = archive.testzip()
            if damaged is not None:
                raise DamagedCheckpoint(f"{model} is damaged: {damaged} in it.")
            for name in archive.namelist():
                if name.endswith(".pth"):
                    with archive.open(name) as file:
                        values = th.load(io.BytesIO(file.read()), map_location="cpu", weights_only=True)
                    if not is_finite(values):
                        raise DamagedCheckpoint(f"{model}: {name} holds numbers that are NaN or infinite.")
            return dict(json.loads(archive.read("data")))
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, pickle.UnpicklingError) as error:
        raise DamagedCheckpoint(f"{model} is damaged: {str(error).partition('. ')[0]}") from error


def is_finite(values: Any) -> bool:
    """
    Tell whether all numbers are finite.

    :param values: a tensor, or lists and dictionaries of them
    """
    if isinstance(values, th.Tensor):
        return not values.is_floating_point() or bool(th.isfinite(values).all())
    parts = values.values() if isinstance(values, dict) else values if isinstance(values, list | tuple) else ()
    return all(map(is_finite, parts))


def verify_buffer(path: Path, written: dict[str, Any]) -> None:
    """
    Check the file of a replay buffer without unpickling it.

    :param path: of a replay buffer; it is not unpickled
    :param written: its size and checksum, if they are known
    :raises DamagedCheckpoint: if it is missing or damaged
    """
    if not path.is_file():
        raise DamagedCheckpoint(f"{path} is missing: the training would go on with empty stores.")
    crc, last = checksum(path)
    size = path.stat().st_size
    if last != b"." or (written and (size, crc) != (written["buffer_bytes"], written["buffer_crc"])):
        raise DamagedCheckpoint(f"{path} is damaged: its {size} bytes are not those that were written.")


def stored_rows(folder: Path) -> int | None:
    """
    Read how many rows the replay buffer of a checkpoint has.

    :param folder: of a checkpoint
    :return: rows of its replay buffer, None if it has none or is too old to say
    """
    contents = folder / CONTENTS
    return json.loads(contents.read_text()).get("buffer_rows") if contents.exists() else None


def checkpoint_step(model: str | Path) -> int | None:
    """
    Read at which step a checkpoint was written.

    :param model: path of a saved model
    :return: number of steps that were made if it is that of a ``ResumableCheckpoint``, else None
    """
    path = Path(model).resolve()
    folder = path.parent
    is_checkpoint = path.suffix == ".zip" and is_number(folder.name) and folder.parent.name == FOLDER
    return int(folder.name) if is_checkpoint else None
