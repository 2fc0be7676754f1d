"""Imitation in rounds and by a discriminator: HG-DAgger and IWR on SafeDrive-v0, GAIL on CartPole-v1 and HalfCheetah-v5.

    python benchmarks/imitation.py rounds --jobs 2   # HG-DAgger and IWR with the paper's budgets; runs what is missing
    python benchmarks/imitation.py gail --jobs 2     # experts (PPO, SAC), their demonstrations, GAIL; runs what is missing
    python benchmarks/imitation.py report            # tables of both from the CSVs

Hyperparameters of ``rounds`` are those of ``hyperparams/<algo>.yml``; after the warm-up and after each round, one
deterministic episode on each of the maps 1000-1049, without the human. One CSV per run in benchmarks/results/imitation/, a
row per evaluation as it comes; a run that was cut off starts anew. The experts of ``gail`` go to --work (not committed).
"""

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import lab
import numpy as np
import torch as th
import yaml
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import sb3_chac
from sb3_chac import GAIL, InterventionWrapper
from sb3_chac.common.demonstrations import Demonstrations
from sb3_chac.evaluation.evaluation import evaluate
from sb3_chac.zoo.algorithms import ALGORITHMS, hyperparams_file

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "imitation"
TEST_MAPS = range(1000, 1050)
N_ROUNDS = 4
VERSIONS = lab.versions("torch", "stable-baselines3", "gymnasium", "highway-env", "numpy")


# HG-DAgger and IWR


class AfterEachFit(BaseCallback):
    """Appends a row whenever the warm-up or a round has been learned from."""

    def __init__(self, path: Path, labels: dict[str, Any]):
        super().__init__()
        self.path, self.labels, self.evaluated = path, labels, 0

    def _on_rollout_start(self) -> None:
        if self.model.round > self.evaluated:
            self.evaluate()

    def _on_step(self) -> bool:
        return True

    def evaluate(self) -> None:
        self.evaluated += 1
        summary = {key: round(value, 4) for key, value in evaluate(self.model, "SafeDrive-v0", TEST_MAPS).summary().items()}
        counts = {key: int(self.model.counts[key]) for key in ("total_steps", "human_steps", "safety_cost")}
        lab.append(self.path, self.labels | {"round": self.evaluated - 1} | counts | summary | {"versions": VERSIONS})


def imitate_in_rounds(algo: str, seed: int) -> str:
    th.set_num_threads(1)
    path = RESULTS / f"{algo}-{seed}.csv"
    path.unlink(missing_ok=True)
    params = yaml.safe_load(hyperparams_file(algo).read_text())["SafeDrive-v0"]
    n_timesteps = int(params.pop("n_timesteps"))
    del params["env_wrapper"]
    env = make_vec_env("SafeDrive-v0", seed=seed, wrapper_class=InterventionWrapper)
    model = getattr(sb3_chac, ALGORITHMS[algo])(env=env, seed=seed, device="cpu", **params | {"n_rounds": N_ROUNDS})
    callback = AfterEachFit(path, {"algo": algo, "seed": seed})
    model.learn(n_timesteps, callback)
    callback.evaluate()  # what the last round left
    return f"{algo} seed {seed}: {time.process_time():.0f} CPU seconds"


# GAIL


class Task(NamedTuple):
    expert: type[BaseAlgorithm]
    expert_steps: int
    expert_kwargs: dict[str, Any]
    n_episodes: int  # of demonstrations
    steps: int
    n_envs: int
    kwargs: dict[str, Any]


TASKS = {
    "CartPole-v1": Task(
        PPO, 100_000, {}, 20, 100_000, 8, dict(n_steps=256, batch_size=256, ent_coef=0.0, learning_rate=4e-4, n_disc_updates=8)
    ),
    "HalfCheetah-v5": Task(
        SAC,
        100_000,
        {},
        20,
        500_000,
        4,
        dict(
            n_steps=512, batch_size=256, gamma=0.98, gae_lambda=0.95, n_disc_updates=16, gradient_penalty=1.0,
            policy_kwargs=dict(log_std_init=-1.0, net_arch=[256, 256]),
        ),
    ),
}  # fmt: skip


def expert_and_demonstrations(env_id: str, folder: Path) -> tuple[float, Demonstrations]:
    """
    :return: mean return of the demonstrated episodes, and these
    """
    task = TASKS[env_id]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"expert-{env_id}.zip"
    if not path.exists():
        expert = task.expert("MlpPolicy", env_id, seed=100, device="cpu", **task.expert_kwargs).learn(task.expert_steps)
        expert.save(path)
    expert = task.expert.load(path, device="cpu")
    env = gym.make(env_id)
    columns: dict[str, list[Any]] = {
        name: []
        for name in ("observations", "actions", "next_observations", "rewards", "terminations", "truncations", "episodes")
    }
    for episode in range(task.n_episodes):
        observation, _ = env.reset(seed=10_000 + episode)
        done = False
        while not done:
            action, _ = expert.predict(observation, deterministic=True)
            next_observation, reward, terminated, truncated, _ = env.step(action)
            row = (observation, action, next_observation, float(reward), terminated, truncated, episode)
            for column, value in zip(columns.values(), row, strict=True):
                column.append(value)
            observation, done = next_observation, terminated or truncated
    data = Demonstrations(env.observation_space, env.action_space, **{name: np.array(c) for name, c in columns.items()})
    return float(data.rewards.sum() / task.n_episodes), data


def imitate_by_discriminator(env_id: str, seed: int, folder: Path) -> str:
    th.set_num_threads(1)
    path = RESULTS / f"gail-{env_id}-{seed}.csv"
    path.unlink(missing_ok=True)
    expert_return, data = expert_and_demonstrations(env_id, folder)
    task = TASKS[env_id]
    env = make_vec_env(env_id, task.n_envs, seed=seed)
    model = GAIL("MlpPolicy", env, data, seed=seed, device="cpu", **task.kwargs)
    labels = {"env": env_id, "seed": seed, "expert_return": round(expert_return, 1), "demonstrated_steps": len(data)}
    evaluation_env = make_vec_env(env_id, seed=20_000 + seed)
    for part in range(11):
        if part:
            model.learn(task.steps // 10, reset_num_timesteps=False)
        returns = evaluate_policy(model, evaluation_env, 20, return_episode_rewards=True)[0]
        row = {"step": model.num_timesteps, "return_mean": round(np.mean(returns), 1), "return_std": round(np.std(returns), 1)}
        lab.append(path, labels | row | {"cpu_seconds": round(time.process_time()), "versions": VERSIONS})
    return f"GAIL {env_id} seed {seed}: {time.process_time():.0f} CPU seconds"


def rounds(args: argparse.Namespace) -> None:
    missing = [
        (imitate_in_rounds, algo, seed)
        for seed in args.seeds
        for algo in ("hg_dagger", "iwr")
        if len(lab.read(RESULTS / f"{algo}-{seed}.csv")) < N_ROUNDS + 1
    ]
    lab.run_all(missing, args.jobs)


def gail(args: argparse.Namespace) -> None:
    for env_id in args.envs:  # once, not by several processes at a time
        print(f"{env_id}: expert {expert_and_demonstrations(env_id, args.work)[0]:.1f}", flush=True)
    missing = [
        (imitate_by_discriminator, env_id, seed, args.work)
        for env_id in args.envs
        for seed in args.seeds
        if len(lab.read(RESULTS / f"gail-{env_id}-{seed}.csv")) < 11
    ]
    lab.run_all(missing, args.jobs)


def report(args: argparse.Namespace) -> None:
    """Mean ± standard deviation over seeds."""

    def text(rows: list[dict[str, str]], key: str, digits: int) -> str:
        values = [float(row[key]) for row in rows]
        return f"{np.mean(values):.{digits}f}" + (f" ± {np.std(values, ddof=1):.{digits}f}" if len(values) > 1 else "")

    print("| method | seeds | after round | human steps | all steps | success | cost | return |")
    print("|---" * 8 + "|")
    for algo in ("hg_dagger", "iwr"):
        runs = [run for seed in args.seeds if len(run := lab.read(RESULTS / f"{algo}-{seed}.csv")) == N_ROUNDS + 1]
        for number, rows in enumerate(zip(*runs, strict=True)):
            columns = [("human_steps", 0), ("total_steps", 0), ("success_rate", 2), ("cost_mean", 2), ("return_mean", 0)]
            cells = [text(list(rows), *column) for column in columns]
            print(f"| {algo} | {len(runs)} | {number or 'warm-up'} | " + " | ".join(cells) + " |")
    print(
        "\n| GAIL on | seeds | demonstrated steps | expert | untrained | at the end | steps |\n|---|---|---|---|---|---|---|"
    )
    for env_id in args.envs:
        runs = [run for seed in args.seeds if len(run := lab.read(RESULTS / f"gail-{env_id}-{seed}.csv")) == 11]
        if runs:
            first, last = [run[0] for run in runs], [run[-1] for run in runs]
            print(
                f"| {env_id} | {len(runs)} | {last[0]['demonstrated_steps']} | {last[0]['expert_return']} "
                f"| {text(first, 'return_mean', 0)} | {text(last, 'return_mean', 0)} | {last[0]['step']} |"
            )


if __name__ == "__main__":
    commands = {f.__name__: f for f in (rounds, gail, report)}
    parser = lab.make_parser(__doc__, commands)
    lab.add_seeds(parser)
    parser.add_argument("--envs", nargs="+", choices=TASKS, default=list(TASKS), help="of GAIL")
    lab.add_jobs(parser)
    parser.add_argument("--work", type=Path, default=HERE / "models" / "imitation")
    arguments = parser.parse_args()
    commands[arguments.command](arguments)
