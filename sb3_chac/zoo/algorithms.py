"""Our algorithms by their names on the command line (the table is ``sb3_chac.ALGORITHMS``), and their hyperparameters."""

from pathlib import Path
from typing import TYPE_CHECKING

import sb3_chac
from sb3_chac import ALGORITHMS

if TYPE_CHECKING:
    from sb3_chac.common.guided import GuidedOffPolicyAlgorithm


def hyperparams_file(algo: str) -> Path:
    """
    Find our default hyperparameters of an algorithm.

    :param algo: name on RL-Zoo3's command line, e.g. "dsac", or "sac" for SB3's algorithms on our environments
    :return: our default hyperparameters: inside an installed package, beside it in a checkout (editable install)
    :raises FileNotFoundError: if there are none
    """
    package = Path(sb3_chac.__file__).parent
    for folder in (package, package.parent):
        path = folder / "hyperparams" / f"{algo}.yml"
        if path.is_file():
            return path
    raise FileNotFoundError(f"sb3_chac has no hyperparameters for {algo!r}, choose from {sorted(ALGORITHMS)}.")


def drivable_algorithms() -> dict[str, type["GuidedOffPolicyAlgorithm"]]:
    """
    Return the algorithms that learn from takeovers, which a person can train in the cockpit.

    :return: name on the command line -> class
    """
    from sb3_chac.common.guided import GuidedOffPolicyAlgorithm

    classes = {name: getattr(sb3_chac, public) for name, public in ALGORITHMS.items()}
    return {name: found for name, found in classes.items() if issubclass(found, GuidedOffPolicyAlgorithm)}
