"""What guidance is worth: SAC, DSAC, PVP, D-PVP, C-HAC and C-HAC's ablations on SafeDrive-v0, with the same evaluation.

    python benchmarks/guidance.py run --jobs 2     # runs what is missing; stop and restart it at any time
    python benchmarks/guidance.py report           # prints the tables and draws the curves from the CSVs
    python benchmarks/guidance.py cost             # CPU time that wrapper, human and dual buffer add to a step of DSAC
    python benchmarks/guidance.py agents           # copies one trained agent per method to benchmarks/agents/

Hyperparameters are those of ``hyperparams/<algo>.yml``. Training maps 100-119; every evaluation is one deterministic episode
on each of the maps 1000-1199, without the human. Seeds 0-2 are the reported ones; tuning is done on seeds from 100 and maps
2000-2199. C-HAC and its ablations share their stage 1. With ``--env MetaDriveSafety-v0``, the same there.
One CSV per run is written to benchmarks/results/guidance/ (guidance-metadrive/), a row per evaluation as it comes. A run of
stage 2 that was cut off goes on from its last evaluation; others (half an hour at most) start anew. Models go to --models.
"""

import argparse
import functools
import io
import shutil
import time
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import lab
import numpy as np
import tables
import torch as th
import yaml
from guidance_curves import load_run
from lab import read
from rl_zoo3.utils import ALGOS, get_wrapper_class
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_chac import DSAC, InterventionWrapper
from sb3_chac.common.guided import GuidedOffPolicyAlgorithm
from sb3_chac.envs import ONE_PER_PROCESS
from sb3_chac.evaluation import curves
from sb3_chac.evaluation.curves import Method
from sb3_chac.evaluation.evaluation import evaluate
from sb3_chac.zoo.algorithms import hyperparams_file

HERE = Path(__file__).parent
RESULTS = {
    "SafeDrive-v0": HERE / "results" / "guidance",
    "MetaDriveSafety-v0": HERE / "results" / "guidance-metadrive",
}
PACKAGES = ("torch", "stable-baselines3", "gymnasium", "numpy")
SIMULATORS = {"SafeDrive-v0": "highway-env", "MetaDriveSafety-v0": "metadrive-simulator"}
TEST_MAPS, TUNING_MAPS = range(1000, 1200), range(2000, 2200)
FIRST_TUNING_SEED = 100
GUIDED, SWITCH = 50_000, 20_000  # steps of D-PVP, and of C-HAC's stage 1
AFTER_SWITCH = 50_000  # steps that the ablations are compared over


class Config(NamedTuple):
    algo: str
    steps: int
    title: str
    overrides: dict[str, Any] = {}  # noqa: RUF012
    goes_on_from: str | None = None  # the method whose last state it starts with
    human: dict[str, Any] | None = None  # arguments of the InterventionWrapper, if not those of the yaml


METHODS = {
    "sac": Config("sac", 200_000, "SAC"),
    "dsac": Config("dsac", 200_000, "DSAC"),
    "pvp": Config("pvp", GUIDED, "PVP"),
    "dpvp": Config("dpvp", GUIDED, "D-PVP"),
    "dpvp-1k": Config("dpvp", GUIDED, "D-PVP, 1K human steps", human={"budget": 1000}),
    "dpvp-2k": Config("dpvp", GUIDED, "D-PVP, 2K human steps", human={"budget": 2000}),
    "chac-stage-1": Config("chac", SWITCH, "C-HAC, end of stage 1"),
    "chac": Config("chac", 200_000, "C-HAC", {}, "chac-stage-1"),
    "chac-no-share": Config("chac", SWITCH + AFTER_SWITCH, "C-HAC, No Share", {"shared_control": False}, "chac-stage-1"),
    "chac-no-confidence": Config("chac", SWITCH + AFTER_SWITCH, "C-HAC, No Confidence", {"delta": 0.5}, "chac-stage-1"),
}

# What of a policy acts when deterministic
ACTING = {
    "sac": ("actor.",),
    "dsac": ("actor.",),
    "pvp": ("actor.",),
    "dpvp": ("averaged_actor.",),
    "chac": ("actor.", "averaged_actor.", "averaged_self_actor.", "confidence_critic."),
}


def make_model(algo: str, seed: int, env_id: str, human: dict[str, Any] | None = None, **overrides: Any) -> BaseAlgorithm:
    """As ``rl_zoo3 train --algo <algo> --env <env_id>`` makes it, with another human if there are arguments of one."""
    params = yaml.safe_load(hyperparams_file(algo).read_text())[env_id]
    del params["n_timesteps"]
    if human is not None:
        (wrapper_kwargs,) = params["env_wrapper"][0].values()
        wrapper_kwargs |= human
    wrapper = get_wrapper_class(params)
    params.pop("env_wrapper", None)
    policy_kwargs = eval(params.get("policy_kwargs", "dict()"), {"dict": dict, "th": th})
    if algo == "sac":  # the default of our policies; it changes the speed, not the result
        policy_kwargs["optimizer_kwargs"] = {"fused": True}
    vec_env_cls = SubprocVecEnv if env_id in ONE_PER_PROCESS else DummyVecEnv
    env = make_vec_env(env_id, seed=seed, wrapper_class=wrapper, vec_env_cls=vec_env_cls)
    return ALGOS[algo](env=env, seed=seed, device="cpu", **params | {"policy_kwargs": policy_kwargs} | overrides)


class Record(BaseCallback):
    """Sums up the safety cost of the training, and appends a row to the CSV at each evaluation."""

    def __init__(
        self,
        path: Path,
        labels: dict[str, Any],
        env_id: str,
        every: int,
        maps: range,
        training_cost: float = 0.0,
        save_to: Path | None = None,
    ):
        """
        :param training_cost: so far
        :param save_to: model and transitions at each evaluation, nothing if None
        """
        super().__init__()
        self.env_id, self.versions = env_id, lab.versions(*PACKAGES, SIMULATORS[env_id])
        self.path, self.labels, self.every, self.maps = path, labels, every, maps
        self.training_cost = training_cost
        self.save_to = save_to

    def _on_step(self) -> bool:
        self.training_cost += sum(info["cost"] for info in self.locals["infos"])
        if self.num_timesteps % self.every == 0:
            summary = evaluate(self.model, self.env_id, self.maps).summary()
            counts = getattr(self.model, "counts", {})
            row = {**self.labels, "step": self.num_timesteps, **{key: round(value, 4) for key, value in summary.items()}}
            row |= {"human_steps": int(counts.get("human_steps", 0)), "training_cost": int(self.training_cost)}
            row |= {"training_cost_human": int(counts.get("safety_cost_human", 0))}
            row |= {"cpu_seconds": round(time.process_time()), "versions": self.versions}
            lab.append(self.path, row)
            if self.save_to is not None:
                self.model.save(self.save_to)
                self.model.save_replay_buffer(self.save_to.with_suffix(".pkl"))
        return True


def run(
    name: str, seed: int, every: int, results: Path, models: Path, env_id: str = "SafeDrive-v0", most_steps: int = 200_000
) -> str:
    th.set_num_threads(1)
    method = METHODS[name]
    path, end = results / f"{name}-{seed}.csv", models / f"{name}-{seed}.zip"
    for folder in (results, models):
        folder.mkdir(parents=True, exist_ok=True)
    model = make_model(method.algo, seed, env_id, method.human)
    maps = TUNING_MAPS if seed >= FIRST_TUNING_SEED else TEST_MAPS
    record = functools.partial(Record, path, {"method": name, "seed": seed}, env_id, every, maps)
    if method.goes_on_from is None:
        path.unlink(missing_ok=True)
        callback = record()
    else:
        if not (path.exists() and end.exists()):
            path.unlink(missing_ok=True)
            for suffix in (".zip", ".pkl"):
                shutil.copy((models / f"{method.goes_on_from}-{seed}").with_suffix(suffix), end.with_suffix(suffix))
        model = type(model).load(end, env=model.get_env(), device="cpu", **method.overrides)
        model.load_replay_buffer(end.with_suffix(".pkl"))
        forget_rows_after(path, model.num_timesteps)
        callback = record(training_cost=model.counts["safety_cost"], save_to=end)
    steps = min(method.steps, most_steps) - model.num_timesteps
    model.learn(steps, callback=callback, reset_num_timesteps=method.goes_on_from is None)
    model.save(end)
    if any(other.goes_on_from == name for other in METHODS.values()):
        model.save_replay_buffer(end.with_suffix(".pkl"))
    model.get_env().close()
    return f"{name} seed {seed}: {time.process_time():.0f} CPU seconds"


def forget_rows_after(path: Path, step: int) -> None:
    """Drop evaluations of a state that was not saved: they will be made again."""
    rows = read(path)
    kept = [row for row in rows if int(row["step"]) <= step]
    if len(kept) < len(rows):
        path.unlink()
        if kept:
            lab.append(path, *kept)


def is_finished(path: Path, method: Config, most_steps: int) -> bool:
    return path.exists() and int(read(path)[-1]["step"]) >= min(method.steps, most_steps)


def run_all(args: argparse.Namespace) -> None:
    def missing(go_on: bool) -> list[tuple[str, int]]:
        return [
            (name, seed)
            for seed in args.seeds
            for name in args.methods
            if (METHODS[name].goes_on_from is not None) == go_on
            and not is_finished(args.results / f"{name}-{seed}.csv", METHODS[name], args.steps)
        ]

    arguments = (args.every, args.results, args.models, args.env, args.steps)
    for go_on in (False, True):  # from what the first round leaves
        lab.run_all([(run, *job, *arguments) for job in missing(go_on)], args.jobs)


def report(args: argparse.Namespace) -> None:
    """Print the tables, and draw the curves (see ``curves.draw``)."""
    print(tables.guidance(args.results))
    print()
    print(tables.ablations(args.results, AFTER_SWITCH))
    drawn = []
    for name, method in METHODS.items():
        seeds = [seed for seed in args.seeds if (args.results / f"{name}-{seed}.csv").exists()]
        if seeds and not any(other.goes_on_from == name for other in METHODS.values()):
            drawn.append(Method(method.title, [load_run(args.results, name, seed, method.goes_on_from) for seed in seeds]))
    figure = curves.draw(drawn, (curves.RETURN, curves.SUCCESS, curves.COST, curves.TRAINING_COST))
    figure.axes[-1].set_yscale("symlog", linthresh=10)
    figure.savefig(args.results / "curves.png", dpi=90)


class GuidedDSAC(GuidedOffPolicyAlgorithm, DSAC):
    """DSAC that stores what a human drives apart, and else learns as it does."""


def cost(args: argparse.Namespace) -> None:
    """CPU time of a step of DSAC, with the wrapper, the human and the dual buffer and without, taking turns."""
    th.set_num_threads(1)
    params = dict(learning_rate=3e-4, learning_starts=200, policy_delay=1, policy_kwargs=dict(net_arch=[256, 256]), seed=0)
    guided_env = make_vec_env("SafeDrive-v0", seed=0, wrapper_class=InterventionWrapper)
    models = {
        "plain": DSAC("MlpPolicy", make_vec_env("SafeDrive-v0", seed=0), **params),
        "guided": GuidedDSAC("MlpPolicy", guided_env, **params),
    }
    rows = []
    for part in range(11):
        for name, model in models.items():
            start = time.process_time()
            model.learn(1000, reset_num_timesteps=False)
            rows.append(
                {
                    "part": part,
                    "kind": name,
                    "versions": lab.versions(*PACKAGES, SIMULATORS["SafeDrive-v0"]),
                    "cpu_ms_per_step": round(time.process_time() - start, 4),
                }
            )
    times = {name: [row["cpu_ms_per_step"] for row in rows if row["kind"] == name and row["part"] > 0] for name in models}
    ratios = np.array(times["guided"]) / np.array(times["plain"])
    print({name: f"{np.median(values):.2f} ms" for name, values in times.items()}, end=" ")
    print(f"guided / plain: median {np.median(ratios):.3f}, {ratios.min():.3f} to {ratios.max():.3f} in ten rounds")
    lab.write(args.results / "cost.csv", rows)


def agents(args: argparse.Namespace) -> None:
    """Of each method, the seed whose last evaluation is the median of the returns."""
    folder = HERE / "agents"
    folder.mkdir(exist_ok=True)
    for name, networks in ACTING.items():
        seeds = [seed for seed in args.seeds if is_finished(args.results / f"{name}-{seed}.csv", METHODS[name], args.steps)]
        if seeds:
            seeds.sort(key=lambda seed: float(read(args.results / f"{name}-{seed}.csv")[-1]["return_mean"]))
            chosen = seeds[(len(seeds) - 1) // 2]
            slim(args.models / f"{name}-{chosen}.zip", folder / f"{name}-{args.env}.zip", networks)
            print(f"{name}: seed {chosen}")


def slim(source: Path, target: Path, networks: tuple[str, ...]) -> None:
    """Keeps what acts when deterministic. All else becomes zeros, which take no room, and the optimizers lose their state."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            content = old.read(name)
            if name.endswith(".pth"):
                state = th.load(io.BytesIO(content), weights_only=False)
                if name == "policy.pth":
                    state = {k: v if k.startswith((*networks, "stage")) else th.zeros_like(v) for k, v in state.items()}
                elif name.endswith("optimizer.pth"):
                    state["state"] = {}
                buffer = io.BytesIO()
                th.save(state, buffer)
                content = buffer.getvalue()
            new.writestr(name, content)


if __name__ == "__main__":
    parser = lab.make_parser(__doc__, ["run", "report", "agents", "cost"])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    lab.add_seeds(parser)
    parser.add_argument("--every", type=int, default=10_000, help="steps between evaluations")
    parser.add_argument("--steps", type=int, default=200_000, help="most steps of a run, to stop the long ones earlier")
    lab.add_jobs(parser)
    parser.add_argument("--env", choices=RESULTS, default="SafeDrive-v0")
    parser.add_argument("--results", type=Path, help="default: see above")
    parser.add_argument("--models", type=Path, help="not committed; default: benchmarks/models/<env>")
    arguments = parser.parse_args()
    arguments.results = arguments.results or RESULTS[arguments.env]
    arguments.models = arguments.models or HERE / "models" / arguments.env
    {"run": run_all, "report": report, "agents": agents, "cost": cost}[arguments.command](arguments)
