"""``python -m sb3_chac resume``: go on with a training that was interrupted."""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path

from sb3_chac.cli.command import command_parser, run_command
from sb3_chac.zoo import register
from sb3_chac.zoo.runs import NotResumable, find_training, steps
from sb3_chac.zoo.stopping import one_sentence

DESCRIPTION = """Go on with a training that was interrupted or killed (kill -9, a power cut), from its newest checkpoint.

  sb3-chac resume logs/chac/SafeDrive-v0_1

Run it in the folder where the training was started: its command line is repeated, for the steps that remain. Model,
optimizers, replay buffer, stage, counts and the human's budget are those of the checkpoint; the seeds are others, so that no
episode is seen twice. What was done after the checkpoint is lost. Episodes, evaluations and checkpoints go into a run folder
of its own (_2 after _1), which can be resumed in turn. If the newest checkpoint is damaged, the one before it is used.

'rl_zoo3 train' with an algorithm of sb3_chac writes a checkpoint every --save-freq steps (10000 if it is not given, none with
--save-freq 0), at the end, and when it is stopped by SIGTERM or Ctrl-C, and keeps the newest two in <run folder>/checkpoints.

A run folder is code: models, replay buffers and command lines in it can run anything. Resume those that you trust only."""


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = command_parser("resume", DESCRIPTION)
    parser.add_argument("run_folder", type=Path, metavar="RUN_FOLDER", help="e.g. logs/chac/SafeDrive-v0_1")
    return parser


def main(arguments: list[str]) -> None:
    """
    Run the command.

    :param arguments: of the command line, after ``resume``
    """
    go_on = run_command(make_parser(), arguments, find, NotResumable)
    if go_on is not None:
        go_on()


def find(args: argparse.Namespace) -> Callable[[], None] | None:
    """
    Find what remains to be done.

    :param args: see ``make_parser``
    :return: does it; None if nothing remains
    :raises NotResumable: if there is nothing to go on from
    """
    command, model = find_training(args.run_folder)
    done, total = steps(model)
    if done >= total:
        print(f"{args.run_folder}: nothing remains to be done, all {total} steps were made.")
        return None
    if command[:1] == ["drive"]:
        return partial(import_module("sb3_chac.cli.drive").main, ["--resume", str(args.run_folder)])
    return partial(train_again, command, model)


def train_again(command: list[str], model: Path) -> None:
    """
    Repeat a command line of RL-Zoo3.

    :param command: of the run, after ``rl_zoo3 train``
    :param model: that it goes on with
    """
    with one_sentence("sb3-chac resume"):
        register()
        from rl_zoo3.train import train

        sys.argv[1:] = [*command, "-i", str(model)]
        train()
