"""Skeleton of a command, without torch: parse the command line, run, and end with one line where a user can help."""

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


def command_parser(name: str, description: str) -> argparse.ArgumentParser:
    """
    Make the parser of a command.

    :param name: of the command
    :param description: shown by ``--help`` as it stands
    :return: without arguments
    """
    return argparse.ArgumentParser(
        f"sb3-chac {name}", description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def check_least(args: argparse.Namespace, error: type[Exception], **least: int) -> None:
    """
    Check options that have a lowest value.

    :param args: parsed; an option that is None was left out
    :param error: to raise
    :param least: name of an option -> its lowest value
    """
    for name, low in least.items():
        value = getattr(args, name)
        if value is not None and value < low:
            raise error(f"--{name.replace('_', '-')} must be at least {low}, got {value}.")


def run_command(
    parser: argparse.ArgumentParser,
    arguments: list[str],
    run: Callable[[argparse.Namespace], Any],
    *errors: type[Exception],
) -> Any:
    """
    Run a command.

    It ends with one line and status 2 at an error that a user can mend, and after cleaning up with 130 at Ctrl-C and 143 at
    SIGTERM. With ``SB3_CHAC_TRACEBACK`` set, errors are raised.

    :param parser: of the command line; a subcommand's may set ``prog``
    :param arguments: of the command line, after the command
    :param run: does it, takes the parsed arguments
    :param errors: that a user can mend, besides ``OSError`` (such as a full disk)
    :return: what ``run`` returns
    :raises SystemExit: with the statuses above
    """
    args = parser.parse_args(arguments)
    name = getattr(args, "prog", parser.prog)
    mendable: tuple[type[Exception], ...] = (OSError, *errors)
    try:
        with exit_at_sigterm():
            return run(args)
    except mendable as error:
        if os.environ.get("SB3_CHAC_TRACEBACK"):
            raise
        parser.exit(2, f"{name}: error: {error}\n")
    except KeyboardInterrupt:
        parser.exit(130, f"{name}: interrupted\n")


@contextmanager
def exit_at_sigterm() -> Iterator[None]:
    """Let SIGTERM end the process as an exception does, so that ``finally`` clauses clean up; in the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _exit)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _exit(signal_number: int, frame: FrameType | None) -> None:
    sys.exit(128 + signal_number)
