"""Callbacks that show and write how one of our algorithms learns."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import BarColumn, TimeRemainingColumn
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.logger import CSVOutputFormat
from tqdm.rich import FractionColumn, tqdm

from sb3_chac.common.costs import TOTAL, measured_costs
from sb3_chac.common.guided import GuidedOffPolicyAlgorithm

PROGRESS_FILE = "progress.csv"


class GuidedProgressBar(ProgressBarCallback):
    """
    SB3's progress bar which also tells, for an algorithm that learns from takeovers, what the human does: the stage of the
    training (C-HAC) or the round (HG-DAgger, IWR; 0 is the warm-up), the share and number of steps that the human drove and
    the safety cost, since the start of the training; and in stage 2 the share of the latest steps that the self-learning
    policy drove.

    :param refresh_every: number of calls between two updates of the text
    """

    model: GuidedOffPolicyAlgorithm

    def __init__(self, refresh_every: int = 100):
        super().__init__()
        self.refresh_every = refresh_every
        self.self_share: float | None = None

    def _on_training_start(self) -> None:
        # Less beside the text than SB3's, it is to fit into 80 columns
        columns = ("{task.description}", BarColumn(bar_width=None), FractionColumn(), TimeRemainingColumn())
        total = self.locals["total_timesteps"] - self.model.num_timesteps
        self.pbar = tqdm(total=total, desc=self.text(), progress=columns)

    def _on_step(self) -> bool:
        if self.n_calls % self.refresh_every == 0:
            self.pbar.set_description_str(self.text(), refresh=False)
        return super()._on_step()

    def _on_training_end(self) -> None:
        self.pbar.set_description_str(self.text(), refresh=False)
        super()._on_training_end()

    def text(self) -> str:
        """
        Word the progress.

        :return: e.g. "stage 2, self 31 %, human 12 % (1850 steps), cost 9"
        """
        counts = self.model.counts
        parts = [f"{name} {getattr(self.model, name)}" for name in ("stage", "round") if hasattr(self.model, name)]
        choices = list(getattr(self.model, "choices", ()))[-self.refresh_every :]
        if choices:  # else the logger has just taken them
            self.self_share = float(np.mean([choice["self_drives"] for choice in choices]))
        if self.self_share is not None:
            parts.append(f"self {100 * self.self_share:.0f} %")
        rate = counts["human_steps"] / max(counts["total_steps"], 1)
        parts.append(f"human {100 * rate:.0f} % ({counts['human_steps']:.0f} steps)")
        if self.model.safety_cost is not None:
            parts.append(f"cost {self.model.safety_cost:g}")
        watch = getattr(self.model, "watch", None)
        if watch is not None and watch.relapsed:
            parts.append("RELAPSE")
        return ", ".join(parts)


class SafetyCost(BaseCallback):
    """
    Sum of the safety cost (``info["cost"]``, if there is any) of a training whose algorithm does not, as
    ``safety/safety_cost`` of the logger and ``model.safety_cost``, which is saved with the model.
    """

    def _on_training_start(self) -> None:
        if self.model.num_timesteps == 0 and hasattr(self.model, "safety_cost"):
            del self.model.safety_cost
        self.is_measured = hasattr(self.model, "safety_cost")

    def _on_step(self) -> bool:
        costs = measured_costs(self.locals["infos"])
        self.is_measured = self.is_measured or any(cost is not None for cost in costs)
        if self.is_measured:  # else it would look like a zero
            self.model.safety_cost = getattr(self.model, "safety_cost", 0.0) + sum(filter(None, costs))  # type: ignore[attr-defined]
            self.logger.record(TOTAL, self.model.safety_cost)  # type: ignore[attr-defined]
        return True


class CSVProgress(BaseCallback):
    """
    Writer of what the logger gets as CSV, a row each time it is dumped. It adds rows when the training starts and ends and
    when a stage begins: they tell the runs of a training apart, and its stages, to the step.

    :param file: is overwritten
    """

    def __init__(self, file: str | Path):
        super().__init__()
        self.file = Path(file)
        self.output: CSVOutputFormat | None = None
        self.stage: int | None = None

    def _on_training_start(self) -> None:
        self.output = CSVOutputFormat(str(self.file))
        self.logger.output_formats.append(self.output)
        self.stage = getattr(self.model, "stage", None)
        self._add_row(self.output)

    def _on_step(self) -> bool:
        stage = getattr(self.model, "stage", None)
        if self.output is not None and stage != self.stage:
            self.stage = stage
            self._add_row(self.output)
        return True

    def _on_training_end(self) -> None:
        if self.output is not None:  # RL-Zoo3 may end a training twice
            self._add_row(self.output)
            self.logger.output_formats.remove(self.output)
            self.output.close()
            self.output = None

    def _add_row(self, output: CSVOutputFormat) -> None:
        row: dict[str, Any] = {"time/total_timesteps": self.model.num_timesteps}
        if self.stage is not None:
            row["chac/stage"] = self.stage
        if isinstance(self.model, GuidedOffPolicyAlgorithm):
            row["takeover/human_steps"] = self.model.counts["human_steps"]
        safety_cost = getattr(self.model, "safety_cost", None)
        if safety_cost is not None:
            row[TOTAL] = safety_cost
        output.write(row, {})
