"""What benchmarks share: jobs in processes of their own, and rows with the versions of packages in CSV files."""

import csv
import importlib.metadata
import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any


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
