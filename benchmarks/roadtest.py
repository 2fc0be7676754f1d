"""The paper's road test, rehearsed: a vehicle in its own process, trained on route 1 over a bad link, tested on both.

    python benchmarks/roadtest.py train             # D-PVP: 'sb3-chac vehicle' and the learner, two processes
    python benchmarks/roadtest.py test              # ten episodes on each route, without the person
    python benchmarks/roadtest.py report            # tables, and figures.png: actions and speed along the routes

The link has 20 to 80 ms of delay and loses 5 % of the actions, the sensors a noise of .01; the tests have them, too.
Hyperparameters are those of hyperparams/<algo>.yml. Rows go to benchmarks/results/roadtest/, the model to --models.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import lab
import numpy as np
import torch as th
import yaml
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.callbacks import BaseCallback

import sb3_chac.envs  # noqa: F401
from sb3_chac.deploy.remote import LateLink
from sb3_chac.zoo.algorithms import hyperparams_file

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "roadtest"
LINK = {"latency": 0.02, "jitter": 0.06, "loss": 0.05, "noise": 0.01}
ROUTES, EPISODES = (1, 2), 10
WINDOW = 10_000  # steps of a row of the training
VERSIONS = lab.versions("torch", "stable-baselines3", "gymnasium", "highway-env", "numpy")


class Windows(BaseCallback):
    """Append a row for each window of the training: takeovers, human steps, collisions, completed episodes."""

    def __init__(self, labels: dict[str, Any]) -> None:
        super().__init__()
        self.labels, self.before = labels, dict[str, float]()
        self.sums = {"collisions": 0, "episodes": 0, "completed": 0, "takeovers": 0}
        self.human = False

    def _on_step(self) -> bool:
        (info,) = self.locals["infos"]
        human = bool(info["is_intervention"])
        self.sums["takeovers"] += human and not self.human
        self.human = human
        self.sums["collisions"] += int(info["cost"])
        if self.locals["dones"][0]:
            self.sums["episodes"] += 1
            self.sums["completed"] += bool(info["is_success"])
            self.human = False
        if self.num_timesteps % WINDOW == 0:
            human_steps = int(self.model.counts["human_steps"])
            row = {**self.labels, "step": self.num_timesteps, "human_steps": human_steps, **self.sums}
            lab.append(RESULTS / "train.csv", row | {"cpu_seconds": round(time.process_time()), "versions": VERSIONS})
            self.sums = dict.fromkeys(self.sums, 0)
        return True


def train(args: argparse.Namespace) -> None:
    """Start the vehicle, train over the link, and save the model."""
    th.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        ready = Path(folder) / "address"
        options = [f"--{name}={value}" for name, value in LINK.items()]
        command = [sys.executable, "-m", "sb3_chac", "vehicle", "--env", "RoadTest-v0", "--env-kwargs", "route:1", *options]
        command += ["--budget", str(args.budget), "--seed", str(args.seed), "--listen", "127.0.0.1:0", "--ready", str(ready)]
        vehicle = subprocess.Popen(command)
        try:
            while not ready.is_file() or not ready.read_text():
                if vehicle.poll() is not None:
                    sys.exit("The vehicle did not start.")
                time.sleep(0.1)
            params = yaml.safe_load(hyperparams_file(args.algo).read_text())["RemoteVehicle-v0"]
            params = {key: value for key, value in params.items() if key not in ("n_timesteps", "env_wrapper")}
            params["policy_kwargs"] = eval(params["policy_kwargs"], {"dict": dict})
            env = gym.make("RemoteVehicle-v0", address=ready.read_text())
            model = ALGOS[args.algo](env=env, seed=args.seed, device="cpu", **params)
            model.learn(args.steps, callback=Windows({"algo": args.algo, "seed": args.seed}))
            args.models.mkdir(parents=True, exist_ok=True)
            model.save(args.models / f"{args.algo}-{args.seed}")
            env.close()
        finally:
            vehicle.terminate()
            vehicle.wait()


def test(args: argparse.Namespace) -> None:
    """Drive both routes without the person, a row per episode and per step."""
    th.set_num_threads(1)
    model = ALGOS[args.algo].load(args.models / f"{args.algo}-{args.seed}", device="cpu")
    episodes, steps = [], []
    for route in ROUTES:
        env = LateLink(gym.make("RoadTest-v0", route=route), **LINK, seed=1000)
        for episode in range(EPISODES):
            observation, _ = env.reset(seed=1000 + episode, options={"scenario": route})
            done, n = False, 0
            while not done:
                action, _ = model.predict(observation, deterministic=True)
                observation, _, terminated, truncated, info = env.step(action)
                done, n = terminated or truncated, n + 1
                values = (info["route_completion"], *env.action, info["speed"])
                names = ("completion", "steering", "acceleration", "speed")
                numbers = {name: f"{value:.3f}" for name, value in zip(names, values, strict=True)}
                steps.append({"route": route, "episode": episode, "step": n} | numbers)
            row = {"algo": args.algo, "seed": args.seed, "trained_steps": model.num_timesteps, "route": route}
            row |= {"episode": episode, "completed": int(info["is_success"]), "collisions": int(info["episode_cost"])}
            episodes.append(row | {"route_completion": round(info["route_completion"], 3), "steps": n, "versions": VERSIONS})
            print(episodes[-1], flush=True)
    lab.write(RESULTS / "test.csv", episodes)
    lab.write(RESULTS / "drives.csv", steps)


def report(args: argparse.Namespace) -> None:
    """Print both tables, and draw the actions and the speed along the routes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    print("| steps | human steps | takeovers | collisions | episodes completed |\n|---|---|---|---|---|")
    for row in lab.read(RESULTS / "train.csv"):
        completed = f"{row['completed']} of {row['episodes']}"
        print(f"| {row['step']} | {row['human_steps']} | {row['takeovers']} | {row['collisions']} | {completed} |")
    print("\n| route | completed | collisions | steps |\n|---|---|---|---|")
    rows, drives = lab.read(RESULTS / "test.csv"), lab.read(RESULTS / "drives.csv")
    figure, axes = plt.subplots(3, 2, figsize=(9, 6), sharex=True, sharey="row", layout="constrained")
    for column, route in enumerate(ROUTES):
        here = [row for row in rows if int(row["route"]) == route]
        completed, collisions = (sum(int(row[key]) for row in here) for key in ("completed", "collisions"))
        mean = np.mean([int(row["steps"]) for row in here])
        print(f"| {route} | {completed} of {len(here)} | {collisions} | {mean:.0f} |")
        for axis, key in zip(axes[:, column], ("steering", "acceleration", "speed"), strict=True):
            for episode in range(EPISODES):
                drive = [row for row in drives if int(row["route"]) == route and int(row["episode"]) == episode]
                axis.plot(
                    [100 * float(r["completion"]) for r in drive], [float(r[key]) for r in drive], linewidth=0.7, alpha=0.7
                )
            axis.set_ylabel(f"{key} [m/s]" if key == "speed" else key)
        axes[0, column].set_title(f"route {route}" + (" (trained on)" if route == 1 else ""))
        axes[-1, column].set_xlabel("route [%]")
    figure.savefig(RESULTS / "figures.png", dpi=100)


if __name__ == "__main__":
    parser = lab.make_parser(__doc__, ["train", "test", "report"])
    parser.add_argument("--algo", choices=("dpvp", "chac"), default="dpvp")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000, help="(default: %(default)s)")
    parser.add_argument("--budget", type=int, default=10_000, help="steps of the person at most (default: %(default)s)")
    parser.add_argument("--models", type=Path, default=HERE / "models" / "RoadTest-v0", help="not committed")
    arguments = parser.parse_args()
    {"train": train, "test": test, "report": report}[arguments.command](arguments)
