"""sb3-chac compare: methods and seeds in one figure and table; and the README's table, which comes from the same code."""

import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_chac.cli import compare
from sb3_chac.evaluation import curves
from sb3_chac.evaluation.curves import Method

ROOT = Path(__file__).parent.parent


def make_run(folder: Path, returns: list[float], human: bool = False, start: int = 0) -> str:
    """A run folder with an evaluation every 1000 steps."""
    folder.mkdir(parents=True)
    steps = start + 1000 * np.arange(1, len(returns) + 1)
    results = np.array(returns, float)[:, None] + [-1.0, 1.0]
    np.savez(folder / "evaluations.npz", timesteps=steps, results=results, successes=results > 5)
    lines = ["time/total_timesteps,safety/safety_cost,takeover/human_steps,chac/stage"]
    for number, step in enumerate(steps):
        lines.append(f"{step},{number},{100 * (number + 1) if human else ''},{1 + (number > 0) if human else ''}")
    (folder / "progress.csv").write_text("\n".join(lines) + "\n")
    return str(folder)


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    monkeypatch.setattr(curves, "RESAMPLES", 60)


@pytest.fixture
def runs(tmp_path):
    guided = [make_run(tmp_path / "chac" / f"SafeDrive-v0_{n}", [n, 10 + n, 20 + n, 30 + n], human=True) for n in (1, 2, 3)]
    return [*guided, make_run(tmp_path / "sac" / "SafeDrive-v0_1", [1, 2, 3, 4])]


def test_figures_and_tables(runs, tmp_path, capsys):
    outputs = [str(tmp_path / f"compare{suffix}") for suffix in (".png", ".svg", ".pdf")]
    tables = [str(tmp_path / name) for name in ("table.md", "table.tex")]
    compare.main([*runs, "--out", *outputs, "--table", *tables])
    printed = capsys.readouterr().out
    assert all(Path(file).stat().st_size > 1000 for file in outputs)
    svg = Path(outputs[1]).read_text(encoding="utf-8")
    assert svg.count("<!-- C-HAC (3 seeds) -->") == svg.count("<!-- SAC (1 seed) -->") == 1  # in the legend
    # The last three evaluations of the seeds have the means 21, 22, 23; the middle half of three values is the middle one
    row = next(line for line in Path(tables[0]).read_text(encoding="utf-8").splitlines() if line.startswith("| C-HAC | 3 "))
    assert re.match(r"\| C-HAC \| 3 \| 4,000 \| 22\.0 \[21\.\d, 2[23]\.\d\] \| 1\.00 \[1\.00, 1\.00\] \|", row)
    assert "| SAC | 1 | 4,000 | 3.0 | 0.00 |" in printed  # one seed, no interval
    assert "| C-HAC |  | 1.00 [1.00, 1.00] |" in printed and "| SAC | 0.00 [0.00, 0.00] |  |" in printed
    latex = Path(tables[1]).read_text(encoding="utf-8")
    assert latex.count(r"\begin{tabular}") == latex.count(r"\end{tabular}") == 3 and r"C-HAC & 3 & 4,000 & 22.0" in latex


def test_over_the_humans_steps(runs, tmp_path, capsys):
    compare.main([*runs, "--x", "human", "--out", str(tmp_path / "human.svg")])
    assert "SAC: no human drove" in capsys.readouterr().out
    svg = (tmp_path / "human.svg").read_text(encoding="utf-8")
    assert "steps driven by the human" in svg and "SAC" not in svg
    with pytest.raises(SystemExit):
        compare.main([runs[-1], "--x", "human", "--out", str(tmp_path / "none.png")])
    assert "no human drove in any" in capsys.readouterr().err


def test_labels_and_resumed_runs(tmp_path):
    first = make_run(tmp_path / "chac" / "Toy-v0_1", [1, 2, 3])
    second = make_run(tmp_path / "chac" / "Toy-v0_2", [7, 8], start=1500)
    (method,) = compare.read([f"anchor 5={first}+{second}"])
    assert method.title == "anchor 5" and method.label == "anchor 5 (1 seed)"
    assert method.runs[0]["return"].tolist() == [[1000, 1], [2000, 2], [2500, 7], [3500, 8]]


@pytest.mark.parametrize("names, message", [((0, 0), "named twice"), ((0, 4), "different environments"), ((5,), "no folder")])
def test_what_cannot_be_compared(runs, names, message, tmp_path, capsys):
    known = [*runs, make_run(tmp_path / "sac" / "Pendulum-v1_1", [1]), str(tmp_path / "nowhere")]
    with pytest.raises(SystemExit):
        compare.main([known[number] for number in names])
    assert message in capsys.readouterr().err


def test_stage_1_is_joined_to_stage_2():
    def run(*points):
        return {"return": np.array(points, float), curves.STAGE: np.array([(x, 2 if x > 2 else 1) for x, _ in points], float)}

    joined = curves.join_curves(run((1, 10), (2, 20), (3, 99)), run((3, 30), (4, 40)))
    assert joined["return"].tolist() == [[1, 10], [2, 20], [3, 30], [4, 40]]
    assert joined[curves.STAGE][:, 1].tolist() == [1, 1, 2, 2]


def test_mean_over_the_steps_that_all_seeds_have():
    short, long = np.array([[0.0, 0.0], [10.0, 10.0]]), np.array([[0.0, 2.0], [5.0, 7.0], [20.0, 22.0]])
    steps, means, low, high = curves.mean_and_interval([short, long])
    assert steps.tolist() == [0, 5, 10] and means.tolist() == [1, 6, 11]
    assert low.tolist() == [0, 5, 10] and high.tolist() == [2, 7, 12]


def test_interquartile_mean_and_probability_of_improvement():
    values = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1000.0])
    score = curves.interquartile_mean(values)
    assert score.value == 3.5 and score.low <= 3.5 <= score.high
    assert curves.interquartile_mean(values[:1]).text(1) == "0.0" and curves.interquartile_mean(values[:0]) is None
    probability = curves.probability_of_improvement(np.array([1.0, 3.0]), np.array([2.0, 3.0]))
    assert probability.value == (0 + 0 + 1 + 0.5) / 4
    assert math.isnan(curves.probability_of_improvement(values[:1], values[1:2]).low)
    state = np.random.get_state()[1].tolist()
    curves.interquartile_mean(values)
    assert np.random.get_state()[1].tolist() == state  # rliable draws from the global generator


def test_no_two_methods_look_alike():
    assert len({curves.style(number) for number in range(32)}) == 32
    figure = curves.draw([Method(str(n), [{"return": np.array([[0.0, n], [1.0, n]])}]) for n in range(13)], ["return"])
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [f"{n} (1 seed)" for n in range(13)]


def test_every_table_is_that_of_the_csvs(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import tables

    monkeypatch.delitem(sys.modules, "tables")
    shown = set()
    for page in tables.pages():
        text = page.read_text(encoding="utf-8")
        assert text == tables.fill(text), f"{page.name}: run benchmarks/tables.py"
        shown |= {match[1] for match in tables.MARK.findall(text)}
    assert shown == set(tables.TABLES)
    changed = tables.README.read_text(encoding="utf-8").replace("| 0.58 ", "| 0.59 ")
    assert tables.fill(changed) != changed
    assert len(tables.README.read_text(encoding="utf-8").splitlines()) <= 150
