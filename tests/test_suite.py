"""The benchmark suite: what it runs, what it keeps, and what it does when something is in its way."""

import csv
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from shell import FOREVER, wait_until

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import lab  # noqa: E402
import suite  # noqa: E402
import suite_job  # noqa: E402
import suite_report  # noqa: E402
from suite_job import Job, Outcome  # noqa: E402

from sb3_chac.common.checkpoint_files import newest_checkpoint, sound_checkpoint  # noqa: E402
from sb3_chac.evaluation import curves  # noqa: E402

ROWS = {row.name: row for row in suite.ROWS}


def a_job(name: str = "dpvp", seed: int = 0, scale: float = 0.1) -> Job:
    return Job(ROWS[name], "SafeDrive-v0", seed, scale, seed == 0)


def outcome(job: Job, success: bool = True) -> Outcome:
    facts = {"human_steps": 10, "total_steps": 100, "training_cost": 3.0, "fingerprint": suite_job.fingerprint(job)}
    record = {"method": job.row.name, "seed": job.seed, "return": 300.0 + job.seed, "cost": 0.5, "success": success}
    episodes = [record | {"scenario": number} | facts | {"versions": "x=1"} for number in suite_job.TEST_MAPS]
    points = [
        {"method": job.row.name, "seed": job.seed, "quantity": quantity, "step": step, "value": step / 10}
        for quantity in suite_job.CURVES
        for step in (10, 50, 100)
    ]
    drive = {"method": job.row.name, "seed": job.seed, "x": 1.0, "y": 2.0, "action_0": 0.1, "action_1": -0.2, "cost": 0}
    drives = [drive | {"scenario": number, "step": step} for number in suite_job.DRIVES for step in range(5)]
    files = {"episodes": lab.to_csv(episodes), "curves": lab.to_csv(points)}
    return Outcome(files | ({"drives": lab.to_csv(drives)} if job.keeps_drives else {}), b"model")


# suite.py with fewer and shorter evaluations
QUICK = f"""
import runpy, sys
sys.path.insert(0, {str(BENCHMARKS)!r})
import suite_job
suite_job.TEST_MAPS, suite_job.DRIVES = range(1000, 1002), (1000,)
suite_job.EVALUATIONS, suite_job.VALIDATION_EPISODES, suite_job.CHECKPOINTS = 2, 1, 5
runpy.run_path({str(BENCHMARKS / "suite.py")!r}, run_name="__main__")
"""


def command(tmp_path: Path, *arguments: str) -> list[str]:
    places = ["--results", str(tmp_path / "results"), "--work", str(tmp_path / "work")]
    return [sys.executable, "-c", QUICK, *arguments, *places]


def test_one_scale_shrinks_all_budgets_and_nothing_else():
    full, tenth = (suite_job.hyperparameters(a_job("chac", scale=scale)) for scale in (1.0, 0.1))
    assert full["n_timesteps"] == 1_000_000
    assert tenth["n_timesteps"] == 100_000
    assert (full["switch_after"], tenth["switch_after"]) == (20_000, 2_000)
    wrapper = "sb3_chac.human.InterventionWrapper"
    assert tenth["env_wrapper"][0][wrapper]["budget"] == full["env_wrapper"][0][wrapper]["budget"] / 10
    assert tenth["learning_rate"] == full["learning_rate"]
    assert tenth["learning_starts"] == full["learning_starts"]


def test_ablations_differ_from_chac_by_their_parameter():
    chac, no_share = (suite_job.hyperparameters(a_job(name)) for name in ("chac", "chac-no-share"))
    assert no_share == chac | {"shared_control": False}


def test_every_row_of_both_suites_has_hyperparameters_and_an_own_fingerprint():
    for env in suite.SUITES.values():
        prints = {suite_job.fingerprint(Job(row, env, 0, 0.1, True)) for row in suite.ROWS}
        assert len(prints) == len(suite.ROWS)


def test_results_are_kept_and_found_again(tmp_path):
    results, job = suite.Results(tmp_path), a_job()
    assert results.state(job) == suite.UNFINISHED
    results.write(job, outcome(job))
    assert results.state(job) == ""
    assert results.state(a_job(seed=1)) == suite.UNFINISHED
    assert not list(tmp_path.glob(".*"))


def test_changed_hyperparameters_are_noticed(tmp_path, monkeypatch):
    results, job = suite.Results(tmp_path), a_job()
    results.write(job, outcome(job))
    monkeypatch.setattr(suite_job, "fingerprint", lambda job: "another")
    assert "other hyperparameters" in results.state(job)


@pytest.mark.parametrize("damage", [lambda text: text[:-200], lambda text: text.replace("dpvp,0,300.0", "dpvp,\x00", 1)])
def test_a_damaged_line_is_named_and_the_others_stay(tmp_path, damage):
    results, jobs = suite.Results(tmp_path), [a_job(seed=seed) for seed in (0, 1)]
    for job in jobs:
        results.write(job, outcome(job))
    path = results.path(jobs[0]) / "episodes.csv"
    path.write_text(damage(path.read_text()))
    state = results.state(jobs[0])
    assert str(path) in state
    assert "Remove" in state
    assert results.state(jobs[1]) == ""
    methods, problems = suite_report.read(jobs, results)
    assert [job.seed for job in methods["dpvp"].jobs] == [1]
    assert problems == [state]


def test_a_full_disk_leaves_the_job_unfinished(tmp_path, monkeypatch):
    results, job = suite.Results(tmp_path), a_job()

    def full(self, text):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full)
        with pytest.raises(OSError, match="No space left"):
            results.write(job, outcome(job))
    assert results.state(job) == suite.UNFINISHED
    results.write(job, outcome(job))
    assert results.state(job) == ""


def test_the_report_has_all_methods_and_names_what_contradicts_the_paper(tmp_path, monkeypatch):
    monkeypatch.setattr(curves, "RESAMPLES", 50)
    results = suite.Results(tmp_path)
    jobs = [a_job(name, seed) for name in ("pvp", "dpvp", "chac", "chac-no-share") for seed in (0, 1)]
    for job in jobs:
        results.write(job, outcome(job, success=job.row.name != "dpvp"))
    (tmp_path / suite_report.REMARKS).write_text("D-PVP had a bad day.")
    suite_report.write("table1", 0.1, jobs, results)
    text = (tmp_path / "RESULTS.md").read_text()
    assert "| D-PVP | 2 | 10 | 100 | 3 | 300 ± 1 [300, 301] | 0.50 ± 0.00 [0.50, 0.50] | 0.00" in text
    assert "| D-PVP against PVP | -1.00 (paper +0.02): **contradicts the paper**" in text
    assert "| C-HAC against D-PVP | +1.00 (paper +0.08): as in the paper" in text
    assert "D-PVP had a bad day." in text
    for name in suite_report.PICTURES:
        assert (tmp_path / f"{name}.png").stat().st_size > 5000


def test_the_same_scores_give_the_same_interval():
    scores = np.random.default_rng(0).normal(size=(3, 50))
    low, high = suite_report.interval(scores)
    assert low < scores.mean() < high
    assert suite_report.interval(scores) == (low, high)


def test_thinned_curves_keep_the_last_point():
    curve = np.column_stack([np.arange(1000), np.arange(1000), np.zeros(1000)])
    thin = suite_job.thinned(curve)
    assert len(thin) == suite_job.POINTS
    assert thin[-1].tolist() == [999, 999]


def test_a_killed_suite_goes_on_from_checkpoints_and_takes_its_processes_along(tmp_path):
    arguments = command(tmp_path, "run", "--rows", "pvp", "--seeds", "1", "--scale", "0.008", "--jobs", "1")
    first = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    logs = tmp_path / "work" / "pvp-0" / "logs" / "pvp"

    def has_checkpoint():
        return any(newest_checkpoint(folder) for folder in logs.glob("*/checkpoints"))

    wait_until(lambda: has_checkpoint() or first.poll() is not None, pause=0.2)
    assert first.poll() is None
    first.send_signal(signal.SIGKILL)
    first.wait()
    again = subprocess.run(arguments, capture_output=True, text=True, timeout=FOREVER)
    assert again.returncode == 0, again.stdout + again.stderr
    assert "another process" not in again.stdout
    assert len(list(logs.glob("SafeDrive-v0_*"))) == 2  # the second resumed the first
    with (tmp_path / "results" / "pvp-0" / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["scenario"] for row in rows] == ["1000", "1001"]
    assert int(rows[0]["total_steps"]) == 400
    assert subprocess.run(arguments, capture_output=True, text=True).stdout.startswith("1 jobs: 1 done, 0 to do")


@pytest.mark.parametrize("number", [pytest.param(signal.SIGTERM, marks=pytest.mark.slow), signal.SIGINT])
def test_a_signal_ends_the_suite_and_its_jobs_in_good_order(tmp_path, number):
    # Long enough not to end before the signal
    arguments = command(tmp_path, "run", "--rows", "pvp", "dpvp", "--seeds", "1", "--scale", "1", "--jobs", "1")
    process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    folder = tmp_path / "work" / "pvp-0"
    begun = folder / "logs" / "pvp" / "SafeDrive-v0_1" / "progress.csv"
    wait_until(lambda: begun.exists() or process.poll() is not None, pause=0.2)
    process.send_signal(number)
    _, complaints = process.communicate(timeout=FOREVER)
    assert process.returncode == 128 + number
    assert complaints.splitlines()[-1] == (
        f"Stopped by {signal.Signals(number).name}; the same command goes on from the checkpoints."
    )
    assert "Traceback" not in complaints and "Stopped by SIGTERM at step" in (folder / "log.txt").read_text()
    assert sound_checkpoint(begun.parent / "checkpoints")[0] is not None
    assert not (tmp_path / "work" / "dpvp-0" / "logs").exists()  # the next one was not begun


def test_a_failed_job_does_not_stop_the_others(tmp_path):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "bc-0").write_text("in the way")  # a file where its folder should be
    arguments = command(tmp_path, "run", "--rows", "human", "bc", "--seeds", "1", "--scale", "0.001", "--jobs", "1")
    ran = subprocess.run(arguments, capture_output=True, text=True, timeout=FOREVER)
    assert ran.returncode == 1
    assert "human-0: done" in ran.stdout
    assert "1 of 2 jobs failed" in ran.stdout
    assert (tmp_path / "results" / "human-0" / "episodes.csv").is_file()


@pytest.mark.slow
def test_a_ray_cluster_of_two_nodes_survives_the_loss_of_a_worker(tmp_path):
    pytest.importorskip("ray", reason='needs Ray: pip install "ray>=2.50"')
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        cluster.add_node(num_cpus=1)
        jobs = command(tmp_path, "run", "--rows", "human", "--seeds", "3", "--scale", "0.001", "--ray", cluster.address)
        running = subprocess.Popen(jobs, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        wait_until(lambda: ray_workers() or running.poll() is not None, pause=0.1)
        assert running.poll() is None
        os.kill(ray_workers()[0], signal.SIGKILL)
        output, _ = running.communicate(timeout=FOREVER)
        assert running.returncode == 0, output
        assert len(list((tmp_path / "results").glob("*/episodes.csv"))) == 3
    finally:
        cluster.shutdown()


def ray_workers() -> list[int]:
    """
    :return: processes of Ray that run a job
    """
    listing = subprocess.run(["ps", "-eo", "pid,args"], capture_output=True, text=True).stdout
    return [int(line.split()[0]) for line in listing.splitlines() if "ray::run" in line and "ps -eo" not in line]
