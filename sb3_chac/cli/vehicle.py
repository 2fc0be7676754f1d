"""``python -m sb3_chac vehicle``: an environment as a vehicle at the end of a network link, for a learner elsewhere."""

import argparse
import time
from pathlib import Path

import gymnasium as gym

import sb3_chac.envs  # noqa: F401  (registers our environments)
from sb3_chac.cli.arguments import add_env_kwargs, check_output, parse_env_kwargs
from sb3_chac.cli.command import check_least, command_parser, run_command
from sb3_chac.common.files import write_safely
from sb3_chac.deploy.address import bound_socket, parse_address
from sb3_chac.deploy.metadata import NotDeployable
from sb3_chac.deploy.remote import LateLink, VehicleServer
from sb3_chac.evaluation.episodes import NotEvaluable, make_env
from sb3_chac.human import InterventionWrapper

DESCRIPTION = """Be the vehicle: make the steps of an environment as a learner asks for them over UDP, with a person in it who
takes over. The learner trains in RemoteVehicle-v0, in another process or on another machine:

  sb3-chac vehicle --env RoadTest-v0 --listen 127.0.0.1:5700 --latency 0.02 --jitter 0.06 --loss 0.05 --noise 0.01
  rl_zoo3 train --algo dpvp --env RemoteVehicle-v0 --env-kwargs "address:'127.0.0.1:5700'" --eval-freq -1

Time is the environment's: as fast as both ends can. Packets are neither encrypted nor authenticated: use a network that nobody
else is on."""


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = command_parser("vehicle", DESCRIPTION)
    what = parser.add_argument_group("vehicle")
    what.add_argument("--env", default="RoadTest-v0", metavar="ID", help="environment, also module:ID (default: %(default)s)")
    add_env_kwargs(what)
    what.add_argument("--expert", default="scripted", metavar="NAME", help="who takes over, also package.module:function")
    what.add_argument("--rule", default="risk", metavar="NAME", help="when: risk, disagreement, always or never (%(default)s)")
    what.add_argument("--budget", type=int, metavar="N", help="steps of the person at most (default: no limit)")
    link = parser.add_argument_group("link")
    link.add_argument("--listen", default="127.0.0.1:5700", metavar="HOST:PORT", help="(default: %(default)s)")
    link.add_argument("--latency", type=float, default=0.0, metavar="S", help="least delay of an action (%(default)s)")
    link.add_argument("--jitter", type=float, default=0.0, metavar="S", help="that the greatest delay is longer (%(default)s)")
    link.add_argument("--loss", type=float, default=0.0, metavar="SHARE", help="of the actions (%(default)s)")
    link.add_argument("--noise", type=float, default=0.0, metavar="SD", help="of the sensors (%(default)s)")
    link.add_argument("--seed", type=int, default=0, help="of link and sensors (%(default)s)")
    parser.add_argument("--steps", type=int, metavar="N", help="end after N steps")
    parser.add_argument("--ready", type=Path, metavar="FILE", help="write the address into this file as soon as it listens")
    return parser


def main(arguments: list[str]) -> None:
    """
    Run the command.

    :param arguments: of the command line, after ``vehicle``
    """
    run_command(make_parser(), arguments, run, NotDeployable, NotEvaluable, ValueError)


def run(args: argparse.Namespace) -> None:
    """
    Serve as the command line says.

    :param args: see ``make_parser``
    :raises ValueError: for arguments that do not fit
    :raises OSError: if the file of ``--ready`` cannot be written
    """
    address = parse_address("--listen", args.listen)
    check_output("--ready", args.ready)
    check_least(args, NotDeployable, steps=1, seed=0, budget=1)
    env: gym.Env = make_env(args.env, parse_env_kwargs(args.env_kwargs))
    try:
        env.reset()  # compiles and loads, which takes longer than a learner waits for an answer
        env = InterventionWrapper(env, expert=args.expert, rule=args.rule, budget=args.budget, armed=True)
        env = LateLink(env, args.latency, args.jitter, args.loss, args.noise, args.seed)
        with bound_socket("--listen", address) as sock:
            server = VehicleServer(env, sock)
            own = ":".join(map(str, sock.getsockname()))
            print(f"{args.env} waits for a learner at {own}", flush=True)
            if args.ready is not None:
                write_safely(args.ready, own.encode())  # whoever waits for it reads all of it
            start = time.monotonic()
            try:
                server.serve(args.steps)
            finally:
                seconds = time.monotonic() - start
                print(f"{server.steps} steps in {server.episodes} episodes, {seconds:.0f} s", flush=True)
    finally:
        env.close()
