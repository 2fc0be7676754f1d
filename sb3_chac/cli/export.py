"""``python -m sb3_chac export``: a trained model as one ONNX file."""

import argparse
import hashlib
import math
import sys
from pathlib import Path

import torch as th

from sb3_chac.cli.arguments import add_control, add_env_kwargs, check_output, parse_env_kwargs
from sb3_chac.cli.command import check_least, command_parser, run_command
from sb3_chac.deploy.export import compare, export
from sb3_chac.deploy.metadata import NotDeployable
from sb3_chac.deploy.policy import OnnxPolicy
from sb3_chac.evaluation.episodes import ModelDriver, NotEvaluable, make_env
from sb3_chac.evaluation.evaluation import scenario_list
from sb3_chac.evaluation.models import env_of, find_algorithm, find_normalization, load_model

DESCRIPTION = """Write a model as one ONNX graph, with all that acts inside: normalization of the observation
(<folder of the model>/<env>/vecnormalize.pkl, if it is there), averaged parameters, C-HAC's shared control, clipping and
units. The file tells a runtime what goes in and what comes out, see docs/guide/deployment.md.

  sb3-chac export logs/chac/SafeDrive-v0_1/best_model.zip policy.onnx --check 1000
  sb3-chac export benchmarks/agents/chac-SafeDrive-v0.zip policy.onnx --env-kwargs corridors:False
  sb3-chac run policy.onnx --listen 127.0.0.1:5600

It needs onnx and onnxruntime: pip install 'sb3_chac[deploy]'.
A model and its vecnormalize.pkl are code (docs/loading.md): load those that you trust only."""


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = command_parser("export", DESCRIPTION)
    parser.add_argument("model", type=Path, metavar="MODEL.zip", help="a model saved by Stable-Baselines3")
    parser.add_argument("file", type=Path, metavar="POLICY.onnx", help="the file to write")
    parser.add_argument(
        "--env", metavar="ID", help="environment, also module:ID (default: ours that MODEL.zip is called after)"
    )
    add_env_kwargs(parser)
    parser.add_argument("--algo", metavar="NAME", help="algorithm as RL-Zoo3 calls it (default: read from the file)")
    add_control(parser)
    parser.add_argument("--rate", type=float, metavar="HZ", help="decisions per second (default: the environment's)")
    parser.add_argument("--check", type=int, metavar="N", help="drive N steps and compare with predict(); differences fail")
    parser.add_argument(
        "--scenarios", metavar="RANGE", help="of the check, e.g. 1000:1050 (default: those, in our environments)"
    )
    return parser


def main(arguments: list[str]) -> None:
    """
    Run the command.

    :param arguments: of the command line, after ``export``
    """
    equal = run_command(make_parser(), arguments, run, NotEvaluable, NotDeployable)
    if not equal:
        sys.exit(1)


def run(args: argparse.Namespace) -> bool:
    """
    Export a model and compare it with its graph.

    :param args: see ``make_parser``
    :return: whether the file acts as the model does, as far as that was checked
    :raises FileNotFoundError: if the model, or the folder of the file, does not exist
    :raises ValueError: for whatever else does not fit (``NotEvaluable``, ``NotDeployable``)
    """
    th.set_num_threads(1)
    check_least(args, NotDeployable, check=1)
    if args.rate is not None and not (math.isfinite(args.rate) and args.rate > 0):
        raise NotDeployable(f"--rate must be a finite number above 0, got {args.rate}.")
    check_output("POLICY.onnx", args.file, (".onnx",))
    path, algo, algorithm = find_algorithm(args.model, args.algo)
    env_id = args.env or env_of(path)
    env = make_env(env_id, parse_env_kwargs(args.env_kwargs))
    try:
        model = load_model(path, algo, algorithm, env, args.control)
        ModelDriver(model, env, None)  # finds what does not fit
        statistics, normalize = find_normalization(path, env_id, env)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        metadata = export(model, args.file, normalize=normalize, env=env, rate=args.rate, model_sha256=digest)
        normalized = f", observations normalized with {statistics}" if normalize else ""
        print(f"Saved {args.file}: {metadata.algorithm}{normalized}, {args.file.stat().st_size / 1e6:.1f} MB")
        if args.check is None:
            return True
        own = args.scenarios or ("1000:1050" if hasattr(env.unwrapped, "scripted_driver") else None)
        numbers = scenario_list(own) if own else None
        result = compare(model, OnnxPolicy(args.file), env, args.check, normalize=normalize, scenarios=numbers)
        print(f"{result}: {'equal' if result.equal else 'NOT EQUAL'}")
        return result.equal
    finally:
        env.close()
