"""The tables of README and documentation, and the README's picture, from the committed CSVs alone.

    python benchmarks/tables.py            # writes each table between its markers, and docs/headline.png
    python benchmarks/tables.py --check    # says which pages do not show what the CSVs hold

``TABLES`` names them; one stands between ``<!-- table NAME: made by benchmarks/tables.py -->`` and ``<!-- end of table -->``.

In the README's table, of each method the runs with corridors in the observation (results/guidance/) count, and those without
them (results/guidance-without-corridors/) as long as there are none. A run is left out while it is shorter than half of the
longest one of its method; the figures are those at the step that all others have reached, means of the last three evaluations.
"""

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from guidance_curves import COLUMNS, load_run
from lab import read

from sb3_chac.evaluation import curves
from sb3_chac.evaluation.curves import Curves, Method

HERE = Path(__file__).parent
ROOT, RESULTS = HERE.parent, HERE / "results"
README, PICTURE = ROOT / "README.md", ROOT / "docs" / "headline.png"
WITH, WITHOUT = RESULTS / "guidance", RESULTS / "guidance-without-corridors"
LIMITED = RESULTS / "guidance-max-deviation"
METADRIVE = RESULTS / "guidance-metadrive-without-corridors"
MARK = re.compile(r"(<!-- table (\S+): made by benchmarks/tables\.py -->\n)(?:(?!<!-- ).)*(<!-- end of table -->)", re.DOTALL)
METHODS = {"sac": "SAC", "dsac": "DSAC", "pvp": "PVP", "dpvp": "D-PVP", "chac": "C-HAC"}
STAGE_1 = {"chac": "chac-stage-1"}  # the method whose runs it goes on from
GUIDED = {
    "sac": "SAC",
    "dsac": "DSAC",
    "pvp": "PVP",
    "dpvp": "D-PVP, on its own",
    "dpvp-1k": "D-PVP, at most 1K human steps",
    "dpvp-2k": "D-PVP, at most 2K human steps",
    "chac-stage-1": "D-PVP as C-HAC's stage 1",
    "chac": "C-HAC",
}
ABLATIONS = {
    "chac": "C-HAC",
    "chac-no-confidence": "No Confidence (`delta=0.5`)",
    "chac-no-share": "No Share (`shared_control=False`)",
}
PAPER = {
    "pvp": "338, .90, .81",
    "dpvp": "353, .31, .83",
    "chac": "393, .16, .91",
    "sac": "359, 1.00, .74",
    "dsac": "349, .47, .77",
}


def spread(values: np.ndarray | Sequence[float], digits: int) -> str:
    """
    :return: mean ± standard deviation over seeds
    """
    return f"{np.mean(values):.{digits}f}" + (f" ± {np.std(values, ddof=1):.{digits}f}" if len(values) > 1 else "")


def files(folder: Path, name: str) -> list[Path]:
    """
    :return: CSVs of a method, by seed
    """
    paths = [path for path in folder.glob("*.csv") if re.fullmatch(rf"{name}-\d+", path.stem)]
    return sorted(paths, key=lambda path: int(path.stem.rpartition("-")[2]))


def thousands(steps: float) -> str:
    return f"{steps / 1000:.0f}K"


# The README's


def load(folder: Path, name: str) -> tuple[list[Curves], int]:
    """
    :param name: of a method in guidance.py
    :return: its runs, cut where the shortest of them ends, stage 1 before stage 2; and the number of maps of an evaluation
    """
    paths = files(folder, name)
    seeds = [int(path.stem.rpartition("-")[2]) for path in paths]
    runs = [load_run(folder, name, seed, STAGE_1.get(name)) for seed in seeds]
    maps = int(read(paths[0])[-1]["episodes"]) if paths else 0
    ends = [run[curves.RETURN][-1, 0] for run in runs]
    runs = [run for run, end in zip(runs, ends, strict=True) if end >= max(ends) / 2]
    end = min((run[curves.RETURN][-1, 0] for run in runs), default=0)
    return [{key: curve[curve[:, 0] <= end] for key, curve in run.items()} for run in runs], maps


def collect(with_corridors: Path = WITH, without: Path = WITHOUT) -> list[tuple[Method, int, bool]]:
    """
    :return: method, maps of an evaluation, and whether its observation has corridors
    """
    result = []
    for name, title in METHODS.items():
        for folder in (with_corridors, without):
            runs, maps = load(folder, name)
            if runs:
                result.append((Method(title, runs), maps, folder == with_corridors))
                break
    return result


def headline() -> str:
    rows = [["", "seeds", "steps", "human steps", "success", "cost", "return", "collisions in training"]]
    collected = collect()
    for method, _, has_corridors in collected:
        values = {name: curves.finals(method, name) for name in COLUMNS.values()}
        link = {"C-HAC": "chac", "D-PVP": "dpvp", "PVP": "pvp", "DSAC": "dsac"}.get(method.title)
        title = f"[{method.title}](docs/modules/{link}.md)" if link else method.title
        rows.append(
            [
                title + ("" if has_corridors else " ¹"),
                str(len(method.runs)),
                thousands(method.runs[0][curves.RETURN][-1, 0]),
                f"{values[curves.HUMAN_STEPS].mean():,.0f}",
                spread(values[curves.SUCCESS], 2),
                spread(values[curves.COST], 2),
                spread(values[curves.RETURN], 0),
                f"{values[curves.TRAINING_COST].mean():,.0f}",
            ]
        )
    maps = {has_corridors: number for _, number, has_corridors in collected}
    notes = [
        f"On {maps.get(True, maps.get(False))} maps that none of them has seen, without the human, mean ± standard deviation "
        "over seeds of the last three evaluations. Cost: collisions per episode."
    ]
    if False in maps and True in maps:
        notes.append(
            f"¹ With an observation that lacks [corridors](docs/envs/safedrive.md), on {maps[False]} maps: made before they "
            "were there, so compare with care; with the same observation D-PVP and C-HAC have a cost above 1 "
            "([all figures](docs/benchmarks/guidance.md))."
        )
    return curves.markdown(rows) + "\n\n" + " ".join(notes)


def picture() -> None:
    """Draw the README's picture."""
    methods = [Method(method.title + ("" if has else " ¹"), method.runs) for method, _, has in collect()]
    figure = curves.draw(methods, (curves.SUCCESS, curves.COST, curves.TRAINING_COST), width=3.4)
    figure.axes[1].set_ylim(0, 4)
    figure.axes[2].set_yscale("symlog", linthresh=10)
    figure.savefig(PICTURE, dpi=100)


# What guidance is worth


def guidance(folder: Path, paper: bool = False) -> str:
    """
    :param paper: whether the paper's figures stand beside ours
    :return: a row for each method, means of the last three evaluations that all its seeds have
    """
    rows = [["method", "seeds", "steps", "human steps", "return", "cost", "success", "training cost"]]
    rows[0] += ["paper: return, cost, success"] * paper
    for name, title in GUIDED.items():
        runs = [read(path) for path in files(folder, name)]
        if not runs:
            continue
        runs = [run[: min(map(len, runs))] for run in runs]
        last = {key: [np.mean([float(row[key]) for row in run[-3:]]) for run in runs] for key in COLUMNS}
        whole = {key: f"{np.mean([float(run[-1][key]) for run in runs]):.0f}" for key in ("human_steps", "training_cost")}
        row = [title, str(len(runs)), thousands(float(runs[0][-1]["step"])), whole["human_steps"]]
        row += [spread(last["return_mean"], 0), spread(last["cost_mean"], 2), spread(last["success_rate"], 2)]
        rows.append([*row, whole["training_cost"], *([PAPER.get(name, "")] * paper)])
    return curves.markdown(rows)


def seeds(folder: Path = WITH) -> str:
    """
    :return: a row for each run, with its last three evaluations one by one
    """
    rows = [["method", "seed", "steps", "human steps", "return", "cost", "success", "training cost"]]
    for name, title in GUIDED.items():
        for path in files(folder, name):
            last = read(path)[-3:]
            texts = [
                " / ".join(f"{float(row[key]):.{digits}f}" for row in last)
                for key, digits in (("return_mean", 1), ("cost_mean", 2), ("success_rate", 2))
            ]
            steps = " / ".join(thousands(float(row["step"])) for row in last)
            cost = last[-1]["training_cost"]
            rows.append([title, path.stem.rpartition("-")[2], steps, last[-1]["human_steps"], *texts, cost])
    return curves.markdown(rows)


def second_stage(folder: Path = WITH) -> str:
    """
    :return: a row for each run of C-HAC: the end of stage 1 and each evaluation of stage 2
    """
    runs = [[read(folder / path.name.replace("chac", "chac-stage-1"))[-1], *read(path)] for path in files(folder, "chac")]
    steps = [thousands(float(row["step"])) for row in max(runs, key=len, default=[])]
    rows = [["seed", *(step + " (stage 1)" * (idx == 0) for idx, step in enumerate(steps)), "collisions in stage 2"]]
    for run in runs:
        cells = [f"{float(r['cost_mean']):.2f}, {float(r['success_rate']):.3f}, {float(r['return_mean']):.1f}" for r in run]
        collisions = str(int(run[-1]["training_cost"]) - int(run[0]["training_cost"]))
        rows.append([run[0]["seed"], *cells, *[""] * (len(steps) - len(cells)), collisions])
    return curves.markdown(rows)


def ablations(folder: Path = WITHOUT, after: int = 50_000) -> str:
    """
    :param after: steps of stage 2 that are looked at
    :return: what the switch to stage 2 costs (the paper's Figure 8)
    """
    rows = [["", "seeds", "lowest return", "drop", "lowest success", "training cost since the switch"]]
    for name, title in ABLATIONS.items():
        values = []
        for path in files(folder, name):
            start = read(folder / f"chac-stage-1-{path.stem.rpartition('-')[2]}.csv")[-1]
            run = [row for row in read(path) if int(row["step"]) <= int(start["step"]) + after]
            lowest = min(float(row["return_mean"]) for row in run)
            success = min(float(row["success_rate"]) for row in run)
            cost = float(run[-1]["training_cost"]) - float(start["training_cost"])
            values.append((lowest, 1 - lowest / float(start["return_mean"]), success, cost))
        if values:
            lowest, drop, success, cost = zip(*values, strict=True)
            cells = [spread(lowest, 0), f"{np.mean(drop):.1%}", spread(success, 2), spread(cost, 0)]
            rows.append([title, str(len(values)), *cells])
    return curves.markdown(rows)


# The driving task


def drivers() -> str:
    names = {
        "scripted-ideal": "`scripted-ideal`",
        "scripted": "`scripted`",
        "blind": "blind lane follower",
        "random": "random actions",
    }
    rows = [["driver", "return", "cost", "success", "steps"]]
    found = read(RESULTS / "safedrive" / "drivers.csv")
    for name, title in names.items():
        means = {
            key: np.mean([float(row[key]) for row in found if row["driver"] == name])
            for key in ("return", "cost", "success", "steps")
        }
        rows.append(
            [title, f"{means['return']:.1f}", f"{means['cost']:.2f}", f"{means['success']:.3f}", f"{means['steps']:.0f}"]
        )
    return curves.markdown(rows)


def takeovers() -> str:
    names = {"scripted-ideal": "`scripted-ideal`", "scripted": "`scripted`", "noise 0.6": "the driver with noise of 0.6"}
    rows = [["novice", "alone: success", "alone: cost", "with the human: success", "cost", "steps driven by the human"]]
    found = read(RESULTS / "safedrive" / "takeovers.csv")
    for name in dict.fromkeys(row["novice"] for row in found):
        cells = []
        for armed in ("0", "1"):
            here = [row for row in found if row["novice"] == name and row["armed"] == armed]
            cells += [f"{np.mean([float(row[key]) for row in here]):.2f}" for key in ("success", "cost")]
        share = sum(int(row["human_steps"]) for row in here) / sum(int(row["steps"]) for row in here)
        rows.append([names.get(name, name), *cells, f"{100 * share:.0f} %"])
    return curves.markdown(rows)


# Single algorithms


def learning() -> str:
    rows = [["environment", "steps", "DSAC", "SAC", "TQC"]]
    for env_id in ("Pendulum-v1", "HalfCheetah-v5", "Hopper-v5"):
        cells, steps = [], 0.0
        for algo in ("dsac", "sac", "tqc"):
            runs = [read(path) for path in files(RESULTS / "learning" / env_id, algo)]
            cells.append(spread([np.mean([float(row["return_mean"]) for row in run[-3:]]) for run in runs], 0))
            steps = float(runs[0][-1]["step"])
        rows.append([env_id, thousands(steps), *cells])
    return curves.markdown(rows)


def speed() -> str:
    names = {
        "dsac_relu_delay1": "DSAC, `policy_delay=1`, ReLU as SAC",
        "dsac_gelu_delay1": "DSAC, `policy_delay=1`",
        "dsac_gelu_delay2": "DSAC, `policy_delay=2` (default)",
        "dpvp_gelu_delay1": "D-PVP, `policy_delay=1`",
        "chac_gelu_delay1": "C-HAC, stage 1, `policy_delay=1`",
        "chac_gelu_delay1_stage2": "C-HAC, stage 2, `policy_delay=1`",
    }
    processors = {"speed": "AMD Zen 5", "speed-epyc": "AMD EPYC", "speed-xeon": "Intel Xeon (AMX)"}
    found = {name: [row for row in read(RESULTS / f"{name}.csv") if row["obs_dim"] == "259"] for name in processors}
    columns = [(name, "") for name in processors] + [("speed-xeon", "_bf16")]
    rows = [["", *processors.values(), "Intel Xeon (AMX), bfloat16"]]
    for variant, title in names.items():
        cells = []
        for name, suffix in columns:
            key = "{}_steps_per_cpu_second"
            here = [row for row in found[name] if row.get(key.format(variant + suffix))]
            ratios = [float(row[key.format(variant + suffix)]) / float(row[key.format("sac_relu")]) for row in here]
            cells.append(f"{np.median(ratios):.2f}x" if ratios else "")
        rows.append([title, *cells])
    return curves.markdown(rows)


def lagrangian() -> str:
    rows = [["method", "steps", "training episodes: return", "cost", "deterministic: return", "cost"]]
    for name, title in {"sac": "SAC", "sac_lag": "SAC-Lag", "ppo": "PPO", "ppo_lag": "PPO-Lag"}.items():
        runs = [read(path) for path in files(RESULTS / "lagrangian", name)]
        cells = [
            spread([np.mean([float(row[key]) for row in run[-3:]]) for run in runs], 0)
            for key in ("return", "cost", "evaluation_return", "evaluation_cost")
        ]
        rows.append([title, thousands(float(runs[0][-1]["step"])), *cells])
    return curves.markdown(rows)


def rounds() -> str:
    rows = [["human steps", "HG-DAgger: success", "cost", "IWR: success", "cost"]]
    runs = {algo: [read(path) for path in files(RESULTS / "imitation", algo)] for algo in ("hg_dagger", "iwr")}
    for number in range(len(runs["iwr"][0])):
        cells = [
            spread([float(run[number][key]) for run in runs[algo]], 2)
            for algo in runs
            for key in ("success_rate", "cost_mean")
        ]
        steps = float(runs["iwr"][0][number]["human_steps"])
        rows.append([thousands(steps) + (" (warm-up)" if number == 0 else ""), *cells])
    return curves.markdown(rows)


def beyond(folder: Path = RESULTS / "beyond") -> str:
    rows = [["seed", "human", "end of stage 1", "end of stage 2", "best of stage 2", "steps of the human"]]
    for path in sorted(folder.glob("[0-9]*.csv")):
        found = read(path)
        returns = {
            who: [float(row["return_mean"]) for row in found if row["who"] == who] for who in ("human", "stage 1", "stage 2")
        }
        ends = [returns["human"][-1], returns["stage 1"][-1], np.mean(returns["stage 2"][-3:]), max(returns["stage 2"])]
        rows.append([path.stem, *(f"{value:.0f}" for value in ends), found[-1]["human_steps"]])
    return curves.markdown(rows)


TABLES: dict[str, Callable[[], str]] = {
    "headline": headline,
    "guidance": partial(guidance, WITH),
    "guidance-seeds": seeds,
    "second-stage": second_stage,
    "second-stage-limited": partial(second_stage, LIMITED),
    "guidance-without-corridors": partial(guidance, WITHOUT),
    "ablations": ablations,
    "metadrive-without-corridors": partial(guidance, METADRIVE, paper=True),
    "safedrive-drivers": drivers,
    "safedrive-takeovers": takeovers,
    "learning": learning,
    "speed": speed,
    "lagrangian": lagrangian,
    "rounds": rounds,
}


def pages() -> list[Path]:
    """
    :return: where tables may stand
    """
    return [README, *(path for path in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in path.parts)]


def fill(text: str) -> str:
    """
    :param text: of a page
    :return: with the tables of today between their markers
    :raises KeyError: for a table that ``TABLES`` does not name
    """
    return MARK.sub(lambda match: match[1] + TABLES[match[2]]() + "\n" + match[3], text)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, exit 1 if a page shows another table")
    arguments = parser.parse_args()
    differ = [page for page in pages() if fill(page.read_text(encoding="utf-8")) != page.read_text(encoding="utf-8")]
    names = ", ".join(str(page.relative_to(ROOT)) for page in differ)
    if arguments.check:
        sys.exit(f"Not what the CSVs hold: {names}. Run benchmarks/tables.py." if differ else 0)
    for page in differ:
        page.write_text(fill(page.read_text(encoding="utf-8")), encoding="utf-8")
    picture()
    print(f"Written: {names or 'nothing new'}, and {PICTURE.relative_to(ROOT)}")
