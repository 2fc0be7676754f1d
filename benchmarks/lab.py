"""What benchmarks share: command lines, jobs in processes of their own, drives, and rows with versions in CSV files."""

import argparse
import csv
import importlib.metadata
import io
import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any


def make_parser(description: str | None, commands: Iterable[str]) -> argparse.ArgumentParser:
    """
    :param description: shown by ``--help`` as it stands
    :param commands: one of which is chosen
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=list(commands))
    return parser


def add_seeds(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])


def add_jobs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--jobs", type=int, default=2, help="processes at once, one torch thread each")


def versions(*packages: str) -> str:
    """
    :return: such as "torch=2.13.0 numpy=2.4.6", for a column of that name
    """
    return " ".join(f"{name}={importlib.metadata.version(name)}" for name in packages)


def read(path: Path) -> list[dict[str, str]]:
    """
    :return: rows of a CSV, none if it is not there
    """
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def append(path: Path, *rows: dict[str, Any]) -> None:
    """Write rows at the end of a CSV, after a header if they are its first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        if file.tell() == 0:
            writer.writeheader()
        writer.writerows(rows)


def to_csv(rows: list[dict[str, Any]]) -> str:
    """
    :return: rows as the text of a CSV
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write a CSV in place of what was there."""
    path.unlink(missing_ok=True)
    append(path, *rows)


def outcomes(calls: Iterable[tuple[Callable[..., Any], Any]], jobs: int) -> Iterator[Any]:
    """
    Call functions in processes that are started for one call each.

    :param calls: a function and its arguments
    :param jobs: processes at a time
    :return: what the calls return, as they end
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context, max_tasks_per_child=1) as pool:
        for future in as_completed([pool.submit(function, *arguments) for function, *arguments in calls]):
            yield future.result()


def run_all(calls: Iterable[tuple[Callable[..., Any], Any]], jobs: int) -> None:
    """Call functions in processes of their own and print what they return, see ``outcomes``."""
    calls = list(calls)
    for number, outcome in enumerate(outcomes(calls, jobs), 1):
        print(f"[{number}/{len(calls)}] {outcome}", flush=True)


def drive(env: Any, driver: Any, scenario: int, contact: str, column: str) -> dict[str, Any]:
    """
    Drive one scenario of a driving task.

    :param contact: key of ``info`` that is summed up
    :param column: for the sum
    :return: a row
    """
    observation, _ = env.reset(options={"scenario": scenario})
    driver.reset(scenario)
    done, total, contacts = False, 0.0, 0.0
    while not done:
        observation, reward, terminated, truncated, info = env.step(driver(observation))
        done, total, contacts = terminated or truncated, total + reward, contacts + info[contact]
    return {
        "scenario": scenario,
        "return": round(total, 2),
        "cost": int(info["episode_cost"]),
        column: int(contacts),
        "success": int(info["is_success"]),
        "out_of_road": int(info["out_of_road"]),
        "route_completion": round(info["route_completion"], 4),
        "steps": env.steps,
    }
