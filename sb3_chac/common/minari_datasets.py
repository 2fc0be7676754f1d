"""Minari's datasets on the disk: where they are, and opening them, with one error for all that may be wrong."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from minari import MinariDataset

HOW_TO_GET_ONE = (
    "Record one with 'python -m sb3_chac demos record', fetch one with 'minari download', or list those that are there with "
    "'minari list local'."
)


class DatasetError(ValueError):
    """Raised for a dataset that is missing, damaged, empty or made for other spaces; says what is wrong and what to do."""


def is_minari_dataset(dataset: Any) -> bool:
    """
    Tell Minari's datasets from others, without importing Minari.

    :return: whether it is a ``MinariDataset``
    """
    from minari import MinariDataset

    return isinstance(dataset, MinariDataset)


def open_dataset(dataset: "str | os.PathLike[str] | MinariDataset") -> "MinariDataset":
    """
    Open a dataset with Minari.

    :param dataset: id of a local dataset of Minari, its folder, or what was opened before
    :raises DatasetError: if it is missing, damaged, empty, or made by a version of Minari that the installed one cannot read
    """
    from minari import MinariDataset

    if isinstance(dataset, MinariDataset):
        opened, name = dataset, f"dataset {dataset.id!r}"
    else:
        folder, name = find_dataset(dataset), f"dataset {os.fspath(dataset)!r}"
        check_metadata(folder, name)
        try:
            opened = MinariDataset(folder)
        except Exception as error:  # whatever a damaged file leads to
            raise damaged(name, error) from error
    try:
        empty = len(opened.episode_indices) == 0 or opened.total_steps == 0
    except Exception as error:
        raise damaged(name, error) from error
    if empty:
        raise DatasetError(f"{name} holds no steps. {HOW_TO_GET_ONE}")
    return opened


def check_metadata(folder: Path, name: str) -> None:
    """
    Check that Minari can read a dataset, and that the episodes that it names are there: Minari would look for each of them.

    :param folder: that holds the data
    :param name: of the dataset, for the message
    :raises DatasetError: if the installed Minari cannot read what another version has written, or episodes are missing
    """
    from minari import __version__, supported_dataset_versions

    try:
        metadata = json.loads((folder / "metadata.json").read_text())
        version = metadata["minari_version"]
        episodes, data_format = metadata.get("total_episodes"), metadata.get("data_format")
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return  # not Minari's, which it says itself
    if version not in supported_dataset_versions:
        raise DatasetError(
            f"{name} was made by Minari {version}, which the installed Minari {__version__} cannot read (only "
            f"{', '.join(sorted(supported_dataset_versions))}). Install a version that can (pip install minari=={version}), "
            "or record or download the dataset anew."
        )
    file = folder / "main_data.hdf5"
    if not isinstance(episodes, int) or (data_format == "hdf5" and not file.is_file()):
        return  # likewise
    found = len(groups_in(file, name)) if data_format == "hdf5" else sum(part.is_dir() for part in folder.iterdir())
    if episodes > found:
        raise damaged(name, f"metadata.json names {episodes} episodes, but {found} are there")


def groups_in(file: Path, name: str) -> list[str]:
    """
    List the groups of a file of Minari, one for each episode.

    :param name: of the dataset, for the message
    :raises DatasetError: if it is no HDF5
    """
    import h5py

    if not file.stat().st_size:
        return []  # as it is before the first episode
    try:
        with h5py.File(file, "r") as opened:
            return list(opened)
    except Exception as error:  # nearly any
        raise damaged(name, error) from error


def find_dataset(dataset: str | os.PathLike[str]) -> Path:
    """
    Find the folder of a dataset.

    :param dataset: id of a local dataset of Minari, or its folder
    :return: the folder that holds the data
    :raises DatasetError: if there is none
    """
    name = os.fspath(dataset)
    candidates = [Path(name)]
    if is_dataset_id(name):
        candidates.insert(0, minari_folder() / name)
    for candidate in candidates:
        if (candidate / "data").is_dir():
            return candidate / "data"
        if (candidate / "metadata.json").is_file():
            return candidate
    looked_for = " or ".join(str(candidate) for candidate in candidates)
    raise DatasetError(f"There is no dataset {name!r} (looked for {looked_for}). {HOW_TO_GET_ONE}")


def minari_folder() -> Path:
    """
    Find Minari's folder of datasets.

    :return: where Minari keeps them; it need not exist yet
    """
    return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")


def is_dataset_id(name: str) -> bool:
    """
    Tell whether a name is an id of Minari.

    :return: whether it is an id such as "safedrive/scripted-v0", with a version at its end
    """
    from minari.dataset.minari_dataset import parse_dataset_id

    try:
        parse_dataset_id(name)
    except (ValueError, TypeError):  # malformed, without a version
        return False
    return True


def damaged(name: str, problem: object) -> DatasetError:
    """
    Make the error for a dataset that cannot be used.

    :param name: of the dataset
    :param problem: with it
    """
    return DatasetError(
        f"{name}: the dataset cannot be used, it is damaged or not Minari's: {str(problem) or type(problem).__name__}. "
        "Restore it from a copy, or record it anew with 'python -m sb3_chac demos record --overwrite'."
    )
