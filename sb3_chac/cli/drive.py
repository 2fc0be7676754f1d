"""``python -m sb3_chac drive``: train with a person at the wheel."""

import argparse
import asyncio
import functools
import re
import shlex
import sys
import time
from pathlib import Path
from typing import Any

import torch as th

from sb3_chac.cli.arguments import add_env_kwargs, parse_env_kwargs
from sb3_chac.cli.command import check_least, command_parser, run_command
from sb3_chac.cockpit.devices import (
    G29,
    GAMEPAD,
    WHEEL,
    Calibration,
    Device,
    DeviceError,
    Joystick,
    Keyboard,
    Spring,
    is_wheel,
    load_config,
    save_config,
)
from sb3_chac.cockpit.person import NotDrivable
from sb3_chac.evaluation.models import DEFAULT_ENV

DESCRIPTION = """Train with yourself as the human: watch the novice drive, take over at any moment, hand back.

  sb3-chac drive --algo chac --env SafeDrive-v0                       in a window, with the keyboard
  sb3-chac drive --algo chac --env SafeDrive-v0 --device wheel        with a steering wheel (see --calibrate)
  sb3-chac drive --algo chac --env SafeDrive-v0 --serve 8000          in a browser, with keyboard or gamepad
  sb3-chac drive --resume logs/chac/SafeDrive-v0_1                    go on, with all that was learned and driven

Hyperparameters, run folders and files are those of 'rl_zoo3 train'. The drive is recorded as a dataset, see
'sb3-chac demos'. The operator's guide is sb3_chac/cockpit/README.md.

Models, run folders and hyperparameters files are code (docs/loading.md): open those that you trust only."""

SAVE_FREQ = 600  # steps: a minute


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = command_parser("drive", DESCRIPTION)
    what = parser.add_argument_group("what is trained")
    what.add_argument("--algo", default="chac", help="chac, dpvp, pvp, hg_dagger or iwr (default: %(default)s)")
    what.add_argument("--env", default=DEFAULT_ENV, metavar="ID", help="environment (default: %(default)s)")
    add_env_kwargs(what)
    what.add_argument("-params", "--hyperparams", nargs="+", default=[], metavar="KEY:VALUE", help="other hyperparameters")
    what.add_argument("--conf-file", metavar="FILE", help="other hyperparameters file")
    what.add_argument("-n", "--n-timesteps", type=int, default=-1, metavar="N", help="steps in all (default: the yaml's)")
    what.add_argument("--seed", type=int, default=-1, help="default: a random one")
    what.add_argument("-i", "--trained-agent", default="", metavar="MODEL", help="begin with this model (.zip)")
    what.add_argument("--demos", default="", metavar="ID", help="begin with what this dataset holds")
    what.add_argument("--pretrain", type=int, default=0, metavar="N", help="gradient steps on it before the drive")
    how = parser.add_argument_group("how it is driven")
    how.add_argument(
        "--device",
        default="auto",
        choices=("auto", "keyboard", "gamepad", "wheel", "g29"),
        help="g29: a Logitech G29 as in MetaDrive, drive while a paddle is held (default: %(default)s)",
    )
    how.add_argument("--serve", metavar="[HOST:]PORT", help="no window, but a page to drive in (default host: 127.0.0.1)")
    how.add_argument("--tls-cert", type=Path, metavar="FILE", help="with --serve: encrypt with this certificate (PEM)")
    how.add_argument("--tls-key", type=Path, metavar="FILE", help="its key (PEM), if that is in another file")
    how.add_argument("--config", type=Path, metavar="FILE", help="axes and buttons of gamepad or wheel, see --calibrate")
    how.add_argument(
        "--force-feedback",
        type=float,
        metavar="SHARE",
        help="a spring of this share of the wheel's force turns it to where the novice steers, for example 0.3",
    )
    how.add_argument("--rate", type=float, metavar="HZ", help="steps per second (default: the environment's own real time)")
    how.add_argument(
        "--steering", default="auto", choices=("auto", "left", "right"), help="side of the greatest first action (%(default)s)"
    )
    how.add_argument(
        "--query", type=float, metavar="RISK", help="the novice asks for help from this risk on, for example 0.95"
    )
    how.add_argument("--no-meter", action="store_true", help="do not show the guidance meter")
    how.add_argument("--no-takeover", action="store_true", help="watch only")
    how.add_argument("--no-learning", action="store_true", help="the novice (-i MODEL) stays as it is, and does not explore")
    how.add_argument("--go", action="store_true", help="begin at once, do not wait for P")
    where = parser.add_argument_group("what is written")
    where.add_argument("-f", "--log-folder", default="logs", help="(default: %(default)s)")
    where.add_argument("--dataset", metavar="ID", help="of the recording (default: drives/<algo>-<env>-<time>-v0)")
    where.add_argument(
        "--save-freq",
        type=int,
        default=SAVE_FREQ,
        metavar="N",
        help="steps between checkpoints, 0: only at the end",
    )
    where.add_argument("--verbose", type=int, default=0, help="1: RL-Zoo3's and the logger's output (default: %(default)s)")
    other = parser.add_argument_group("in place of a new drive")
    other.add_argument("--resume", type=Path, metavar="RUN_FOLDER", help="go on with this drive; other arguments override")
    other.add_argument("--recover", type=Path, metavar="RUN_FOLDER", help="make the dataset of a drive that was killed")
    other.add_argument("--calibrate", type=Path, metavar="FILE", help="find out what axes and buttons a device has")
    return parser


def main(arguments: list[str]) -> None:
    """
    Run the command.

    :param arguments: of the command line, after ``drive``
    """
    run_command(make_parser(), arguments, functools.partial(run, arguments), ValueError, RuntimeError)


def run(arguments: list[str], args: argparse.Namespace) -> None:
    """
    Calibrate, recover, resume or begin.

    :param arguments: of the command line
    :param args: see ``make_parser``
    """
    th.set_num_threads(1)
    if args.calibrate:
        calibrate(args.calibrate)
    elif args.recover:
        recover(args.recover)
    else:
        drive(prepare(arguments))


def recover(run_folder: Path) -> None:
    """
    Make the dataset of a drive that was killed.

    :param run_folder: of a drive that was killed
    :raises NotDrivable: if it left nothing behind
    """
    from sb3_chac.cockpit.recording import finish_recording

    summary = finish_recording(run_folder)
    if summary is None:
        raise NotDrivable(f"{run_folder} holds no recording that is not finished.")
    print(summary)


def prepare(arguments: list[str]) -> argparse.Namespace:
    """
    Prepare a drive that begins or is resumed.

    :param arguments: of the command line
    :return: see ``make_parser``, checked
    :raises NotDrivable: for what does not fit, or cannot be resumed
    """
    from sb3_chac.cockpit.recording import finish_recording
    from sb3_chac.zoo.runs import NotResumable, find_training

    args = make_parser().parse_args(arguments)
    if args.resume:
        try:
            command, checkpoint = find_training(args.resume)
        except NotResumable as error:
            raise NotDrivable(str(error)) from error
        if command[:1] != ["drive"]:
            raise NotDrivable(f"{args.resume} was not driven: go on with 'sb3-chac resume {args.resume}'.")
        left_behind = finish_recording(args.resume)
        if left_behind is not None:
            print(f"What the drive that was interrupted had recorded:\n{left_behind}\n")
        # What follows is recorded as a dataset of its own
        arguments = [*without("--dataset", command[1:]), *without("--resume", arguments)]
        args = make_parser().parse_args(arguments)
        args.trained_agent = str(checkpoint)
    check_arguments(args)
    # What RL-Zoo3 writes into the run folder, and 'sb3-chac resume' repeats
    sys.argv[1:] = ["drive", *arguments]
    return args


def without(option: str, arguments: list[str]) -> list[str]:
    """
    Drop an option from a command line.

    :param option: that has a value
    :return: the arguments without it
    """
    kept, skip = [], False
    for argument in arguments:
        if not skip and not argument.startswith(option):
            kept.append(argument)
        skip = argument == option
    return kept


def check_given(args: argparse.Namespace) -> None:
    """
    Check arguments for which nothing is filled in.

    :raises NotDrivable: for numbers out of their range, and for what does not go together
    """
    if args.rate is not None and not 0.5 <= args.rate <= 100:
        raise NotDrivable(f"--rate must be from 0.5 to 100 steps per second, got {args.rate:g}.")
    if args.query is not None and not 0 < args.query <= 1:
        raise NotDrivable(f"--query must be above 0 and at most 1 (for example 0.95), got {args.query:g}.")
    if args.force_feedback is not None and not 0 < args.force_feedback <= 1:
        raise NotDrivable(f"--force-feedback must be above 0 and at most 1 (for example 0.3), got {args.force_feedback:g}.")
    if args.no_learning and not args.trained_agent:
        raise NotDrivable("--no-learning needs a model that can drive: -i MODEL.zip.")
    if args.no_takeover and args.algo in ("hg_dagger", "iwr") and not args.trained_agent:
        raise NotDrivable(f"--no-takeover: {args.algo} begins with a person who drives: leave it out, or name a model, -i.")
    if args.query is not None and (args.no_meter or args.no_takeover):
        raise NotDrivable("--query asks for help by the meter: leave out --no-meter and --no-takeover.")


def check_arguments(args: argparse.Namespace) -> None:
    """
    Check the command line, and fill in what was left open.

    :raises NotDrivable: for what does not fit
    """
    import gymnasium as gym
    import numpy as np

    import sb3_chac.envs  # noqa: F401
    from sb3_chac.cockpit.address import parse_address
    from sb3_chac.datasets.writer import folder_to_make
    from sb3_chac.zoo.algorithms import drivable_algorithms

    if args.algo not in drivable_algorithms():
        known = ", ".join(drivable_algorithms())
        raise NotDrivable(f"--algo {args.algo} does not learn from takeovers, choose from {known}.")
    if args.env not in gym.registry:
        raise NotDrivable(f"--env: gymnasium knows no {args.env!r}.")
    check_least(args, NotDrivable, pretrain=0, save_freq=0)
    if args.trained_agent and not Path(args.trained_agent).is_file():
        raise NotDrivable(f"--trained-agent: there is no file {args.trained_agent}.")
    if args.pretrain and not args.demos:
        raise NotDrivable("--pretrain needs --demos: there is nothing to learn from before the drive.")
    check_given(args)
    if args.serve and (args.device != "auto" or args.config):
        raise NotDrivable("--serve is driven with the browser's devices: leave out --device and --config.")
    if (args.tls_cert or args.tls_key) and not (args.serve and args.tls_cert):
        raise NotDrivable("--tls-cert and --tls-key: both are for --serve, and a key needs its certificate.")
    if args.serve:
        args.serve = parse_address(args.serve)
    if args.force_feedback is not None and (args.serve or args.device == "keyboard"):
        raise NotDrivable("--force-feedback is for a wheel at this machine: leave it out with --serve and --device keyboard.")
    if args.device == "keyboard" and args.config:
        raise NotDrivable("--config is for a gamepad or wheel, the keyboard needs none.")
    if args.seed < 0:
        args.seed = int(np.random.default_rng().integers(2**32 - 1))
    args.env_kwargs = parse_env_kwargs(args.env_kwargs)
    args.hyperparams = parse_env_kwargs(args.hyperparams)
    if args.dataset is None:
        env = re.sub(r"-v\d+$", "", args.env).replace("/", "-")
        args.dataset = f"drives/{args.algo}-{env}-{time.strftime('%Y%m%d-%H%M%S')}-v0"
    if folder_to_make(args.dataset, overwrite=True).exists():
        raise NotDrivable(f"--dataset {args.dataset} exists already, choose another name.")


def drive(args: argparse.Namespace) -> None:
    """
    Drive, in a window or in a browser.

    :param args: see ``make_parser``, checked
    """
    from sb3_chac.cockpit.experiment import CockpitRun

    if args.serve:
        drive_run = in_browser(args)
    else:
        from sb3_chac.cockpit.window import Window

        window = Window(f"sb3_chac: {args.algo} on {args.env}")
        drive_run = CockpitRun(args, find_device(args))
        try:
            begin(drive_run)
            wait_for_end(window, drive_run)
        finally:
            window.close()
    if drive_run.summary is not None:
        print(drive_run.summary)
        print(f"  run folder    {drive_run.run_folder}")
        print(f"Go on with:  sb3-chac drive --resume {shlex.quote(str(drive_run.run_folder))}")
    if drive_run.error is not None:
        raise drive_run.error


def begin(drive_run: Any) -> None:
    """
    Start the driving thread.

    :param drive_run: is begun; unless it is to go at once, it waits for the person
    """
    drive_run.thread.start()
    if drive_run.args.go:
        drive_run.drive.go_on()


def in_browser(args: argparse.Namespace) -> Any:
    """
    Serve the page until the drive is over.

    :param args: see ``make_parser``, checked
    :return: the run, when it is over
    """
    from sb3_chac.cockpit.devices.browser import Browser
    from sb3_chac.cockpit.experiment import CockpitRun
    from sb3_chac.cockpit.server import Server, serve, tls_context

    tls = tls_context(args.tls_cert, args.tls_key) if args.tls_cert else None
    device = Browser()
    drive_run = CockpitRun(args, device)

    async def conduct() -> None:
        begin(drive_run)
        await drive_run.wait()

    asyncio.run(serve(Server(drive_run.drive, device, args.serve, tls), conduct))
    return drive_run


def wait_for_end(window: Any, drive_run: Any) -> None:
    """
    Show the window until the drive is over.

    :param window: of the cockpit
    :param drive_run: that it shows. Ctrl-C and SIGTERM end it as Q does
    """
    while True:
        try:
            window.run(drive_run.drive, lambda: drive_run.is_over)
            drive_run.thread.join()
            return
        except (KeyboardInterrupt, SystemExit):
            drive_run.drive.quit()


def find_device(args: argparse.Namespace) -> Device:
    """
    Choose the device of the command line.

    :param args: see ``make_parser``
    :raises DeviceError: for a configuration that cannot be used
    """
    import pygame

    config = load_config(args.config) if args.config else None
    if args.device == "keyboard":
        return Keyboard()
    pygame.joystick.init()
    names = [pygame.joystick.Joystick(i).get_name() for i in range(pygame.joystick.get_count())]
    if args.device == "auto" and not names:
        return Keyboard()
    wheel = args.device == "wheel" or (args.device == "auto" and is_wheel(names[0]))
    layout = G29 if args.device == "g29" else WHEEL if wheel else GAMEPAD
    spring = None
    if args.force_feedback is not None:
        spring = Spring(args.force_feedback)
        if names:
            spring.attach(pygame.joystick.Joystick(0))  # tells at once if it offers none
    return Joystick(config or layout, spring=spring)


def calibrate(file: Path) -> None:
    """
    Ask for the axes and buttons of a device and save them.

    :param file: YAML, is written
    :raises DeviceError: if there is no device, or no sense in what it says
    """
    import pygame

    if file.exists():
        raise DeviceError(f"{file} exists already. Choose another name.")
    pygame.display.init()
    pygame.joystick.init()
    if pygame.joystick.get_count() == 0:
        raise DeviceError("No gamepad or wheel is plugged in.")
    joystick = pygame.joystick.Joystick(0)
    calibration = Calibration(joystick.get_name())
    while calibration.step:
        button = calibration.step == "takeover"
        print(str(calibration.question) + ("." if button else ", then press Enter here."))
        if not button:
            input()
        while True:
            for event in pygame.event.get():
                if event.type != pygame.JOYBUTTONDOWN or button:
                    calibration.handle(event)
            if not button or not calibration.step:
                break
            pygame.time.wait(20)
        if not button:
            try:
                calibration.answer()
            except DeviceError as error:
                print(error)
    save_config(file, calibration.config())
    print(f"Saved {file}: sb3-chac drive --device wheel --config {file}")
