"""Deterministic evaluation episodes: one per scenario, in parallel processes if wanted."""

import importlib.metadata
import io
import json
import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper
from tqdm import tqdm

import sb3_chac
from sb3_chac.common.checks import check_integer
from sb3_chac.evaluation.episodes import DrivenPath, NotEvaluable, Runner, SavedModel, Task, control_of

MOST_SCENARIOS = 100_000  # at once

# Key of a record -> what the table calls it. The second to fourth only exist if the environment reports them.
METRICS = {
    "return": "return",
    "cost": "safety cost",
    "success": "success rate",
    "route_completion": "route completion",
    "steps": "steps",
}
DIGITS = {"return": 1, "cost": 2, "success": 2, "route_completion": 2, "steps": 0}  # behind the point, in ``compare``


@dataclass
class Evaluation:
    """
    Result of ``evaluate``.

    :param records: one dictionary per episode: scenario (or episode), seed, return, steps, terminated, truncated; success,
        cost and route_completion if the environment reports them; and every other scalar of its last info
    :param settings: policy, environment, scenarios, seed and versions, can be written as JSON
    :param paths: one per episode, if they were asked for
    """

    records: list[dict[str, Any]]
    settings: dict[str, Any]
    paths: list[DrivenPath] = field(default_factory=list)

    def summary(self) -> dict[str, float]:
        """
        Sum up the episodes.

        :return: number of episodes, mean and standard deviation over the episodes of all that every episode reports
        """
        result: dict[str, float] = {"episodes": len(self.records)}
        for key in METRICS:
            values = [record[key] for record in self.records if key in record]
            if len(values) == len(self.records):
                name = "success_rate" if key == "success" else key
                result[name if key == "success" else f"{name}_mean"] = float(np.mean(values))
                result[f"{name}_std"] = float(np.std(values))
        return result

    def table(self) -> str:
        """
        Word the summary.

        :return: the summary to read, a line per number
        """
        summary = self.summary()
        lines = [f"{self.settings['policy']} on {self.settings['env']}, {len(self.records)} episodes, mean ± std"]
        for key, title in METRICS.items():
            name = "success_rate" if key == "success" else f"{key}_mean"
            if name in summary:
                std = summary[name.removesuffix("_mean") + "_std"]
                lines.append(f"  {title:<17}{summary[name]:>10.3f} ± {std:.3f}")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Collect summary, settings and records. What an episode does not have is left out."""
        return {**self.summary(), **self.settings, "records": self.records}

    def to_json(self) -> str:
        """Write ``to_dict`` as strict JSON (no NaN)."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False, default=repr)


def evaluate(
    policy: BaseAlgorithm | str | Callable[[Any], Any],
    env: str | Callable[..., gym.Env] = "SafeDrive-v0",
    scenarios: Iterable[int] | str = range(1000, 1050),
    *,
    episodes: int | None = None,
    seed: int = 0,
    jobs: int = 1,
    env_kwargs: dict[str, Any] | None = None,
    normalize: VecNormalize | None = None,
    record_paths: bool = False,
    progress_bar: bool = False,
) -> Evaluation:
    """
    Run one deterministic episode per scenario. An episode depends on ``seed`` and its scenario only, not on ``jobs``, the
    order or the other scenarios. The return is the sum of the environment's raw rewards.

    With ``jobs`` above 1 the processes are spawned: a script must call this under ``if __name__ == "__main__":``.
    They act on the CPU with one torch thread each; with ``jobs=1`` a model acts on its own device.

    :param policy: a model, the name of an expert of the environment (``env.unwrapped.scripted_driver(name)``), or a function
        of the observation that returns the action; if that has a method ``reset(seed)``, it is called after each env reset
    :param env: id of the environment, or a function that makes it
    :param scenarios: numbers that ``env.reset(options={"scenario": k})`` understands, or text such as "1000:1050"
    :param episodes: for environments without scenarios: number of episodes, ``scenarios`` is ignored then
    :param seed: non-negative
    :param jobs: number of processes
    :param env_kwargs: passed to the environment
    :param normalize: statistics that the model's observations are normalized with, by default those of the model's own env
    :param record_paths: whether to keep the driven paths, for environments that have ``env.unwrapped.position``
    :param progress_bar: whether to show one
    :return: the records, in the order of the scenarios
    :raises ValueError: if the arguments do not fit together (``NotEvaluable``), or for a reward, cost or route completion
        that is not finite
    """
    check_integer("seed", seed, low=0)
    check_integer("jobs", jobs, low=1)
    if episodes is not None:
        check_integer("episodes", episodes, low=1)
    numbers = scenario_list(scenarios) if episodes is None else list(range(episodes))
    if normalize is None and isinstance(policy, BaseAlgorithm):
        normalize = policy.get_vec_normalize_env()
    task = Task(policy, env, env_kwargs or {}, normalize, seed, episodes is None, record_paths)
    with Runner(task) as runner:  # finds what does not fit, before any process is started
        results = list(tqdm(_episodes(runner, numbers, jobs), total=len(numbers), disable=not progress_bar, unit="episode"))
    settings = {
        "policy": policy_name(policy),
        "env": env if isinstance(env, str) else getattr(env, "__name__", repr(env)),
        "env_kwargs": env_kwargs or {},
        "normalized": normalize is not None,
        "scenarios": numbers if episodes is None else None,
        "seed": seed,
        "versions": {
            "sb3_chac": sb3_chac.__version__,
            **{name: importlib.metadata.version(name) for name in ("stable_baselines3", "torch", "gymnasium")},
        },
    }
    records, paths = zip(*results, strict=True)
    return Evaluation(list(records), settings, list(paths) if record_paths else [])


def policy_name(policy: BaseAlgorithm | str | Callable[[Any], Any]) -> str:
    """
    Name a policy for tables and files.

    :return: e.g. "SAC", "scripted", or with shared control which of its policies acts, "CHAC (shared)"
    """
    if isinstance(policy, str):
        return policy
    name = getattr(policy, "__name__", type(policy).__name__)
    control = control_of(policy)
    return name if control is None else f"{name} ({'guided' if policy.policy.stage == 1 else control})"  # type: ignore[union-attr]


def compare(evaluations: list[Evaluation]) -> str:
    """
    Compare evaluations in a table.

    :param evaluations: on the same episodes
    :return: a table to read, a line per policy
    """
    summaries = [evaluation.summary() for evaluation in evaluations]
    columns = [["policy", *(evaluation.settings["policy"] for evaluation in evaluations)]]
    for key, title in METRICS.items():
        mean = "success_rate" if key == "success" else f"{key}_mean"
        if all(mean in summary for summary in summaries):
            cells = [f"{summary[mean]:.{DIGITS[key]}f}" for summary in summaries]
            if key != "success":  # its spread follows from it
                cells = [f"{cell} ± {s[f'{key}_std']:.{DIGITS[key]}f}" for cell, s in zip(cells, summaries, strict=True)]
            columns.append([title, *cells])
    widths = [max(map(len, column)) for column in columns]
    title = f"{evaluations[0].settings['env']}, {len(evaluations[0].records)} episodes each, mean ± std"
    lines = [
        "  ".join([row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))])
        for row in zip(*columns, strict=True)
    ]
    return "\n".join([title, *lines])


def scenario_list(scenarios: Iterable[int] | str) -> list[int]:
    """
    Parse scenarios.

    :param scenarios: numbers, or text: "1000:1050" (1050 itself excluded), "1000" or "1000,1003:1010"
    :raises ValueError: if there is none, one is negative or occurs twice, or the text is malformed
    """
    if isinstance(scenarios, str):
        parts = [part.strip().split(":") for part in scenarios.split(",")]
        if not all(len(part) <= 2 and all(number.isdecimal() for number in part) for part in parts):
            raise NotEvaluable(f"scenarios must look like 1000:1050, 1000 or 1000,1003:1010, got {scenarios!r}.")
        if any(len(number) > 18 for part in parts for number in part):
            raise NotEvaluable(f"scenarios: a number is too large in {scenarios!r:.60}.")
        ranges = [range(int(part[0]), int(part[1]) if len(part) == 2 else int(part[0]) + 1) for part in parts]
        if sum(map(len, ranges)) > MOST_SCENARIOS:
            raise NotEvaluable(f"scenarios: {scenarios!r} are more than {MOST_SCENARIOS}, evaluate them in parts.")
        result = [number for part in ranges for number in part] if all(ranges) else []
    else:
        result = list(scenarios)
        for number in result:
            check_integer("scenarios", number, low=0)
        result = [int(number) for number in result]
    if not result:
        raise NotEvaluable(f"scenarios: a range is empty in {scenarios!r} (the end of a range is not part of it).")
    if len(set(result)) < len(result):
        raise NotEvaluable(f"scenarios must differ from each other, got {scenarios!r}.")
    return result


def _episodes(runner: Runner, numbers: list[int], jobs: int) -> Iterator[tuple[dict[str, Any], DrivenPath | None]]:
    if jobs == 1 or len(numbers) == 1:
        yield from map(runner.episode, numbers)
        return
    task = task_of_processes(runner)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(numbers)), context, _start_process, (CloudpickleWrapper(task),)) as pool:
        yield from pool.map(_run_episode, numbers)


def task_of_processes(runner: Runner) -> Task:
    """
    Return the task of a runner in a form that can be sent to other processes, which need not know the environment's id.

    :param runner: that has found that the task fits
    """
    task = runner.task
    if isinstance(task.env, str) and runner.env.spec is not None:
        task = task._replace(env=runner.env.spec)
    if isinstance(task.policy, BaseAlgorithm):
        task = task._replace(policy=saved_model(task.policy))
    return task


def saved_model(model: BaseAlgorithm) -> SavedModel:
    """
    Save a model for another process.

    :return: the model in a form that can be sent to another process
    """
    archive = io.BytesIO()
    model.save(archive)
    return SavedModel(type(model), archive.getvalue(), control_of(model))


_runner: Runner  # of a worker process


def _start_process(task: CloudpickleWrapper) -> None:
    global _runner
    th.set_num_threads(1)
    _runner = Runner(task.var)


def _run_episode(number: int) -> tuple[dict[str, Any], DrivenPath | None]:
    return _runner.episode(number)
