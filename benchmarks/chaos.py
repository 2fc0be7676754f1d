"""What is left of a training that is killed again and again, whose disk is full and whose checkpoints are damaged.

    python benchmarks/chaos.py                 # 12 times kill -9, SIGTERM or Ctrl-C in both stages of C-HAC, then a full disk
    python benchmarks/chaos.py --kills 3 --steps 240 --disk 0

A small C-HAC on SafeDrive-v0 is trained by `sb3-chac train`, stopped at random, its newest checkpoint damaged now and then,
and resumed, until all steps are made. An odometer in the environment knows how many really were. Asked for: no checkpoint in
use that is half-written, no step counted twice, the human's budget kept, at most one interval lost each time.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym

from sb3_chac import CHAC
from sb3_chac.common.checkpoint_files import BUFFER, FOLDER, checkpoints, newest_checkpoint, sound_checkpoint

ENV = "SafeDrive-v0"
BUDGET = 60  # steps of the human
FOREVER = 1800.0  # [s] only against hanging for ever
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


class Odometer(gym.Wrapper):
    """
    Counts steps where no kill can undo it.

    :param env: environment
    :param file: gets a byte for each step
    """

    def __init__(self, env: gym.Env, file: str) -> None:
        super().__init__(env)
        self.file = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        os.write(self.file, b".")
        return result


class Stop(NamedTuple):
    """What happened to one process: the signal, the step reached, and that of the checkpoint that the next goes on from."""

    how: str
    reached: int
    kept: int
    damage: str


class Training:
    """
    A training that is stopped and resumed.

    :param folder: for all that it writes
    :param steps: in all
    :param save_freq: steps between two checkpoints
    :param seed: of the training
    """

    def __init__(self, folder: Path, steps: int, save_freq: int, seed: int) -> None:
        self.folder, self.steps, self.save_freq = folder, steps, save_freq
        self.odometer = folder / "odometer"
        wrappers = [
            {"chaos.Odometer": {"file": str(self.odometer)}},
            {"sb3_chac.human.InterventionWrapper": {"budget": BUDGET, "rule": "risk"}},
        ]
        self.command = ["train", "--algo", "chac", "--env", ENV, "-n", str(steps), "--save-freq", str(save_freq)]
        self.command += ["--eval-freq", "-1", "--seed", str(seed), "--device", "cpu", "--verbose", "0", "-f", "logs"]
        self.command += ["--env-kwargs", "horizon:60", "blocks:2", "-params", "learning_starts:20", "train_freq:1"]
        self.command += ["buffer_size:2000", "batch_size:16", "policy_kwargs:dict(net_arch=[8])", "prefit_steps:5"]
        self.command += [f"switch_after:{steps // 2}", f"env_wrapper:{wrappers!r}"]

    @property
    def runs(self) -> list[Path]:
        return sorted((self.folder / "logs" / "chac").glob(f"{ENV}_*"), key=lambda path: int(path.name.rpartition("_")[2]))

    def start(self) -> subprocess.Popen[str]:
        """
        :return: the process that begins the training, or goes on with the newest run that has a checkpoint
        """
        resumable = [run for run in self.runs if checkpoints(run / FOLDER)]
        command = ["resume", str(resumable[-1])] if resumable else self.command
        environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
        environment["PYTHONPATH"] = os.pathsep.join(
            [str(Path(__file__).parent.absolute()), *filter(None, [os.environ.get("PYTHONPATH")])]
        )
        return subprocess.Popen(
            [sys.executable, "-m", "sb3_chac", *command],
            cwd=self.folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def made(self) -> int:
        """
        :return: steps that all processes together have made
        """
        return self.odometer.stat().st_size if self.odometer.exists() else 0

    def kept(self) -> int:
        """
        :return: step of the checkpoint that the next process goes on from
        """
        found = [sound_checkpoint(run / FOLDER)[0] for run in self.runs]
        return max((int(path.name) for path in found if path is not None), default=0)

    def model(self) -> CHAC:
        """
        :return: of the checkpoint that the next process goes on from
        """
        path = next(path for run in reversed(self.runs) if (path := sound_checkpoint(run / FOLDER)[0]) is not None)
        model = CHAC.load(path / f"{ENV}.zip", device="cpu")
        model.load_replay_buffer(path / BUFFER)
        return model


def stop_at(training: Training, step: int, how: signal.Signals, pause: float) -> tuple[int, int, str]:
    """
    :param step: of the training, at which it is to be stopped
    :param pause: [s] after that, so that it is anywhere in what it does
    :return: its exit code, the step reached (in its own counting), and what it printed
    """
    start, before = training.kept(), training.made()
    process = training.start()
    end = time.monotonic() + FOREVER
    while process.poll() is None and start + training.made() - before < step and time.monotonic() < end:
        time.sleep(0.01)
    time.sleep(pause)
    process.send_signal(how)
    output = process.communicate(timeout=FOREVER)[0]
    return process.returncode, start + training.made() - before, output


def damage(training: Training, generator: random.Random) -> str:
    """
    Does something to the newest checkpoint, if there is one to fall back to.

    :return: what
    """
    folder = training.runs[-1] / FOLDER
    if len(checkpoints(folder)) < 2:
        return ""
    newest = newest_checkpoint(folder)
    assert newest is not None
    kind = generator.choice(["model cut", "buffer changed", "buffer gone", "empty folder"])
    if kind == "model cut":
        os.truncate(newest / f"{ENV}.zip", (newest / f"{ENV}.zip").stat().st_size // 2)
    elif kind == "buffer changed":
        content = bytearray((newest / BUFFER).read_bytes())
        content[len(content) // 2] ^= 1
        (newest / BUFFER).write_bytes(content)
    elif kind == "buffer gone":
        (newest / BUFFER).unlink()
    else:
        (folder / str(10 * training.steps)).mkdir()
    return kind


def torment(training: Training, kills: int, seed: int) -> tuple[list[Stop], list[str]]:
    """
    :param kills: how many processes are stopped
    :param seed: decides when and how
    :return: what happened, and what should not have
    """
    generator = random.Random(seed)
    stops: list[Stop] = []
    problems: list[str] = []
    for number in range(kills):
        how = generator.choice(SIGNALS)
        step = round(training.steps * (number + generator.random()) / kills)
        start = training.kept()
        code, reached, output = stop_at(training, step, how, generator.random())
        if code == 0:
            break
        expected = -how if how == signal.SIGKILL else 128 + how
        is_learning = start < reached < training.steps  # else the process is still starting, or ending
        if code != expected and not (code == -how and not is_learning):
            problems.append(f"stop {number}: {how.name} led to exit code {code}, not {expected}: {output[-500:]}")
        before = training.kept()
        if reached > before and how != signal.SIGKILL and code == expected:
            problems.append(f"stop {number}: {how.name} lost {reached - before} steps")
        if reached - before > training.save_freq + 1:
            problems.append(f"stop {number}: {reached - before} steps lost, the interval is {training.save_freq}")
        done = damage(training, generator) if generator.random() < 0.4 else ""
        kept = training.kept()
        if before - kept > training.save_freq + 1:
            problems.append(f"stop {number}: the damage ({done}) cost {before - kept} steps")
        stops.append(Stop(how.name, reached, kept, done))
        problems += check(training, kept)
    output = training.start().communicate(timeout=FOREVER)[0]
    if training.kept() != training.steps:
        problems.append(f"it ended at step {training.kept()} of {training.steps}: {output[-1000:]}")
    return stops, problems + check(training, training.steps)


def check(training: Training, step: int) -> list[str]:
    """
    :param step: of the checkpoint
    :return: what it counts twice or not at all
    """
    if step == 0:
        return []
    model, problems = training.model(), []
    counts, buffer = model.counts, model.replay_buffer
    if not model.num_timesteps == counts["total_steps"] == len(buffer.novice) + len(buffer.human) == step:
        rows = len(buffer.novice), len(buffer.human)
        problems.append(f"checkpoint {step}: {model.num_timesteps} steps, {counts['total_steps']} counted, {rows} stored")
    if counts["human_steps"] != len(buffer.human) or counts["human_steps"] > BUDGET:
        problems.append(f"checkpoint {step}: the human drove {counts['human_steps']}, stored are {len(buffer.human)}")
    return problems


def on_a_small_disk(folder: Path, size: int, steps: int) -> list[str]:
    """
    :param folder: is mounted over, in a namespace of its own
    :param size: [MB] of its disk
    :return: what went wrong
    """
    mount = f"mount -t tmpfs -o size={size}m tmpfs '{folder}' && exec \"$@\""
    inside = [sys.executable, str(Path(__file__).absolute()), "--inside", str(folder), "--steps", str(steps)]
    command = ["unshare", "--map-root-user", "--mount", "sh", "-c", mount, "sh", *inside]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=FOREVER, check=False)
    if ran.returncode != 0:
        return [f"small disk: {(ran.stdout + ran.stderr)[-1000:]}"]
    return list(json.loads(ran.stdout.splitlines()[-1]))


def fill_disk(folder: Path, steps: int) -> list[str]:
    """
    Trains until there is a checkpoint, fills the disk, and lets the training go on.

    :param folder: on a small disk
    :return: what went wrong
    """
    training = Training(folder, steps, steps // 8, seed=0)
    process = training.start()
    end = time.monotonic() + FOREVER
    while process.poll() is None and training.kept() == 0 and time.monotonic() < end:
        time.sleep(0.01)
    with (folder / "filler").open("wb", buffering=0) as filler:
        try:
            while True:
                filler.write(bytes(4096))
        except OSError:
            pass  # it is full
        output = process.communicate(timeout=FOREVER)[0]
    kept, problems = training.kept(), []
    if kept == 0:
        problems.append("full disk: no checkpoint is left")
    if "Traceback" in output:
        problems.append(f"full disk: {output[-1500:]}")
    problems += check(training, kept)
    (folder / "filler").unlink()
    output = training.start().communicate(timeout=FOREVER)[0]
    if training.kept() != steps:
        problems.append(f"full disk: with room again it ended at {training.kept()} of {steps}: {output[-1000:]}")
    return problems


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=12, metavar="N", help="(default: %(default)s)")
    parser.add_argument("--steps", type=int, default=1200, metavar="N", help="of the training (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="(default: %(default)s)")
    parser.add_argument("--disk", type=int, default=16, metavar="MB", help="size of the disk, 0: no such test (%(default)s)")
    parser.add_argument("--inside", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    if args.inside:
        print(json.dumps(fill_disk(args.inside, args.steps)))
        return
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work, "kills")
        folder.mkdir()
        stops, problems = torment(Training(folder, args.steps, max(10, args.steps // 40), args.seed), args.kills, args.seed)
        for stop in stops:
            print(f"{stop.how:8} at step {stop.reached:5}, goes on from {stop.kept:5}  {stop.damage}", flush=True)
        if args.disk:
            disk = Path(work, "disk")
            disk.mkdir()
            problems += on_a_small_disk(disk, args.disk, max(args.steps // 4, 80))
    print("\n".join(problems) or f"{len(stops)} stops{', a full disk' if args.disk else ''}: nothing lost that was to be kept")
    sys.exit(bool(problems))


if __name__ == "__main__":
    main(sys.argv[1:])
