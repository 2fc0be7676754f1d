"""Files that others made: what they say is read, and nothing that they name is run."""

import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.envs.registration import EnvSpec

from sb3_chac.cli.demos import main as demos
from sb3_chac.cockpit.recording import ABOUT, FOLDER, CrashSafeRecorder, finish_recording
from sb3_chac.common.minari_datasets import open_dataset
from sb3_chac.datasets.recording import record
from sb3_chac.evaluation.episodes import NotEvaluable, check_names_no_code, registered_spec

ROOT = Path(__file__).parents[1]
EVIL = {
    "entry point": {"entry_point": "os:system"},
    "another id": {"id": "Evil-v0", "entry_point": "os:system"},
    "a module in the id": {"id": "antigravity:Evil-v0"},
    "vector entry point": {"id": "Evil-v0", "vector_entry_point": "os:system"},
    "a wrapper": {"additional_wrappers": [{"name": "Evil", "entry_point": "os:system", "kwargs": {"command": "touch ran"}}]},
}


@pytest.fixture
def no_code(monkeypatch, tmp_path):
    """Fails if one of the named things is run or imported."""
    monkeypatch.chdir(tmp_path)
    ran: list[str] = []
    monkeypatch.setattr(os, "system", lambda *args, **kwargs: ran.append(str((args, kwargs))))
    yield
    assert ran == [] and "antigravity" not in sys.modules


def changed(text: str, harm: dict) -> str:
    return json.dumps(json.loads(text) | harm)


@pytest.mark.parametrize("harm", EVIL.values(), ids=EVIL)
def test_a_dataset_names_registered_environments_only(tmp_path, no_code, harm, capsys):
    folder = record(tmp_path / "set-v0", lambda observation: np.zeros(1, np.float32), "Pendulum-v1", 10)
    file = next(folder.rglob("metadata.json"))
    metadata = json.loads(file.read_text())
    metadata["env_spec"] = changed(metadata["env_spec"], harm | {"kwargs": {"command": "touch ran"}})
    file.write_text(json.dumps(metadata))
    with pytest.raises(SystemExit) as ended:
        demos(["replay", "--dataset", str(folder)])
    error = capsys.readouterr().err
    assert ended.value.code == 2 and error.count("\n") == 1, error


@pytest.mark.parametrize("harm", EVIL.values(), ids=EVIL)
def test_a_drive_is_recovered_without_making_its_environment(tmp_path, no_code, harm):
    env = gym.make("Pendulum-v1")
    recorder = CrashSafeRecorder(tmp_path, env, str(tmp_path / "drive-v0"), "test", 0.1)
    observation, _ = env.reset(seed=0)
    recorder.begin(observation, 0, None)
    info = {"applied_action": np.zeros(1, np.float32), "takeover": False, "cost": 0.0}
    recorder.add(np.zeros(1, np.float32), observation, 0.0, False, True, info)
    file = tmp_path / FOLDER / ABOUT
    about = json.loads(file.read_text())
    file.write_text(json.dumps(about | {"spec": changed(about["spec"], harm)}))
    summary = finish_recording(tmp_path)
    assert summary is not None and summary.steps == 1


class Importing(PendulumEnv):
    """As highway-env does, it imports what its keywords and the options of a reset name."""

    def __init__(self, render_mode=None, config=None):
        super().__init__(render_mode)
        self.configure(config or {})

    def configure(self, config):
        for part in config.values():
            import_module(part["type"] if isinstance(part, dict) else part[0])

    def reset(self, *, seed=None, options=None):
        self.configure(options or {})
        return super().reset(seed=seed)


@pytest.mark.parametrize("config", [{"a": {"type": "evil.module"}}, {"a": ["evil.module"]}, {"a": ["antigravity:fly", 1]}])
@pytest.mark.parametrize("place", ["keywords", "options"])
def test_what_a_file_gives_to_an_environment_names_no_code(tmp_path, no_code, monkeypatch, capsys, config, place):
    monkeypatch.setitem(
        gym.registry, "Importing-v0", EnvSpec("Importing-v0", entry_point=f"{__name__}:Importing", max_episode_steps=5)
    )
    (tmp_path / "evil").mkdir()
    (tmp_path / "evil" / "module.py").write_text("open('ran', 'w')")
    monkeypatch.syspath_prepend(tmp_path)
    folder = record(tmp_path / "set-v0", lambda observation: np.zeros(1, np.float32), "Importing-v0", 5)
    if place == "keywords":
        file = next(folder.rglob("metadata.json"))
        metadata = json.loads(file.read_text())
        metadata["env_spec"] = changed(metadata["env_spec"], {"kwargs": {"config": config}})
        file.write_text(json.dumps(metadata))
    else:
        storage = type(open_dataset(folder).storage)
        original = storage.get_episode_metadata

        def with_options(self, episodes):
            return [found | {"options": config} for found in original(self, episodes)]

        monkeypatch.setattr(storage, "get_episode_metadata", with_options)
    with pytest.raises(SystemExit) as ended:
        demos(["replay", "--dataset", str(folder)])
    error = capsys.readouterr().err
    assert ended.value.code == 2 and error.count("\n") == 1 and "may be code that it imports" in error
    assert not (tmp_path / "ran").exists()


def test_keywords_of_the_package_itself_or_registered_with_it_are_fine():
    own, registered = {"config": {"vehicle": "gymnasium.envs.Some"}}, {"xml_file": "mine.xml"}
    known = EnvSpec("Known-v0", entry_point="gymnasium.envs:Env", kwargs=registered)
    check_names_no_code({**own, "text": "SXO 0.5 1e3", 3: [None, 1.5, True]}, known, "a file")
    with pytest.raises(NotEvaluable, match=r"^a file: Known-v0 is to get 'os.system'"):
        check_names_no_code({"os.system": 1}, known, "a file")


def test_a_registered_environment_keeps_the_keywords_of_the_file():
    spec = registered_spec(EnvSpec("SafeDrive-v0", entry_point="os:system", kwargs={"horizon": 7}), "a file")
    assert spec.kwargs["horizon"] == 7 and spec.entry_point == gym.spec("SafeDrive-v0").entry_point
    with pytest.raises(NotEvaluable, match=r"^a file: the environment 'Nowhere-v0' is not registered"):
        registered_spec(EnvSpec("Nowhere-v0", entry_point="os:system"), "a file")
    with pytest.raises(NotEvaluable, match=r"^a file: RemoteVehicle-v0 at 10.0.0.1:5700 is a vehicle"):
        registered_spec(EnvSpec("RemoteVehicle-v0", kwargs={"address": "10.0.0.1:5700"}), "a file")


START = """
import os, site, sys
del os.environ["SB3_CHAC_NO_AUTOLOAD"]
os.environ.update({variables!r})
sys.meta_path[:] = [finder for finder in sys.meta_path if "sb3_chac" not in str(finder)]
site.addpackage({root!r}, "sb3_chac.pth", set())
hooked = any("ZooFinder" in str(finder) for finder in sys.meta_path)
import gymnasium
print(hooked, "SafeDrive-v0" in gymnasium.registry, sys.modules.get("sb3_chac"))
"""


def start(cwd: Path, **variables: str) -> str:
    environment = os.environ | {"PYTHONPATH": ":", "SB3_CHAC_NO_AUTOLOAD": "1"}
    code = START.format(root=str(ROOT), variables=variables)
    return subprocess.run(
        [sys.executable, "-c", code], cwd=cwd, env=environment, capture_output=True, text=True, check=True
    ).stdout


def test_the_start_up_hook_runs_no_strangers_package(tmp_path):
    (tmp_path / "sb3_chac").mkdir()
    for name in ("__init__", "_startup"):
        (tmp_path / "sb3_chac" / f"{name}.py").write_text("open('ran', 'w')\n")
    output = start(tmp_path)
    assert output.startswith("True True") and str(ROOT / "sb3_chac") in output
    assert not (tmp_path / "ran").exists()


def test_the_start_up_hook_asks_first_whether_it_is_wanted(tmp_path):
    assert start(tmp_path, SB3_CHAC_NO_AUTOLOAD="1").startswith("False False None")
