"""RESULTS.md and its pictures, from the CSVs of the suite alone."""

import warnings
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
import suite_job
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rliable.library import get_interval_estimates
from suite_job import Job

import sb3_chac.envs  # noqa: F401  (registers our environments)

if TYPE_CHECKING:
    from suite import Results

HERE = Path(__file__).parent
METRICS = {"return": ("return", 0), "cost": ("safety cost", 2), "success": ("success", 2)}  # name -> title, digits
RESAMPLES = 2000
REMARKS = "remarks.md"  # beside the CSVs, written by hand: reasons for what contradicts the paper


class Paper(NamedTuple):
    """The paper's figures, on MetaDrive after 1M steps (imitation: 50K of the human)."""

    value: dict[str, float]  # by metric
    training_cost: str = ""
    human_steps: str = ""


def paper(result: float, cost: float, success: float, training_cost: str = "", human_steps: str = "") -> Paper:
    return Paper({"return": result, "cost": cost, "success": success}, training_cost, human_steps)


PAPER = {
    "sac": paper(359.18, 1.00, 0.74, "8.86K"),
    "ppo": paper(278.65, 3.92, 0.44, "45.12K"),
    "sac_lag": paper(346.05, 0.64, 0.62, "8.73K"),
    "ppo_lag": paper(222.15, 0.88, 0.26, "26.55K"),
    "dsac": paper(349.35, 0.47, 0.77, "7.44K"),
    "human": paper(377.52, 0.39, 0.97, "23", "50K"),
    "cql": paper(93.12, 1.45, 0.09, "", "50K"),
    "bc": paper(59.13, 0.12, 0.0, "", "50K"),
    "gail": paper(34.78, 1.07, 0.0, "", "50K"),
    "hg_dagger": paper(142.35, 2.1, 0.30, "56", "34.9K"),
    "iwr": paper(329.97, 4.00, 0.70, "49", "37.1K"),
    "pvp": paper(338.28, 0.898, 0.81, "36", "15K"),
    "dpvp": paper(353.39, 0.31, 0.83, "32", "15K"),
    "chac": paper(392.92, 0.16, 0.91, "176", "15K"),
}
# What the paper claims: the first is better than the second
CLAIMS = [
    ("dpvp", "pvp"),
    ("chac", "dpvp"),
    ("chac", "dsac"),
    ("dsac", "sac"),
    ("sac_lag", "sac"),
    ("ppo_lag", "ppo"),
    ("iwr", "hg_dagger"),
    ("pvp", "iwr"),
]


class Method(NamedTuple):
    title: str
    jobs: list[Job]
    episodes: list[list[dict[str, str]]]  # of each job
    curves: list[dict[str, np.ndarray]]  # of each job: quantity -> steps and values, shape (n, 2)

    def scores(self, metric: str) -> np.ndarray:
        """
        :return: shape (n_jobs, n_maps)
        """
        return np.array([[number(row[metric]) for row in rows] for rows in self.episodes])

    def counts(self, name: str) -> np.ndarray:
        """
        :return: shape (n_jobs,)
        """
        return np.array([float(rows[0][name]) for rows in self.episodes])


def number(text: str) -> float:
    return float({"True": "1", "False": "0"}.get(text, text))


def read(jobs: list[Job], results: "Results") -> tuple[dict[str, Method], list[str]]:
    """
    :return: methods with at least one job that is done, by name; and what is the matter with others
    """
    methods: dict[str, Method] = {}
    problems = []
    for job in jobs:
        state = results.state(job)
        if state:
            if state != "unfinished":
                problems.append(state)
            continue
        method = methods.setdefault(job.row.name, Method(job.row.title, [], [], []))
        method.jobs.append(job)
        method.episodes.append(results.read(job, "episodes"))
        curves: dict[str, list[tuple[float, float]]] = defaultdict(list)
        if job.row.algo:
            for row in results.read(job, "curves"):
                curves[row["quantity"]].append((float(row["step"]), float(row["value"])))
        method.curves.append({name: np.array(points) for name, points in curves.items()})
    return methods, problems


def write(suite: str, scale: float, jobs: list[Job], results: "Results") -> None:
    """
    :param suite: its name
    :param scale: of the budgets
    :param jobs: all of the suite
    :param results: where they are; the pictures go beside them
    """
    methods, problems = read(jobs, results)
    for problem in problems:
        print(f"Left out: {problem}")
    if not methods:
        print(f"Nothing is done yet of {suite} at scale {scale:g}: run it first.")
        return
    text = [
        f"# {suite}, budgets x {scale:g}, {jobs[0].env}",
        "",
        f"Trained by `python benchmarks/suite.py run --suite {suite} --scale {scale:g}`. With `report` in place of `run` this "
        "was written, from the CSVs beside it.",
        f"Mean ± standard deviation over seeds, of one deterministic episode on each of the maps {suite_job.TEST_MAPS[0]}-"
        f"{suite_job.TEST_MAPS[-1]}, without the human; in brackets 95 % bootstrap intervals of the mean (rliable, seeds "
        "resampled map by map). In italics the paper's figures, which are MetaDrive's at the full budgets.",
        "",
        *main_table(methods),
        "",
        *claims(methods),
        "",
    ]
    remarks = results.folder / REMARKS
    if remarks.exists():
        text += [remarks.read_text().rstrip(), ""]
    for name, (title, draw) in PICTURES.items():
        figure = draw(methods, results)
        if figure is not None:
            figure.savefig(results.folder / f"{name}.png", dpi=110)
            text += [f"## {title}", "", f"![{title}]({name}.png)", ""]
    versions = sorted({rows[0]["versions"] for method in methods.values() for rows in method.episodes})
    text += ["Versions: " + "; ".join(versions), ""]
    (results.folder / "RESULTS.md").write_text("\n".join(text))
    print(f"Saved {results.folder / 'RESULTS.md'}")


def main_table(methods: dict[str, Method]) -> list[str]:
    lines = [
        "| method | seeds | human data | total data | training cost | return | safety cost | success | paper: r. / c. / s. |",
        "|---" * 9 + "|",
    ]
    for name, method in methods.items():
        cells = [f"{method.counts(key).mean():,.0f}" for key in ("human_steps", "total_steps", "training_cost")]
        for metric, (_, digits) in METRICS.items():
            means = method.scores(metric).mean(axis=1)
            cell = f"{means.mean():.{digits}f}"
            if len(means) > 1:
                low, high = interval(method.scores(metric))
                cell += f" ± {means.std(ddof=1):.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"
            cells.append(cell)
        figures = PAPER.get(name)
        cells.append("*" + " / ".join(f"{value:g}" for value in figures.value.values()) + "*" if figures else "")
        lines.append(f"| {method.title} | {len(method.jobs)} | " + " | ".join(cells) + " |")
    return lines


def interval(scores: np.ndarray) -> tuple[float, float]:
    """
    :param scores: shape (n_seeds, n_maps)
    :return: 95 % bootstrap interval of the mean
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # rliable's use of arch
        np.random.seed(0)  # rliable draws from numpy's global generator, whatever random_state it is given
        _, intervals = get_interval_estimates({"": scores}, lambda x: np.array([x.mean()]), reps=RESAMPLES)
    low, high = intervals[""][:, 0]
    return float(low), float(high)


def claims(methods: dict[str, Method]) -> list[str]:
    """What of the paper's ordering holds here, and what does not."""
    lines = ["## The paper's ordering", "", "| claim | success | safety cost |", "|---|---|---|"]
    for better, worse in CLAIMS:
        if better not in methods or worse not in methods:
            continue
        cells = []
        for metric, sign in (("success", 1), ("cost", -1)):
            ours = sign * (methods[better].scores(metric).mean() - methods[worse].scores(metric).mean())
            theirs = sign * (PAPER[better].value[metric] - PAPER[worse].value[metric])
            agrees = "as in the paper" if ours * theirs > 0 else "equal here" if ours == 0 else "**contradicts the paper**"
            cells.append(f"{sign * ours:+.2f} (paper {sign * theirs:+.2f}): {agrees}")
        lines.append(f"| {methods[better].title} against {methods[worse].title} | " + " | ".join(cells) + " |")
    return lines


# Pictures

LINES = ["-", "--", ":"]  # one more for every ten methods: as many colours has the cycle


def draw_curves(axes: Axes, methods: dict[str, Method], quantity: str, per_step: bool = False) -> None:
    """
    Mean over seeds, shaded from least to greatest.

    :param per_step: draw it divided by the number of steps
    """
    for number, method in enumerate(methods.values()):
        curves = [curve[quantity] for curve in method.curves if len(curve.get(quantity, ())) > 1]
        if not curves:
            continue
        first, last = max(c[0, 0] for c in curves), min(c[-1, 0] for c in curves)
        steps = np.unique(np.concatenate([c[:, 0] for c in curves]).clip(first, last))
        values = np.array([np.interp(steps, *curve.T) for curve in curves])
        if per_step:
            values = values / np.maximum(steps, 1)
        style = {"color": f"C{number % 10}", "linestyle": LINES[number // 10]}
        axes.plot(steps, values.mean(axis=0), label=method.title, linewidth=1.3, **style)
        axes.fill_between(steps, values.min(axis=0), values.max(axis=0), color=style["color"], alpha=0.12)
    axes.set_xlabel("steps of the training")
    axes.grid(alpha=0.25)


def learning(methods: dict[str, Method], results: "Results") -> Figure:
    figure = Figure(figsize=(13, 4), layout="constrained")
    titles = {"return": "return", "success": "success rate", "safety/safety_cost": "safety cost of the training"}
    for axes, (quantity, title) in zip(figure.subplots(1, 3), titles.items(), strict=True):
        draw_curves(axes, {name: method for name, method in methods.items() if not name.startswith("chac-")}, quantity)
        axes.set_title(title)
        axes.set_xscale("log")  # the person's methods take a tenth of the steps
        if quantity == "safety/safety_cost":
            axes.set_yscale("symlog", linthresh=10)
            axes.set_ylim(bottom=0)
    handles = {label: line for axes in figure.axes for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=7, fontsize="small")
    return figure


def takeovers(methods: dict[str, Method], results: "Results") -> Figure | None:
    guided = {n: m for n, m in methods.items() if any("takeover/human_steps" in curve for curve in m.curves)}
    if not guided:
        return None
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    draw_curves(axes, guided, "takeover/human_steps", per_step=True)
    axes.set(title="takeover rate: the human's share of the steps so far", ylim=(0, None), xscale="log")
    axes.legend(fontsize="small")
    return figure


def ablation(methods: dict[str, Method], results: "Results") -> Figure | None:
    chosen = {name: method for name, method in methods.items() if name.startswith("chac")}
    if len(chosen) < 2:
        return None
    figure = Figure(figsize=(11, 4), layout="constrained")
    for axes, quantity in zip(figure.subplots(1, 3), ("return", "success", "safety/safety_cost"), strict=True):
        draw_curves(axes, chosen, quantity)
        axes.set_title({"safety/safety_cost": "safety cost of the training"}.get(quantity, quantity))
    figure.axes[0].legend(fontsize="small")
    return figure


def drives(methods: dict[str, Method], results: "Results", names: tuple[str, ...]) -> dict[str, list[dict[str, str]]]:
    """
    :return: every step of the first seed's recorded drives, by method
    """
    found = {}
    for name in names:
        for job in methods[name].jobs if name in methods else []:
            if job.keeps_drives:
                found[name] = results.read(job, "drives")
    return found if len(found) == len(names) else {}


def column(rows: list[dict[str, str]], scenario: int, *names: str) -> np.ndarray:
    """
    :return: shape (n_steps, n_names)
    """
    return np.array([[float(row[name]) for name in names] for row in rows if int(row["scenario"]) == scenario])


def actions(methods: dict[str, Method], results: "Results") -> Figure | None:
    """Steering and throttle of C-HAC and PVP on one map (the paper's Figure 9)."""
    found = drives(methods, results, ("chac", "pvp"))
    if not found:
        return None
    figure = Figure(figsize=(10, 5), layout="constrained")
    both = figure.subplots(2, 1, sharex=True, sharey=True)
    for name, rows in found.items():
        sequence = column(rows, suite_job.DRIVES[0], "action_0", "action_1")
        change = np.abs(np.diff(sequence, axis=0)).mean(axis=0) if len(sequence) > 1 else np.zeros(2)
        for axes, values, title, jerk in zip(both, sequence.T, ("steering", "throttle"), change, strict=True):
            axes.plot(
                np.arange(len(values)) / 10,
                values,
                label=f"{methods[name].title}: mean change per step {jerk:.3f}",
                linewidth=1.1,
            )
            axes.set_ylabel(title)
            axes.grid(alpha=0.25)
    for axes in both:
        axes.legend(fontsize="small", loc="upper right")
    both[1].set_xlabel("time [s]")
    figure.suptitle(f"Actions on map {suite_job.DRIVES[0]}")
    return figure


def paths(methods: dict[str, Method], results: "Results") -> Figure | None:
    """What D-PVP and C-HAC drive on two maps (the paper's Figure 10)."""
    found = drives(methods, results, ("dpvp", "chac"))
    if not found:
        return None
    env = gym.make(methods["chac"].jobs[0].env)
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    for axes, scenario in zip(figure.subplots(1, 2), suite_job.DRIVES[1:], strict=True):
        env.reset(options={"scenario": scenario})
        env.unwrapped.plot_map(axes)  # type: ignore[attr-defined]
        for (name, rows), colour in zip(found.items(), ("tab:orange", "tab:blue"), strict=True):
            track = column(rows, scenario, "x", "y", "cost")
            axes.plot(
                track[:, 0],
                track[:, 1],
                color=colour,
                linewidth=1.6,
                zorder=3,
                label=f"{methods[name].title}, {len(track) / 10:.0f} s",
            )
            costly = track[track[:, 2] > 0]
            axes.plot(costly[:, 0], costly[:, 1], "x", color=colour, markersize=9, zorder=4)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title(f"map {scenario} (crosses: collisions)")
        axes.legend(fontsize="small")
    env.close()
    return figure


PICTURES: dict[str, tuple[str, Any]] = {
    "curves": ("Learning curves", learning),
    "takeovers": ("Takeover rate", takeovers),
    "ablation": ("Ablation of C-HAC", ablation),
    "actions": ("Actions of C-HAC and PVP (the paper's Figure 9)", actions),
    "paths": ("D-PVP and C-HAC on two maps (the paper's Figure 10)", paths),
}
