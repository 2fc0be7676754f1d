"""``python -m sb3_chac resume``: go on with a training that was interrupted."""

import argparse
import sys
from importlib import import_module
from pathlib import Path

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


def main(arguments: list[str]) -> None:
    """
    Run the command.

    :param arguments: of the command line, after ``resume``
    """
    parser = argparse.ArgumentParser(
        "sb3-chac resume", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run_folder", type=Path, metavar="RUN_FOLDER", help="e.g. logs/chac/SafeDrive-v0_1")
    run_folder = parser.parse_args(arguments).run_folder
    try:
        command, model = find_training(run_folder)
        done, total = steps(model)
    except NotResumable as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    if done >= total:
        print(f"{run_folder}: nothing remains to be done, all {total} steps were made.")
        return

    if command[:1] == ["drive"]:
        import_module("sb3_chac.drive").main(["--resume", str(run_folder)])
        return

    with one_sentence("sb3-chac resume"):
        register()
        from rl_zoo3.train import train

        sys.argv[1:] = [*command, "-i", str(model)]
        train()
