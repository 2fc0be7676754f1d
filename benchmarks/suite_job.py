"""One job of the suite: a row of the table with one seed. It trains with RL-Zoo3, drives the test maps, and hands back CSVs.

Everything that a job needs is in ``Job``, and all that it leaves is in ``Outcome``: it may run in any process on any machine
that has sb3_chac. It can be stopped at any time; run again in the same ``work`` folder, it goes on from its newest checkpoint.
"""

import contextlib
import ctypes
import fcntl
import hashlib
import inspect
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import lab
import numpy as np
import yaml

import sb3_chac
from sb3_chac.cli.plot import join
from sb3_chac.common.checkpoint_files import FOLDER, newest_checkpoint, sound_checkpoint
from sb3_chac.common.demonstrations import load_demonstrations
from sb3_chac.zoo.algorithms import ALGORITHMS, hyperparams_file
from sb3_chac.zoo.runs import steps

DEMONSTRATION_STEPS = 50_000  # of the human, for the row of the human and the methods that learn offline
VALIDATION_EPISODES, EVALUATIONS, CHECKPOINTS = 10, 10, 20
# What a scale shrinks: steps of the training, of its stages and rounds, and of the human; be they in the hyperparameters or
# the defaults of the algorithm
BUDGETS = {"n_timesteps", "budget", "switch_after", "prefit_steps", "warm_up_steps", "round_human_steps"}
LEAST = 50  # of any of them
PACKAGES = ("sb3_chac", "torch", "stable-baselines3", "gymnasium")
SIMULATORS = {"SafeDrive-v0": "highway-env", "MetaDriveSafety-v0": "metadrive-simulator"}
TEST_MAPS = range(1000, 1050)
DRIVES = (1003, 1012, 1027)  # maps of which every step is kept, if the job keeps any
CURVES = ("return", "success", "safety/safety_cost", "takeover/human_steps", "chac/self_share")
POINTS = 100  # of a curve


class Row(NamedTuple):
    """A row of the table: ``algo`` is that of RL-Zoo3, or empty for the human; ``params`` are added to its hyperparameters."""

    name: str
    title: str
    algo: str
    params: dict[str, Any] = {}  # noqa: RUF012
    from_demonstrations: bool = False


class Job(NamedTuple):
    row: Row
    env: str
    seed: int
    scale: float
    keeps_drives: bool

    @property
    def name(self) -> str:
        return f"{self.row.name}-{self.seed}"


class Outcome(NamedTuple):
    """Names of files -> what is in them, and the trained model (empty for the human)."""

    files: dict[str, str]
    model: bytes


class JobFailed(RuntimeError):
    """Says what failed, and ends with what it printed."""


def hyperparameters(job: Job) -> dict[str, Any]:
    """
    :return: what ``hyperparams/<algo>.yml`` says of the environment, with the row's parameters, all budgets shrunk
    """
    params = yaml.safe_load(hyperparams_file(job.row.algo).read_text())[job.env]
    if job.row.algo in ALGORITHMS:
        defaults = inspect.signature(getattr(sb3_chac, ALGORITHMS[job.row.algo])).parameters
        params = {name: defaults[name].default for name in BUDGETS if name in defaults} | params
    return scaled(params | job.row.params, job.scale)


def scaled(params: Any, scale: float, name: str = "") -> Any:
    """
    :param params: hyperparameters, or a part of them
    :param scale: what the budgets among them are multiplied with
    :param name: of this part
    """
    if isinstance(params, dict):
        return {key: scaled(value, scale, key) for key, value in params.items()}
    if isinstance(params, list):
        return [scaled(value, scale) for value in params]
    return max(LEAST, round(params * scale)) if name in BUDGETS and params else params


def demonstration_steps(job: Job) -> int:
    return max(LEAST, round(DEMONSTRATION_STEPS * job.scale))


def fingerprint(job: Job) -> str:
    """
    :return: of all that the result depends on, except the code
    """
    params = hyperparameters(job) if job.row.algo else {}
    settings = [job.env, job.row.algo, params, demonstration_steps(job), list(TEST_MAPS)]
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


def run(job: Job, work: Path) -> Outcome:
    """
    :param job: what is to be done; what was done of it before is not done again
    :param work: folder for runs, checkpoints and demonstrations
    :raises JobFailed: if a command of it fails, or another process runs it
    """
    folder = begin(job, work)
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise JobFailed(f"another process runs this job in {folder}.") from None
        return run_in(folder, job)


def run_in(folder: Path, job: Job) -> Outcome:
    """
    :param folder: see ``begin``
    """
    dataset = folder / "demonstrations" / "human-v0"
    if (job.row.from_demonstrations or not job.row.algo) and not dataset.exists():
        command = ["demos", "record", "--env", job.env, "--expert", "scripted", "--jobs", "1", "--seed", job.seed]
        call(folder, *command, "--steps", demonstration_steps(job), "--dataset", dataset)
    model = train(job, folder) if job.row.algo else None
    tested = folder / "tested.json"
    who = ["evaluate", *([model] if model else ["--expert", "scripted"]), "--env", job.env, "--jobs", "1"]
    call(folder, *who, "--scenarios", f"{TEST_MAPS[0]}:{TEST_MAPS[-1] + 1}", "--json", tested)
    test = json.loads(tested.read_text())

    used = {"human_steps": 0, "total_steps": 0, "training_cost": 0.0}
    if job.row.from_demonstrations or model is None:
        human = load_demonstrations(dataset)
        assert human.costs is not None  # our environments report them
        used |= {"human_steps": len(human), "total_steps": len(human), "training_cost": float(human.costs.sum())}
    curves = join(run_folders(job, folder)) if model else {}
    for name, quantity in (("human_steps", "takeover/human_steps"), ("training_cost", "safety/safety_cost")):
        if quantity in curves:
            used[name] += float(curves[quantity][-1, 1])
    if model and not job.row.from_demonstrations:
        used["total_steps"] = steps(model)[0]

    run = {"method": job.row.name, "seed": job.seed}
    versions = lab.versions(*PACKAGES, SIMULATORS[job.env], "numpy")
    facts = {"fingerprint": fingerprint(job), "versions": versions}
    columns = ("scenario", "return", "cost", "success", "route_completion", "steps")
    episodes = [run | {key: record[key] for key in columns} | used | facts for record in test["records"]]
    files = {"episodes": lab.to_csv(episodes)}
    if curves:
        points = [(quantity, *point) for quantity in CURVES for point in thinned(curves.get(quantity, np.zeros((0, 3))))]
        files["curves"] = lab.to_csv([run | {"quantity": q, "step": int(s), "value": round(v, 4)} for q, s, v in points])
    if job.keeps_drives:
        drives = folder / "drives.csv"
        call(folder, *who, "--scenarios", ",".join(map(str, DRIVES)), "--steps", drives)
        files["drives"] = lab.to_csv([run | row for row in lab.read(drives)])
    return Outcome(files, model.read_bytes() if model else b"")


def begin(job: Job, work: Path) -> Path:
    """
    :return: the folder of the job, with its hyperparameters; emptied if it was begun with others
    """
    folder = (work / job.name).absolute()
    begun_with = folder / "fingerprint"
    if folder.exists() and not (begun_with.exists() and begun_with.read_text() == fingerprint(job)):
        shutil.rmtree(folder)
    if not folder.exists():
        folder.mkdir(parents=True)
        if job.row.algo:
            params = hyperparameters(job)
            if job.row.from_demonstrations:
                params["dataset"] = str(folder / "demonstrations" / "human-v0")
            (folder / "hyperparameters.yml").write_text(yaml.safe_dump({job.env: params}, sort_keys=False))
        begun_with.write_text(fingerprint(job))
    return folder


def train(job: Job, folder: Path) -> Path:
    """
    ``rl_zoo3 train``, or ``sb3-chac resume`` from the newest checkpoint until it is done.

    :return: the model
    """
    done = folder / "trained"  # holds the path of the model
    if not done.exists():
        runs = run_folders(job, folder)
        while runs and sound_checkpoint(runs[-1] / FOLDER)[0] is None:  # killed before it had one, or damaged
            shutil.rmtree(runs.pop())
        if runs:
            call(folder, "resume", runs[-1])
        else:
            steps = hyperparameters(job)["n_timesteps"]
            command = ["train", "--algo", job.row.algo, "--env", job.env, "--seed", job.seed, "--device", "cpu"]
            command += ["--conf-file", folder / "hyperparameters.yml", "--log-folder", folder / "logs", "--verbose", 0]
            command += ["--eval-freq", max(1, steps // EVALUATIONS), "--eval-episodes", VALIDATION_EPISODES]
            command += ["--save-freq", max(1, steps // CHECKPOINTS), "--log-interval", 1]
            call(folder, *command)
        done.write_text(str(run_folders(job, folder)[-1] / f"{job.env}.zip"))
    return Path(done.read_text())


def run_folders(job: Job, folder: Path) -> list[Path]:
    """
    :return: those of RL-Zoo3, each but the first resumed the one before
    """
    found = (folder / "logs" / job.row.algo).glob(f"{job.env}_*")
    return sorted(found, key=lambda path: int(path.name.rpartition("_")[2]))


def share_done(job: Job, work: Path) -> float:
    """
    :return: of the training, by its newest checkpoint, from 0 to 1
    """
    runs = run_folders(job, work / job.name)
    checkpoint = newest_checkpoint(runs[-1] / FOLDER) if runs else None
    return int(checkpoint.name) / hyperparameters(job)["n_timesteps"] if checkpoint else 0.0


def call(folder: Path, *arguments: Any) -> None:
    """
    ``python -m sb3_chac`` with one thread, in a process group of its own that ends with this process.

    :param folder: of the job, gets what the command prints
    :raises JobFailed: unless it ends well
    """
    if stopping:
        raise JobFailed("stopped.")
    log = folder / "log.txt"
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    command = [sys.executable, "-m", "sb3_chac", *map(str, arguments)]
    with log.open("a") as file:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=file,
            env=environment,
            cwd=folder,
            start_new_session=True,
            preexec_fn=end_with_parent,
        )
        running.append(process)
        if stopping:  # it was begun while all were stopped
            process.terminate()
        try:
            code = process.wait()
        finally:
            running.remove(process)
            stop(process)
    if code:
        end = "\n".join(log.read_text(errors="replace").splitlines()[-15:])
        raise JobFailed(f"sb3-chac {' '.join(map(str, arguments[:3]))} ended with {code}. The end of {log}:\n{end}")


running: list[subprocess.Popen[bytes]] = []
stopping = False  # no job begins anything new
PR_SET_PDEATHSIG = 1


def end_with_parent() -> None:
    """Called in the new process: it is killed when the one that waits for it is (Linux; elsewhere it goes on to its end)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def stop_all() -> None:
    """
    Ends what runs in good order: a training writes a checkpoint first. Returns when nothing runs any more.
    """
    global stopping
    stopping = True
    for process in list(running):
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
    for process in list(running):
        process.wait()


def stop(process: subprocess.Popen[bytes]) -> None:
    """The process and all that it started."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass


def thinned(curve: np.ndarray) -> np.ndarray:
    """
    :param curve: shape (n, 3): step, value, spread
    :return: steps and values, shape (at most ``POINTS``, 2), the last one among them
    """
    chosen = np.unique(np.linspace(0, len(curve) - 1, min(len(curve), POINTS)).round().astype(int))
    return curve[chosen, :2]
