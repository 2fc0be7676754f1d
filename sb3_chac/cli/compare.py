"""``python -m sb3_chac compare``: several runs in one figure and in one table."""

import argparse
import re
from pathlib import Path

from sb3_chac.cli.arguments import check_output
from sb3_chac.cli.command import command_parser, run_command
from sb3_chac.cli.plot import NotPlottable, join
from sb3_chac.evaluation import curves
from sb3_chac.evaluation.curves import Method
from sb3_chac.evaluation.episodes import NotEvaluable
from sb3_chac.evaluation.pictures import PLOT_SUFFIXES

DESCRIPTION = """Compare runs of 'rl_zoo3 train': learning curves (mean over seeds, shaded its 95 % bootstrap interval) in one
figure; interquartile means and the probability of improvement, with 95 % bootstrap intervals (rliable), in one table. The
score of a run is the mean of its last three evaluations.

  sb3-chac compare logs/chac/SafeDrive-v0_1 logs/chac/SafeDrive-v0_2 logs/sac/SafeDrive-v0_1
  sb3-chac compare logs/*/SafeDrive-v0_* --x human --out human.pdf --table table.tex
  sb3-chac compare "anchor 5=logs/chac/SafeDrive-v0_3" "anchor 15=logs/chac/SafeDrive-v0_4+logs/chac/SafeDrive-v0_5"

Runs with the same label are seeds of one method. Without LABEL= it is the algorithm's name, from the folder. FOLDER+FOLDER is
a run and the one that resumed it. Both stages of C-HAC are one curve, a diamond marks the switch."""

NAMES = {
    "sac": "SAC", "ppo": "PPO", "td3": "TD3", "tqc": "TQC", "dsac": "DSAC", "pvp": "PVP", "dpvp": "D-PVP", "chac": "C-HAC",
    "sac_lag": "SAC-Lag", "ppo_lag": "PPO-Lag", "bc": "BC", "cql": "CQL", "gail": "GAIL",
    "hg_dagger": "HG-DAgger", "iwr": "IWR",
}  # fmt: skip
TABLE_SUFFIXES = (".md", ".tex")
QUANTITIES = (curves.RETURN, curves.SUCCESS, curves.TRAINING_COST, curves.HUMAN_STEPS)


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = command_parser("compare", DESCRIPTION)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="[LABEL=]FOLDER[+FOLDER ...]")
    parser.add_argument(
        "--x",
        choices=("steps", "human"),
        default="steps",
        help="environment steps, or the human's (%(default)s)",
    )
    parser.add_argument(
        "--out", nargs="+", type=Path, default=[Path("compare.png")], metavar="FILE", help=".png, .svg or .pdf (compare.png)"
    )
    parser.add_argument("--table", nargs="+", type=Path, default=[], metavar="FILE", help="the tables, .md or .tex (LaTeX)")
    return parser


def main(arguments: list[str]) -> None:
    """
    Run the command.

    :param arguments: of the command line, after ``compare``
    """
    run_command(make_parser(), arguments, run, NotEvaluable)


def run(args: argparse.Namespace) -> None:
    """
    Compare runs.

    :param args: see ``make_parser``
    :raises FileNotFoundError: if a run, or the folder of an output file, does not exist
    :raises NotEvaluable: for whatever else does not fit
    """
    for option, files, suffixes in (("--out", args.out, PLOT_SUFFIXES), ("--table", args.table, TABLE_SUFFIXES)):
        for file in files:
            check_output(option, file, suffixes)
    methods = read(args.runs)
    if args.x == "human":
        methods = with_human(methods)
    write(methods, args)


def read(runs: list[str]) -> list[Method]:
    """
    Read the runs of the command line.

    :param runs: see ``DESCRIPTION``
    :return: in the order in which their labels come first
    :raises FileNotFoundError: if a folder does not exist
    :raises NotPlottable: for folders without curves, a run that is named twice, or runs in different environments
    """
    methods: dict[str, Method] = {}
    seen: set[tuple[Path, ...]] = set()
    environments: dict[str, str] = {}
    for run in runs:
        label, folders = parse(run)
        key = tuple(folder.resolve() for folder in folders)
        if key in seen:
            raise NotPlottable(f"{run} is named twice: one run would count as two seeds.")
        seen.add(key)
        match = re.fullmatch(r"(.+)_\d+", folders[-1].resolve().name)
        if match:
            environments[match[1]] = run
        found = {name: curve[:, :2] for name, curve in join(folders).items()}
        methods.setdefault(label, Method(label, [])).runs.append(found)
    if len(environments) > 1:
        raise NotPlottable(f"runs in different environments cannot be compared: {', '.join(environments.values())}.")
    return list(methods.values())


def parse(run: str) -> tuple[str, list[Path]]:
    """
    Parse a run of the command line.

    :param run: [LABEL=]FOLDER[+FOLDER ...]; a folder of this name goes first, whatever is in its name
    :return: label and folders
    """
    label, equals, rest = run.partition("=")
    if not equals or Path(run).is_dir():
        label, rest = "", run
    folders = [Path(rest)] if Path(rest).is_dir() else [Path(part) for part in rest.split("+")]
    algo = folders[-1].resolve().parent.name
    return label or NAMES.get(algo, algo), folders


def with_human(methods: list[Method]) -> list[Method]:
    """
    Select the methods that a human helped.

    :raises NotPlottable: if there is none
    """
    helped = [method for method in methods if any(curves.over_human_steps(run) for run in method.runs)]
    for method in methods:
        if method not in helped:
            print(f"{method.title}: no human drove, so it has no curve over the human's steps.")
    if not helped:
        raise NotPlottable("--x human: no human drove in any of these runs.")
    return helped


def write(methods: list[Method], args: argparse.Namespace) -> None:
    """
    Write the pictures and tables.

    :param args: see ``make_parser``
    """
    figure = curves.draw(methods, QUANTITIES, over_human=args.x == "human")
    for file in args.out:
        figure.savefig(file, dpi=150)
    tables = [curves.summary(methods)]
    if len(methods) > 1:
        tables += [
            curves.improvements(methods, quantity)
            for quantity in (curves.RETURN, curves.SUCCESS)
            if all(len(curves.finals(method, quantity)) for method in methods)
        ]
    for file in args.table:
        to_text = curves.latex if file.suffix == ".tex" else curves.markdown
        file.write_text("\n\n".join(map(to_text, tables)) + "\n", encoding="utf-8")
    print("\n\n".join(map(curves.markdown, tables)))
    print("Interquartile means [95 % bootstrap interval]; a single seed has none.")
    for file in (*args.out, *args.table):
        print(f"Saved {file}")
