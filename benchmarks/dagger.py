"""
Can a simulator be driven from what the agent observes? Imitate the scripted driver with DAgger (Ross et al. 2011) and see
how far a plain MLP gets.

    python benchmarks/dagger.py                 # results/safedrive/dagger.csv
    python benchmarks/dagger.py --no-corridors  # from the observation without its corridors
    python benchmarks/dagger.py --first 100 --maps 20 --labels 50000   # how far 20 maps carry
    SB3_CHAC_METADRIVE_HEADLESS=1 python benchmarks/dagger.py --env MetaDriveSafety-v0   # results/metadrive/dagger.csv

The labels are the ideal driver's actions in the states that the imitation visits; a share of the episodes, which falls
from 1 to 0, is driven by the driver.
"""

import argparse
import time
from pathlib import Path

import gymnasium as gym
import lab
import numpy as np
import torch as th
from torch import nn

import sb3_chac.envs  # noqa: F401

RESULTS = Path(__file__).parent / "results"
FOLDERS = {"SafeDrive-v0": "safedrive", "MetaDriveSafety-v0": "metadrive"}


def drive(env, policy, expert, scenarios, rng, expert_share=0.0, steps=None):
    """Observations and labels of whole episodes, and per episode: success, cost, return, route completion."""
    observations, labels, episodes = [], [], []
    for scenario in scenarios:
        observation, _ = env.reset(options={"scenario": int(scenario)})
        expert.reset(int(scenario))
        by_expert, done, total = rng.random() < expert_share, False, 0.0
        while not done:
            label = expert(observation)
            observations.append(observation)
            labels.append(label)
            observation, reward, terminated, truncated, info = env.step(label if by_expert else policy(observation))
            done, total = terminated or truncated, total + reward
        episodes.append((info["is_success"], info["episode_cost"], total, info["route_completion"]))
        if steps is not None and len(observations) >= steps:
            break
    return np.array(observations), np.array(labels), np.array(episodes, dtype=float)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=FOLDERS, default="SafeDrive-v0")
    parser.add_argument("--corridors", action=argparse.BooleanOptionalAction, default=True, help="observe the corridors")
    parser.add_argument("--labels", type=int, default=200_000)
    parser.add_argument("--round", type=int, default=10_000, help="labels between two fits")
    parser.add_argument("--first", type=int, default=20_000, help="first map to learn on")
    parser.add_argument("--maps", type=int, default=1000, help="number of maps to learn on")
    parser.add_argument("--test", type=int, default=1000, help="first of the test maps")
    parser.add_argument("--episodes", type=int, default=100, help="number of test maps")
    parser.add_argument("--every", type=int, default=50_000, help="labels between two tests")
    parser.add_argument("--epochs", type=int, default=4)
    parser.add_argument("--hidden", type=int, default=256, help="width of both hidden layers")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="default: dagger.csv in the simulator's folder of benchmarks/results")
    args = parser.parse_args()
    out = args.out or RESULTS / FOLDERS[args.env] / "dagger.csv"
    th.manual_seed(args.seed)
    th.set_num_threads(1)
    rng = np.random.default_rng(args.seed)
    env = gym.make(args.env, corridors=args.corridors).unwrapped
    expert = env.scripted_driver("scripted-ideal")
    n_inputs, n = env.observation_space.shape[0], args.hidden
    net = nn.Sequential(nn.Linear(n_inputs, n), nn.ReLU(), nn.Linear(n, n), nn.ReLU(), nn.Linear(n, 2), nn.Tanh())
    optimizer = th.optim.Adam(net.parameters(), lr=1e-3)

    def policy(observation):
        with th.no_grad():
            return net(th.as_tensor(observation)).numpy()

    data_x = np.empty((0, env.observation_space.shape[0]), np.float32)
    data_y = np.empty((0, 2), np.float32)
    start, share = time.process_time(), 1.0
    while len(data_x) < args.labels:
        scenarios = args.first + rng.integers(args.maps, size=1000)
        x, y, episodes = drive(env, policy, expert, scenarios, rng, share, args.round)
        share = max(0.0, share - 0.25)
        data_x, data_y = np.concatenate([data_x, x]), np.concatenate([data_y, y])
        last = len(data_x) >= args.labels
        tensors = th.as_tensor(data_x), th.as_tensor(data_y)
        epochs = 5 * args.epochs if last else args.epochs
        for epoch in range(epochs):
            for group in optimizer.param_groups:
                group["lr"] = 1e-3 * (1 - epoch / epochs)
            for batch in th.randperm(len(data_x)).split(256):
                loss = nn.functional.mse_loss(net(tensors[0][batch]), tensors[1][batch])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
        success, cost, total, completion = episodes.mean(axis=0).tolist()
        print(
            f"{len(data_x)} labels, loss {loss.item():.4f}, while learning: success {success:.2f} cost {cost:.2f}", flush=True
        )
        if last or len(data_x) // args.every > (len(data_x) - len(x)) // args.every:
            tests = range(args.test, args.test + args.episodes)
            _, _, episodes = drive(env, policy, expert, tests, rng)
            success, cost, total, completion = episodes.mean(axis=0).tolist()
            row = {
                "env": args.env,
                "corridors": args.corridors,
                "hidden": args.hidden,
                "seed": args.seed,
                "maps": args.maps,
                "labels": len(data_x),
                "loss": round(loss.item(), 5),
                "success": round(success, 3),
                "cost": round(cost, 3),
                "return": round(total, 1),
                "route_completion": round(completion, 3),
            }
            print("test:", row, f"{time.process_time() - start:.0f} s", flush=True)
            lab.append(out, row)


if __name__ == "__main__":
    main()
