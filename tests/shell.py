"""Commands as a user types them."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

FOREVER = 1800.0  # [s] no verdict on how fast the machine is: only against hanging for ever


def wait_until(condition: Callable[[], object], pause: float = 0.002) -> None:
    """
    :param condition: returns when it holds
    :param pause: [s] between two looks
    """
    end = time.monotonic() + FOREVER
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(pause)


def clean_environment() -> dict[str, str]:
    """
    :return: the environment variables, without those that lead to another installation
    """
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


def zoo_train(monkeypatch, *arguments: str | Path) -> None:
    """``rl_zoo3 train`` in this process, for tests that ask nothing of the process itself: its imports cost seconds."""
    from rl_zoo3.train import train

    monkeypatch.setattr(sys, "argv", ["rl_zoo3", *map(str, arguments)])
    train()


def run(*command: str | Path, cwd: Path, env: dict[str, str] | None = None, fails: bool = False) -> str:
    """
    :param env: added to the environment
    :param fails: whether the command is expected to fail
    :return: what it printed, stdout then stderr
    """
    completed = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env={**clean_environment(), **(env or {})},
        capture_output=True,
        text=True,
        timeout=FOREVER,
    )
    output = completed.stdout + completed.stderr
    assert (completed.returncode != 0) == fails, output
    return output
