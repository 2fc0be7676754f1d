"""What guidance is worth on SafeDrive-v0: SAC, DSAC, PVP, D-PVP, C-HAC and C-HAC's ablations, with the same evaluation.

    python benchmarks/guidance.py run --jobs 2     # runs what is missing; stop and restart it at any time
    python benchmarks/guidance.py report           # prints the tables and draws the curves from the CSVs

Hyperparameters are those of ``hyperparams/<algo>.yml``. Training maps 100-119; every evaluation is one deterministic episode
on each of the maps 1000-1049, without the human. Seeds 0-2 are the reported ones; tune on seeds from 100 and maps from 2000.
One CSV per run is written to benchmarks/results/guidance/, a row per evaluation as it comes.
"""

import argparse
import csv
import importlib.metadata
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import torch as th
import yaml
from rl_zoo3.utils import ALGOS, get_wrapper_class
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_chac.common.evaluation import evaluate
from sb3_chac.zoo.registration import hyperparams_file

RESULTS = Path(__file__).parent / "results" / "guidance"
VERSIONS = " ".join(
    f"{name}={importlib.metadata.version(name)}"
    for name in ("torch", "stable-baselines3", "gymnasium", "highway-env", "numpy")
)
TEST_MAPS, TUNING_MAPS = range(1000, 1050), range(2000, 2050)
FIRST_REPORTED_SEED, FIRST_TUNING_SEED = 0, 100
# Method -> algorithm, steps
METHODS = {"sac": ("sac", 200_000), "dsac": ("dsac", 200_000), "pvp": ("pvp", 50_000), "dpvp": ("dpvp", 50_000), "chac": ("chac", 200_000)}


def make_model(algo: str, seed: int, **overrides: Any) -> BaseAlgorithm:
    """As ``rl_zoo3 train --algo <algo> --env SafeDrive-v0`` makes it."""
    params = yaml.safe_load(hyperparams_file(algo).read_text())["SafeDrive-v0"]
    del params["n_timesteps"]
    wrapper = get_wrapper_class(params)
    params.pop("env_wrapper", None)
    params["policy_kwargs"] = {
        **eval(params.get("policy_kwargs", "dict()"), {"dict": dict}),
        # The default of our policies; for SAC it changes the speed, not the result
        "optimizer_kwargs": {"fused": True},
    }
    env = make_vec_env("SafeDrive-v0", seed=seed, wrapper_class=wrapper)
    return ALGOS[algo](env=env, seed=seed, device="cpu", **params | overrides)


class Record(BaseCallback):
    """Sums up the safety cost of the training, and appends a row to the CSV at each evaluation."""

    def __init__(self, path: Path, labels: dict[str, Any], every: int, maps: range):
        super().__init__()
        self.path, self.labels, self.every, self.maps = path, labels, every, maps
        self.training_cost = self.training_cost_human = 0.0
        self.human_steps = 0

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            self.training_cost += info["cost"]
            self.training_cost_human += info["cost"] * info.get("takeover", False)
            self.human_steps += info.get("takeover", False)
        if self.num_timesteps % self.every == 0:
            self.write()
        return True

    def write(self) -> None:
        summary = evaluate(self.model, "SafeDrive-v0", self.maps).summary()
        row = {**self.labels, "step": self.num_timesteps, **{key: round(value, 4) for key, value in summary.items()}}
        row |= {"human_steps": self.human_steps, "training_cost": self.training_cost}
        row |= {"training_cost_human": self.training_cost_human, "cpu_seconds": round(time.process_time())}
        row["versions"] = VERSIONS
        is_new = not self.path.exists()
        with self.path.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if is_new:
                writer.writeheader()
            writer.writerow(row)


def run(method: str, seed: int, every: int, folder: Path) -> str:
    th.set_num_threads(1)
    algo, steps = METHODS[method]
    path = folder / f"{method}-{seed}.csv"
    path.unlink(missing_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    model = make_model(algo, seed)
    maps = TUNING_MAPS if seed >= FIRST_TUNING_SEED else TEST_MAPS
    model.learn(steps, callback=Record(path, {"method": method, "seed": seed}, every, maps))
    model.save(folder / f"{method}-{seed}.zip")
    return f"{method} seed {seed}: {time.process_time():.0f} CPU seconds"


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def run_all(args: argparse.Namespace) -> None:
    jobs = []
    for seed in args.seeds:
        for method in args.methods:
            path = args.folder / f"{method}-{seed}.csv"
            if not path.exists() or int(read(path)[-1]["step"]) < METHODS[method][1]:
                jobs.append((method, seed, args.every, args.folder))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(args.jobs, mp_context=context, max_tasks_per_child=1) as pool:
        for future in as_completed([pool.submit(run, *job) for job in jobs]):
            print(future.result(), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["run"])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--every", type=int, default=10_000, help="steps between evaluations")
    parser.add_argument("--jobs", type=int, default=2, help="processes at once, one torch thread each")
    parser.add_argument("--folder", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    run_all(arguments)
