"""Commands as a user types them."""

import os
import subprocess
from pathlib import Path


def clean_environment() -> dict[str, str]:
    """
    :return: the environment variables, without those that lead to another installation
    """
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


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
        timeout=900,
    )
    output = completed.stdout + completed.stderr
    assert (completed.returncode != 0) == fails, output
    return output
