"""``python -m sb3_chac evaluate``: a trained model, or an expert, on held-out scenarios."""

import argparse
import csv
from pathlib import Path
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from sb3_chac.chac.policies import CONTROLS
from sb3_chac.cli.arguments import add_control, add_env_kwargs, add_seed_and_jobs, check_output, parse_env_kwargs
from sb3_chac.cli.command import check_least, command_parser, run_command
from sb3_chac.evaluation import pictures
from sb3_chac.evaluation.episodes import NotEvaluable, Runner, Task, make_env
from sb3_chac.evaluation.evaluation import Evaluation, compare, evaluate, scenario_list
from sb3_chac.evaluation.models import DEFAULT_ENV, env_of, find_algorithm, find_normalization, load_model

DESCRIPTION = """Run one deterministic episode per scenario and print return, safety cost, success rate, route completion
and steps, as mean ± standard deviation over the episodes. The results do not depend on --jobs.

  sb3-chac evaluate logs/chac/SafeDrive-v0_1/best_model.zip --scenarios 1000:1050 --json chac.json
  sb3-chac evaluate logs/chac/SafeDrive-v0_1/SafeDrive-v0.zip --beside guided self scripted
  sb3-chac evaluate --expert scripted --scenarios 1000:1012 --plot paths.png --video drive.mp4
  sb3-chac evaluate logs/sac/Pendulum-v1_1/Pendulum-v1.zip --env Pendulum-v1 --episodes 20

If <folder of the model>/<env>/vecnormalize.pkl exists, where RL-Zoo3 leaves it, observations are normalized with it.
Cost, success and route completion are only reported if the environment's info has 'cost', 'is_success' and
'route_completion' in every episode; the JSON file leaves out what is not there.

A model and its vecnormalize.pkl are code (docs/loading.md): load those that you trust only."""


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = command_parser("evaluate", DESCRIPTION)
    who = parser.add_argument_group("who acts (one of the two)")
    who.add_argument("model", nargs="?", type=Path, metavar="MODEL.zip", help="a model saved by Stable-Baselines3")
    who.add_argument("--expert", metavar="NAME", help="an expert of the environment, as scripted, or package.module:function")
    who.add_argument("--algo", metavar="NAME", help="algorithm of the model as RL-Zoo3 calls it (default: read from the file)")
    add_control(who)
    who.add_argument(
        "--beside",
        nargs="+",
        default=[],
        metavar="NAME",
        help="compare with these on the same episodes: experts (also package.module:function), and guided, self or shared "
        "of the same C-HAC model",
    )
    where = parser.add_argument_group("where")
    where.add_argument(
        "--env",
        metavar="ID",
        help=f"environment, also module:ID (default: ours that MODEL.zip is called after, else {DEFAULT_ENV})",
    )
    add_env_kwargs(where)
    count = where.add_mutually_exclusive_group()
    count.add_argument(
        "--scenarios",
        default="1000:1050",
        metavar="RANGE",
        help="1000:1050 (without 1050), 1000 or 1000,1003:1010 (%(default)s)",
    )
    count.add_argument("--episodes", type=int, metavar="N", help="for environments without scenarios: number of episodes")
    add_seed_and_jobs(where)
    what = parser.add_argument_group("what is written, besides the table")
    what.add_argument("--json", type=Path, metavar="FILE", help="summary, settings, versions and one record per episode")
    what.add_argument("--steps", type=Path, metavar="FILE.csv", help="a row per step: position, action, whether cost arose")
    what.add_argument("--plot", type=Path, metavar="FILE.png", help="the driven paths on the map, up to 12 scenarios")
    what.add_argument("--video", type=Path, metavar="FILE", help=".mp4 or .gif of one episode")
    what.add_argument("--video-scenario", type=int, metavar="K", help="scenario (or episode) to film (default: the first)")
    return parser


def main(arguments: list[str]) -> None:
    """
    Run the command.

    :param arguments: of the command line, after ``evaluate``
    """
    run_command(make_parser(), arguments, run, NotEvaluable)


class Request(NamedTuple):
    """
    Checked request of a command line.

    :param policy: model, or name of an expert
    :param env: id of the environment
    :param env_kwargs: passed to it
    :param normalize: statistics that a model's observations are normalized with, None if they are not
    :param others: name -> whom it is compared with on the same episodes
    :param who: entries of the settings that say who acts
    :param filmed: scenario (or episode) of the video
    """

    policy: BaseAlgorithm | str
    env: str
    env_kwargs: dict[str, Any]
    normalize: VecNormalize | None
    others: dict[str, BaseAlgorithm | str]
    who: dict[str, str]
    filmed: int


def run(args: argparse.Namespace) -> None:
    """
    Evaluate as the command line says.

    :param args: see ``make_parser``
    :raises FileNotFoundError: if the model, or the folder of an output file, does not exist
    :raises NotEvaluable: for whatever else does not fit, found before the episodes run
    """
    th.set_num_threads(1)
    request = resolve(args)
    check_task(args, request)
    evaluation, beside = assess(args, request)
    print(compare([evaluation, *beside]) if beside else evaluation.table())
    write_files(args, evaluation, request)


def resolve(args: argparse.Namespace) -> Request:
    """
    Find what the command line names.

    :raises FileNotFoundError: if the model, or the folder of an output file, does not exist
    :raises NotEvaluable: for whatever does not fit
    """
    if (args.model is None) == (args.expert is None):
        raise NotEvaluable("give either a MODEL.zip or --expert NAME")
    if args.model is None and args.control is not None:
        raise NotEvaluable(f"--control {args.control} needs a C-HAC model")
    check_output("--json", args.json)
    check_output("--steps", args.steps, (".csv",))
    check_output("--plot", args.plot, pictures.PLOT_SUFFIXES)
    check_output("--video", args.video, pictures.VIDEO_SUFFIXES)
    check_least(args, NotEvaluable, seed=0, jobs=1, episodes=1)
    numbers = scenario_list(args.scenarios) if args.episodes is None else list(range(args.episodes))
    filmed = numbers[0] if args.video_scenario is None else args.video_scenario
    if filmed not in numbers:
        raise NotEvaluable(f"--video-scenario {filmed} is not among those that are evaluated.")

    env_id = env_of(args.model) if args.env is None else args.env
    env_kwargs = parse_env_kwargs(args.env_kwargs)
    others: dict[str, BaseAlgorithm | str] = {name: name for name in args.beside}
    if args.model is None:
        return Request(args.expert, env_id, env_kwargs, None, others, {"expert": args.expert}, filmed)

    path, algo, algorithm = find_algorithm(args.model, args.algo)
    env = make_env(env_id, env_kwargs)
    policy = load_model(path, algo, algorithm, env, args.control)
    others |= {name: load_model(path, algo, algorithm, env, name) for name in args.beside if name in CONTROLS}
    statistics, normalize = find_normalization(path, env_id, env)
    env.close()
    print(f"{path}: {algorithm.__name__}" + (f", observations normalized with {statistics}" if normalize else ""))
    return Request(policy, env_id, env_kwargs, normalize, others, {"model": str(path), "algo": algo}, filmed)


def task_of(args: argparse.Namespace, request: Request) -> Task:
    """Return the episodes of the model or expert."""
    return Task(request.policy, request.env, request.env_kwargs, request.normalize, args.seed, args.episodes is None)


def check_task(args: argparse.Namespace, request: Request) -> None:
    """
    Check before the episodes run that they can be driven, and drawn as the command line says.

    :raises NotEvaluable: if not
    """
    task, first = task_of(args, request), scenario_list(args.scenarios)[0] if args.episodes is None else 0
    if args.plot or args.steps or args.video:
        with Runner(task) as runner:
            if args.steps:
                pictures.check_has(runner, first, "position")
            if args.plot:
                pictures.check_has(runner, first, "position", "plot_map")
            if args.video:
                pictures.check_can_render(runner)
    for other in request.others.values():
        Runner(task._replace(policy=other)).env.close()  # finds what does not fit


def assess(args: argparse.Namespace, request: Request) -> tuple[Evaluation, list[Evaluation]]:
    """
    Run the episodes.

    :return: evaluation of the model or expert, and of each that it is compared with
    """

    def assess_one(acting: BaseAlgorithm | str, record_paths: bool = False) -> Evaluation:
        return evaluate(
            acting,
            request.env,
            args.scenarios,
            episodes=args.episodes,
            seed=args.seed,
            jobs=args.jobs,
            env_kwargs=request.env_kwargs,
            normalize=None if isinstance(acting, str) else request.normalize,
            record_paths=record_paths,
            progress_bar=True,
        )

    evaluation = assess_one(request.policy, record_paths=bool(args.plot or args.steps))
    evaluation.settings |= request.who
    beside = {name: assess_one(other) for name, other in request.others.items()}
    if beside:
        evaluation.settings["beside"] = {name: other.to_dict() for name, other in beside.items()}
    return evaluation, list(beside.values())


def write_files(args: argparse.Namespace, evaluation: Evaluation, request: Request) -> None:
    """
    Write the files of an evaluation.

    :param args: which files
    :param evaluation: what goes into them
    :param request: that was evaluated
    """
    if args.json:
        args.json.write_text(evaluation.to_json() + "\n")
    if args.steps:
        write_steps(args.steps, evaluation)
    if args.plot:
        with Runner(task_of(args, request)) as runner:
            pictures.save_plot(args.plot, runner, evaluation)
    if args.video:
        with Runner(task_of(args, request), render_mode="rgb_array") as runner:
            pictures.save_video(args.video, runner, request.filmed)
    for file in filter(None, (args.json, args.steps, args.plot, args.video)):
        print(f"Saved {file}")


def write_steps(file: Path, evaluation: Evaluation) -> None:
    """
    Write the steps of all episodes.

    :param file: CSV, gets a row for each step: scenario (or episode), step, x and y [m] before it, the action, and cost: 1 if
        any arose in it
    :param evaluation: made with ``record_paths=True``
    """
    with file.open("w", newline="") as lines:
        writer = csv.writer(lines)
        for record, path in zip(evaluation.records, evaluation.paths, strict=True):
            actions = path.actions.reshape(len(path.actions), -1)
            if lines.tell() == 0:
                names = [f"action_{i}" for i in range(actions.shape[1])]
                writer.writerow(["scenario" if "scenario" in record else "episode", "step", "x", "y", *names, "cost"])
            for step, (position, action, costly) in enumerate(zip(path.positions, actions, path.costly[1:], strict=False)):
                number = record.get("scenario", record.get("episode"))
                writer.writerow([number, step, *position.round(3), *action.round(4), int(costly)])
