"""Learning curves of several methods, with intervals over seeds, and what they come to (interquartile means, by rliable)."""

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

Curve = np.ndarray  # shape (n, 2 or 3): step and value, steps ascending; a third column is not used here
Curves = dict[str, Curve]  # of one run, by quantity

RETURN, SUCCESS, COST = "return", "success", "cost"  # of the evaluations
TRAINING_COST, HUMAN_STEPS, STAGE = "safety/safety_cost", "takeover/human_steps", "chac/stage"
TITLES = {
    RETURN: "return",
    SUCCESS: "success rate",
    COST: "safety cost per episode",
    TRAINING_COST: "safety cost of the training so far",
    HUMAN_STEPS: "steps driven by the human so far",
}
# Okabe and Ito's colours, which the colour-blind tell apart too
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9", "#999999")
LINES = ("-", "--", "-.", ":")
RESAMPLES = 2000
LAST = 3  # evaluations whose mean is the score of a run


class Method(NamedTuple):
    """The runs of one method, a seed each."""

    title: str
    runs: list[Curves]

    @property
    def label(self) -> str:
        """Title with the number of seeds."""
        return f"{self.title} ({len(self.runs)} seed{'s' if len(self.runs) > 1 else ''})"


class Score(NamedTuple):
    """Interquartile mean over runs and its 95 % interval, NaN for a single run."""

    value: float
    low: float = math.nan
    high: float = math.nan

    def text(self, digits: int) -> str:
        """
        Word the score.

        :param digits: after the point
        """
        interval = "" if math.isnan(self.low) else f" [{self.low:.{digits}f}, {self.high:.{digits}f}]"
        return f"{self.value:.{digits}f}{interval}"


def join_curves(first: Curves, second: Curves) -> Curves:
    """
    Append a run to the one that it goes on from, such as C-HAC's stage 2 to its stage 1.

    :param first: what of it lies beyond the beginning of ``second`` is left out
    :return: quantities of either
    """
    start = min(curve[0, 0] for curve in second.values())
    kept = {name: curve[curve[:, 0] < start] for name, curve in first.items()}
    return {
        name: np.concatenate([part[name][:, :2] for part in (kept, second) if name in part and len(part[name])])
        for name in {**kept, **second}
        if len(kept.get(name, ())) or name in second
    }


def over_human_steps(curves: Curves) -> Curves:
    """
    Change the x axis to the human's steps.

    :return: the same values over the steps that the human has driven; nothing where no human drove
    """
    human = curves.get(HUMAN_STEPS)
    if human is None or human[-1, 1] <= 0:
        return {}
    result = {}
    for name, curve in curves.items():
        steps = np.interp(curve[:, 0], human[:, 0], human[:, 1])
        last = np.append(np.diff(steps) > 0, True)  # of several values at the same step of the human, the latest
        result[name] = np.column_stack([steps, curve[:, 1]])[last]
    return result


def mean_and_interval(curves: Sequence[Curve]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """
    Average curves over the steps that all of them cover, linearly interpolated.

    :param curves: one for each seed
    :return: steps, means, and the ends of the 95 % bootstrap interval of the mean over seeds, shape (n,) each; with one seed
        the interval is empty
    """
    first, last = max(curve[0, 0] for curve in curves), min(curve[-1, 0] for curve in curves)
    steps = np.unique(np.concatenate([curve[:, 0] for curve in curves]))
    steps = steps[(steps >= first) & (steps <= last)]
    values = np.array([np.interp(steps, curve[:, 0], curve[:, 1]) for curve in curves])
    if len(curves) == 1:
        return steps, values[0], values[0], values[0]
    chosen = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    low, high = np.percentile(values[chosen].mean(axis=1), [2.5, 97.5], axis=0)
    return steps, values.mean(axis=0), low, high


def style(number: int) -> tuple[str, str]:
    """
    Choose how a method is drawn.

    :return: colour and line style of a method, no two alike among the first 32
    """
    return COLOURS[number % len(COLOURS)], LINES[(number + number // len(COLOURS)) % len(LINES)]


def draw_panel(
    axes: Axes, methods: Sequence[Method], quantity: str, change: Callable[[Curves], Curves] = lambda curves: curves
) -> dict[str, Line2D]:
    """
    Draw one quantity: means over seeds, shaded their 95 % bootstrap intervals, a diamond where C-HAC's stage 2 begins.

    :param change: of the curves of a run, before they are drawn
    :return: what was drawn, by the label for the legend
    """
    drawn = {}
    for number, method in enumerate(methods):
        runs = [change(run) for run in method.runs]
        curves = [run[quantity] for run in runs if len(run.get(quantity, ()))]
        if not curves or max(curve[0, 0] for curve in curves) > min(curve[-1, 0] for curve in curves):
            continue
        colour, line = style(number)
        steps, means, low, high = mean_and_interval(curves)
        marker = "o" if len(steps) == 1 else None
        (drawn[method.label],) = axes.plot(steps, means, color=colour, linestyle=line, linewidth=1.7, marker=marker)
        axes.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0)
        stages = [run[STAGE] for run in runs if STAGE in run and {1, 2} <= set(run[STAGE][:, 1])]
        switches = [stage[stage[:, 1] == 1][-1, 0] for stage in stages]
        if switches and steps[0] <= np.mean(switches) <= steps[-1]:
            switch = float(np.mean(switches))
            axes.plot(switch, np.interp(switch, steps, means), marker="D", markersize=5, color=colour, zorder=5)
    axes.set_title(TITLES.get(quantity, quantity), fontsize="medium")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}K" if value >= 1000 else f"{value:g}")
    if quantity == SUCCESS:
        axes.set_ylim(-0.03, 1.03)
    elif quantity in (COST, TRAINING_COST, HUMAN_STEPS):
        axes.set_ylim(bottom=0)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    return drawn


def draw(methods: Sequence[Method], quantities: Iterable[str], over_human: bool = False, width: float = 3.6) -> Figure:
    """
    Draw a panel for each quantity that any run has, and one legend below them.

    :param over_human: over the steps that the human drove in place of all; methods without a human are left out
    :param width: of a panel [inches]
    """
    quantities = [name for name in quantities if any(name in run for method in methods for run in method.runs)]
    if over_human:
        quantities = [name for name in quantities if name != HUMAN_STEPS]
    figure = Figure(figsize=(width * len(quantities), 3.4), layout="constrained")
    handles: dict[str, Line2D] = {}
    for axes, quantity in zip(figure.subplots(1, len(quantities), squeeze=False).flat, quantities, strict=True):
        handles |= draw_panel(axes, methods, quantity, over_human_steps if over_human else lambda curves: curves)
        axes.set_xlabel("steps driven by the human" if over_human else "environment steps")
    if any(STAGE in run and 2 in run[STAGE][:, 1] for method in methods for run in method.runs):
        handles["stage 2 begins"] = Line2D([], [], color="0.3", marker="D", linestyle="", markersize=5)
    ncols = max(1, min(len(handles), int(width * len(quantities) / 2.1)))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=ncols, fontsize="small", handlelength=3)
    return figure


def final(run: Curves, quantity: str) -> float:
    """
    Take the value at the end of a run.

    :return: mean of the last ``LAST`` evaluations, or the last value of what is a sum; NaN if there is none
    """
    curve = run.get(quantity, np.empty((0, 2)))
    if not len(curve):
        return math.nan
    return float(curve[-1, 1] if quantity in (TRAINING_COST, HUMAN_STEPS) else curve[-LAST:, 1].mean())


def finals(method: Method, quantity: str) -> np.ndarray:
    """
    Take the values at the end of all runs.

    :return: of the runs that have it, shape (n,)
    """
    values = np.array([final(run, quantity) for run in method.runs])
    return values[~np.isnan(values)]


def interquartile_mean(values: np.ndarray) -> Score | None:
    """
    Average the middle half of the values.

    :param values: one for each run, shape (n,)
    :return: None without values
    """
    from rliable.metrics import aggregate_iqm

    if not len(values):
        return None
    scores = values[:, None]  # one task
    if len(values) == 1:
        return Score(float(values[0]))
    _, low, high = estimate(scores, lambda x: np.array([aggregate_iqm(x)]))
    return Score(float(aggregate_iqm(scores)), low, high)


def probability_of_improvement(better: np.ndarray, worse: np.ndarray) -> Score | None:
    """
    Estimate how probably a run of one method ends above a run of another (Agarwal et al. 2021; ties count one half).

    :param better: one value for each run, shape (n,)
    :param worse: likewise, of the other method
    :return: None without values
    """
    from rliable.metrics import probability_of_improvement as probability

    if not len(better) or not len(worse):
        return None
    x, y = better[:, None], worse[:, None]
    if len(better) == len(worse) == 1:
        return Score(float(probability(x, y)))
    value, low, high = estimate((x, y), lambda x, y: np.array([probability(x, y)]))
    return Score(value, low, high)


def estimate(scores: np.ndarray | tuple[np.ndarray, np.ndarray], function: Callable[..., np.ndarray]) -> tuple[float, ...]:
    """
    Estimate a statistic of scores and its uncertainty.

    :param scores: shape (n_runs, n_tasks), or a pair of such
    :param function: of the scores, returns the statistic, shape (1,)
    :return: value, and the ends of its 95 % stratified bootstrap interval
    """
    from rliable.library import get_interval_estimates

    state = np.random.get_state()
    np.random.seed(0)  # rliable draws from numpy's global generator, whatever random_state it is given
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # rliable's use of arch; arch: all values are equal
            values, intervals = get_interval_estimates({"": scores}, function, reps=RESAMPLES)
    finally:
        np.random.set_state(state)
    return float(values[""][0]), float(intervals[""][0, 0]), float(intervals[""][1, 0])


Table = list[list[str]]  # rows of cells, the header first

COLUMNS = {RETURN: 1, SUCCESS: 2, COST: 2, TRAINING_COST: 0, HUMAN_STEPS: 0}  # -> digits


def summary(methods: Sequence[Method]) -> Table:
    """
    Tabulate the ends of all methods.

    :return: a row for each method: seeds, steps, and interquartile means with intervals
    """
    names = [name for name in COLUMNS if any(len(finals(method, name)) for method in methods)]
    rows = [["method", "seeds", "steps", *(TITLES[name] for name in names)]]
    for method in methods:
        ends = [max(curve[-1, 0] for curve in run.values()) for run in method.runs]
        steps = f"{min(ends):,.0f}" + (f" to {max(ends):,.0f}" if max(ends) > min(ends) else "")
        scores = [interquartile_mean(finals(method, name)) for name in names]
        cells = [score.text(COLUMNS[name]) if score else "" for name, score in zip(names, scores, strict=True)]
        rows.append([method.title, str(len(method.runs)), steps, *cells])
    return rows


def improvements(methods: Sequence[Method], quantity: str = RETURN) -> Table:
    """
    Tabulate how often one method ends above another.

    :return: probability that a run of the row's method ends above one of the column's
    """
    cells = [["" for _ in methods] for _ in methods]
    for row, one in enumerate(methods):
        for column, other in enumerate(methods[:row]):
            score = probability_of_improvement(finals(one, quantity), finals(other, quantity))
            if score is not None:
                cells[row][column] = score.text(2)
                cells[column][row] = Score(*(1 - value for value in (score.value, score.high, score.low))).text(2)
    header = [f"P(above), {TITLES[quantity]}", *(method.title for method in methods)]
    return [header, *([method.title, *texts] for method, texts in zip(methods, cells, strict=True))]


def markdown(table: Table) -> str:
    """Write a table as Markdown."""
    head, *rows = (f"| {' | '.join(row)} |" for row in table)
    return "\n".join([head, "|---" * len(table[0]) + "|", *rows])


def latex(table: Table) -> str:
    """
    Write a table as LaTeX.

    :return: a tabular with the rules of the package booktabs
    """
    escapes = {"\\": r"\textbackslash{}", **{c: f"\\{c}" for c in "&%$#_{}"}, "±": r"$\pm$"}
    head, *rows = (" & ".join("".join(escapes.get(c, c) for c in cell) for cell in row) + r" \\" for row in table)
    body = [r"\toprule", head, r"\midrule", *rows, r"\bottomrule"]
    return "\n".join([rf"\begin{{tabular}}{{l{'r' * (len(table[0]) - 1)}}}", *body, r"\end{tabular}"])
