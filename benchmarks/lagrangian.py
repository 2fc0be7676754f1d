"""Safe velocity: HalfCheetah-v5 with cost 1 in each step faster than 3.2096 m/s, at most 25 an episode of 1000 steps.

    python benchmarks/lagrangian.py run --jobs 2    # SAC-Lag, PPO-Lag, and SAC and PPO beside them; runs what is missing
    python benchmarks/lagrangian.py report          # prints the table and draws the curves from the CSVs

The threshold and the limit are those of Safety-Gymnasium's SafetyHalfCheetahVelocity. Each pair has the same hyperparameters:
SB3's defaults for SAC, RL-Zoo3's of HalfCheetah for PPO. One CSV per run in benchmarks/results/lagrangian/, a row for
each tenth of the training: return and cost of its episodes (what the limit is on), and of 5 deterministic ones. A run that was
cut off starts anew. Seeds 0-2 are the reported ones; tuning is done on seeds from 100.
"""

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import lab
import numpy as np
import tables
import torch as th
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, sync_envs_normalization

from sb3_chac import PPOLag, SACLag

RESULTS = Path(__file__).parent / "results" / "lagrangian"
ENV = "HalfCheetah-v5"
FASTEST, LIMIT = 3.2096, 25.0  # [m/s], steps an episode
PARTS, EVALUATION_EPISODES = 10, 5
VERSIONS = lab.versions("torch", "stable-baselines3", "gymnasium", "mujoco", "numpy")


class Speeding(gym.Wrapper):
    """``info["cost"]`` is 1 in each step that is faster than ``FASTEST``, and ``info["episode_cost"]`` their number so far."""

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self.episode_cost = 0.0
        return super().reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        cost = float(info["x_velocity"] > FASTEST)
        self.episode_cost += cost
        return observation, reward, terminated, truncated, info | {"cost": cost, "episode_cost": self.episode_cost}


class Method(NamedTuple):
    algorithm: type[BaseAlgorithm]
    steps: int
    kwargs: dict[str, Any]
    normalize: bool  # observations and rewards


SAC_KWARGS: dict[str, Any] = dict(learning_starts=1000, policy_kwargs=dict(optimizer_kwargs=dict(fused=True)))
PPO_KWARGS: dict[str, Any] = dict(
    n_steps=512, batch_size=64, gamma=0.98, learning_rate=2.0633e-05, ent_coef=0.000401762, clip_range=0.1, n_epochs=20,
    gae_lambda=0.92, max_grad_norm=0.8, vf_coef=0.58096,
    policy_kwargs=dict(log_std_init=-2.0, ortho_init=False, activation_fn=th.nn.ReLU, net_arch=[256, 256]),
)  # fmt: skip
METHODS = {
    "sac": Method(SAC, 100_000, SAC_KWARGS, False),
    "sac_lag": Method(
        SACLag,
        100_000,
        dict(**SAC_KWARGS, cost_limit=LIMIT, lagrange_start=5000, pid_kp=0.05, pid_ki=0.02, pid_kd=0.01, pid_tau=0.2),
        False,
    ),
    "ppo": Method(PPO, 400_000, PPO_KWARGS, True),
    "ppo_lag": Method(
        PPOLag, 400_000, dict(**PPO_KWARGS, cost_limit=LIMIT, pid_kp=0.005, pid_ki=0.0005, pid_kd=0.01, pid_tau=0.2), True
    ),
}


class CostOfEpisodes(BaseCallback):
    """Return and cost of the training's episodes since ``clear``."""

    def __init__(self) -> None:
        super().__init__()
        self.clear()

    def clear(self) -> None:
        self.returns: list[float] = []
        self.costs: list[float] = []

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self.returns.append(info["episode"]["r"])
                self.costs.append(info["episode_cost"])
        return True


def evaluate(model: BaseAlgorithm, env: VecEnv) -> tuple[float, float]:
    """
    :return: mean return and mean cost of deterministic episodes
    """
    if isinstance(env, VecNormalize):
        sync_envs_normalization(model.get_env(), env)
    returns, costs = [], []
    observation = env.reset()
    while len(returns) < EVALUATION_EPISODES:
        observation, _, _, infos = env.step(model.predict(observation, deterministic=True)[0])
        for info in infos:
            if "episode" in info:
                returns.append(info["episode"]["r"])
                costs.append(info["episode_cost"])
    return float(np.mean(returns)), float(np.mean(costs))


def run(name: str, seed: int, folder: Path) -> str:
    th.set_num_threads(1)
    method = METHODS[name]
    path = folder / f"{name}-{seed}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)

    env: VecEnv = make_vec_env(ENV, seed=seed, wrapper_class=Speeding)
    evaluation_env: VecEnv = make_vec_env(ENV, seed=10_000 + seed, wrapper_class=Speeding)
    if method.normalize:
        env = VecNormalize(env, gamma=method.kwargs["gamma"])
        evaluation_env = VecNormalize(evaluation_env, training=False, norm_reward=False)
    model = method.algorithm("MlpPolicy", env, seed=seed, device="cpu", **method.kwargs)
    episodes = CostOfEpisodes()
    for part in range(1, PARTS + 1):
        episodes.clear()
        model.learn(method.steps * part // PARTS - model.num_timesteps, episodes, reset_num_timesteps=False)
        evaluation_return, evaluation_cost = evaluate(model, evaluation_env)
        row = {
            "method": name,
            "seed": seed,
            "step": model.num_timesteps,
            "return": round(float(np.mean(episodes.returns)), 1),
            "cost": round(float(np.mean(episodes.costs)), 1),
            "evaluation_return": round(evaluation_return, 1),
            "evaluation_cost": round(evaluation_cost, 1),
            "multiplier": round(model.multiplier.value, 4) if hasattr(model, "multiplier") else "",
            "cpu_seconds": round(time.process_time()),
            "versions": VERSIONS,
        }
        lab.append(path, row)
    return f"{name} seed {seed}: {time.process_time():.0f} CPU seconds"


def read(path: Path) -> list[dict[str, str]]:
    """
    :return: the rows of a run that is complete, else none
    """
    rows = lab.read(path)
    return rows if len(rows) == PARTS else []


def run_all(args: argparse.Namespace) -> None:
    missing = [
        (run, name, seed, args.folder)
        for seed in args.seeds
        for name in args.methods
        if not read(args.folder / f"{name}-{seed}.csv")
    ]  # fmt: skip
    lab.run_all(missing, args.jobs)


def report(args: argparse.Namespace) -> None:
    """Mean ± standard deviation over seeds, of the last three tenths of the training."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(8.4, 3.2))
    print(tables.lagrangian())
    for name in args.methods:
        runs = [rows for seed in args.seeds if (rows := read(args.folder / f"{name}-{seed}.csv"))]
        if not runs:
            continue
        for key in ("return", "cost"):
            curves = np.array([[float(row[key]) for row in rows] for rows in runs])
            axis, share = axes[int(key == "cost")], np.arange(1, PARTS + 1) / PARTS
            (line,) = axis.plot(share, curves.mean(axis=0), label=name.upper().replace("_LAG", "-Lag"))
            axis.fill_between(share, curves.min(axis=0), curves.max(axis=0), color=line.get_color(), alpha=0.15)
    axes[0].set(xlabel="share of the training", ylabel="return of an episode")
    axes[1].set(xlabel="share of the training", ylabel="cost of an episode")
    axes[1].axhline(LIMIT, color="black", linewidth=0.8, linestyle="--")
    axes[0].legend()
    figure.tight_layout()
    figure.savefig(args.folder / "curves.png", dpi=90)


if __name__ == "__main__":
    parser = lab.make_parser(__doc__, ["run", "report"])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    lab.add_seeds(parser)
    lab.add_jobs(parser)
    parser.add_argument("--folder", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    {"run": run_all, "report": report}[arguments.command](arguments)
