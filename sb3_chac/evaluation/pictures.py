"""A video of one episode, and a picture of the driven paths on their maps."""

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sb3_chac.common.contract import TakeoverDisplay
from sb3_chac.evaluation.episodes import DrivenPath, NotEvaluable, Runner
from sb3_chac.evaluation.evaluation import Evaluation

VIDEO_SUFFIXES = (".mp4", ".gif")
PLOT_SUFFIXES = (".png", ".svg", ".pdf")
MAX_PANELS = 12
# By success; None where the environment does not report it
COLOURS = {True: ("tab:green", "success"), False: ("tab:red", "no success"), None: ("tab:blue", "path")}


def check_can_render(runner: Runner) -> None:
    """
    Check that an environment can render images.

    :raises NotEvaluable: unless the environment can render images
    """
    modes = runner.env.metadata.get("render_modes") or []
    if "rgb_array" not in modes:
        raise NotEvaluable(f"a video needs an environment with render_mode 'rgb_array', {runner.env.unwrapped} has {modes}.")


def check_has(runner: Runner, number: int, *names: str) -> None:
    """
    Check that an environment can tell positions or draw its map.

    :param number: scenario, or episode if there are no scenarios, to start: environments may have no position before
    :param names: what the environment must have: "position" to say where the vehicle is, "plot_map" to draw its map
    :raises NotEvaluable: unless it has
    """
    runner.reset(number)
    missing = [name for name in names if not hasattr(runner.env.unwrapped, name)]
    if missing:
        raise NotEvaluable(
            f"the driven paths need an environment with {' and '.join(names)}, {runner.env.unwrapped} lacks {missing}."
        )


def save_video(file: Path, runner: Runner, number: int) -> None:
    """
    Run one episode again and film it.

    :param file: .mp4 or .gif
    :param runner: made with ``render_mode="rgb_array"``
    :param number: scenario, or episode if there are no scenarios
    """
    import imageio.v2 as imageio

    fps = float(runner.env.metadata.get("render_fps") or 30)
    # A GIF counts milliseconds per frame and repeats for ever
    options = {"duration": 1000 / fps, "loop": 0} if file.suffix == ".gif" else {"fps": fps, "macro_block_size": 2}
    with imageio.get_writer(file, **options) as writer:  # type: ignore[arg-type]

        def film() -> None:
            if isinstance(runner.env.unwrapped, TakeoverDisplay):
                runner.env.unwrapped.hud = getattr(runner.driver, "hud", {})
            image = np.asarray(runner.env.render())
            height, width = (size - size % 2 for size in image.shape[:2])  # H.264 needs even numbers
            writer.append_data(image[:height, :width])  # type: ignore[attr-defined]

        runner.episode(number, on_step=film)


def save_plot(file: Path, runner: Runner, evaluation: Evaluation) -> None:
    """
    Draw the first paths of an evaluation, one map each.

    :param file: .png, .svg or .pdf
    :param runner: of the same task, to draw the maps
    :param evaluation: made with ``record_paths=True``
    """
    episodes = list(zip(evaluation.records, evaluation.paths, strict=True))[:MAX_PANELS]
    columns = math.ceil(math.sqrt(len(episodes)))
    rows = math.ceil(len(episodes) / columns)
    figure = Figure(figsize=(4 * columns, 4 * rows + 0.8), layout="constrained")
    for axes, (record, path) in zip(figure.subplots(rows, columns, squeeze=False).flat, episodes, strict=False):
        _plot_path(axes, runner, record["scenario"] if runner.task.use_scenarios else record["episode"], record, path)
    for axes in figure.axes[len(episodes) :]:
        axes.set_axis_off()
    title = evaluation.table().splitlines()[0].removesuffix(", mean ± std")
    figure.suptitle(title + (f" (the first {MAX_PANELS})" if len(evaluation.records) > MAX_PANELS else ""))
    seen = {record.get("success") for record, _ in episodes}
    lines = [Line2D([], [], color=colour, label=label) for key, (colour, label) in COLOURS.items() if key in seen]
    crosses = Line2D([], [], color="black", marker="x", linestyle="", label="cost (collision)")
    figure.legend(handles=[*lines, crosses], loc="outside lower center", ncols=4)
    figure.savefig(file, dpi=150)


def _plot_path(axes: Axes, runner: Runner, number: int, record: dict, path: DrivenPath) -> None:
    """
    Draw one driven path on its map.

    :param number: scenario, or episode if there are no scenarios
    """
    runner.reset(number)
    runner.env.unwrapped.plot_map(axes)  # type: ignore[attr-defined]
    colour, _ = COLOURS[record.get("success")]
    axes.plot(*path.positions.T, color=colour, linewidth=1.5, zorder=3)
    axes.plot(*path.positions[0], color=colour, marker="o", zorder=4)
    axes.plot(*path.positions[path.costly].T, color="black", marker="x", linestyle="", zorder=5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title(f"{number}: return {record['return']:.1f}" + (f", cost {record['cost']:g}" if "cost" in record else ""))
    axes.tick_params(labelsize="small")
