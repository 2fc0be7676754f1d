"""RESULTS.md and its pictures, from the CSVs of the suite alone."""

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
import suite_job
from matplotlib.figure import Figure
from suite_job import Job

import sb3_chac.envs  # noqa: F401  (registers our environments)
from sb3_chac.evaluation import curves

if TYPE_CHECKING:
    from suite import Results

HERE = Path(__file__).parent
METRICS = {"return": ("return", 0), "cost": ("safety cost", 2), "success": ("success", 2)}  # name -> title, digits
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
        points: dict[str, list[tuple[float, float]]] = defaultdict(list)
        if job.row.algo:
            for row in results.read(job, "curves"):
                points[row["quantity"]].append((float(row["step"]), float(row["value"])))
        method.curves.append({name: np.array(rows) for name, rows in points.items()})
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
        *outdated(methods),
        main_table(methods),
        "",
        "## The paper's ordering",
        "",
        claims(methods),
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


def outdated(methods: dict[str, Method]) -> list[str]:
    """
    :return: a sentence that names the methods whose hyperparameters have changed since, if there are any
    """
    titles = [
        method.title
        for method in methods.values()
        if any(
            rows[0]["fingerprint"] != suite_job.fingerprint(job)
            for job, rows in zip(method.jobs, method.episodes, strict=True)
        )
    ]
    return (
        [f"Made with the hyperparameters of that time, which have changed since: {', '.join(titles)}.", ""] if titles else []
    )


def main_table(methods: dict[str, Method]) -> str:
    head = ["method", "seeds", "human data", "total data", "training cost", "return", "safety cost", "success"]
    table = [[*head, "paper: r. / c. / s."]]
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
        table.append([method.title, str(len(method.jobs)), *cells])
    return curves.markdown(table)


def interval(scores: np.ndarray) -> tuple[float, float]:
    """
    :param scores: shape (n_seeds, n_maps)
    :return: 95 % bootstrap interval of the mean
    """
    _, low, high = curves.estimate(scores, lambda x: np.array([x.mean()]))
    return low, high


def claims(methods: dict[str, Method]) -> str:
    """What of the paper's ordering holds here, and what does not."""
    table = [["claim", "success", "safety cost"]]
    for better, worse in CLAIMS:
        if better not in methods or worse not in methods:
            continue
        cells = []
        for metric, sign in (("success", 1), ("cost", -1)):
            ours = sign * (methods[better].scores(metric).mean() - methods[worse].scores(metric).mean())
            theirs = sign * (PAPER[better].value[metric] - PAPER[worse].value[metric])
            agrees = "as in the paper" if ours * theirs > 0 else "equal here" if ours == 0 else "**contradicts the paper**"
            cells.append(f"{sign * ours:+.2f} (paper {sign * theirs:+.2f}): {agrees}")
        table.append([f"{methods[better].title} against {methods[worse].title}", *cells])
    return curves.markdown(table)


# Pictures

# What the x axis counts, and who belongs there; C-HAC's ablations have a picture of their own
GROUPS = {
    "steps of reinforcement learning": ("sac", "ppo", "sac_lag", "ppo_lag", "dsac", "gail", "chac"),
    "steps with a human at hand": ("hg_dagger", "iwr", "pvp", "dpvp"),
    "gradient steps on demonstrations": ("bc", "cql"),
}
WINDOWS = 12  # of a training, whose takeover rates are drawn


def chosen(methods: dict[str, Method], names: Iterable[str], *quantities: str) -> list[curves.Method]:
    """
    :return: those of the methods that have all of the quantities, for ``curves.draw_panel``
    """
    found = []
    for name in names:
        runs = (
            [run for run in methods[name].curves if all(len(run.get(q, ())) > 1 for q in quantities)]
            if name in methods
            else []
        )
        if runs:
            found.append(curves.Method(methods[name].title, runs))
    return found


def learning(methods: dict[str, Method], results: "Results") -> Figure:
    groups = {title: found for title, names in GROUPS.items() if (found := chosen(methods, names, curves.RETURN))}
    figure = Figure(figsize=(13, 3.7 * len(groups)), layout="constrained")
    quantities = (curves.RETURN, curves.SUCCESS, curves.TRAINING_COST)
    for part, (title, found) in zip(figure.subfigures(len(groups), 1, squeeze=False).flat, groups.items(), strict=True):
        handles: dict[str, Any] = {}
        for axes, quantity in zip(part.subplots(1, 3), quantities, strict=True):
            handles |= curves.draw_panel(axes, found, quantity)
            axes.set_xlabel(title)
            if not axes.lines:
                axes.set_axis_off()  # no costs without an environment
        part.legend(handles.values(), handles.keys(), loc="outside right center", fontsize="small", handlelength=3)
    return figure


def rate_per_window(run: dict[str, np.ndarray]) -> np.ndarray:
    """
    :return: middle of each window of the training, and the human's share of the steps in it; shape (n, 2)
    """
    steps, human = run[curves.HUMAN_STEPS].T
    ends = np.linspace(0, steps[-1], WINDOWS + 1)
    driven = np.interp(ends, np.append(0, steps), np.append(0, human))
    return np.column_stack([(ends[1:] + ends[:-1]) / 2, np.diff(driven) / np.diff(ends)])


def takeovers(methods: dict[str, Method], results: "Results") -> Figure | None:
    """A panel for each method: its own steps, and what the human drove of them in each part of the training."""
    names = [name for name in methods if not name.startswith("chac-")]
    guided = chosen(methods, names, curves.HUMAN_STEPS)
    if not guided:
        return None
    figure = Figure(figsize=(3.2 * len(guided), 3.4), layout="constrained")
    for number, (axes, method) in enumerate(
        zip(figure.subplots(1, len(guided), squeeze=False, sharey=True).flat, guided, strict=True)
    ):
        colour, _ = curves.style(number)
        rates = [rate_per_window(run) for run in method.runs]
        for rate in rates:
            axes.plot(*rate.T, color=colour, alpha=0.35, linewidth=1)
        axes.plot(*np.mean(rates, axis=0).T, color=colour, linewidth=2, marker="o", markersize=4)
        axes.set_title(method.label, fontsize="medium")
        axes.set(xlabel="environment steps", ylim=(0, 1.03), xlim=(0, None))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}K")
        axes.grid(alpha=0.25)
    figure.axes[0].set_ylabel("human's share of the steps")
    return figure


def ablation(methods: dict[str, Method], results: "Results") -> Figure | None:
    """A column for each quantity, a row for each variant beside C-HAC, so that no line hides another."""
    variants = [name for name in methods if name.startswith("chac-")]
    if not variants or "chac" not in methods:
        return None
    quantities = (curves.RETURN, curves.SUCCESS, curves.TRAINING_COST)
    figure = Figure(figsize=(12, 3.3 * len(variants)), layout="constrained")
    grid = figure.subplots(len(variants), 3, squeeze=False, sharex=True, sharey="col")
    for row, variant in zip(grid, variants, strict=True):
        pair = chosen(methods, ("chac", variant), curves.RETURN)
        for axes, quantity in zip(row, quantities, strict=True):
            handles = curves.draw_panel(axes, pair, quantity)
        row[0].legend(handles.values(), handles.keys(), fontsize="small", handlelength=3, loc="lower right")
    for axes in grid[-1]:
        axes.set_xlabel("environment steps")
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
