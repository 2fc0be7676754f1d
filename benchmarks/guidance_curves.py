"""The CSVs of guidance.py as curves, for its own pictures and those of tables.py."""

from pathlib import Path

import lab
import numpy as np

from sb3_chac.evaluation import curves
from sb3_chac.evaluation.curves import Curves

COLUMNS = {
    "return_mean": curves.RETURN,
    "success_rate": curves.SUCCESS,
    "cost_mean": curves.COST,
    "training_cost": curves.TRAINING_COST,
    "human_steps": curves.HUMAN_STEPS,
}


def to_curves(rows: list[dict[str, str]], stage: int) -> Curves:
    """
    :param rows: a row for each evaluation
    :param stage: of C-HAC
    """
    steps = [float(row["step"]) for row in rows]
    found = {name: np.column_stack([steps, [float(row[key]) for row in rows]]) for key, name in COLUMNS.items()}
    return found | {curves.STAGE: np.column_stack([steps, [stage] * len(steps)])}


def load_run(folder: Path, name: str, seed: int, goes_on_from: str | None = None) -> Curves:
    """
    :param name: of a method in guidance.py
    :param goes_on_from: the method of its stage 1, None if it has none
    :return: both stages as one curve
    """
    run = to_curves(lab.read(folder / f"{name}-{seed}.csv"), 2 if goes_on_from else 1)
    if goes_on_from is None:
        return run
    return curves.join_curves(to_curves(lab.read(folder / f"{goes_on_from}-{seed}.csv"), 1), run)
