"""Recording of a drive: a dataset in Minari's format and a summary. Each episode is on the disk as soon as it ends."""

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from sb3_chac.common.demonstrations import check_spaces
from sb3_chac.common.files import sync, write_safely
from sb3_chac.common.minari_datasets import DatasetError
from sb3_chac.datasets.recording import Recorder as EpisodeRecorder
from sb3_chac.datasets.writer import DatasetWriter, folder_to_make, storable_spec

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer

FOLDER = "recording"  # of a run, while it is driven
ABOUT = "drive.json"
SUMMARY = "summary.json"
VERDICT = "info/verdict"  # of the person on the episode, with its last step: 1 a success, -1 a failure, 0 not said


@dataclass(frozen=True)
class Summary:
    """
    Summary of what a person did in a drive.

    :param dataset: folder of the dataset, None if nothing was driven
    :param episodes: number of episodes, the last may be cut off
    :param steps: steps driven by anybody
    :param human_steps: driven by the person
    :param takeover_rate: human_steps / steps
    :param takeovers: number of segments that the person drove
    :param mean_takeover_steps: length of a segment
    :param cost: sum of the safety costs, None if they were not measured
    :param human_cost: that arose while the person drove
    :param successes: episodes that reached their goal, None if the environment does not tell
    :param seconds: [s] of driving, without pauses
    :param called_success: episodes that the person called a success, likewise ``called_failure``
    """

    dataset: str | None
    episodes: int
    steps: int
    human_steps: int
    takeover_rate: float
    takeovers: int
    mean_takeover_steps: float
    cost: float | None
    human_cost: float
    successes: int | None
    seconds: float
    called_success: int = 0
    called_failure: int = 0

    def __str__(self) -> str:
        lines = [
            f"Driven: {self.episodes} episodes, {self.steps} steps, {self.seconds / 60:.1f} minutes",
            f"  by you        {self.human_steps} steps ({self.takeover_rate:.1%}) in {self.takeovers} takeovers of "
            f"{self.mean_takeover_steps:.1f} steps",
        ]
        if self.cost is not None:
            lines.append(f"  safety cost   {self.cost:g}, {self.human_cost:g} of it while you drove")
        if self.successes is not None:
            lines.append(f"  arrived       {self.successes} of {self.episodes}")
        if self.called_success or self.called_failure:
            lines.append(f"  by your word  {self.called_success} successes, {self.called_failure} failures")
        if self.dataset is not None:
            lines.append(f"  dataset       {self.dataset}")
        return "\n".join(lines)


class EpisodeRecord(NamedTuple):
    """Record of one episode; None stands for what the environment does not tell."""

    steps: int
    human_steps: int
    takeovers: int
    cost: float | None
    human_cost: float
    success: bool | None
    episode_return: float
    seconds: float  # of driving
    verdict: bool | None  # of the person
    is_whole: bool  # False if it was cut off: the person quit, or nobody was at the wheel


class CrashSafeRecorder:
    """
    Recorder that writes each episode into a file of its own once it ends; ``finish`` makes the dataset of them. What a process
    that was killed has left, ``finish_recording`` makes a dataset of later.

    :param folder: of the run
    :param env: what is recorded, its spaces and how it is made
    :param dataset: id or folder of the dataset that it is to become
    :param policy: name of who is watched
    :param seconds_per_step: [s]
    :raises DatasetError: for a name that is taken, or spaces that a dataset cannot hold
    """

    def __init__(self, folder: Path, env: gym.Env, dataset: str, policy: str, seconds_per_step: float) -> None:
        check_spaces(env.observation_space, env.action_space)
        folder_to_make(dataset, overwrite=False)
        from minari.serialization import serialize_space

        self.run_folder, self.env = folder, env
        self.folder = folder / FOLDER
        self.folder.mkdir(parents=True, exist_ok=True)
        spec = storable_spec(env)
        if spec is not None:
            spec.kwargs = {name: value for name, value in spec.kwargs.items() if name != "render_mode"}
        about = {
            "dataset": dataset,
            "policy": policy,
            "seconds_per_step": seconds_per_step,
            "spec": spec.to_json() if spec else None,
            "spaces": [serialize_space(space) for space in (env.observation_space, env.action_space)],
        }
        write_safely(self.folder / ABOUT, json.dumps(about).encode())
        self.number = 0
        self.on_episode: Callable[[EpisodeRecord], None] | None = None  # called when one is on the disk
        self.seconds_per_step = seconds_per_step
        self._steps: list[dict[str, Any]] = []

    def begin(self, observation: np.ndarray, seed: int, options: dict[str, Any] | None) -> None:
        """
        Begin a new episode; one that is under way ends.

        :param observation: the first
        """
        self.end()
        self._first = np.array(observation)
        self._reset = json.dumps({"seed": seed, "options": options})

    def add(
        self,
        action: Any,
        observation: np.ndarray,
        reward: float,
        terminated: bool,
        truncated: bool,
        info: dict[str, Any],
        verdict: bool | None = None,
    ) -> None:
        """
        Record one step.

        :param action: what the novice proposed
        :param observation: what followed
        :param verdict: whether the person calls the episode a success, None if it does not say
        """
        stored = EpisodeRecorder.stored_infos(action, info, self.env.action_space)
        self._steps.append(
            {
                "observation": np.array(observation),
                "action": np.array(info["applied_action"]),
                "reward": reward,
                "termination": terminated,
                "truncation": truncated,
                **{f"info/{name}": value for name, value in stored.items()},
                VERDICT: 0 if verdict is None else 1 if verdict else -1,
            }
        )
        if terminated or truncated:
            self.end()

    def end(self) -> None:
        """End the episode that is under way, if there is one; where it did not end itself, it is cut off (truncated)."""
        steps, self._steps = self._steps, []
        if not steps:
            return
        is_whole = bool(steps[-1]["termination"] or steps[-1]["truncation"])
        steps[-1]["truncation"] = steps[-1]["truncation"] or not steps[-1]["termination"]
        columns = {name: np.array([step[name] for step in steps]) for name in steps[0]}
        columns["observation"] = np.concatenate([self._first[None], columns["observation"]])
        file = self.folder / f"{self.number:06d}.npz"
        temporary = file.with_suffix(".tmp")
        with temporary.open("wb") as stream:
            np.savez(stream, reset=np.array(self._reset), **columns)  # type: ignore[arg-type]
        sync(temporary)
        temporary.rename(file)
        self.number += 1
        if self.on_episode is not None:
            self.on_episode(_record(columns, self.seconds_per_step, is_whole))

    def finish(self) -> Summary:
        """
        Make the dataset and sum up the drive.

        :return: of the drive; the dataset is complete
        """
        self.end()
        return _finish(self.run_folder, self.env)


def finish_recording(run_folder: Path) -> Summary | None:
    """
    Make the dataset of a drive that was killed.

    :param run_folder: of a drive that was killed
    :return: its summary, now that the dataset is made; None if nothing was left behind
    """
    if not (run_folder / FOLDER / ABOUT).is_file():
        return None
    about = json.loads((run_folder / FOLDER / ABOUT).read_text())
    return _finish(run_folder, RecordedEnv(about))


class RecordedEnv(gym.Env):
    """
    Description of an environment that was recorded, to be written down. It is never made: a file runs no code.

    :param about: what ``CrashSafeRecorder`` has written
    :raises DatasetError: if that is damaged
    """

    def __init__(self, about: dict[str, Any]) -> None:
        from minari.serialization import deserialize_space

        try:
            self.observation_space, self.action_space = map(deserialize_space, about["spaces"])
            self.spec = EnvSpec.from_json(about["spec"]) if about["spec"] else None
        except Exception as error:  # nearly anything, of a damaged file
            raise DatasetError(f"{ABOUT} of the drive cannot be read: {type(error).__name__}: {error}") from error


def _finish(run_folder: Path, env: gym.Env) -> Summary:
    folder = run_folder / FOLDER
    about = json.loads((folder / ABOUT).read_text())
    files = sorted(folder.glob("*.npz"))
    dataset = folder_to_make(about["dataset"], overwrite=False) if files else None
    summary = _summary([dict(np.load(file)) for file in files], dataset, about["seconds_per_step"])
    if dataset is not None:
        settings = {"policy": about["policy"], "seed": None, "scenarios": None}
        with DatasetWriter(dataset, env, settings, overwrite=False) as writer:
            for file in files:
                writer.add(_episode(dict(np.load(file))))
            writer.finish()
    write_safely(run_folder / SUMMARY, (json.dumps(asdict(summary), indent=2) + "\n").encode())
    shutil.rmtree(folder)
    return summary


def _episode(columns: dict[str, np.ndarray]) -> "EpisodeBuffer":
    """
    Convert the columns of a recording file to an episode.

    :param columns: of a file
    :return: the episode as Minari stores it, the infos of an action at the index of what followed it
    """
    from minari.data_collector import EpisodeBuffer

    infos = {name.removeprefix("info/"): values for name, values in columns.items() if name.startswith("info/")}
    return EpisodeBuffer(
        **json.loads(str(columns["reset"])),
        observations=columns["observation"],
        actions=columns["action"],
        rewards=columns["reward"].tolist(),
        terminations=columns["termination"].tolist(),
        truncations=columns["truncation"].tolist(),
        # The first entries belong to the reset
        infos={name: np.concatenate([np.zeros_like(values[:1]), values]) for name, values in infos.items()},
    )


def _record(columns: dict[str, np.ndarray], seconds_per_step: float, is_whole: bool) -> EpisodeRecord:
    one = _summary([columns], None, seconds_per_step)
    return EpisodeRecord(
        one.steps,
        one.human_steps,
        one.takeovers,
        one.cost,
        one.human_cost,
        None if one.successes is None else bool(one.successes),
        float(columns["reward"].sum()),
        one.seconds,
        True if one.called_success else False if one.called_failure else None,
        is_whole,
    )


def _summary(episodes: list[dict[str, np.ndarray]], dataset: Path | None, seconds_per_step: float) -> Summary:
    takeovers = [episode["info/takeover"] for episode in episodes]
    starts = sum(int(np.count_nonzero(np.diff(flags.astype(int), prepend=0) == 1)) for flags in takeovers)
    steps, human_steps = sum(map(len, takeovers)), int(sum(flags.sum() for flags in takeovers))
    is_measured = bool(episodes) and all("info/cost" in episode for episode in episodes)
    costs = [episode["info/cost"] for episode in episodes] if is_measured else []
    tell_success = bool(episodes) and all("info/is_success" in episode for episode in episodes)
    verdicts = [int(episode[VERDICT][-1]) for episode in episodes if VERDICT in episode]  # earlier recordings have none
    return Summary(
        dataset=str(dataset) if dataset else None,
        episodes=len(episodes),
        steps=steps,
        human_steps=human_steps,
        takeover_rate=human_steps / steps if steps else 0.0,
        takeovers=starts,
        mean_takeover_steps=human_steps / starts if starts else 0.0,
        cost=float(sum(values.sum() for values in costs)) if is_measured else None,
        human_cost=float(sum((values * flags).sum() for values, flags in zip(costs, takeovers, strict=False))),
        successes=sum(bool(episode["info/is_success"][-1]) for episode in episodes) if tell_success else None,
        seconds=steps * seconds_per_step,
        called_success=sum(verdict == 1 for verdict in verdicts),
        called_failure=sum(verdict == -1 for verdict in verdicts),
    )
