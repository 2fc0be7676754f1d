"""A study: its protocol, the order of the conditions, what is stored of each participant, and the summary."""

import csv
import fcntl
import io
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import yaml

from sb3_chac.cockpit.forms import TLX, raw_tlx
from sb3_chac.cockpit.recording import EpisodeRecord
from sb3_chac.common.files import sync, write_safely

PROTOCOL, CONSENT_TEXT, CONSENT = "protocol.yaml", "consent.txt", "consent.json"
ORDER, EPISODES, ANSWERS, SUMMARY = "order.json", "episodes.jsonl", "answers.jsonl", "summary.csv"
ORDERS = ("counterbalanced", "random", "fixed")
NAME = re.compile(r"[A-Za-z0-9][\w-]*", re.ASCII)


class StudyError(ValueError):
    """Raised for a protocol or a folder with which no study can be made; says what to do."""


@dataclass(frozen=True)
class Condition:
    """
    Condition of a study, or a practice drive: arguments of ``sb3-chac drive`` by other names.

    :param episodes: number that each participant drives
    :param algo: that the novice learns with
    :param model: that it begins with, beside the protocol; None for a new one
    :param learn: whether it learns
    :param takeover: whether the participant may take over
    :param meter: whether the guidance meter is shown
    :param query: risk from which the novice asks for help
    :param env: environment
    :param env_kwargs: passed to it
    :param scenarios: [first, number], for environments that have them
    :param hyperparams: other hyperparameters
    :param rate: [1/s] steps, None for the environment's
    """

    episodes: int
    algo: str = "chac"
    model: str | None = None
    learn: bool = True
    takeover: bool = True
    meter: bool = True
    query: float | None = None
    env: str = "SafeDrive-v0"
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    scenarios: list[int] | None = None
    hyperparams: dict[str, Any] = field(default_factory=dict)
    rate: float | None = None

    def drive_arguments(self, folder: Path, models: Path, dataset: str, seed: int) -> list[str]:
        """
        Translate to the arguments of ``sb3-chac drive``.

        :param folder: absolute, that the drive is to fill
        :param models: in which ``model`` is looked for
        :param dataset: name of the dataset in ``folder``
        :param seed: of the drive
        """
        env_kwargs = dict(self.env_kwargs)
        if self.scenarios is not None:
            env_kwargs["start_scenario"], env_kwargs["num_scenarios"] = self.scenarios
        arguments = ["--algo", self.algo, "--env", self.env, "--seed", f"{seed}", "-f", f"{folder}"]
        # A checkpoint at the beginning of each episode: to resume from
        arguments += ["--dataset", f"{folder / dataset}", "--save-freq", "1" if self.learn else "0"]
        for option, values in (("--env-kwargs", env_kwargs), ("-params", self.hyperparams)):
            if values:
                arguments += [option, *(f"{key}:{value!r}" for key, value in values.items())]
        if self.model is not None:
            arguments += ["-i", f"{models / self.model}"]
        for option, number in (("--query", self.query), ("--rate", self.rate)):
            if number is not None:
                arguments += [option, f"{number}"]
        off = {"--no-learning": self.learn, "--no-takeover": self.takeover, "--no-meter": self.meter}
        return arguments + [option for option, is_on in off.items() if not is_on]


TYPES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "episodes": (lambda value: type(value) is int and value >= 1, "a number of at least 1"),
    "scenarios": (lambda value: isinstance(value, list) and [type(part) for part in value] == [int, int], "[first, number]"),
    **dict.fromkeys(("algo", "model", "env"), (lambda value: isinstance(value, str), "a name")),
    **dict.fromkeys(("learn", "takeover", "meter"), (lambda value: isinstance(value, bool), "true or false")),
    **dict.fromkeys(("query", "rate"), (lambda value: type(value) in (int, float), "a number")),
    **dict.fromkeys(("env_kwargs", "hyperparams"), (lambda value: isinstance(value, dict), "a mapping")),
}


@dataclass(frozen=True)
class Protocol:
    """
    Protocol of a study.

    :param title: shown above the consent text
    :param consent: name of the file with it, beside the protocol
    :param conditions: by name
    :param practice: drives before them, by name
    :param order: of the conditions, see ``ORDERS``
    :param seed: of orders and scenarios
    :param questions: answered with free text after each condition
    :param text: of the file
    :param consent_text: of the other
    :param folder: of both
    """

    title: str
    consent: str
    conditions: dict[str, Condition]
    practice: dict[str, Condition] = field(default_factory=dict)
    order: str = "counterbalanced"
    seed: int = 0
    questions: tuple[str, ...] = ()
    text: str = ""
    consent_text: str = ""
    folder: Path = Path()

    def order_for(self, participant: int) -> list[str]:
        """
        Order the conditions for a participant.

        Counterbalanced: the rows of a Williams design (each condition as often at each place, and as often after each other
        one), taken in turn by number; the seed says which condition is which of its letters.

        :param participant: number, at least 1
        :return: names of the conditions
        """
        names = list(self.conditions)
        if self.order == "random":
            return [names[i] for i in np.random.default_rng([self.seed, participant]).permutation(len(names))]
        if self.order == "counterbalanced":
            names = [names[i] for i in np.random.default_rng(self.seed).permutation(len(names))]
            return [names[i] for i in williams_row(len(names), participant - 1)]
        return names


def williams_row(size: int, number: int) -> list[int]:
    """
    Compute a row of a Williams design (balanced Latin square; for odd sizes two of them, the second in reverse).

    :param size: number of conditions
    :param number: of the row, from 0; the rows repeat
    """
    first = [(i + 1) // 2 if i % 2 else (size - i // 2) % size for i in range(size)]
    row = [(place + number) % size for place in first]
    return row[::-1] if size % 2 and number // size % 2 else row


def read_protocol(file: Path) -> Protocol:
    """
    Read a protocol and the consent text.

    :param file: YAML
    :raises StudyError: for what is missing, unknown or of another kind
    """
    try:
        text = file.read_text(encoding="utf-8")
        data = yaml.safe_load(text)
    except (OSError, UnicodeError, yaml.YAMLError) as error:
        raise StudyError(f"{file}: cannot be read as YAML: {' '.join(str(error).split())}") from error
    known = [entry.name for entry in fields(Protocol)][:7]
    _check_keys(f"{file}", data, known, ("title", "consent", "conditions"))
    data["questions"] = tuple(data.get("questions") or ())
    checks: dict[str, tuple[bool, str]] = {
        "title": (isinstance(data["title"], str), "text"),
        "consent": (isinstance(data["consent"], str), "the name of a file"),
        "order": (data.get("order", ORDERS[0]) in ORDERS, f"one of {', '.join(ORDERS)}"),
        "seed": (type(data.get("seed", 0)) is int and data.get("seed", 0) >= 0, "a number of at least 0"),
        "questions": (all(isinstance(question, str) for question in data["questions"]), "a list of texts"),
    }
    for key, (is_right, wanted) in checks.items():
        if not is_right:
            raise StudyError(f"{file}: {key} must be {wanted}, got {data[key]!r}.")
    if len({*data["questions"], *(scale.name for scale in TLX)}) < len(data["questions"]) + len(TLX):
        raise StudyError(f"{file}: questions: each must be another one.")
    for key in ("conditions", "practice"):
        named = data.get(key) or {}
        if not isinstance(named, dict) or (key == "conditions" and not named):
            raise StudyError(f"{file}: {key} must map names to arguments, got {named!r}.")
        data[key] = {name: _condition(f"{file}: {key}", name, values) for name, values in named.items()}
    both = set(data["conditions"]) & set(data["practice"])
    if both:
        raise StudyError(f"{file}: {', '.join(sorted(both))} names a condition and a practice drive: rename one.")
    try:
        consent_text = (file.parent / data["consent"]).read_text(encoding="utf-8")
    except (OSError, UnicodeError) as error:
        raise StudyError(
            f"{file}: consent: {file.parent / data['consent']} cannot be read: write what is agreed to."
        ) from error
    return Protocol(**data, text=text, consent_text=consent_text, folder=file.parent.resolve())


def _check_keys(where: str, data: Any, known: list[str], needed: tuple[str, ...]) -> None:
    if not isinstance(data, dict):
        raise StudyError(f"{where}: must be a mapping with {', '.join(needed)}, got {data!r:.60}.")
    for key in data:
        if key not in known:
            raise StudyError(f"{where}: {key!r} is unknown, choose from {', '.join(known)}.")
    for key in needed:
        if key not in data:
            raise StudyError(f"{where}: {key!r} is missing.")


def _condition(where: str, name: Any, data: Any) -> Condition:
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise StudyError(f"{where}: {name!r} cannot be a name, use letters, digits, - and _.")
    where = f"{where}: {name}"
    _check_keys(where, data, list(TYPES), ("episodes",))
    data = {key: value for key, value in data.items() if value is not None}  # null: the default
    for key, value in data.items():
        is_right, wanted = TYPES[key]
        if not is_right(value):
            raise StudyError(f"{where}: {key} must be {wanted}, got {value!r}.")
    return Condition(**data)


class Participant:
    """
    Folder of a participant. Each line is on the disk when its method returns.

    :param study: folder of the study
    :param number: of the participant
    """

    def __init__(self, study: Path, number: int) -> None:
        self.number = number
        self.folder = study / f"participant-{number:03d}"

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """
        Keep the folder from other processes inside the block; it is free again whenever this one ends.

        :raises StudyError: if another one has it
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self.folder, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(descriptor)
            raise StudyError(f"{self.folder} is in use: end the other process, or take another --participant.") from error
        try:
            yield
        finally:
            os.close(descriptor)
            with suppress(OSError):
                self.folder.rmdir()  # if nothing came of it

    def has_agreed(self, protocol: Protocol) -> bool:
        """
        Tell whether the participant has agreed before.

        :return: False if it was not asked yet
        :raises StudyError: if it has declined, or the protocol is another one by now
        """
        consent = self._read(CONSENT)
        if not consent:
            return False
        if not consent[0]["agreed"]:
            raise StudyError(f"{self.folder}: participant {self.number} has declined: take another --participant.")
        for name, now in ((PROTOCOL, protocol.text), (CONSENT_TEXT, protocol.consent_text)):
            if (self.folder / name).read_text(encoding="utf-8") != now:
                raise StudyError(
                    f"{self.folder}: the protocol is not the one that participant {self.number} has begun with: go on with "
                    f"{self.folder / name}, or choose another --out."
                )
        return True

    def store_consent(self, protocol: Protocol, agreed: bool) -> None:
        """
        Store the answer to the consent text, and if it was a yes, the protocol and the order.

        :param protocol: of the study
        :param agreed: whether it was
        """
        if agreed:
            write_safely(self.folder / PROTOCOL, protocol.text.encode())
            write_safely(self.folder / CONSENT_TEXT, protocol.consent_text.encode())
            write_safely(self.folder / ORDER, (json.dumps(protocol.order_for(self.number)) + "\n").encode())
        write_safely(self.folder / CONSENT, (json.dumps({"agreed": agreed}) + "\n").encode())  # last: then all is there

    @property
    def order(self) -> list[str]:
        """Names of the conditions in this participant's order."""
        return self._read(ORDER)[0]

    def store_episode(self, condition: str, record: EpisodeRecord) -> None:
        """
        Store an episode.

        :param condition: its name, or that of a practice drive
        :param record: of it
        """
        self._append(EPISODES, {"condition": condition, **record._asdict()})

    def store_answers(self, condition: str, values: dict[str, Any]) -> None:
        """
        Store the answers after a condition.

        :param condition: its name
        :param values: scales and free text
        """
        self._append(ANSWERS, {"condition": condition, "raw_tlx": raw_tlx(values), "values": values})

    def episodes(self, condition: str) -> list[dict[str, Any]]:
        """
        Return the episodes of a condition that were driven to their end.

        :param condition: its name, or that of a practice drive
        """
        return [line for line in self._read(EPISODES) if line["condition"] == condition and line["is_whole"]]

    def answers(self, condition: str) -> dict[str, Any] | None:
        """
        Return the answers after a condition.

        :param condition: its name
        :return: None if there are none yet
        """
        return next((line for line in self._read(ANSWERS) if line["condition"] == condition), None)

    def _read(self, name: str) -> list[Any]:
        file = self.folder / name
        lines = file.read_text(encoding="utf-8").splitlines(keepends=True) if file.exists() else []
        return [json.loads(line) for line in lines if line.endswith("\n")]  # a last one without its end was cut off

    def _append(self, name: str, line: dict[str, Any]) -> None:
        file = self.folder / name
        before = file.read_bytes() if file.exists() else b""
        whole = before[: before.rfind(b"\n") + 1]
        write_safely(file, whole + (json.dumps(line, ensure_ascii=False) + "\n").encode())
        sync(self.folder)


# The summary

SCALES = [scale.name for scale in TLX]
SUMS = ("steps", "human_steps", "takeovers", "cost", "seconds")
COLUMNS = ["participant", "condition", "place", "episodes", *SUMS, "success", "return", *SCALES, "raw_tlx"]


def summarise(study: Path) -> list[dict[str, Any]]:
    """
    Sum up a study and write ``summary.csv``.

    :param study: its folder
    :return: a row for each participant and condition; sums over its episodes, the share that succeeded, the mean return and
        the answers. What is not known is None
    :raises StudyError: if nobody has taken part
    """
    numbers = sorted(int(folder.name.removeprefix("participant-")) for folder in study.glob("participant-*[0-9]"))
    participants = [person for number in numbers if (person := Participant(study, number)).folder.joinpath(ORDER).exists()]
    rows = [row for participant in participants for row in _rows(participant)]
    if not rows:
        raise StudyError(f"{study} holds no episode of a participant: name the --out of a study.")
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_safely(study / SUMMARY, text.getvalue().encode())
    return rows


def _rows(participant: Participant) -> Iterator[dict[str, Any]]:
    for place, condition in enumerate(participant.order, 1):
        episodes, answers = participant.episodes(condition), participant.answers(condition)
        if not episodes:
            continue
        row: dict[str, Any] = {"participant": participant.number, "condition": condition, "place": place}
        row["episodes"] = len(episodes)
        for name in SUMS:
            row[name] = _over(sum, [episode[name] for episode in episodes])
        row["success"] = _over(fmean, [episode["success"] for episode in episodes])
        row["return"] = _over(fmean, [episode["episode_return"] for episode in episodes])
        scales = answers["values"] if answers else {}
        row |= {name: scales.get(name) for name in SCALES} | {"raw_tlx": answers["raw_tlx"] if answers else None}
        yield row


def _over(combine: Callable[[list[Any]], float], values: list[Any]) -> float | None:
    return None if None in values else combine(values)


def table(rows: list[dict[str, Any]]) -> str:
    """
    Print means over participants.

    :param rows: see ``summarise``
    :return: a line for each condition
    """
    shown = ["episodes", "human_steps", "takeovers", "cost", "success", "return", "seconds", *SCALES, "raw_tlx"]
    lines = [["condition", "participants", *shown]]
    for condition in dict.fromkeys(row["condition"] for row in rows):
        own = [row for row in rows if row["condition"] == condition]
        means = [_over(fmean, [row[name] for row in own if row[name] is not None] or [None]) for name in shown]
        lines.append([condition, f"{len(own)}", *("-" if mean is None else f"{mean:.4g}" for mean in means)])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)
