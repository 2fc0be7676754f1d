"""Arguments of the command line that several commands share."""

import argparse
import ast
import os
import tempfile
from pathlib import Path
from typing import Any

from sb3_chac.chac.policies import CONTROLS
from sb3_chac.evaluation.episodes import NotEvaluable


def add_env_kwargs(parser: argparse._ActionsContainer) -> None:
    """Add ``--env-kwargs``, which ``parse_env_kwargs`` reads."""
    parser.add_argument("--env-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="passed to it, Python literals")


def add_seed_and_jobs(parser: argparse._ActionsContainer) -> None:
    """Add ``--seed`` and ``--jobs``, of a command that drives episodes in several processes."""
    parser.add_argument("--seed", type=int, default=0, help="the episodes' seeds derive from it (default: %(default)s)")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    parser.add_argument(
        "--jobs", type=int, default=cores, metavar="N", help="number of processes (default: %(default)s, the cores)"
    )


def add_control(parser: argparse._ActionsContainer) -> None:
    """Add ``--control``, also by its old name ``--policy``."""
    parser.add_argument(
        "--control", "--policy", choices=CONTROLS, help="who acts of a C-HAC model in stage 2 (default: as in its training)"
    )


def check_output(option: str, path: Path | None, suffixes: tuple[str, ...] = ()) -> None:
    """
    Check before the work begins that a file can be written.

    :param option: for the message
    :param path: file that is to be written at the end, None if none
    :param suffixes: those possible, all if empty
    :raises FileNotFoundError: if its folder does not exist
    :raises NotEvaluable: if it cannot be written, or has another suffix
    """
    if path is None:
        return
    if suffixes and path.suffix not in suffixes:
        raise NotEvaluable(f"{option} {path}: the file name must end with {' or '.join(suffixes)}.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{option} {path}: the folder {path.parent} does not exist, create it first.")
    try:
        if path.exists():
            path.open("ab").close()
        else:  # beside it: somebody may wait for the file itself
            tempfile.NamedTemporaryFile(prefix=path.name, dir=path.parent).close()
    except OSError as error:
        raise NotEvaluable(f"{option} {path}: cannot be written ({error.strerror}).") from error


def parse_env_kwargs(pairs: list[str]) -> dict[str, Any]:
    """
    Parse pairs of key and value.

    :param pairs: such as "density:0.1"
    :raises NotEvaluable: unless each has a key and a Python literal
    """
    result = {}
    for pair in pairs:
        key, _, value = pair.partition(":")
        try:
            result[key] = ast.literal_eval(value)
        except (ValueError, SyntaxError) as error:
            hint = "must look like key:value with a Python literal, e.g. density:0.1 or name:\"'text'\""
            raise NotEvaluable(f"--env-kwargs {hint}, got {pair!r}.") from error
    return result
