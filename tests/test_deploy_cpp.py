"""The C++ gate and policy against Python's, step by step. Skipped where there is no compiler, or no onnxruntime."""

import functools
import math
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from eleven import Walk, make_any

from sb3_chac.deploy.export import export
from sb3_chac.deploy.gate import Gate, Given, Limits
from sb3_chac.deploy.policy import OnnxPolicy

CPP = Path(__file__).parents[1] / "cpp"
COMPILER = shutil.which("g++") or shutil.which("clang++")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
# Where CMakeLists.txt looks, too
HEADERS = [Path(os.environ.get("ONNXRUNTIME_INCLUDE_DIR", "/usr/include/onnxruntime")), Path("/usr/include")]
HEADERS += [folder / "onnxruntime/core/session" for folder in HEADERS]


def compiled(source, target, *arguments):
    """:return: the program, made from a file in cpp/"""
    command = [COMPILER, "-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", "-o", str(target), str(CPP / source), *arguments]
    subprocess.run(command, check=True)
    return target


def text(value):
    """As check_gate.cpp reads it."""
    if value is None:
        return "-1"
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float | int):
        return repr(float(value))
    return " ".join([str(len(value)), *(repr(float(number)) for number in value)])


def random_steps(rng, n):
    """Times and what the gate is given: mostly good, with every kind of fault now and then, in bursts."""
    now, bad = 0.0, False
    for _ in range(n):
        bad = rng.random() < (0.7 if bad else 0.1)

        def action():
            values = rng.uniform(-1.2 if bad else -1, 1.2 if bad else 0.8, 2).tolist()  # noqa: B023
            if bad and rng.random() < 0.3:  # noqa: B023
                values[rng.integers(2)] = rng.choice([math.nan, math.inf, -math.inf])
            return tuple(values[: rng.choice([2, 2, 2, 1])]) if bad else tuple(values)  # noqa: B023

        maybe = functools.partial(lambda p: action() if rng.random() < p else None)
        dt = float(rng.choice([0.01, 0.05, 0.1, 0.5]) if rng.random() < 0.97 else rng.choice([0.0, -0.1, math.nan]))
        now = now if math.isnan(dt) else max(now + dt, 0.0)
        late = [float(rng.choice([0.01, 9.0, math.nan, -1.0])) if bad else 0.01 for _ in range(3)]
        yield (
            (dt if math.isnan(dt) else now),
            Given(
                maybe(0.9), maybe(0.7), *late, bool(rng.random() > 0.3 * bad), bool(rng.random() < 0.05), maybe(0.7),
                bool(rng.random() < 0.1), bool(rng.random() < 0.1), maybe(0.5),
            ),
        )  # fmt: skip


def test_the_gates_decide_alike(tmp_path):
    program = compiled("check_gate.cpp", tmp_path / "check_gate")
    limits = Limits((-1.0, -1.0), (1.0, 0.8), (None, -1.0), (None, 0.0), (5.0, 10.0), guided_for=0.3, latch_after=0.6)
    gate, steps = Gate(limits), list(random_steps(np.random.default_rng(0), 5000))
    lines = ["2 -1 -1 1 0.8 none -1 none 0 5 10"]
    lines += [" ".join(repr(getattr(limits, name)) for name in (
        "max_age", "max_silence", "deadline", "hold_for", "guided_for", "latch_after", "tolerance"))]  # fmt: skip
    lines += [" ".join([repr(now), *map(text, given)]) for now, given in steps]
    output = subprocess.run([program], input="\n".join(lines), text=True, capture_output=True, check=True).stdout
    rows = output.splitlines()
    assert len(rows) == len(steps)
    states = set()
    for (now, given), row in zip(steps, rows, strict=True):
        expected = gate.step(now, given)
        state, faults, engaged, *action = row.split()
        assert (int(state), int(faults), bool(int(engaged))) == (expected.state, expected.faults, expected.engaged)
        assert tuple(map(float, action)) == expected.action
        states.add(expected.state)
    assert len(states) == 5


def test_the_policies_act_alike(tmp_path):
    headers = next((folder for folder in HEADERS if (folder / "onnxruntime_c_api.h").is_file()), None)
    library = next(Path(onnxruntime.__file__).parent.glob("capi/libonnxruntime.so*"), None)
    if headers is None or library is None:
        pytest.skip("needs onnxruntime_c_api.h (ONNXRUNTIME_INCLUDE_DIR) and the wheel's library")
    link = tmp_path / "libonnxruntime.so.1"  # as the library calls itself
    link.symlink_to(library)
    program = compiled(
        "check_policy.cpp", tmp_path / "check_policy", f"-isystem{headers}", str(link), f"-Wl,-rpath,{tmp_path}"
    )
    observations = np.random.default_rng(0).uniform(-3, 3, (50, 2)).astype(np.float32)
    for name, kwargs in [("CHAC", {"switch_after": 20, "delta": 0.5}), ("DSAC", {})]:
        export(make_any(name, Walk(), **kwargs).learn(40), tmp_path / "policy.onnx")
        exported = OnnxPolicy(tmp_path / "policy.onnx")
        output = subprocess.run(
            [program, tmp_path / "policy.onnx"],
            input="\n".join(" ".join(map(repr, row)) for row in observations.tolist()),
            text=True, capture_output=True, check=True,
        ).stdout  # fmt: skip
        rows = [np.array(line.split(), float) for line in output.splitlines()]
        assert len(rows) == len(observations)
        for observation, row in zip(observations, rows, strict=True):
            proposal = exported(observation)
            expected = [*proposal.action]
            if proposal.confidence is not None:
                expected += [*proposal.guided_action, proposal.self_drives, proposal.confidence]
            assert np.allclose(row, expected, atol=1e-6)
