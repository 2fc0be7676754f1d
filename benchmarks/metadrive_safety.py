"""MetaDriveSafety-v0: how its drivers do, and what is observed.

    python benchmarks/metadrive_safety.py drivers --jobs 2   # its drivers on 100 maps; runs what is missing
    python benchmarks/metadrive_safety.py report             # table of the means
    python benchmarks/metadrive_safety.py observations       # means and standard deviations of MetaDrive's observations

Needs MetaDrive (Python 3.11), goes without its assets. (A script called metadrive.py would hide it.) One row per preset,
driver and map is appended to benchmarks/results/metadrive/drivers.csv. Maps: 1000-1099. None of these was used while
tuning; that was done on maps 3000-3199.
"""

import argparse
from itertools import product
from pathlib import Path

import gymnasium as gym
import lab
import numpy as np
import torch as th

import sb3_chac.envs  # noqa: F401
from sb3_chac import InterventionWrapper
from sb3_chac.envs.metadrive import PRESETS

DRIVERS_CSV = Path(__file__).parent / "results" / "metadrive" / "drivers.csv"
VERSIONS = lab.versions("metadrive-simulator", "panda3d", "numpy", "torch", "stable-baselines3", "gymnasium")
DRIVERS = ("scripted", "scripted-ideal", "idm", "ppo")
DRIVER_MAPS = range(1000, 1100)
CHUNK = 5  # episodes after which a process writes its rows
COLUMNS = {  # -> digits in the report
    "success": 2,
    "cost": 2,
    "return": 1,
    "contact_cost": 2,
    "steps": 0,
    "route_completion": 3,
}


def drive_some(preset: str, name: str, scenarios: list[int]) -> list[dict]:
    th.set_num_threads(1)
    env = gym.make("MetaDriveSafety-v0", preset=preset, headless=True).unwrapped
    try:
        driver = env.scripted_driver(name)
        rows = [lab.drive(env, driver, scenario, "contact_cost", "contact_cost") for scenario in scenarios]
        return [{"preset": preset, "driver": name, **row, "versions": VERSIONS} for row in rows]
    finally:
        env.close()


def drivers(args: argparse.Namespace) -> None:
    there = {(row["preset"], row["driver"], int(row["scenario"])) for row in lab.read(DRIVERS_CSV)}
    tasks = []
    for name, preset in product(args.drivers, PRESETS):
        missing = [scenario for scenario in DRIVER_MAPS if (preset, name, scenario) not in there]
        tasks += [(preset, name, missing[i : i + CHUNK]) for i in range(0, len(missing), CHUNK)]
    for rows in lab.outcomes([(drive_some, *task) for task in tasks], args.jobs):  # MetaDrive has one engine per process
        lab.append(DRIVERS_CSV, *rows)
    report(args)


def observations(args: argparse.Namespace) -> None:
    """Of a novice who drives as the scripted driver plus much slow noise, and whom the human takes over (maps 100-111)."""
    env = InterventionWrapper(gym.make("MetaDriveSafety-v0", raw_observations=True, headless=True), armed=True)
    rng = np.random.default_rng(0)
    driver, noise, seen = env.unwrapped.scripted_driver("scripted"), np.zeros(2), []
    for scenario in range(100, 112):
        observation, _ = env.reset(seed=scenario, options={"scenario": scenario})
        driver.reset(scenario)
        done = False
        while not done:
            noise = 0.95 * noise + 0.1 * rng.normal(size=2)
            action = np.clip(driver(observation) + noise, -1, 1).astype(np.float32)
            observation, _, terminated, truncated, _ = env.step(action)
            seen.append(observation)
            done = terminated or truncated
    values = np.array(seen)
    with np.printoptions(precision=2, suppress=True):
        print(f"{len(values)} steps\nmeans {values[:, :19].mean(axis=0)}\nstandard deviations {values[:, :19].std(axis=0)}")
    print(f"lidar: mean {values[:, 19:].mean():.3f}, {(values[:, 19:] > 0.999).mean():.0%} free")


def report(args: argparse.Namespace) -> None:
    rows = lab.read(DRIVERS_CSV)
    print("| preset | driver | episodes | " + " | ".join(name.replace("_", " ") for name in COLUMNS) + " |")
    print("|---|---|---" + "|---" * len(COLUMNS) + "|")
    for preset, name in product(PRESETS, DRIVERS):
        here = [row for row in rows if (row["preset"], row["driver"]) == (preset, name)]
        if here:
            means = [f"{np.mean([float(row[key]) for row in here]):.{digits}f}" for key, digits in COLUMNS.items()]
            print(f"| {preset} | {name} | {len(here)} | " + " | ".join(means) + " |")


if __name__ == "__main__":
    commands = {f.__name__: f for f in (drivers, report, observations)}
    parser = lab.make_parser(__doc__, commands)
    parser.add_argument("--drivers", nargs="+", choices=DRIVERS, default=list(DRIVERS))
    lab.add_jobs(parser)
    arguments = parser.parse_args()
    commands[arguments.command](arguments)
