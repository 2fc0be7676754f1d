"""Stable-Baselines3's own test suite, asked of all eleven algorithms, each in the role of its nearest relative.

    python benchmarks/sb3_suite.py                       # all, ten minutes of one core
    python benchmarks/sb3_suite.py --only PVP GAIL       # the others' rows stay

The tests are those in the source distribution of the installed version. Results go to benchmarks/results/sb3-suite: a row a
test in tests.csv, and table.md. What cannot apply is listed there with its reason, from tests/sb3_suite_roles.py.
"""

import argparse
import csv
import io
import os
import subprocess
import sys
import tarfile
import tempfile
from collections import Counter
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results" / "sb3-suite"
OUTCOMES = ("passed", "failed", "not applicable")

sys.path.insert(0, str(ROOT / "tests"))
from sb3_suite_roles import LEFT_OUT, ROLES  # noqa: E402


def fetch(folder: Path) -> Path:
    """
    :param folder: for SB3's sources
    :return: a folder that holds nothing but its tests, away from its sources and settings
    """
    requirement = f"stable-baselines3=={version('stable-baselines3')}"
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", ":all:", requirement]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    with tarfile.open(next(folder.glob("*.tar.gz"))) as sdist:
        sdist.extractall(folder, filter="data")
    (folder / "run").mkdir()
    next(folder.glob("*/tests")).rename(folder / "run" / "tests")
    return folder / "run"


def groups(names: list[str]) -> list[list[str]]:
    """
    :return: algorithms that can be tested in one process: of different roles
    """
    found: list[list[str]] = []
    for name in names:
        free = [group for group in found if ROLES[name] not in {ROLES[other] for other in group}]
        if free:
            free[0].append(name)
        else:
            found.append([name])
    return found


def run(suite: Path, names: list[str], selection: list[str] | None = None) -> tuple[list[list[str]], str]:
    """
    :param suite: folder that holds SB3's tests
    :param names: of algorithms of different roles
    :param selection: more arguments for pytest, which tests to run
    :return: algorithm, test, outcome and reason of each test, and what pytest printed
    """
    report = suite / f"{'-'.join(names)}.csv"
    report.unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "sb3_suite_plugin", "-p", "no:cacheprovider", "--tb=short"]
    command += [*(f"--ignore={name}" for name in LEFT_OUT), *(selection or ["tests"])]
    paths = os.pathsep.join(map(str, [ROOT / "tests", ROOT]))  # of this checkout, wherever the installation points
    env = {**os.environ, "PYTHONPATH": paths, "SB3_SUITE": ",".join(names), "SB3_SUITE_REPORT": str(report)}
    ran = subprocess.run(command, cwd=suite, env=env, capture_output=True, text=True, check=False)
    if not report.is_file():
        return [], ran.stdout + ran.stderr
    with report.open(newline="") as file:
        return list(csv.reader(file)), ran.stdout + ran.stderr


def table(rows: list[list[str]]) -> str:
    """
    :param rows: see ``run``
    :return: in Markdown
    """
    lines = ["| algorithm | in the role of | passed | failed | not applicable |", "|---|---|---|---|---|"]
    total: Counter[str] = Counter()
    for name, role in ROLES.items():
        counts = Counter(outcome for algorithm, _, outcome, _ in rows if algorithm == name)
        total += counts
        if counts:
            lines.append(f"| {name} | {role} | " + " | ".join(str(counts[outcome]) for outcome in OUTCOMES) + " |")
    lines += ["| all | | " + " | ".join(str(total[outcome]) for outcome in OUTCOMES) + " |", ""]
    lines += ["Not applicable, and why:", "", "| algorithm | tests | reason |", "|---|---|---|"]
    reasons = Counter((algorithm, why) for algorithm, _, outcome, why in rows if outcome == "not applicable")
    lines += [f"| {algorithm} | {number} | {why} |" for (algorithm, why), number in sorted(reasons.items())]
    lines += [f"| all | {file} | {why} |" for file, why in LEFT_OUT.items()]
    packages = ("stable-baselines3", "gymnasium", "torch", "numpy")
    lines += ["", f"Python {sys.version.split()[0]}, {', '.join(f'{name} {version(name)}' for name in packages)}.", ""]
    return "\n".join(lines)


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=ROLES, default=list(ROLES), metavar="NAME", help="algorithms (all)")
    args = parser.parse_args(arguments)
    with (RESULTS / "tests.csv").open(newline="") if (RESULTS / "tests.csv").is_file() else io.StringIO() as file:
        rows = [row for row in csv.reader(file) if row[0] in ROLES and row[0] not in args.only]
    with tempfile.TemporaryDirectory() as work:
        suite = fetch(Path(work))
        for names in groups(args.only):
            found, printed = run(suite, names)
            if not found or any(row[2] == "failed" for row in found):
                print(printed[-20000:])
            rows += found
    RESULTS.mkdir(parents=True, exist_ok=True)
    with (RESULTS / "tests.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["algorithm", "test", "outcome", "reason"])
        writer.writerows(rows)
    (RESULTS / "table.md").write_text(table(rows))
    print(table(rows))
    sys.exit(not rows or any(row[2] == "failed" for row in rows))


if __name__ == "__main__":
    main(sys.argv[1:])
