"""Demonstrations: datasets in Minari's format (minari.farama.org) as flat arrays. ``datasets.recording`` makes some."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypeAlias, Union

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecTransposeImage

from sb3_chac.common.checks import check_action_space, is_finite
from sb3_chac.common.contract import NOVICE_ACTION, TAKEOVER
from sb3_chac.common.minari_datasets import HOW_TO_GET_ONE, DatasetError, damaged, is_minari_dataset, open_dataset

if TYPE_CHECKING:
    from minari import MinariDataset

# What ``load_demonstrations`` takes
Dataset: TypeAlias = Union[
    str,
    os.PathLike[str],
    "Demonstrations",
    "MinariDataset",
    Sequence[Union[str, os.PathLike[str], "Demonstrations", "MinariDataset"]],
]
# Names in the infos of a recording -> fields of Demonstrations. An action's info is stored at the index of what follows it
INFOS = {TAKEOVER: "takeovers", NOVICE_ACTION: "novice_actions", "cost": "costs", "is_success": "successes"}


def missing_dataset(algorithm: str) -> DatasetError:
    """
    Make the error for an algorithm without a dataset.

    :param algorithm: name of the class
    """
    return DatasetError(
        f"dataset: {algorithm} learns from demonstrations, and has none. Pass "
        f"{algorithm}(..., dataset='safedrive/scripted-v0') or load(..., dataset=...), in RL-Zoo3 "
        f"-params \"dataset:'safedrive/scripted-v0'\". {HOW_TO_GET_ONE}"
    )


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """
    Flat arrays of demonstrated transitions: n steps of all episodes, in their order. The dtypes are those of the recording.

    :param observation_space: of the observations, a Box
    :param action_space: of the actions, a Box or Discrete
    :param observations: what the actions answered, shape (n, *observation_shape)
    :param actions: what was executed, in the units of the action space, shape (n, *action_shape)
    :param next_observations: what followed, shape (n, *observation_shape)
    :param rewards: shape (n,)
    :param terminations: whether the episode ended there for good, shape (n,), bool
    :param truncations: whether it was cut off there, e.g. by a time limit, shape (n,), bool
    :param episodes: index of the episode that a step belongs to, shape (n,), int
    :param takeovers: whether the human (or the expert in the human's place) drove, shape (n,), bool; None if not recorded
    :param novice_actions: what the novice proposed, shape (n, *action_shape); None if there was no novice
    :param costs: safety costs, shape (n,); None if not recorded
    :param successes: whether the goal was reached by then, shape (n,), bool; None if not recorded
    """

    observation_space: spaces.Space
    action_space: spaces.Space
    observations: np.ndarray
    actions: np.ndarray
    next_observations: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray
    episodes: np.ndarray
    takeovers: np.ndarray | None = None
    novice_actions: np.ndarray | None = None
    costs: np.ndarray | None = None
    successes: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.rewards)

    @property
    def ends(self) -> np.ndarray:
        """Ends of episodes: whether a step is the last one of its episode, whatever its flags say, shape (n,)."""
        return self.terminations | self.truncations | (np.diff(self.episodes, append=self.episodes[-1:] + 1) != 0)


def load_demonstrations(
    dataset: Dataset,
    observation_space: spaces.Space | None = None,
    action_space: spaces.Space | None = None,
) -> Demonstrations:
    """
    Load demonstrations as flat arrays.

    :param dataset: id of a dataset among the local ones of Minari ("safedrive/scripted-v0"), its folder, a ``MinariDataset``
        (filtered, too), or what was loaded before; or a list of these, one after the other. It may have been recorded by
        others, with ``minari.DataCollector``
    :param observation_space: what it must fit (images are transposed if need be), anything if None
    :param action_space: what it must fit, anything if None
    :return: all its episodes
    :raises DatasetError: if it is missing, damaged, empty or does not fit
    """
    if isinstance(dataset, list | tuple):
        if not dataset:
            raise DatasetError(f"dataset: the list is empty. {HOW_TO_GET_ONE}")
        return joined([load_demonstrations(part, observation_space, action_space) for part in dataset])
    if isinstance(dataset, Demonstrations):
        demonstrations, name = dataset, "the demonstrations"
    elif isinstance(dataset, str | os.PathLike) or is_minari_dataset(dataset):
        opened = open_dataset(dataset)
        name = f"dataset {os.fspath(dataset)!r}" if isinstance(dataset, str | os.PathLike) else f"dataset {opened.id!r}"
        check_spaces(opened.observation_space, opened.action_space)
        try:
            demonstrations = _read(opened)
        except Exception as error:  # h5py raises nearly anything, numpy for shapes that do not fit together
            raise damaged(name, error) from error
    else:
        raise DatasetError(
            f"dataset: must be the id or folder of a dataset, a MinariDataset, Demonstrations or a list, got {dataset!r}."
        )
    _check_arrays(demonstrations, name)
    for kind, expected in [("observation", observation_space), ("action", action_space)]:
        if expected is None:
            continue
        found = getattr(demonstrations, f"{kind}_space")
        if kind == "observation" and found != expected and is_image_space(found) and len(found.shape) == 3:
            demonstrations = _channels_first(demonstrations)
            found = demonstrations.observation_space
        difference = space_difference(found, expected)
        if difference:
            raise DatasetError(
                f"{name} does not fit the environment: the {kind} space differs in {difference}. Use the environment (with "
                "the wrappers and env_kwargs) that it was recorded in, or record another ('python -m sb3_chac demos record')."
            )
    return demonstrations


def joined(parts: Sequence[Demonstrations]) -> Demonstrations:
    """
    Concatenate demonstrations.

    :param parts: at least one
    :return: all their episodes, one after the other; what is not recorded in each of them is left out, but for who drove:
        where it is not told, the human drove all of it
    :raises DatasetError: if their spaces differ
    """
    first = parts[0]
    for part in parts:
        for kind in ("observation", "action"):
            difference = space_difference(getattr(part, f"{kind}_space"), getattr(first, f"{kind}_space"))
            if difference:
                raise DatasetError(f"dataset: the {kind} spaces of the datasets of the list differ in {difference}.")
    if any(part.takeovers is not None for part in parts):
        parts = [part if part.takeovers is not None else replace(part, takeovers=np.ones(len(part), bool)) for part in parts]
    if any(part.novice_actions is not None for part in parts):
        parts = [part if part.novice_actions is not None else replace(part, novice_actions=part.actions) for part in parts]
    episodes, offset = [], 0
    for part in parts:
        numbers = np.cumsum(np.diff(part.episodes, prepend=part.episodes[:1]) != 0)
        episodes.append(numbers + offset)
        offset += int(numbers[-1]) + 1
    columns: dict[str, Any] = {}
    for field in fields(Demonstrations):
        values = [getattr(part, field.name) for part in parts]
        if field.name not in ("observation_space", "action_space", "episodes"):
            columns[field.name] = None if any(value is None for value in values) else np.concatenate(values)
    return replace(first, episodes=np.concatenate(episodes), **columns)


def check_spaces(observation_space: spaces.Space, action_space: spaces.Space) -> None:
    """
    Check that a dataset can hold the spaces.

    :raises DatasetError: unless observations are a Box and actions a Box or Discrete
    """
    if not isinstance(observation_space, spaces.Box):
        raise DatasetError(
            f"Demonstrations need Box observations, got {observation_space}. Wrap the environment, e.g. in "
            "gymnasium.wrappers.FlattenObservation, before you record and learn."
        )
    if not isinstance(action_space, spaces.Box | spaces.Discrete):
        raise DatasetError(f"Demonstrations need Box or Discrete actions, got {action_space}. Wrap the environment.")


def check_imitable(env: Any) -> None:
    """
    Check that an algorithm can imitate in an environment: a dataset can hold its spaces, and a Box of actions is bounded.

    :param env: a gymnasium or vectorized environment
    :raises DatasetError: for other spaces
    :raises UnsupportedActionSpace: for actions without finite bounds
    """
    check_spaces(env.observation_space, env.action_space)
    if isinstance(env.action_space, spaces.Box):
        check_action_space(env.action_space)


def space_difference(found: spaces.Space, expected: spaces.Space) -> str:
    """
    Word the difference between two spaces.

    :return: what differs in ``found``, to follow "differs in", or "" if nothing does
    """
    if not (isinstance(found, spaces.Box) and isinstance(expected, spaces.Box)):
        return "" if found == expected else f"its kind: {found} instead of {expected}"
    if found.shape != expected.shape:
        return f"shape: {found.shape} instead of {expected.shape}"
    differences = []
    if found.dtype != expected.dtype:
        differences.append(f"dtype: {found.dtype} instead of {expected.dtype}")
    for bound in ("low", "high"):
        ours, theirs = getattr(found, bound), getattr(expected, bound)
        differing = np.argwhere(~np.isclose(ours, theirs))
        if len(differing):
            index = tuple(differing[0])
            where = ", ".join(str(int(number)) for number in index)
            differences.append(f"bounds: {bound}[{where}] is {ours[index]:g} instead of {theirs[index]:g}")
    return "; ".join(differences)


def _read(dataset: "MinariDataset") -> Demonstrations:
    """
    Read the episodes of a dataset.

    :raises Exception: of any kind, for a damaged one
    """
    episodes = list(dataset.storage.get_episodes(dataset.episode_indices))
    lengths = [len(episode["rewards"]) for episode in episodes]
    for number, (episode, length) in enumerate(zip(episodes, lengths, strict=True)):
        counts = [len(episode[key]) for key in ("observations", "actions", "terminations", "truncations")]
        if counts != [length + 1, length, length, length]:
            raise ValueError(
                f"episode {number} has {length} rewards, but {counts[0]} observations, {counts[1]} actions, {counts[2]} "
                f"terminations and {counts[3]} truncations"
            )
    observations = [np.asarray(episode["observations"]) for episode in episodes]

    def joined(key: str) -> np.ndarray:
        return np.concatenate([np.asarray(episode[key]) for episode in episodes])

    return Demonstrations(
        dataset.observation_space,
        dataset.action_space,
        observations=np.concatenate([values[:-1] for values in observations]),
        actions=joined("actions"),
        next_observations=np.concatenate([values[1:] for values in observations]),
        rewards=joined("rewards"),
        terminations=joined("terminations").astype(bool),
        truncations=joined("truncations").astype(bool),
        episodes=np.repeat(np.arange(len(episodes)), lengths),
        **{field: _joined_infos(episodes, lengths, key) for key, field in INFOS.items()},
    )


def _joined_infos(episodes: Sequence[dict[str, Any]], lengths: Sequence[int], key: str) -> np.ndarray | None:
    """
    Concatenate an entry of the infos.

    :return: the values that belong to the actions, None unless every episode has one for each
    """
    infos = [np.asarray((episode["infos"] or {}).get(key)) for episode in episodes]
    if any(values.shape[:1] != (length + 1,) for values, length in zip(infos, lengths, strict=True)):
        return None
    return np.concatenate([values[1:] for values in infos])


def _check_arrays(demonstrations: Demonstrations, name: str) -> None:
    """
    Check shapes, bounds and finiteness.

    :raises DatasetError: unless there is at least one step, all arrays have the shape that their space asks for, all numbers
        are finite and all actions within their bounds
    """
    observation_space, action_space = demonstrations.observation_space, demonstrations.action_space
    check_spaces(observation_space, action_space)
    steps = len(demonstrations)
    if steps == 0:
        raise DatasetError(f"{name} holds no steps. {HOW_TO_GET_ONE}")
    observation_shape, action_shape = (steps, *observation_space.shape), (steps, *action_space.shape)  # type: ignore[misc]
    shapes = {
        **dict.fromkeys(("observations", "next_observations"), observation_shape),
        **dict.fromkeys(("actions", "novice_actions"), action_shape),
        **dict.fromkeys(("rewards", "terminations", "truncations", "episodes", "takeovers", "costs", "successes"), (steps,)),
    }
    for field, shape in shapes.items():
        values = getattr(demonstrations, field)
        if values is None:
            continue
        if values.shape != shape:
            raise damaged(name, f"{field} have shape {values.shape} instead of {shape}")
        if not is_finite(values):
            step = next(step for step in range(steps) if not is_finite(values[step]))
            raise damaged(name, f"{field} are NaN or infinite at step {step}")
    if isinstance(action_space, spaces.Discrete):
        low, high = np.array(action_space.start), np.array(action_space.start + action_space.n - 1)
    else:
        assert isinstance(action_space, spaces.Box)
        low, high = action_space.low.astype(float), action_space.high.astype(float)
    tolerance = np.nan_to_num(1e-6 * (high - low), posinf=0.0)  # for rounding
    for whose, values in (("", demonstrations.actions), ("novice's ", demonstrations.novice_actions)):
        if values is None:
            continue
        outside = ((values < low - tolerance) | (values > high + tolerance)).reshape(steps, -1).any(axis=1)
        if outside.any():
            step = int(np.argmax(outside))
            raise DatasetError(
                f"{name}: the {whose}action of step {step} is out of bounds, {values[step]} is not in {action_space}. "
                "Record what the environment executes: clip the actions before they are recorded."
            )


def _channels_first(demonstrations: Demonstrations) -> Demonstrations:
    """Transpose images as SB3's models see them."""
    assert isinstance(demonstrations.observation_space, spaces.Box)
    return replace(
        demonstrations,
        observation_space=VecTransposeImage.transpose_space(demonstrations.observation_space),
        observations=np.moveaxis(demonstrations.observations, -1, 1),
        next_observations=np.moveaxis(demonstrations.next_observations, -1, 1),
    )
