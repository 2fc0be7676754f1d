"""Recording demonstrations: episodes of an expert, or of a novice whom an expert watches, as a dataset of Minari."""

import contextlib
import copy
import itertools
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper
from tqdm import tqdm

from sb3_chac.common.checks import UnsupportedActionSpace, check_integer, happened_in, number_in, number_or_nan
from sb3_chac.common.contract import (
    NOVICE_ACTION,
    TAKEOVER,
    TakeoverWrapper,
    check_report_order,
    check_takeover_order,
    read_report,
    scaled,
)
from sb3_chac.common.demonstrations import check_spaces
from sb3_chac.common.minari_datasets import DatasetError
from sb3_chac.datasets.writer import DatasetWriter, folder_to_make
from sb3_chac.evaluation.episodes import Runner, SavedModel, Task, make_env
from sb3_chac.evaluation.evaluation import policy_name, scenario_list, task_of_processes
from sb3_chac.human.intervention import InterventionWrapper

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer

AHEAD = 2  # episodes that are queued, per process


@dataclass(frozen=True)
class WatchedEnv:
    """
    Environment factory with an armed ``InterventionWrapper``: what ``record`` needs to record takeovers.

    :param env: id of the environment
    :param expert: name of an expert of the environment, or a model
    :param rule: when the expert takes over, see ``InterventionWrapper``
    """

    env: str
    expert: str | SavedModel
    rule: str = "risk"

    def __call__(self, **env_kwargs: Any) -> gym.Env:
        env = make_env(self.env, env_kwargs)
        expert = self.expert.load(env) if isinstance(self.expert, SavedModel) else self.expert
        return InterventionWrapper(env, expert, self.rule, armed=True)


def record(
    dataset: str | os.PathLike[str],
    expert: BaseAlgorithm | str | Callable[[Any], Any],
    env: str | Callable[..., gym.Env] = "SafeDrive-v0",
    steps: int = 50_000,
    *,
    scenarios: Iterable[int] | str | None = None,
    seed: int = 0,
    jobs: int = 1,
    env_kwargs: dict[str, Any] | None = None,
    normalize: VecNormalize | None = None,
    overwrite: bool = False,
    progress_bar: bool = False,
) -> Path:
    """
    Record whole episodes until there are at least ``steps`` steps. An episode depends on ``seed`` and its number only, so
    that the dataset does not depend on ``jobs``. It appears under its name when it is complete.

    Besides what Minari asks for, each step holds who drove (takeover), what the novice proposed (novice_action, if there is
    one), and cost and is_success if the environment reports them. Without an ``InterventionWrapper`` the expert drives every
    step and there is no novice. With one, armed, in the environment (``WatchedEnv``), ``expert`` is the novice who acts, and
    the actions are those that were executed.

    With ``jobs`` above 1 the processes are spawned: a script must call this under ``if __name__ == "__main__":``.

    :param dataset: id for Minari's folder, e.g. "safedrive/scripted-v0", or the folder to make; it ends with a version
    :param expert: who acts: a model, the name of an expert of the environment, or a function of the observation that returns
        the action; if that has a method ``reset(seed)``, it is called after each reset of the environment
    :param env: id of the environment, or a function that makes it; observations are a Box, actions a Box or Discrete
    :param steps: how many at least
    :param scenarios: numbers that ``env.reset(options={"scenario": k})`` understands, or text such as "100:120"; they take
        turns. None leaves the choice to the environment
    :param seed: the episodes' seeds derive from it, non-negative
    :param jobs: number of processes
    :param env_kwargs: passed to the environment
    :param normalize: statistics that the observations of ``expert``, a model, are normalized with, by default those of its own
        env. The dataset holds the raw ones
    :param overwrite: whether to replace a dataset of that name
    :param progress_bar: whether to show one
    :return: the folder of the dataset
    :raises DatasetError: if there is such a dataset already, or spaces that it cannot hold
    :raises ValueError: if the arguments do not fit together (``NotEvaluable``)
    """
    check_integer("steps", steps, low=1)
    check_integer("seed", seed, low=0)
    check_integer("jobs", jobs, low=1)
    folder = folder_to_make(dataset, overwrite)
    numbers = None if scenarios is None else scenario_list(scenarios)
    if normalize is None and isinstance(expert, BaseAlgorithm):
        normalize = expert.get_vec_normalize_env()
    task = Task(expert, env, env_kwargs or {}, normalize, seed, use_scenarios=numbers is not None)
    with Recorder(task, numbers) as recorder:  # finds what does not fit, before any process is started
        settings = {"policy": policy_name(expert), "seed": seed, "scenarios": numbers}
        with (
            DatasetWriter(folder, recorder.env, settings, overwrite) as writer,
            contextlib.closing(recorded_episodes(recorder, jobs)) as episodes,
            tqdm(total=steps, disable=not progress_bar, unit="step") as bar,
        ):
            while writer.steps < steps:
                episode = next(episodes)
                writer.add(episode)
                bar.update(min(len(episode), steps - bar.n))
            writer.finish()
    return folder


class Recorder(Runner):
    """
    Recorder of the episodes of a task in this process. A context manager, which closes its environment.

    :param task: what to record
    :param scenarios: take turns, None for those that the environment chooses
    :raises DatasetError: if a dataset cannot hold observations or actions
    :raises UnsupportedActionSpace: if actions are changed above an ``InterventionWrapper``
    """

    def __init__(self, task: Task, scenarios: list[int] | None) -> None:
        super().__init__(task)
        self.scenarios = scenarios
        try:
            check_spaces(self.env.observation_space, self.env.action_space)
            check_takeover_order(self.env)
        except (DatasetError, UnsupportedActionSpace):
            self.env.close()
            raise

    def __enter__(self) -> "Recorder":
        return self

    def record(self, number: int) -> "EpisodeBuffer":
        """
        Record one episode.

        :param number: of the episode, from 0
        :return: the episode as Minari stores it, the infos of an action at the index of what followed it
        """
        from minari.data_collector import EpisodeBuffer

        seed = self.seed(number)
        options = None if self.scenarios is None else {"scenario": self.scenarios[number % len(self.scenarios)]}
        observation, _ = self.env.reset(seed=seed, options=options)
        if hasattr(self.driver, "reset"):
            self.driver.reset(seed)
        observations, actions = [np.array(observation)], []
        proposals: list[Any] = []
        told: list[dict[str, Any]] = []
        rewards: list[float] = []
        terminations: list[bool] = []
        truncations: list[bool] = []
        while not rewards or not (terminations[-1] or truncations[-1]):
            action = self._in_space(self._act(observation))
            proposed = copy.deepcopy(action)  # the environment may change what it is given
            observation, reward, terminated, truncated, info = self.env.step(action)
            observations.append(np.array(observation))
            actions.append(self._executed(proposed, info))
            rewards.append(number_or_nan(reward))
            terminations.append(bool(terminated))
            truncations.append(bool(truncated))
            proposals.append(proposed)
            told.append(dict(copy.deepcopy(info)))
        stacked = np.array(observations, self.env.observation_space.dtype)
        if not all(np.isfinite(values).all() for values in (stacked, rewards, actions)):
            raise ValueError(f"episode {number} of {self.env.unwrapped} has NaN or infinite values: mend the environment.")
        return EpisodeBuffer(
            seed=seed,
            options=options,
            observations=stacked,
            actions=np.array(actions, self.env.action_space.dtype),
            rewards=rewards,
            terminations=terminations,
            truncations=truncations,
            # The first entries belong to the reset
            infos=self._stacked_infos(proposals, told),
        )

    def _executed(self, proposed: Any, info: dict[str, Any]) -> Any:
        """
        Find the executed action.

        :return: what was executed instead of ``proposed`` if the human took over
        :raises ValueError: if that is not in the units of the action space, as far as one can see
        """
        space = self.env.action_space
        executed = read_report(info, space).action
        if executed is None:
            return proposed
        if not isinstance(self.env, TakeoverWrapper):
            check_report_order(self.env)
        if isinstance(space, spaces.Box) and space.is_bounded():
            scaled(executed, space, 0)
        return executed

    def _stacked_infos(self, proposals: list[Any], told: list[dict[str, Any]]) -> dict[str, np.ndarray]:
        """
        Collect the infos of an episode.

        :param proposals: what the driver proposed, at each step
        :param told: ``info`` of each step
        :return: per key zero for the reset, then what a dataset holds of each step; zero where one does not tell
        """
        space = self.env.action_space
        someone_watches = any(read_report(info, space).says_so for info in told)  # some only tell of what they drive
        steps = [self.stored_infos(*step, space, someone_watches) for step in zip(proposals, told, strict=True)]
        zeros = {key: np.zeros_like(value) for step in steps for key, value in step.items()}
        return {key: np.array([zero, *(step.get(key, zero) for step in steps)]) for key, zero in zeros.items()}

    def _in_space(self, action: Any) -> Any:
        """Copy an action in the dtype of its space: what is executed is what is stored."""
        space = self.env.action_space
        return int(action) if isinstance(space, spaces.Discrete) else np.array(action, space.dtype)

    @staticmethod
    def stored_infos(
        action: Any, info: dict[str, Any], action_space: spaces.Space, someone_watches: bool = False
    ) -> dict[str, Any]:
        """
        Select the entries of a step's ``info`` that are stored.

        :param action: what the novice proposed, if there is one
        :param info: of the step
        :param action_space: of the environment
        :param someone_watches: whether a human may take over, if ``info`` itself does not tell
        :return: what a dataset holds of the step besides what Minari asks for
        """
        report = read_report(info, action_space)
        has_novice = report.says_so or someone_watches
        cost, is_success = number_in(info, "cost", 0), happened_in(info, "is_success")
        return {
            TAKEOVER: report.takeover or not has_novice,
            **({NOVICE_ACTION: np.array(action)} if has_novice else {}),
            **({} if cost is None else {"cost": cost}),
            **({} if is_success is None else {"is_success": is_success}),
        }


def recorded_episodes(recorder: Recorder, jobs: int) -> Generator["EpisodeBuffer"]:
    """
    Record episodes, in parallel processes if wanted.

    :return: endless, in the order of the numbers; to be closed
    """
    if jobs == 1:
        yield from map(recorder.record, itertools.count())
        return
    task = task_of_processes(recorder)
    context = multiprocessing.get_context("spawn")
    arguments = (CloudpickleWrapper(task), recorder.scenarios)
    queue: deque[Future[EpisodeBuffer]] = deque()
    with ProcessPoolExecutor(jobs, context, _start_process, arguments) as pool:
        try:
            for number in itertools.count():
                queue.append(pool.submit(_record_episode, number))
                if len(queue) == AHEAD * jobs:
                    yield queue.popleft().result()
        finally:
            for future in queue:
                future.cancel()


_recorder: Recorder  # of a worker process


def _start_process(task: CloudpickleWrapper, scenarios: list[int] | None) -> None:
    global _recorder
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that collects the episodes
    th.set_num_threads(1)
    _recorder = Recorder(task.var, scenarios)


def _record_episode(number: int) -> "EpisodeBuffer":
    return _recorder.record(number)
