"""The table and the picture of the README: what guidance is worth on SafeDrive-v0, from the CSVs of guidance.py alone.

    python benchmarks/headline.py            # writes the table between the README's markers, and docs/headline.png
    python benchmarks/headline.py --check    # says whether the README's table is that of the CSVs

Of each method, the runs with corridors in the observation (results/guidance/) count, and those without them
(results/guidance-without-corridors/) as long as there are none. A run is left out while it is shorter than half of the longest
one of its method; the figures are those at the step that all others have reached, means of the last three evaluations.
"""

import argparse
import re
import sys
from pathlib import Path

import numpy as np
from guidance_curves import COLUMNS, load_run, read

from sb3_chac.evaluation import curves
from sb3_chac.evaluation.curves import Curves, Method

HERE = Path(__file__).parent
README, PICTURE = HERE.parent / "README.md", HERE.parent / "docs" / "headline.png"
WITH, WITHOUT = HERE / "results" / "guidance", HERE / "results" / "guidance-without-corridors"
BEGIN, END = "<!-- headline: made by benchmarks/headline.py -->", "<!-- end of headline -->"
METHODS = {"sac": "SAC", "dsac": "DSAC", "pvp": "PVP", "dpvp": "D-PVP", "chac": "C-HAC"}
STAGE_1 = {"chac": "chac-stage-1"}  # the method whose runs it goes on from


def load(folder: Path, name: str) -> tuple[list[Curves], int]:
    """
    :param name: of a method in guidance.py
    :return: its runs, cut where the shortest of them ends, stage 1 before stage 2; and the number of maps of an evaluation
    """
    paths = [path for path in folder.glob("*.csv") if re.fullmatch(rf"{name}-\d+", path.stem)]
    seeds = sorted(int(path.stem.rpartition("-")[2]) for path in paths)
    runs = [load_run(folder, name, seed, STAGE_1.get(name)) for seed in seeds]
    maps = int(read(paths[0])[-1]["episodes"]) if paths else 0
    ends = [run[curves.RETURN][-1, 0] for run in runs]
    runs = [run for run, end in zip(runs, ends, strict=True) if end >= max(ends) / 2]
    end = min((run[curves.RETURN][-1, 0] for run in runs), default=0)
    return [{key: curve[curve[:, 0] <= end] for key, curve in run.items()} for run in runs], maps


def spread(values: np.ndarray, digits: int) -> str:
    """
    :return: mean ± standard deviation over seeds
    """
    return f"{values.mean():.{digits}f}" + (f" ± {values.std(ddof=1):.{digits}f}" if len(values) > 1 else "")


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


def table(collected: list[tuple[Method, int, bool]]) -> str:
    rows = [["", "seeds", "steps", "human steps", "success", "cost", "return", "collisions in training"]]
    for method, _, has_corridors in collected:
        values = {name: curves.finals(method, name) for name in COLUMNS.values()}
        steps = method.runs[0][curves.RETURN][-1, 0]
        link = {"C-HAC": "chac", "D-PVP": "dpvp", "PVP": "pvp", "DSAC": "dsac"}.get(method.title)
        title = f"[{method.title}](docs/modules/{link}.md)" if link else method.title
        rows.append(
            [
                title + ("" if has_corridors else " ¹"),
                str(len(method.runs)),
                f"{steps / 1000:.0f}K",
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


def insert(text: str, content: str) -> str:
    """
    :param text: of the README
    :return: with ``content`` between the markers
    """
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{content}\n{END}{after}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, exit 1 if the README's table is another one")
    arguments = parser.parse_args()
    collected = collect()
    old = README.read_text(encoding="utf-8")
    new = insert(old, table(collected))
    if arguments.check:
        sys.exit("README.md: the table is not that of the CSVs, run benchmarks/headline.py." if new != old else 0)
    README.write_text(new, encoding="utf-8")
    methods = [Method(method.title + ("" if has_corridors else " ¹"), method.runs) for method, _, has_corridors in collected]
    figure = curves.draw(methods, (curves.SUCCESS, curves.COST, curves.TRAINING_COST), width=3.4)
    figure.axes[1].set_ylim(0, 4)
    figure.axes[2].set_yscale("symlog", linthresh=10)
    figure.savefig(PICTURE, dpi=100)
    print(table(collected))
