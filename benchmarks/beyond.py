"""Beyond the human: C-HAC on SafeDrive-v0 with a timid human, who drives at a third of the usual speed.

    python benchmarks/beyond.py run --jobs 2     # runs what is missing; a row per evaluation in results/beyond/<seed>.csv
    python benchmarks/beyond.py report           # the table: the human, the end of stage 1, stage 2

So slow, half of the routes are too long for the time that there is. Settings are those of ``hyperparams/chac.yml`` but for
``ARGUMENTS``: the class's defaults, which leave more to the reward. Evaluations as in ``guidance.py``.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import lab
import tables
import torch as th
from guidance import PACKAGES, TEST_MAPS, make_model

from sb3_chac.envs.safedrive import SafeDriveEnv
from sb3_chac.envs.safedrive.driver import ScriptedDriver
from sb3_chac.evaluation.evaluation import evaluate

RESULTS = Path(__file__).parent / "results" / "beyond"
SPEED = 3.5  # [m/s]
SWITCH, EVERY = 20_000, 10_000
ARGUMENTS: dict[str, Any] = {"cost_coef": 100.0, "anchor_coef": 15.0}


class TimidDriver(ScriptedDriver):
    """The scripted driver, with its delay and noise, at ``SPEED``."""

    def __init__(self, env: Any):
        driven = env.unwrapped
        assert isinstance(driven, SafeDriveEnv)
        super().__init__(driven, desired_speed=SPEED)


def run(seed: int, steps: int, path: Path, arguments: dict[str, float]) -> str:
    th.set_num_threads(1)
    labels = {"seed": seed, "versions": lab.versions(*PACKAGES, "highway-env")}

    def note(who: str, step: int, policy: Any, human_steps: float, training_cost: float) -> None:
        summary = evaluate(policy, "SafeDrive-v0", TEST_MAPS).summary()
        row = {"who": who, "step": step, **{key: round(value, 4) for key, value in summary.items()}}
        row |= {
            "human_steps": int(human_steps),
            "training_cost": int(training_cost),
            "cpu_seconds": round(time.process_time()),
        }
        lab.append(path, labels | row)

    path.unlink(missing_ok=True)
    note("human", 0, "beyond:TimidDriver", 0, 0)
    model = make_model("chac", seed, "SafeDrive-v0", {"expert": "beyond:TimidDriver"}, **ARGUMENTS | arguments)
    while model.num_timesteps < steps:
        model.learn(EVERY, reset_num_timesteps=model.num_timesteps == 0)
        stage = "stage 1" if model.num_timesteps <= SWITCH else "stage 2"
        note(stage, model.num_timesteps, model, model.counts["human_steps"], model.counts["safety_cost"])
    return f"seed {seed}: {time.process_time():.0f} CPU seconds"


def run_all(args: argparse.Namespace) -> None:
    paths = {seed: args.results / f"{seed}.csv" for seed in args.seeds}
    missing = [seed for seed, path in paths.items() if not path.exists() or int(lab.read(path)[-1]["step"]) < args.steps]
    names = ("cost_coef", "anchor_coef", "max_deviation")
    arguments = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    lab.run_all([(run, seed, args.steps, paths[seed], arguments) for seed in missing], args.jobs)


def report(args: argparse.Namespace) -> None:
    print(tables.beyond(args.results))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["run", "report"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=40_000, help="of both stages")
    parser.add_argument("--jobs", type=int, default=2, help="processes at once, one torch thread each")
    parser.add_argument("--results", type=Path, default=RESULTS)
    for name in ("--cost-coef", "--anchor-coef", "--max-deviation"):
        parser.add_argument(name, type=float, help="of C-HAC, in place of that of the settings")
    given = parser.parse_args()
    {"run": run_all, "report": report}[given.command](given)
