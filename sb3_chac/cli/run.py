"""``python -m sb3_chac run``: an exported policy at the end of a network link. Without torch and Stable-Baselines3."""

import argparse
import gc
import math
import os
import time
from contextlib import ExitStack
from pathlib import Path

from sb3_chac.cli.command import check_least, command_parser, run_command
from sb3_chac.deploy.address import bound_socket, parse_address, resolve
from sb3_chac.deploy.gate import Limits
from sb3_chac.deploy.log import DecisionLog
from sb3_chac.deploy.metadata import NotDeployable
from sb3_chac.deploy.policy import OnnxPolicy
from sb3_chac.deploy.runtime import HOLD_FOR, MAX_SILENCE, Runtime
from sb3_chac.deploy.server import PolicyServer

DESCRIPTION = """Read observations from a vehicle and answer each with an action that the gate has checked, over UDP. The
packets are described in sb3_chac/deploy/udp.py; docs/guide/deployment.md has the wiring, the states of the gate, what to check
before the first metre, and what is not guaranteed.

  sb3-chac run policy.onnx --listen 127.0.0.1:5600
  sb3-chac run policy.onnx --listen 0.0.0.0:5600 --vehicle 192.168.7.2 --log drive.jsonl
  sb3-chac demos from-log drive.jsonl --dataset drives/monday-v0 --env SafeDrive-v0

Packets are neither encrypted nor authenticated: use a network that nobody else is on."""


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = command_parser("run", DESCRIPTION)
    parser.add_argument("policy", type=Path, metavar="POLICY.onnx", help="a file that 'sb3-chac export' wrote")
    link = parser.add_argument_group("link")
    link.add_argument("--listen", default="127.0.0.1:5600", metavar="HOST:PORT", help="(default: %(default)s)")
    link.add_argument("--vehicle", metavar="HOST", help="take observations from this address only (default: from the first)")
    link.add_argument("--copies", type=int, default=2, metavar="N", help="of each packet, against loss (default: %(default)s)")
    gate = parser.add_argument_group("gate")
    gate.add_argument("--rate", type=float, metavar="HZ", help="decisions per second at least (default: the policy's)")
    gate.add_argument("--max-age", type=float, metavar="S", help="of an observation (default: .35)")
    gate.add_argument(
        "--max-silence", type=float, default=MAX_SILENCE, metavar="S", help="without observations (default: %(default)s)"
    )
    gate.add_argument("--deadline", type=float, metavar="S", help="of a decision (default: .05)")
    gate.add_argument("--hold-for", type=float, default=HOLD_FOR, metavar="S", help="HOLD at most (default: %(default)s)")
    gate.add_argument(
        "--brake", metavar="VALUES", help="action that stops, e.g. hold,-1 (default: the policy's); write --brake=-1,hold"
    )
    other = parser.add_argument_group("other")
    other.add_argument("--log", type=Path, metavar="FILE.jsonl", help="write every decision; the file must not be there")
    other.add_argument("--steps", type=int, metavar="N", help="end after N decisions")
    other.add_argument("--realtime", action="store_true", help="ask for real-time priority (SCHED_FIFO, Linux)")
    return parser


def main(arguments: list[str]) -> None:
    """
    Run the command.

    :param arguments: of the command line, after ``run``
    """
    run_command(make_parser(), arguments, run, NotDeployable)


def run(args: argparse.Namespace) -> None:
    """
    Serve a policy as the command line says.

    :param args: see ``make_parser``
    :raises NotDeployable: for arguments that do not fit
    :raises OSError: if a file cannot be used
    """
    start = time.perf_counter()
    address = parse_address("--listen", args.listen)
    allowed = None if args.vehicle is None else resolve("--vehicle", args.vehicle)
    check_least(args, NotDeployable, copies=1, steps=1)
    policy = OnnxPolicy(args.policy)
    times = {name: getattr(args, name) for name in ("max_age", "max_silence", "deadline", "hold_for")}
    brake = None if args.brake is None else parse_brake(args.brake)
    limits = Limits.of(policy.metadata, brake, **{name: value for name, value in times.items() if value is not None})
    rate = policy.metadata.rate if args.rate is None else args.rate
    if not (math.isfinite(rate) and rate > 0):
        raise NotDeployable(f"--rate must be a finite number above 0, got {rate}.")
    runtime = Runtime(policy, limits)
    with ExitStack() as stack:
        sock = stack.enter_context(bound_socket("--listen", address))
        sock.setblocking(False)
        log = None
        if args.log is not None:
            try:
                log = stack.enter_context(DecisionLog(args.log, policy.metadata))
            except FileExistsError as error:
                raise NotDeployable(f"--log {args.log}: the file is there already, choose another name.") from error
            except OSError as error:
                raise NotDeployable(f"--log {args.log}: cannot be written ({error.strerror}), choose another.") from error
        if args.realtime:
            ask_for_priority()
        server = PolicyServer(runtime, sock, 1 / rate, args.copies, allowed, log)
        own = ":".join(map(str, sock.getsockname()))
        metadata = policy.metadata
        print(f"{args.policy}: {metadata.algorithm}, {len(metadata.layout)} described parts of an observation", flush=True)
        print(f"Ready on {own} after {time.perf_counter() - start:.2f} s; waiting for a vehicle", flush=True)
        # What there is now stays: no pause of the garbage collector while the vehicle drives
        gc.collect()
        gc.freeze()
        gc.disable()
        try:
            server.serve(args.steps)
        finally:
            gc.enable()
            print(server.summary(), flush=True)


def parse_brake(text: str) -> list[float | None]:
    """
    Parse the action that brakes.

    :param text: numbers, or "hold" for what keeps its value
    :raises NotDeployable: for anything else
    """
    try:
        return [None if part.strip() == "hold" else float(part) for part in text.split(",")]
    except ValueError as error:
        raise NotDeployable(f"--brake must be numbers and 'hold', such as hold,-1, got {text!r}.") from error


def ask_for_priority() -> None:
    """Run before all that is not real-time, where the operating system lets us; print that it does not."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except (AttributeError, OSError) as error:
        print(f"--realtime: not permitted ({error}), going on without", flush=True)
