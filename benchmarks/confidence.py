"""
Can C-HAC's confidence be trusted? P(Q_r > Q_g) beside how often the self-learning action did better when both were tried.

    python benchmarks/confidence.py run benchmarks/agents/chac-SafeDrive-v0.zip    # results/confidence/rollouts.csv
    python benchmarks/confidence.py report                                         # the reliability diagram

States are drawn from drives under shared control on the tuning maps. From each, a copy of the world goes on with pi_r's
action and another with pi_g's, then both under shared control, and their discounted returns are compared: rewards in units
of their root mean square less ``cost_coef`` per collision, as in Z_c. Bars: 95 % intervals (Wilson).
"""

import argparse
import copy
import csv
from collections import OrderedDict
from itertools import pairwise
from pathlib import Path

import gymnasium as gym
import lab
import numpy as np
import torch as th

import sb3_chac.envs  # noqa: F401
from sb3_chac import CHAC
from sb3_chac.envs.safedrive import SafeDriveEnv

RESULTS = Path(__file__).parent / "results" / "confidence"
FIRST_MAP = 2000
BINS = np.linspace(0.0, 1.0, 11)


def copy_of(env: SafeDriveEnv) -> SafeDriveEnv:
    """
    Copy a world with everything that moves; maps do not.

    :return: goes on from the same state
    """
    return copy.deepcopy(env, {id(env._scenes): OrderedDict(), id(env.map): env.map})


def discounted_return(env: SafeDriveEnv, model: CHAC, action: np.ndarray, steps: int) -> float:
    """
    Execute one action, then what shared control chooses.

    :param env: changed by this
    :param steps: after which the rest is left out
    :return: as Z_c counts it
    """
    scale, total, discount = model.reward_square**0.5, 0.0, 1.0
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(action)
        total += discount * (reward / scale - model.cost_coef * info["cost"])
        discount *= model.gamma
        if terminated or truncated:
            break
        action, _ = model.predict(observation, deterministic=True)
    return total


def run(args: argparse.Namespace) -> None:
    """Append a row per state: confidence and both returns."""
    th.set_num_threads(1)
    rng = np.random.default_rng(args.seed)
    model = CHAC.load(args.model, device="cpu", custom_objects={"buffer_size": 1})
    if model.stage == 1:
        raise SystemExit(f"{args.model} is in stage 1, there is no pi_r yet.")
    env = gym.make("SafeDrive-v0").unwrapped
    assert isinstance(env, SafeDriveEnv)
    versions = lab.versions("torch", "stable-baselines3", "numpy")
    args.results.mkdir(parents=True, exist_ok=True)
    rows, scenario = 0, FIRST_MAP
    with (args.results / "rollouts.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["model", "map", "step", "confidence", "return_self", "return_guided", "versions"])
        while rows < args.states:
            observation, _ = env.reset(options={"scenario": scenario})
            done = False
            while not done and rows < args.states:
                action, _ = model.predict(observation, deterministic=True)
                choice = model.policy.last_choice
                if choice is not None and rng.random() < 1 / args.every:
                    guided, own = (
                        model.predict(observation, deterministic=True, control=who)[0] for who in ("guided", "self")
                    )
                    returns = [discounted_return(copy_of(env), model, a, args.steps) for a in (own, guided)]
                    confidence = float(choice.confidence)
                    numbers = [f"{value:.5f}" for value in (confidence, *returns)]
                    writer.writerow([args.model.name, scenario, env.steps, *numbers, versions])
                    rows += 1
                observation, _, terminated, truncated, _ = env.step(action)
                done = terminated or truncated
            file.flush()
            scenario += 1
    print(f"{rows} states on maps {FIRST_MAP}-{scenario - 1}")


def wilson(better: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """
    :return: bounds of the 95 % interval of a proportion
    """
    center, spread = better + z**2 / 2, z * np.sqrt(better * (n - better) / n + z**2 / 4)
    return (center - spread) / (n + z**2), (center + spread) / (n + z**2)


def report(args: argparse.Namespace) -> None:
    """Print the table of the bins, and draw it."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    rows = lab.read(args.results / "rollouts.csv")
    confidence = np.array([float(row["confidence"]) for row in rows])
    gain = np.array([float(row["return_self"]) - float(row["return_guided"]) for row in rows])
    print("| P(Q_r > Q_g) | states | pi_r did better | mean gain |")
    print("|---|---|---|---|")
    figure, axis = plt.subplots(figsize=(4.5, 4.2))
    for low, high in pairwise(BINS):
        inside = (confidence >= low) & ((confidence < high) | (high == 1.0))
        n, better = int(inside.sum()), int((gain[inside] > 0).sum())
        if n == 0:
            continue
        bounds = wilson(better, n)
        interval = f"{better / n:.2f} ({bounds[0]:.2f} to {bounds[1]:.2f})"
        print(f"| {low:.1f} to {high:.1f} | {n} | {interval} | {gain[inside].mean():.2f} |")
        middle = confidence[inside].mean()
        axis.plot([middle, middle], bounds, color="tab:blue", linewidth=1)
        axis.plot(middle, better / n, "o", color="tab:blue", markersize=3 + n**0.5 / 4)
    axis.plot([0, 1], [0, 1], color="grey", linestyle="--", linewidth=1)
    axis.set(xlabel="confidence P(Q_r > Q_g)", ylabel="share of states in which pi_r's action did better")
    axis.set(xlim=(0, 1), ylim=(0, 1), title=f"C-HAC on SafeDrive, {len(rows)} states")
    figure.tight_layout()
    figure.savefig(args.results / "reliability.png", dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run")
    runs.add_argument("model", type=Path, metavar="MODEL.zip", help="C-HAC in stage 2, of SafeDrive-v0")
    runs.add_argument("--states", type=int, default=500)
    runs.add_argument("--every", type=int, default=60, help="steps between two states, on average")
    runs.add_argument("--steps", type=int, default=150, help="of a rollout")
    runs.add_argument("--seed", type=int, default=0)
    commands.add_parser("report")
    for command in commands.choices.values():
        command.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    {"run": run, "report": report}[arguments.command](arguments)
