"""Writes datasets in Minari's format: complete ones or none."""

import importlib.metadata
import os
import re
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

import sb3_chac
from sb3_chac.common.minari_datasets import DatasetError, is_dataset_id, minari_folder
from sb3_chac.human.intervention import InterventionWrapper

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer

SETTINGS = "sb3_chac"  # where Minari's metadata holds ours
# Wrappers that change nothing of what is recorded: who takes over is in the actions
LEFT_OUT = (InterventionWrapper.__name__, "Monitor")


class DatasetWriter:
    """
    Writer of a dataset. It fills a hidden folder beside its own, which gets its name at the end: what is interrupted leaves
    nothing.

    :param folder: of the dataset, see ``folder_to_make``
    :param env: the environment that is recorded
    :param settings: how it was recorded, can be written as JSON
    :param overwrite: whether ``folder`` may be there
    """

    def __init__(self, folder: Path, env: gym.Env, settings: dict[str, Any], overwrite: bool) -> None:
        self.folder, self.overwrite = folder, overwrite
        self.env, self.settings = env, settings
        self.steps = 0

    def __enter__(self) -> "DatasetWriter":
        from minari.dataset.minari_storage import MinariStorage

        root = next(parent for parent in self.folder.parents if parent.is_dir())
        try:
            self.temporary = tempfile.TemporaryDirectory(prefix=".recording-", dir=root)
        except OSError as error:
            raise DatasetError(f"dataset: {root} cannot be written ({error.strerror}).") from error
        data = Path(self.temporary.name, "new", "data")
        data.mkdir(parents=True)
        self.storage = MinariStorage.new(
            data,
            observation_space=self.env.observation_space,
            action_space=self.env.action_space,
            env_spec=storable_spec(self.env),
            data_format="hdf5",
            jpeg_encoding=False,  # it loses what the picture was
        )
        return self

    def add(self, episode: "EpisodeBuffer") -> None:
        """
        Add an episode.

        :param episode: whole, with its infos
        """
        self.storage.update_episodes([episode])
        self.steps += len(episode)

    def finish(self) -> None:
        """
        Complete the dataset and give it its name.

        :raises DatasetError: if a dataset of that name has come into being in the meantime
        """
        dataset_id = dataset_id_of(self.folder)
        self.storage.update_metadata(
            {
                "dataset_id": dataset_id,
                "minari_version": importlib.metadata.version("minari"),
                "algorithm_name": self.settings["policy"],
                "description": f"Recorded by sb3_chac: {self.settings['policy']}",
                SETTINGS: {**self.settings, "versions": versions()},
            }
        )
        make_namespace(dataset_id)
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        check_free(self.folder, self.overwrite)
        if self.folder.exists():
            self.folder.rename(Path(self.temporary.name, "old"))
        Path(self.temporary.name, "new").rename(self.folder)

    def __exit__(self, *_: object) -> None:
        self.temporary.cleanup()


def folder_to_make(dataset: str | os.PathLike[str], overwrite: bool) -> Path:
    """
    Find the folder of a dataset that is to be made.

    :param dataset: id for Minari's folder, or the folder to make: an absolute one, or one that begins with "."
    :raises DatasetError: for an id that Minari does not take, or a name that is taken
    """
    name = os.fspath(dataset)
    is_folder = not isinstance(dataset, str) or name.startswith(".") or os.path.isabs(name)
    folder = Path(name).absolute() if is_folder else minari_folder().absolute() / name
    if not is_dataset_id(dataset_id_of(folder)):
        raise DatasetError(
            "dataset: the name must look like safedrive/scripted-v0, with a version at its end, or like ./scripted, a folder "
            f"outside of Minari's, got {name!r}."
        )
    check_free(folder, overwrite)
    return folder


def check_free(folder: Path, overwrite: bool) -> None:
    """
    Check that a folder may be written.

    :raises DatasetError: if the folder is there, unless it is a dataset that may be overwritten
    """
    if not folder.exists():
        return
    if not (folder / "data").is_dir():
        raise DatasetError(f"dataset: {folder} is there and is not a dataset. Choose another name.")
    if not overwrite:
        raise DatasetError(f"dataset: {folder} exists already. Choose another name, or replace it with --overwrite.")


def dataset_id_of(folder: Path) -> str:
    """Return the id under which Minari finds a dataset, or if it is kept elsewhere the name of its folder as such an id."""
    root = minari_folder().absolute()
    if folder.is_relative_to(root):
        return folder.relative_to(root).as_posix()
    if is_dataset_id(folder.name):
        return folder.name
    return f"{re.sub('[^A-Za-z0-9]+', '-', folder.name).strip('-') or 'dataset'}-v0"


def make_namespace(dataset_id: str) -> None:
    """Minari lists datasets in folders that it knows as namespaces only."""
    from minari.namespace import create_namespace, list_local_namespaces

    namespace = dataset_id.rpartition("/")[0]
    if namespace and namespace not in list_local_namespaces():
        create_namespace(namespace)


def storable_spec(env: gym.Env) -> EnvSpec | None:
    """
    Describe how to make an environment again, without those who take over.

    :return: None if that cannot be written down
    """
    spec = env.spec
    if spec is None:
        return None
    wrappers = tuple(wrapper for wrapper in spec.additional_wrappers if wrapper.name not in LEFT_OUT)
    spec = replace(spec, additional_wrappers=wrappers)
    try:
        spec.to_json()
    except (TypeError, ValueError):  # e.g. a class as entry point
        return None
    return spec


def versions() -> dict[str, str]:
    """
    Collect the versions of the packages that matter for a recording.

    :return: of the packages that have a say in what is recorded
    """
    names = ("stable_baselines3", "gymnasium", "numpy", "minari")
    return {"sb3_chac": sb3_chac.__version__, **{name: importlib.metadata.version(name) for name in names}}
