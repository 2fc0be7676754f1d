"""``python -m sb3_chac plot``: the curves of a training."""

import argparse
import csv
import math
import zipfile
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_chac.cli.arguments import check_output
from sb3_chac.cli.command import command_parser, run_command
from sb3_chac.common.callbacks import PROGRESS_FILE
from sb3_chac.common.checks import real_numbers
from sb3_chac.evaluation.episodes import NotEvaluable
from sb3_chac.evaluation.pictures import PLOT_SUFFIXES

DESCRIPTION = """Draw a run of 'rl_zoo3 train' with an algorithm of sb3_chac over its steps: return and success rate of the
evaluations, and of the training itself the safety cost, what the human drove and, for C-HAC, what the self-learning policy
drove.

  sb3-chac plot logs/chac/SafeDrive-v0_1
  sb3-chac plot logs/chac/SafeDrive-v0_1 logs/chac/SafeDrive-v0_2 --out curves.png    # if _2 resumed _1

It reads evaluations.npz and progress.csv in the run folder, and leaves out the panels for which there is nothing."""

EVALUATIONS_FILE = "evaluations.npz"
# What NumPy, zipfile and csv raise for a file that is damaged or something else
UNREADABLE = (OSError, ValueError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error, csv.Error)
STEPS, STAGE = "time/total_timesteps", "chac/stage"


class NotPlottable(NotEvaluable):
    """Raised for folders without curves; says what is missing."""


class Panel(NamedTuple):
    """Titles and colour of the panel of a curve."""

    title: str
    subtitle: str
    colour: str
    is_share: bool = False


# Name of a curve, in progress.csv or as ``read_evaluations`` calls it -> where it is drawn
PANELS = {
    "return": Panel("Return", "evaluations, mean ± std of the episodes", "tab:blue"),
    "success": Panel("Success rate", "evaluations", "tab:blue", is_share=True),
    "safety/safety_cost": Panel("Safety cost", "training, sum since the start", "tab:red"),
    "takeover/human_steps": Panel("Steps driven by the human", "training, sum since the start", "tab:orange"),
    "takeover/rate": Panel("Takeover rate", "training, human's share of the steps so far", "tab:orange", is_share=True),
    "chac/self_share": Panel("Self-learning policy", "training, its share of the steps", "tab:green", is_share=True),
}

# Curves by name, each of shape (n, 3): step, value, standard deviation
Curves = dict[str, np.ndarray]


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = command_parser("plot", DESCRIPTION)
    parser.add_argument(
        "run_folders", nargs="+", type=Path, metavar="RUN_FOLDER", help="a run, and in order those that resumed it"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help=".png, .svg or .pdf (default: curves.png in the last folder)")
    return parser


def main(arguments: list[str]) -> None:
    """
    Run the command.

    :param arguments: of the command line, after ``plot``
    """
    run_command(make_parser(), arguments, run, NotEvaluable)


def run(args: argparse.Namespace) -> None:
    """
    Plot a run.

    :param args: see ``make_parser``
    :raises FileNotFoundError: if a run, or the folder of the picture, does not exist
    :raises NotEvaluable: for whatever else does not fit
    """
    out = args.out or args.run_folders[-1] / "curves.png"
    curves = join(args.run_folders)
    check_output("--out", out, PLOT_SUFFIXES)
    figure = draw(curves)
    figure.suptitle(", ".join(map(str, args.run_folders)), fontsize="medium")
    try:
        figure.savefig(out, dpi=150)
    except OSError as error:  # such as a full disk
        out.unlink(missing_ok=True)
        raise NotEvaluable(f"--out {out}: cannot be written ({error.strerror or error}).") from error
    print(f"Saved {out}")


def join(run_folders: list[Path]) -> Curves:
    """
    Join the curves of runs that resumed each other.

    :param run_folders: each but the first goes on from some step of the one before; what that did afterwards is left out
    :raises FileNotFoundError: if one does not exist
    :raises NotPlottable: if there is nothing in it, or it does not go on from the one before
    """
    joined: Curves = {}
    start = 0.0
    for folder in run_folders:
        curves = read_run(folder)
        start, before = min(curve[0, 0] for curve in curves.values()), start
        if joined and (start == 0 or start < before):
            raise NotPlottable(f"{folder} begins at step {start:.0f}: it does not go on where the run before it was.")
        kept = {name: curve[curve[:, 0] <= start] for name, curve in joined.items()}
        joined = {name: np.concatenate([c[name] for c in (kept, curves) if name in c]) for name in {**kept, **curves}}
    if not any(len(joined.get(name, ())) for name in PANELS):
        raise NotPlottable(f"{run_folders[-1]}: nothing has been evaluated or logged yet.")
    return joined


def read_run(folder: Path) -> Curves:
    """
    Read the curves of a run.

    :raises FileNotFoundError: if it does not exist
    :raises NotPlottable: if there is no curve in it
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"There is no folder {folder}.")
    evaluations, progress = folder / EVALUATIONS_FILE, folder / PROGRESS_FILE
    if not evaluations.is_file() and not progress.is_file():
        raise NotPlottable(
            f"{folder} holds neither {EVALUATIONS_FILE} nor {PROGRESS_FILE}: "
            "it is not the folder of a run, such as logs/chac/SafeDrive-v0_1."
        )
    curves: Curves = {}
    for file, read in ((evaluations, read_evaluations), (progress, read_progress)):
        if file.is_file():
            try:
                curves |= read(file)
            except UNREADABLE as error:
                raise NotPlottable(f"{file} cannot be read: {error}") from error
    curves = {name: curve for name, curve in curves.items() if len(curve)}
    if not curves:
        raise NotPlottable(f"{folder}: nothing has been evaluated or logged yet.")
    return curves


def read_evaluations(file: Path) -> Curves:
    """
    Read the curves of the evaluations.

    :param file: as SB3's EvalCallback writes it
    :raises ValueError: if there is something else in it
    """
    loaded = np.load(file)
    if not isinstance(loaded, np.lib.npyio.NpzFile):
        raise ValueError("it is no archive of arrays, which SB3's EvalCallback writes.")
    with loaded as data:
        found = {name: data[name] for name in ("timesteps", "results", "successes") if name in data}
    steps = checked_numbers("timesteps", found, 1)
    returns = checked_numbers("results", found, 2, len(steps))
    curves = {"return": np.column_stack([steps, returns.mean(axis=1), returns.std(axis=1)])}
    if "successes" in found:
        successes = checked_numbers("successes", found, 2, len(steps))
        curves["success"] = np.column_stack([steps, successes.mean(axis=1), np.zeros(len(steps))])
    return curves


def checked_numbers(name: str, arrays: dict[str, np.ndarray], dimensions: int, n: int | None = None) -> np.ndarray:
    """
    Take an array of the evaluations.

    :param name: of it
    :param arrays: of a file
    :param dimensions: that it must have
    :param n: length of the first of them, None for any
    :return: of at least one number each, in float64
    :raises ValueError: unless it is there, finite numbers, and has this shape
    """
    values = real_numbers(arrays.get(name))
    fits = values is not None and values.ndim == dimensions and n in (None, len(values)) and np.isfinite(values).all()
    if values is None or not fits or 0 in values.shape:
        shape = f"({n}, number of episodes)" if dimensions == 2 else "(number of evaluations,)"
        raise ValueError(f"{name} must be finite numbers of shape {shape}, as SB3's EvalCallback writes them.")
    return values


def read_progress(file: Path) -> Curves:
    """
    Read the curves of the training.

    :param file: as ``CSVProgress`` writes it
    :raises ValueError: for what is no finite number
    """
    with file.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    curves = {}
    for name in (STEPS, STAGE, *PANELS):
        points = [(float(row[STEPS]), float(row[name]), 0.0) for row in rows if row.get(STEPS) and row.get(name)]
        if points:
            curves[name] = np.array(points)
            if not np.isfinite(curves[name]).all():
                raise ValueError(f"{name}, or the number of steps beside it, is NaN or infinite.")
    return curves


def draw(curves: Curves) -> Figure:
    """
    Draw all curves.

    :param curves: at least one of those in ``PANELS``
    """
    names = [name for name in PANELS if name in curves]
    columns = min(3, len(names))
    rows = math.ceil(len(names) / columns)
    figure = Figure(figsize=(4.2 * columns, 2.9 * rows + 0.5), layout="constrained")
    all_axes = figure.subplots(rows, columns, squeeze=False, sharex=True).flat
    last = max(curve[-1, 0] for curve in curves.values())
    for axes, name in zip(all_axes, names, strict=False):
        draw_panel(axes, PANELS[name], curves[name])
        axes.set_xlim(0, 1.02 * last)
        mark_stage_2(axes, curves)
    for axes in figure.axes[len(names) :]:
        axes.set_axis_off()
    for axes in figure.axes[max(0, len(names) - columns) : len(names)]:  # the lowest of each column
        axes.set_xlabel("environment steps")
        axes.tick_params(labelbottom=True)
    return figure


def draw_panel(axes: Axes, panel: Panel, curve: np.ndarray) -> None:
    """
    Draw one curve.

    :param curve: of shape (n, 3): step, value, standard deviation
    """
    steps, values, spread = curve.T
    axes.plot(steps, values, color=panel.colour, linewidth=1.8, marker="o" if len(steps) <= 20 else None, markersize=4)
    if spread.any():
        axes.fill_between(steps, values - spread, values + spread, color=panel.colour, alpha=0.15, linewidth=0)
    axes.margins(y=0.12)  # room for the mark of stage 2
    if panel.is_share:
        axes.set_ylim(-0.03, 1.15)
        axes.set_yticks(np.linspace(0, 1, 6))
        axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
    elif panel.subtitle.endswith("since the start"):
        axes.set_ylim(-0.03 * max(values.max(), 1), 1.15 * max(values.max(), 1))
    axes.set_title(panel.title, loc="left", fontweight="bold", fontsize="medium", pad=20)
    axes.text(0, 1.03, panel.subtitle, transform=axes.transAxes, fontsize="small", color="0.35", va="bottom")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.locator_params(axis="x", nbins=5)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def mark_stage_2(axes: Axes, curves: Curves) -> None:
    """A line where C-HAC's stage 2 begins, if both stages are there."""
    steps, stages, _ = curves.get(STAGE, np.zeros((1, 3))).T
    if 1 in stages and 2 in stages:
        switch = steps[stages == 2][0]
        axes.axvline(switch, color="0.3", linestyle="--", linewidth=1)
        axes.annotate(
            "stage 2", (switch, 1), xycoords=("data", "axes fraction"), xytext=(4, -3), textcoords="offset points",
            fontsize="small", color="0.3", va="top",
        )  # fmt: skip
