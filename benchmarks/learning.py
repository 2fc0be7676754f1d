"""Learning curves of DSAC against SB3's SAC and sb3-contrib's TQC: same budget, network size and evaluation.

    python benchmarks/learning.py run --jobs 2     # runs what is missing; stop and restart it at any time
    python benchmarks/learning.py report           # prints the table from the CSVs

Hyperparameters are those of each algorithm's own RL-Zoo3 file (ours for DSAC, the zoo's for SAC and TQC), with
``net_arch=[256, 256]`` and one torch thread for all. Every evaluation is 10 deterministic episodes on an environment of
its own seed. The score of a run is the mean of its last three evaluations.
One CSV per run is written under ``benchmarks/results/learning/<env>/``, a row per evaluation as it comes; a run that was
cut off starts anew. Seeds 0-2 are the reported ones; tune on seeds from 100.
"""

import argparse
import csv
import time
from pathlib import Path

import lab
import numpy as np
import rl_zoo3
import sb3_contrib.tqc.tqc as tqc
import tables
import torch as th
import yaml
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

RESULTS = Path(__file__).parent / "results" / "learning"
BUDGETS = {"Pendulum-v1": (20_000, 2_000), "HalfCheetah-v5": (100_000, 10_000), "Hopper-v5": (100_000, 10_000)}
ALGOS = ("dsac", "sac", "tqc")
EVAL_EPISODES = 10
PACKAGES = ("torch", "stable-baselines3", "sb3-contrib", "gymnasium", "mujoco", "numpy")


def hyperparameters(algo: str, env_id: str) -> dict:
    """The entry of the algorithm's RL-Zoo3 yaml, as constructor arguments (the zoo lists MuJoCo tasks as -v4)."""
    if algo == "dsac":
        from sb3_chac.zoo import hyperparams_file

        path = hyperparams_file(algo)
    else:
        path = Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo}.yml"
    entries = yaml.safe_load(path.read_text())
    params = dict(entries.get(env_id) or entries[env_id.replace("-v5", "-v4")])
    del params["n_timesteps"]
    if isinstance(params.get("policy_kwargs"), str):
        params["policy_kwargs"] = eval(params["policy_kwargs"], {"dict": dict, "nn": th.nn})
    # Fused Adam is DSAC's default; for SAC and TQC it changes the speed, not the result
    params["policy_kwargs"] = {
        "optimizer_kwargs": {"fused": True},
        **params.get("policy_kwargs", {}),
        "net_arch": [256, 256],
    }
    return params


class Evaluate(BaseCallback):
    """Append one row to the CSV each time it is called."""

    def __init__(self, file, labels: list, eval_env):
        super().__init__()
        self.file, self.labels, self.eval_env = file, labels, eval_env
        self.versions = lab.versions(*PACKAGES)
        csv.writer(file).writerow(["algo", "env", "seed", "step", "return_mean", "return_std", "cpu_seconds", "versions"])

    def _on_step(self) -> bool:
        mean, std = evaluate_policy(self.model, self.eval_env, n_eval_episodes=EVAL_EPISODES, deterministic=True)
        row = [self.num_timesteps, f"{mean:.2f}", f"{std:.2f}", f"{time.process_time():.0f}", self.versions]
        csv.writer(self.file).writerow(self.labels + row)
        self.file.flush()
        return True


def run(algo: str, env_id: str, seed: int, folder: Path, overrides: dict | None = None) -> str:
    """Train one agent and write its evaluations to ``folder/<env>/<algo>-<seed>.csv``."""
    th.set_num_threads(1)
    # Half of TQC's time goes into this one elementwise loss; compiling it changes its speed, not its value.
    tqc.quantile_huber_loss = th.compile(tqc.quantile_huber_loss)
    algorithms = {"sac": SAC, "tqc": tqc.TQC}
    if algo == "dsac":
        from sb3_chac import DSAC

        algorithms["dsac"] = DSAC

    budget, eval_freq = BUDGETS[env_id]
    params = {**hyperparameters(algo, env_id), **(overrides or {})}
    model = algorithms[algo](env=env_id, seed=seed, device="cpu", **params)
    eval_env = make_vec_env(env_id, n_envs=1, seed=10_000 + seed)
    path = folder / env_id / f"{algo}-{seed}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        model.learn(budget, callback=EveryNTimesteps(eval_freq, Evaluate(file, [algo, env_id, seed], eval_env)))
    return f"{algo} {env_id} seed {seed}: {time.process_time():.0f} CPU seconds"


def is_finished(path: Path, budget: int) -> bool:
    rows = lab.read(path)
    return bool(rows) and int(rows[-1]["step"] or 0) >= budget


def run_all(args: argparse.Namespace) -> None:
    jobs = [
        (algo, env_id, seed)
        for env_id in args.envs
        for seed in args.seeds
        for algo in args.algos
        if not is_finished(args.folder / env_id / f"{algo}-{seed}.csv", BUDGETS[env_id][0])
    ]
    lab.run_all([(run, *job, args.folder) for job in jobs], args.jobs)


def report(args: argparse.Namespace) -> None:
    """Print the table and draw the curves (mean over seeds, shaded from the worst to the best seed)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(args.envs), figsize=(4.2 * len(args.envs), 3.2), squeeze=False)
    print(tables.learning())
    for env_id, axis in zip(args.envs, axes[0], strict=True):
        for algo in args.algos:
            paths = [args.folder / env_id / f"{algo}-{seed}.csv" for seed in args.seeds]
            runs = [lab.read(path) for path in paths if is_finished(path, BUDGETS[env_id][0])]
            if not runs:
                continue
            steps = [int(row["step"]) for row in runs[0]]
            curves = np.array([[float(row["return_mean"]) for row in rows] for rows in runs])
            (line,) = axis.plot(steps, curves.mean(axis=0), label=algo.upper())
            axis.fill_between(steps, curves.min(axis=0), curves.max(axis=0), color=line.get_color(), alpha=0.15)
        axis.set(title=env_id, xlabel="environment steps", ylabel="evaluation return")
        if axis.lines:
            axis.legend()
    figure.tight_layout()
    figure.savefig(args.folder / "curves.png", dpi=90)


if __name__ == "__main__":
    parser = lab.make_parser(__doc__, ["run", "report"])
    parser.add_argument("--envs", nargs="+", choices=BUDGETS, default=list(BUDGETS))
    parser.add_argument("--algos", nargs="+", choices=ALGOS, default=list(ALGOS))
    lab.add_seeds(parser)
    lab.add_jobs(parser)
    parser.add_argument("--folder", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    {"run": run_all, "report": report}[arguments.command](arguments)
