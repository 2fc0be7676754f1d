"""``python -m sb3_chac demos``: record demonstrations, look at them, drive them again."""

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from sb3_chac.cli.arguments import add_env_kwargs, add_seed_and_jobs, check_output, parse_env_kwargs
from sb3_chac.cli.command import check_least, command_parser, run_command
from sb3_chac.common.demonstrations import load_demonstrations
from sb3_chac.common.minari_datasets import DatasetError, open_dataset
from sb3_chac.datasets.recording import WatchedEnv, record
from sb3_chac.datasets.replay import Replay
from sb3_chac.datasets.writer import SETTINGS
from sb3_chac.deploy.dataset import dataset_of
from sb3_chac.evaluation import pictures
from sb3_chac.evaluation.episodes import NotEvaluable, make_env
from sb3_chac.evaluation.evaluation import saved_model
from sb3_chac.evaluation.models import DEFAULT_ENV, find_algorithm, find_normalization, load_model

if TYPE_CHECKING:
    from minari import MinariDataset

DESCRIPTION = """Demonstrations are datasets in Minari's format, see 'minari list local', in the folder MINARI_DATASETS_PATH,
~/.minari/datasets if it is not set. A folder may be named in place of an id.

  sb3-chac demos record --expert scripted --steps 50000 --dataset safedrive/scripted-v0
  sb3-chac demos record --expert scripted --novice sac.zip --dataset safedrive/takeovers-v0
  sb3-chac demos info --dataset safedrive/scripted-v0
  sb3-chac demos replay --dataset safedrive/scripted-v0 --episode 3 --video drive.mp4"""

RECORD = """Record whole episodes until there are at least --steps steps. With --novice, that model drives and the expert
watches it, takes over by --rule and hands back. The dataset does not depend on --jobs; nothing is left of one that is
interrupted. Models are code (docs/loading.md): open those that you trust only."""

FROM_LOG = """Write what a vehicle reported to 'sb3-chac run' as a dataset: observations, executed actions, who drove, what the
policy proposed, cost. A reward that it did not report is 0; where packets were lost, episodes are cut."""

REPLAY = """Make the environment again, reset it with the recorded seed and scenario, and repeat the actions of one episode. It
tells how far that led elsewhere than when it was recorded. The environment must be registered: a dataset runs no code."""


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = command_parser("demos", DESCRIPTION)
    commands = parser.add_subparsers(dest="command", required=True, metavar="{record,info,replay,from-log}")
    new = commands.add_parser("record", help="record a dataset", description=RECORD)
    new.add_argument("--dataset", required=True, metavar="ID", help="such as safedrive/scripted-v0, or a folder such as ./ds")
    new.add_argument("--overwrite", action="store_true", help="replace a dataset of that name")
    new.add_argument("--steps", type=int, default=50_000, metavar="N", help="how many at least (default: %(default)s)")
    who = new.add_argument_group("who acts")
    who.add_argument(
        "--expert",
        required=True,
        metavar="NAME|MODEL.zip",
        help="an expert of the environment, e.g. scripted, package.module:function, or a model",
    )
    who.add_argument("--novice", type=Path, metavar="MODEL.zip", help="who drives unless the expert takes over")
    who.add_argument(
        "--rule",
        metavar="NAME",
        help="when the expert takes over: risk (default), disagreement, always, never or package.module:function",
    )
    where = new.add_argument_group("where")
    where.add_argument("--env", default=DEFAULT_ENV, metavar="ID", help="environment, also module:ID (default: %(default)s)")
    add_env_kwargs(where)
    where.add_argument(
        "--scenarios", metavar="RANGE", help="in turns, e.g. 100:120 (without 120) (default: the environment chooses)"
    )
    add_seed_and_jobs(where)

    info = commands.add_parser("info", help="what is in a dataset", description="Print what is in a dataset.")
    replay = commands.add_parser("replay", help="drive an episode again", description=REPLAY)
    for command in (info, replay):
        command.add_argument("--dataset", required=True, metavar="ID", help="of Minari, or a folder such as ./ds")
    from_log = commands.add_parser("from-log", help="a log of 'sb3-chac run' as a dataset", description=FROM_LOG)
    from_log.add_argument("log", type=Path, metavar="LOG.jsonl", help="that 'sb3-chac run --log' wrote")
    from_log.add_argument("--dataset", required=True, metavar="ID", help="such as drives/monday-v0, or a folder such as ./ds")
    from_log.add_argument("--overwrite", action="store_true", help="replace a dataset of that name")
    from_log.add_argument("--env", default=DEFAULT_ENV, metavar="ID", help="with the vehicle's spaces (default: %(default)s)")
    add_env_kwargs(from_log)
    replay.add_argument("--episode", type=int, default=0, metavar="K", help="number, from 0 (default: %(default)s)")
    replay.add_argument("--video", type=Path, metavar="FILE", help=".mp4 or .gif of it")
    for command in (new, info, replay, from_log):
        command.set_defaults(prog=command.prog)
    return parser


def main(arguments: list[str]) -> None:
    """
    Run the command.

    :param arguments: of the command line, after ``demos``
    """
    # ValueErrors are ours and, of what a recorded environment tells, its author's
    run_command(make_parser(), arguments, run, ValueError)


def run(args: argparse.Namespace) -> None:
    """
    Run one of the subcommands.

    :param args: see ``make_parser``
    """
    th.set_num_threads(1)
    {"record": run_record, "info": run_info, "replay": run_replay, "from-log": run_from_log}[args.command](args)


def run_from_log(args: argparse.Namespace) -> None:
    """
    Make a dataset of a log of decisions.

    :param args: see ``make_parser``
    :raises ValueError: if the log does not fit (``NotDeployable``, ``DatasetError``, ``NotEvaluable``)
    """
    env = make_env(args.env, parse_env_kwargs(args.env_kwargs))
    try:
        folder, episodes, steps = dataset_of(args.log, args.dataset, env, args.overwrite)
    finally:
        env.close()
    print(f"Saved {folder}: {episodes} episodes, {steps} steps")


def run_record(args: argparse.Namespace) -> None:
    """
    Record a dataset.

    :param args: see ``make_parser``
    :raises DatasetError: for a name that is taken, or spaces that a dataset cannot hold
    :raises FileNotFoundError: if a model does not exist
    :raises NotEvaluable: for whatever else does not fit
    """
    check_least(args, NotEvaluable, steps=1, seed=0, jobs=1)
    if args.rule is not None and args.novice is None:
        raise NotEvaluable(f"--rule {args.rule}: it says when the expert takes over from a novice, give --novice, too.")
    env_kwargs = parse_env_kwargs(args.env_kwargs)
    env: str | Callable[..., Any] = args.env
    acting: BaseAlgorithm | str = args.expert
    expert: BaseAlgorithm | str = args.expert
    normalize = None
    if Path(args.expert).suffix == ".zip":
        expert, normalize = find_model(Path(args.expert), args.env, env_kwargs)
        acting = expert
    if args.novice is not None:
        if normalize is not None:
            raise NotEvaluable(f"--expert {args.expert} takes over raw observations, but was trained with normalized ones.")
        env = WatchedEnv(args.env, expert if isinstance(expert, str) else saved_model(expert), args.rule or "risk")
        acting, normalize = find_model(args.novice, args.env, env_kwargs)
    folder = record(
        args.dataset,
        acting,
        env,
        args.steps,
        scenarios=args.scenarios,
        seed=args.seed,
        jobs=args.jobs,
        env_kwargs=env_kwargs,
        normalize=normalize,
        overwrite=args.overwrite,
        progress_bar=True,
    )
    print(describe(folder))
    print(f"Saved {folder}")


def find_model(path: Path, env_id: str, env_kwargs: dict[str, Any]) -> tuple[BaseAlgorithm, VecNormalize | None]:
    """Load a model, and the statistics that its observations are normalized with, if any."""
    path, algo, algorithm = find_algorithm(path, None)
    env = make_env(env_id, env_kwargs)
    model = load_model(path, algo, algorithm, env)
    normalize = find_normalization(path, env_id, env)[1]
    env.close()
    return model, normalize


def run_info(args: argparse.Namespace) -> None:
    """
    Print what is in a dataset.

    :raises DatasetError: for a dataset that is missing, damaged or empty
    """
    print(describe(args.dataset))


def describe(dataset: str | os.PathLike[str]) -> str:
    """
    Describe a dataset.

    :return: what there is to know about a dataset, to read
    :raises DatasetError: for one that is missing, damaged or empty
    """
    demonstrations, opened = load_demonstrations(dataset), open_dataset(dataset)
    metadata = opened.storage.metadata
    settings = metadata.get(SETTINGS, {})
    episodes, spec = demonstrations.episodes, opened.env_spec
    size = sum(file.stat().st_size for file in opened.storage.data_path.rglob("*") if file.is_file())
    lines = [f"{opened.id}: {opened.total_episodes} episodes, {len(demonstrations)} steps, {size / 1e6:.1f} MB"]

    def add(title: str, text: str) -> None:
        lines.append(f"  {title:<18}{text}")

    def add_statistics(title: str, values: np.ndarray) -> None:
        add(title, f"{values.mean():.3f} ± {values.std():.3f}")

    add_statistics("return", np.bincount(episodes, demonstrations.rewards))
    if demonstrations.costs is not None:
        add_statistics("safety cost", np.bincount(episodes, demonstrations.costs))
    if demonstrations.successes is not None:
        last = np.flatnonzero(np.diff(episodes, append=-1))
        add("success rate", f"{demonstrations.successes[last].mean():.3f}")
    if demonstrations.takeovers is not None:
        add("takeover share", f"{demonstrations.takeovers.mean():.3f}")
    add("observations", shortened(demonstrations.observation_space))
    add("actions", shortened(demonstrations.action_space))
    add("environment", f"{spec.id} {spec.kwargs or ''}".rstrip() if spec else "not known")
    add("policy", metadata.get("algorithm_name", "not known"))
    if settings.get("seed") is not None:
        add("recorded with", f"seed {settings['seed']}, scenarios {as_range(settings['scenarios'])}")
    versions = {"minari": opened.minari_version, **settings.get("versions", {})}
    add("versions", ", ".join(f"{name} {version}" for name, version in versions.items()))
    return "\n".join(lines)


def as_range(scenarios: list[int] | None) -> str:
    """
    Word a list of scenarios.

    :return: "100:120" for 100 to 119 in their order, else the numbers themselves
    """
    if scenarios is None:
        return "of the environment"
    first, end = scenarios[0], scenarios[-1] + 1
    return f"{first}:{end}" if scenarios == list(range(first, end)) else ", ".join(map(str, scenarios))


def shortened(space: spaces.Space) -> str:
    """
    Word a space in a few characters.

    :return: what to call it, without a number for each of its bounds
    """
    if not isinstance(space, spaces.Box):
        return str(space)
    return f"Box({space.low.min():g}, {space.high.max():g}, {space.shape}, {space.dtype})"


def run_replay(args: argparse.Namespace) -> None:
    """
    Drive an episode again.

    :raises DatasetError: for a dataset, or an episode of it, that is missing or cannot be driven again
    :raises NotEvaluable: if its environment cannot be made, or cannot render
    """
    check_output("--video", args.video, pictures.VIDEO_SUFFIXES)
    try:
        drive_again(args, open_dataset(args.dataset))
    except (NotEvaluable, DatasetError, OSError):
        raise
    except Exception as error:  # whatever damaged data lead to, in Minari, the environment or h5py
        reason = f"{type(error).__name__}: {error}"
        raise DatasetError(f"--dataset {args.dataset}: episode {args.episode} cannot be driven again ({reason}).") from error


def drive_again(args: argparse.Namespace, dataset: "MinariDataset") -> None:
    """
    Repeat the actions of an episode.

    :param dataset: that holds it
    """
    with Replay(dataset, args.episode, "rgb_array" if args.video else None) as replay:
        if args.video:
            pictures.check_can_render(replay)
            try:
                pictures.save_video(args.video, replay, args.episode)
            except BaseException:
                args.video.unlink(missing_ok=True)
                raise
        else:
            replay.episode(args.episode)
    print(replay.report())
    if args.video:
        print(f"Saved {args.video}")
