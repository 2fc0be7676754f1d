"""The cockpit's figures: how soon what the person does is driven, and how steadily the drive goes, with training beside it.

    python benchmarks/cockpit.py drive --minutes 10          # C-HAC on SafeDrive-v0, through both stages
    python benchmarks/cockpit.py drive --env MetaDriveSafety-v0
    python benchmarks/cockpit.py report
    python benchmarks/cockpit.py pictures                    # those of the operator's guide

An emulated person presses and lets go keys at random moments, takes over and hands back. All else is what ``sb3-chac drive``
does, with SDL's dummy display. Two CSVs in benchmarks/results/cockpit/ get a row per event and per step of the environment:
<env>-events.csv, from the event in SDL's queue to the moment at which the environment begins the first step that is driven
with it; <env>-steps.csv, the moments of the steps, the gradient steps that were owed, what the car waited for, and the
window's frames. It wants a machine with two cores that does nothing else; the load average is in the rows.
"""

import argparse
import csv
import importlib.metadata
import os
import random
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pygame
import torch as th

from sb3_chac import drive as command
from sb3_chac.cockpit.devices import Keyboard
from sb3_chac.cockpit.emulator import DeviceEmulator
from sb3_chac.cockpit.run import DriveRun
from sb3_chac.cockpit.window import Window

RESULTS = Path(__file__).parent / "results" / "cockpit"
PICTURES = Path(command.__file__).parent / "cockpit" / "images"
KEYS = (pygame.K_LEFT, pygame.K_RIGHT, pygame.K_UP, pygame.K_DOWN, pygame.K_SPACE)
PERIOD = 0.1  # [s] of a step, as the environments say
VERSIONS = " ".join(
    f"{name}={importlib.metadata.version(name)}" for name in ("sb3_chac", "torch", "numpy", "pygame-ce", "stable-baselines3")
)


class Person(threading.Thread):
    """
    Presses keys at random moments.

    :param seed: of the moments
    """

    def __init__(self, seed: int) -> None:
        super().__init__(daemon=True)
        self.rng = random.Random(seed)
        self.emulator = DeviceEmulator()
        self.events: list[float] = []  # [s] time.monotonic()
        self.stopped = threading.Event()

    def run(self) -> None:
        while not self.stopped.wait(self.rng.uniform(0.3, 0.9)):
            key = self.rng.choice(KEYS)
            for action in (self.emulator.press, self.emulator.release):
                self.events.append(time.monotonic())
                action(key)
                if self.stopped.wait(self.rng.uniform(0.25, 0.6)):  # more than a step: each event is seen by itself
                    break


def make_run(env: str, folder: str, *arguments: str) -> DriveRun:
    """
    :param env: id
    :param folder: for everything that is written
    :param arguments: more of the command line
    """
    os.environ["MINARI_DATASETS_PATH"] = folder
    own = ["--env", env, "--seed", "1", "--log-folder", folder, "--device", "keyboard", "--go", *arguments]
    args = command.make_parser().parse_args(own)
    command.check_arguments(args)
    sys.argv[1:] = ["drive", *own]
    th.set_num_threads(1)
    return DriveRun(args, Keyboard())


def measure(env: str, minutes: float) -> None:
    """
    :param env: id
    :param minutes: of driving
    """
    steps: list[dict[str, Any]] = []
    switch = int(60 * minutes / PERIOD * 0.4)
    with tempfile.TemporaryDirectory() as folder:
        window = Window("benchmark")
        run = make_run(env, folder, "-params", f"switch_after:{switch}")
        person = Person(seed=0)

        def watch() -> None:
            while run.cockpit is None and not run.is_over:
                time.sleep(0.01)
            assert run.cockpit is not None
            vehicle = run.cockpit.env
            step = vehicle.step

            def timed(action: np.ndarray) -> Any:
                drive = run.drive
                now, heard = time.monotonic(), drive.person.input.time
                steps.append(
                    {"time": now, "heard": heard, "lag": drive.lag, "stage": drive.novice.stage, "frames": window.frames}
                )
                return step(action)

            vehicle.step = timed  # type: ignore[method-assign]
            run.drive.go_on()
            person.start()
            time.sleep(60 * minutes)
            person.stopped.set()
            run.drive.quit()

        run.thread.start()
        threading.Thread(target=watch, daemon=True).start()
        window.run(run.drive, lambda: run.is_over)
        run.thread.join()
        window.close()
        if run.error is not None:
            raise run.error
    write(env, steps, person.events)


def write(env: str, steps: list[dict[str, Any]], events: list[float]) -> None:
    """
    :param steps: a row each
    :param events: moments
    """
    first = steps[0]["time"]
    facts = {"load": round(os.getloadavg()[2], 2), "cores": os.cpu_count(), "versions": VERSIONS}
    heard = np.array([step["heard"] for step in steps])
    rows = []
    for event in events:
        index = int(np.searchsorted(heard, event))  # the first step that knew of it
        if event > first and index < len(steps):
            rows.append(
                {"event": round(event - first, 5), "latency_ms": round(1000 * (steps[index]["time"] - event), 2)} | facts
            )
    for step in steps:
        step["time"] = round(step["time"] - first, 5)
        del step["heard"]
    RESULTS.mkdir(parents=True, exist_ok=True)
    for kind, table in (("events", rows), ("steps", [step | facts for step in steps])):
        with (RESULTS / f"{env}-{kind}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(table[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(table)
    report()


def report() -> None:
    """Prints the figures of the CSVs."""
    for file in sorted(RESULTS.glob("*-events.csv")):
        env = file.name.removesuffix("-events.csv")
        events, steps = (list(csv.DictReader((RESULTS / f"{env}-{kind}.csv").open())) for kind in ("events", "steps"))
        latency = np.array([float(row["latency_ms"]) for row in events])
        times = np.array([float(row["time"]) for row in steps])
        lag, frames = (np.array([int(row[name]) for row in steps]) for name in ("lag", "frames"))
        intervals, seconds = 1000 * np.diff(times), times[-1]
        tens = np.histogram(times, np.arange(0, seconds, 10))[0] / 10
        print(f"{env}: {seconds / 60:.1f} minutes, {len(steps)} steps, load average {events[0]['load']}")
        print(
            f"  input to action [ms]: median {np.median(latency):.0f}, p99 {np.percentile(latency, 99):.1f}, n {len(latency)}"
        )
        print(f"  rate [1/s]: {(len(times) - 1) / seconds:.2f}, least in 10 s {tens.min():.1f}")
        print(
            f"  interval [ms]: least {intervals.min():.2f}, p99 {np.percentile(intervals, 99):.1f}, most {intervals.max():.0f}"
        )
        print(f"  window: {(frames[-1] - frames[0]) / seconds:.1f} frames per second")
        print(f"  gradient steps owed: median {np.median(lag):.0f}, most {lag.max()}, at the end {lag[-1]}")


def pictures() -> None:
    """Writes those of the operator's guide: trained agents drive, the person takes over."""
    for name, algo, keys in (("takeover", "dpvp", [pygame.K_DOWN, pygame.K_RIGHT]), ("stage-2", "chac", [])):
        agent = Path(__file__).parent / "agents" / f"{algo}-SafeDrive-v0.zip"
        with tempfile.TemporaryDirectory() as folder:
            window = Window("picture")
            run = make_run("SafeDrive-v0", folder, "--algo", algo, "--trained-agent", str(agent))

            def is_over(run: DriveRun = run, window: Window = window, keys: list[int] = keys, name: str = name) -> bool:
                display = run.drive.display
                while keys and display.number >= 60:
                    DeviceEmulator().press(keys.pop())
                if display.number >= 64 and (display.takeover or display.novice.self_drives) and not run.drive.ended:
                    window.draw()
                    pygame.image.save(window.screen, PICTURES / f"{name}.png")
                    run.drive.quit()
                return run.is_over

            run.drive.go_on()
            window.help = False
            run.thread.start()
            window.run(run.drive, is_over)
            run.thread.join()
            window.close()
            if run.error is not None:
                raise run.error


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["drive", "report", "pictures"])
    parser.add_argument("--env", default="SafeDrive-v0", metavar="ID")
    parser.add_argument("--minutes", type=float, default=10.0)
    arguments = parser.parse_args()
    if arguments.command == "drive":
        measure(arguments.env, arguments.minutes)
    else:
        {"report": report, "pictures": pictures}[arguments.command]()
