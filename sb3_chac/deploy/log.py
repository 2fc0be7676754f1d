"""The decision log: a JSON object per line, the first one about the policy, then one per decision."""

import base64
import json
import math
import queue
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sb3_chac.deploy.metadata import Input, Metadata, NotDeployable
from sb3_chac.deploy.runtime import Step
from sb3_chac.deploy.udp import Observed


class DecisionLog:
    """
    Log of decisions, written in a thread of its own, so that a slow disk delays none. A context manager.

    :param file: to write; it must not be there
    :param metadata: of the policy
    """

    def __init__(self, file: Path, metadata: Metadata) -> None:
        self._lines: queue.SimpleQueue[tuple[Step, Observed | None] | None] = queue.SimpleQueue()
        self._inputs = metadata.inputs
        self._stream = file.open("x")
        self._stream.write(json.dumps({"policy": json.loads(metadata.to_json())}) + "\n")
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()

    def __enter__(self) -> "DecisionLog":
        return self

    def __exit__(self, *_: object) -> None:
        self._lines.put(None)
        self._thread.join()
        self._stream.close()

    def add(self, step: Step, packet: Observed | None = None) -> None:
        """
        Write one decision.

        :param step: of a ``Runtime``
        :param packet: in which its observation came, None if there was none
        """
        self._lines.put((step, packet))

    def _write(self) -> None:
        while (entry := self._lines.get()) is not None:
            self._stream.write(json.dumps(line_of(*entry, self._inputs)) + "\n")
            if self._lines.empty():
                self._stream.flush()


def line_of(step: Step, packet: Observed | None, inputs: tuple[Input, ...]) -> dict[str, Any]:
    """Return what a line of the log holds. Numbers that are not finite become None; observations are base64."""
    proposal, given, decision = step.proposal, step.given, step.decision
    line: dict[str, Any] = {
        "time": step.time,
        "state": decision.state.name,
        "faults": [fault.name for fault in decision.faults],
        "action": list(decision.action),
        "engaged": decision.engaged,
        "age": finite(given.age),
        "silence": finite(given.silence),
        "latency": finite(given.latency),
        "override": given.override,
    }
    if proposal is not None:
        line["proposed"] = [finite(value) for value in proposal.action.ravel().tolist()]
        if proposal.confidence is not None and proposal.guided_action is not None:
            line["guided"] = [finite(value) for value in proposal.guided_action.ravel().tolist()]
            line["self_drives"], line["confidence"] = proposal.self_drives, finite(proposal.confidence)
    if step.observation is not None:
        if step.problem is not None:
            line["problem"] = step.problem
        parts = step.observation if isinstance(step.observation, dict) else {"": step.observation}
        line["observation"] = {
            entry.key: base64.b64encode(np.asarray(parts[entry.key], entry.dtype).tobytes()).decode()
            for entry in inputs
            if entry.key in parts and np.shape(parts[entry.key]) == entry.shape
        }
    if packet is not None:
        line |= {"session": packet.session, "sequence": packet.sequence, "flags": int(packet.flags), "stamp": packet.stamp}
        line |= {"reward": finite(packet.reward), "cost": finite(packet.cost)}
        line["executed"] = None if packet.executed is None else [finite(value) for value in packet.executed]
    return line


def finite(number: float) -> float | None:
    """Return None in place of what JSON has no word for."""
    return number if math.isfinite(number) else None


def read_log(file: Path) -> tuple[Metadata, Iterator[dict[str, Any]]]:
    """
    Read a log of decisions.

    :return: what the policy's file told, and the decisions, with their observations as arrays. A last line that was not
        finished is left out
    :raises NotDeployable: for another file
    """
    with file.open() as stream:
        try:
            policy = json.dumps(json.loads(stream.readline())["policy"])
        except (ValueError, KeyError, TypeError) as error:
            raise NotDeployable(f"{file} is not a log of 'sb3-chac run'.") from error
    metadata = Metadata.from_json(policy, str(file))
    return metadata, _decisions(file, metadata)


def _decisions(file: Path, metadata: Metadata) -> Iterator[dict[str, Any]]:
    with file.open() as stream:
        next(stream)
        for number, text in enumerate(stream, start=2):
            if not text.endswith("\n"):
                return
            try:
                line = json.loads(text)
            except ValueError as error:
                raise NotDeployable(f"{file}, line {number}: {error}.") from error
            if "observation" in line:
                stored = line["observation"]
                line["observation"] = {
                    entry.key: np.frombuffer(base64.b64decode(stored[entry.key]), entry.dtype).reshape(entry.shape)
                    for entry in metadata.inputs
                    if entry.key in stored
                }
            yield line
