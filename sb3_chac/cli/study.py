"""``python -m sb3_chac study``: a study with people at the wheel, by a protocol."""

import argparse
import asyncio
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_chac.cli import drive as drive_command
from sb3_chac.cli.command import check_least, command_parser, run_command
from sb3_chac.cockpit.address import parse_address
from sb3_chac.cockpit.person import NotDrivable, Person
from sb3_chac.cockpit.session import Session, SessionEnded

DESCRIPTION = """Run a study in the browser: consent, practice, the conditions in each participant's order, NASA-TLX.

  sb3-chac study protocol.yaml --out study --participant 1     begins, or goes on after an interruption
  sb3-chac study study --summary                               all participants: a table, and study/summary.csv

Participants are numbers; nothing else is stored of them but how they drive and what they type. The protocol is described in
sb3_chac/cockpit/README.md, an example is examples/study. Models are code (docs/loading.md): name those that you trust only."""


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = command_parser("study", DESCRIPTION)
    parser.add_argument("path", type=Path, metavar="PROTOCOL", help="YAML; with --summary the folder of the study")
    parser.add_argument("--summary", action="store_true", help="sum up all participants")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="of the study")
    parser.add_argument("--participant", type=int, metavar="N", help="number, at least 1 (default: the first that is free)")
    parser.add_argument(
        "--serve", default="8000", metavar="[HOST:]PORT", help="where the page is served (default: %(default)s)"
    )
    parser.add_argument("--tls-cert", type=Path, metavar="FILE", help="encrypt with this certificate (PEM)")
    parser.add_argument("--tls-key", type=Path, metavar="FILE", help="its key (PEM), if that is in another file")
    return parser


def main(arguments: list[str]) -> None:
    """
    Run the command.

    :param arguments: of the command line, after ``study``
    """
    run_command(make_parser(), arguments, run, ValueError, RuntimeError)


def run(args: argparse.Namespace) -> None:
    """
    Conduct a study with one participant, or sum it up.

    :param args: see ``make_parser``
    :raises StudyError: for what does not fit
    """
    from sb3_chac.cockpit.study import Participant, StudyError, read_protocol, summarise, table

    if args.summary:
        print(table(summarise(args.path)))
        return
    if args.out is None:
        raise StudyError("--out FOLDER is missing: what participants do is stored there.")
    check_least(args, StudyError, participant=1)
    if args.tls_key and not args.tls_cert:
        raise StudyError("--tls-key needs its certificate: --tls-cert.")
    th.set_num_threads(1)
    protocol = read_protocol(args.path)
    number = args.participant or next(n for n in range(1, 10**6) if not Participant(args.out, n).folder.exists())
    participant = Participant(args.out.resolve(), number)
    check_drives(protocol, participant.folder)
    with participant.in_use():
        study = Study(protocol, participant)
        study.serve(args)
    if not participant.folder.exists() or not study.has_agreed:
        print(f"Participant {number} has not agreed: nothing else is stored.")
        return
    rows = [row for row in summarise(args.out) if row["participant"] == number] if study.has_driven else []
    if rows:
        print(table(rows))
    again = f"Go on with:  sb3-chac study {args.path} --out {args.out} --participant {number}"
    print(f"Participant {number} has finished: {participant.folder}" if study.is_finished else again)


def check_drives(protocol: Any, folder: Path) -> None:
    """
    Check the arguments of all drives, before anybody is asked anything.

    :param protocol: of the study
    :param folder: of the participant
    :raises StudyError: naming the condition
    """
    from sb3_chac.cockpit.study import StudyError

    for name, condition in (protocol.practice | protocol.conditions).items():
        try:
            drive_command.prepare(condition.drive_arguments(folder / name, protocol.folder, "check-v0", 0))
        except ValueError as error:
            raise StudyError(f"{name}: {error}") from error


class Study:
    """
    Parts of a study that one participant goes through.

    :param protocol: of the study
    :param participant: whose folder is in use
    """

    def __init__(self, protocol: Any, participant: Any) -> None:
        from sb3_chac.cockpit.devices.browser import Browser

        self.protocol, self.participant = protocol, participant
        self.device = Browser()
        self.has_agreed = participant.has_agreed(protocol)
        self.is_finished = False

    @property
    def has_driven(self) -> bool:
        """Tell whether there is an episode of a condition."""
        return any(self.participant.episodes(name) for name in self.protocol.conditions)

    def serve(self, args: argparse.Namespace) -> None:
        """
        Serve the page until the participant has finished or quit.

        :param args: see ``make_parser``
        """
        from sb3_chac.cockpit.server import Server, serve, tls_context

        tls = tls_context(args.tls_cert, args.tls_key) if args.tls_cert else None
        idle = Session(Person(self.device))
        idle.busy = "One moment"  # until the first drive
        self.server = Server(idle, self.device, parse_address(args.serve), tls)
        asyncio.run(serve(self.server, self._conduct))

    async def _conduct(self) -> None:
        from sb3_chac.cockpit import forms

        protocol, participant = self.protocol, self.participant
        try:
            if not self.has_agreed:
                answer = await self.server.ask(forms.consent_form(protocol.title, protocol.consent_text))
                self.has_agreed = answer.choice == forms.AGREE
                participant.store_consent(protocol, self.has_agreed)
            if not self.has_agreed:
                self.server.farewell = "You have not agreed: nothing else was stored"
                return
            for name, condition in protocol.practice.items():
                await self._drive(name, condition, "Practice")
            for place, name in enumerate(participant.order, 1):
                part = f"Part {place} of {len(participant.order)}"
                await self._drive(name, protocol.conditions[name], part)
                if participant.answers(name) is None:
                    answer = await self.server.ask(forms.questionnaire(part, protocol.questions))
                    participant.store_answers(name, answer.values)
            self.is_finished = True
            self.server.farewell = "The study is over: thank you"
        except SessionEnded:
            self.server.farewell = "The study is interrupted"

    async def _drive(self, name: str, condition: Any, part: str) -> None:
        """
        Drive the episodes of a condition that are still to be driven.

        :param part: of the study, to read; the participant does not read the condition's name
        :raises SessionEnded: if the person quits before the last one
        """
        from sb3_chac.cockpit.experiment import CockpitRun
        from sb3_chac.cockpit.recording import EpisodeRecord

        participant = self.participant
        done = len(participant.episodes(name))
        if done >= condition.episodes:
            return

        def store(record: EpisodeRecord) -> None:
            nonlocal done
            participant.store_episode(name, record)
            done += record.is_whole
            if done >= condition.episodes:
                drive_run.drive.quit()

        args = await asyncio.to_thread(self._prepare, name, condition, done)
        drive_run = CockpitRun(args, self.device, store)
        left = condition.episodes - done
        drive_run.drive.message = f"{part}, {left} episode{'s' if left > 1 else ''}. Ready: P begins"
        drive_run.drive.show(number=self.server.drive.display.number)
        self.server.drive = drive_run.drive
        drive_run.thread.start()
        await drive_run.wait()
        if drive_run.error is not None:
            raise drive_run.error
        if done < condition.episodes or self.server.has_quit:
            raise SessionEnded

    def _prepare(self, name: str, condition: Any, done: int) -> argparse.Namespace:
        """
        Prepare a drive: the first of a condition, or one that goes on where it learns.

        :param done: episodes
        """
        from sb3_chac.cockpit.recording import finish_recording
        from sb3_chac.cockpit.study import StudyError

        folder = self.participant.folder / name
        runs = sorted(folder.glob(f"{condition.algo}/*_*/"), key=lambda run: int(re.sub(r".*_", "", run.name)))
        dataset = f"drive_{len(runs) + 1}-v0"
        # Draws of its own for each participant and condition, and other ones when it goes on
        index = list(self.protocol.practice | self.protocol.conditions).index(name)
        seed = np.random.SeedSequence([self.protocol.seed, self.participant.number, index, done]).generate_state(1)[0]
        arguments = condition.drive_arguments(folder, self.protocol.folder, dataset, int(seed))
        if runs and done and condition.learn:
            try:
                return drive_command.prepare(
                    ["--resume", f"{runs[-1]}", "--dataset", f"{folder / dataset}", "--seed", f"{seed}"]
                )
            except NotDrivable as error:
                raise StudyError(
                    f"{runs[-1]}: what the novice had learned cannot be found: begin anew with another --participant. {error}"
                ) from error
        for left_behind in runs:
            finish_recording(left_behind)
        return drive_command.prepare(arguments)
