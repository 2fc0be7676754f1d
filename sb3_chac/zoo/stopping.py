"""SIGTERM and Ctrl-C while nothing is learned, and options of RL-Zoo3 that nobody checks: with the standard library alone."""

import argparse
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

MOST_THREADS = 1024  # of PyTorch, unless the machine has more processors


@contextmanager
def one_sentence(command: str) -> Iterator[None]:
    """
    Inside the block SIGTERM and Ctrl-C end the process with one sentence and exit code 143 or 130, unless somebody else
    (``StopSignals``, while a model learns; RL-Zoo3, which saves the model after Ctrl-C) answers them.

    :param command: for the sentence
    """

    def stop(number: int, frame: FrameType | None = None) -> NoReturn:
        sys.stderr.write(
            f"{command}: stopped by {signal.Signals(number).name}. If the run folder has checkpoints, 'sb3-chac resume' goes "
            "on from them.\n"
        )
        raise SystemExit(128 + number)

    is_main = threading.current_thread() is threading.main_thread()  # no other one may set handlers
    before = signal.signal(signal.SIGTERM, stop) if is_main else None
    try:
        yield
    except KeyboardInterrupt:
        stop(signal.SIGINT)
    finally:
        if is_main:
            signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


def known_options(arguments: Sequence[str]) -> argparse.Namespace:
    """
    Read the options that matter before the training is set up.

    :param arguments: of ``rl_zoo3 train``
    :return: algorithm, environment and number of threads, as text
    """
    parser = argparse.ArgumentParser(add_help=False, exit_on_error=False)
    for option, default in (("--algo", "ppo"), ("--env", "CartPole-v1"), ("--num-threads", "-1")):
        parser.add_argument(option, default=default)
    try:
        return parser.parse_known_args(list(arguments))[0]
    except argparse.ArgumentError:  # RL-Zoo3's own parser says so better
        return parser.parse_args([])


def check_threads(value: str) -> None:
    """
    Check the number of threads.

    :param value: of ``--num-threads``
    :raises ValueError: for a number of threads that no machine has: OpenMP would end the process without a word
    """
    try:
        number = int(value)
    except ValueError:
        return  # RL-Zoo3's own parser says so
    most = max(MOST_THREADS, os.cpu_count() or 1)
    if number != -1 and not 1 <= number <= most:
        shown = value if len(value) < 30 else f"{value[:10]}... ({len(value)} digits)"
        raise ValueError(f"--num-threads must be -1 (PyTorch's default) or a number from 1 to {most}, got {shown}.")
