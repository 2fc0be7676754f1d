"""Checkpoints: two are kept, what is damaged is not used, signals end a training in good order, data runs no code."""

import inspect
import json
import os
import shutil
import signal
import subprocess
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from eleven import ALL, OFFLINE, Walk, demonstrations, make_any
from guided_toys import make_guided
from shell import FOREVER, wait_until
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.vec_env import VecNormalize
from test_zoo import swings

import sb3_chac
from sb3_chac import CHAC, DPVP, DSAC, SACLag
from sb3_chac.common.checkpoint_files import (
    BUFFER,
    CONTENTS,
    DamagedCheckpoint,
    checkpoints,
    newest_checkpoint,
    sound_checkpoint,
    verify,
)
from sb3_chac.common.checkpoints import ResumableCheckpoint, StopSignals, TrainingStopped
from sb3_chac.zoo.algorithms import ALGORITHMS
from sb3_chac.zoo.experiments import learn_ours

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SMALL = {"policy_kwargs": {"net_arch": [8]}, "buffer_size": 200}


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A folder with the checkpoints 30 and 40 of a short training with VecNormalize."""
    folder = tmp_path_factory.mktemp("run")
    model = make_guided(DPVP)
    model.set_env(VecNormalize(model.get_env()), force_reset=True)
    model.learn(40, callback=ResumableCheckpoint(10, folder, "toy"))
    return folder


@pytest.fixture
def folder(trained, tmp_path) -> Path:
    shutil.copytree(trained / "checkpoints", tmp_path / "checkpoints")
    return tmp_path / "checkpoints"


def test_the_newest_two_are_kept(trained):
    assert [path.name for path in checkpoints(trained / "checkpoints")] == ["40", "30"]
    assert {path.name for path in (trained / "checkpoints").iterdir()} == {"40", "30"}


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def change(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0x55
    path.write_bytes(content)


def poison(path: Path) -> None:
    """A weight becomes NaN."""
    model = DPVP.load(path)
    with th.no_grad():
        next(model.policy.parameters()).view(-1)[0] = np.nan
    model.save(path)


def other_step(path: Path) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | {"steps": 41}))


def without_policy(path: Path) -> None:
    """A sound zip, but not a whole model."""
    rewrite(path, {"policy.pth": None})


def with_a_pickle(path: Path) -> None:
    """A sound zip, whose weights are none."""
    rewrite(path, {"policy.pth": b"cos\nsystem\n(S'touch ran'\ntR."})


def rewrite(path: Path, changes: dict[str, bytes | None]) -> None:
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()} | changes
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            if content is not None:
                archive.writestr(name, content)


@pytest.mark.parametrize("harm", [cut, change, Path.unlink, poison])
@pytest.mark.parametrize("file", ["toy.zip", BUFFER, CONTENTS, "toy/vecnormalize.pkl"])
def test_damage_is_noticed_and_the_older_one_is_used(folder, file, harm):
    if harm is poison and file != "toy.zip":
        harm = change
    if file == CONTENTS:
        harm = other_step
    harm(folder / "40" / file)
    assert_unsound(folder)


@pytest.mark.parametrize("harm", [without_policy, with_a_pickle])
@pytest.mark.parametrize("version", ["this", "without a list of files"])
def test_a_sound_archive_that_holds_no_model_is_damage(folder, harm, version):
    harm(folder / "40" / "toy.zip")
    if version != "this" and harm is with_a_pickle:
        contents = json.loads((folder / "40" / CONTENTS).read_text())
        del contents["files"]
        (folder / "40" / CONTENTS).write_text(json.dumps(contents))
    assert_unsound(folder)


@pytest.mark.parametrize("text", ["[]", "null", "{", "[" * 100_000], ids=["list", "null", "cut", "deep"])
def test_a_list_of_contents_that_is_none_is_damage(folder, text):
    (folder / "40" / CONTENTS).write_text(text)
    assert_unsound(folder)


@pytest.mark.parametrize("name", ["99", "0099"])
def test_a_copy_under_a_higher_number_is_not_of_that_step(folder, name):
    shutil.copytree(folder / "40", folder / name)
    path, problems = sound_checkpoint(folder)
    assert path == folder / "40" and len(problems) == 1 and "is of step 40, not of" in problems[0]


def assert_unsound(folder: Path) -> None:
    with pytest.raises(DamagedCheckpoint, match="40"):
        verify(folder / "40")
    path, problems = sound_checkpoint(folder)
    assert path == folder / "30" and len(problems) == 1


@pytest.mark.parametrize("name", ["99", "abc", "²", "50.tmp", "-7"])
def test_other_folders_shadow_nothing(folder, name):
    (folder / name).mkdir()
    if name != "99":
        shutil.copytree(folder / "40", folder / name, dirs_exist_ok=True)
    assert newest_checkpoint(folder) == folder / "40" == sound_checkpoint(folder)[0]


def test_an_older_version_without_contents_needs_its_buffer(folder):
    (folder / "40" / CONTENTS).unlink()
    verify(folder / "40")
    (folder / "40" / BUFFER).unlink()
    with pytest.raises(DamagedCheckpoint, match="is missing: the training would go on with empty stores"):
        verify(folder / "40")


def test_nothing_of_the_model_is_unpickled_by_the_check(folder, monkeypatch):
    monkeypatch.setattr("pickle.loads", None)
    monkeypatch.setattr("cloudpickle.loads", None)
    verify(folder / "40")


@pytest.mark.parametrize("algorithm", [SAC, PPO, DSAC, SACLag])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_with_a_checkpoint_of_the_last_step(tmp_path, algorithm, number):
    kwargs = {"n_steps": 16, "batch_size": 8} if algorithm is PPO else SMALL | {"learning_starts": 5}
    kwargs["policy_kwargs"] = {"net_arch": [8]}
    env = "Pendulum-v1" if algorithm is not SACLag else costly_pendulum()
    model = algorithm("MlpPolicy", env, seed=0, **kwargs)
    send = ConvertCallback(lambda local, _: local["self"].num_timesteps != 20 or os.kill(os.getpid(), number) is None)
    before = signal.getsignal(number)
    with StopSignals() as signals, pytest.raises(TrainingStopped) as stopped:
        model.learn(1000, callback=[ResumableCheckpoint(500, tmp_path, "toy", signals=signals), send])
    assert signal.getsignal(number) is before
    steps = 32 if algorithm is PPO else 20  # its rollout is finished and learned from
    assert stopped.value.exit_code == 128 + number
    assert f"at step {steps}; go on: sb3-chac resume {tmp_path}" in str(stopped.value)
    verify(tmp_path / "checkpoints" / str(steps))


def costly_pendulum():
    import gymnasium as gym

    class Costly(gym.Wrapper):
        def step(self, action):
            *rest, info = self.env.step(action)
            return *rest, info | {"cost": 0.0}

    return Costly(gym.make("Pendulum-v1"))


def test_a_training_that_goes_on_has_a_checkpoint_at_once(tmp_path):
    model = DSAC("MlpPolicy", "Pendulum-v1", **SMALL)
    model.learn(7)
    checkpoint = ResumableCheckpoint(500, tmp_path, "toy")
    stop = ConvertCallback(lambda *_: False)
    model.learn(20, callback=[checkpoint, stop], reset_num_timesteps=False)
    assert [path.name for path in checkpoints(tmp_path / "checkpoints")] == ["7"]


def test_a_model_that_is_no_longer_finite_does_not_replace_one_that_was(tmp_path):
    model = DSAC("MlpPolicy", "Pendulum-v1", **SMALL, learning_starts=1000)

    def ruin(local, _):
        if local["self"].num_timesteps == 15:
            with th.no_grad():
                next(local["self"].policy.parameters()).view(-1)[0] = np.nan
            local["self"].policy.predict = lambda *args, **kwargs: (np.zeros((1, 1), np.float32), None)
        return True

    with pytest.raises(ValueError, match="NaN or infinite at step 20: no checkpoint was written"):
        model.learn(25, callback=[ResumableCheckpoint(10, tmp_path, "toy"), ConvertCallback(ruin)])
    assert newest_checkpoint(tmp_path / "checkpoints").name == "10"


def test_weights_load_without_code():
    """As SB3's coming safe deserialisation wants it: what the networks need is tensors, numbers and names."""
    for path in sorted((BENCHMARKS / "agents").glob("*.zip")):
        assert sb3_chac.common.checkpoint_files.verify_model(path)["policy_class"]  # torch.load(..., weights_only=True)


@pytest.mark.parametrize("name", ALGORITHMS.values())
def test_saved_weights_of_every_algorithm_load_without_code(tmp_path, name):
    algorithm = getattr(sb3_chac, name)
    given = {"dataset": swings(), "buffer_size": 10, "policy_kwargs": {"net_arch": [8]}}
    accepted = inspect.signature(algorithm).parameters
    kwargs = {argument: value for argument, value in given.items() if argument in accepted}
    algorithm("MlpPolicy", "Pendulum-v1", **kwargs).save(tmp_path / "model.zip")
    assert sb3_chac.common.checkpoint_files.verify_model(tmp_path / "model.zip")


def test_the_memory_of_stage_2_is_flat_without_a_logger(monkeypatch):
    monkeypatch.setattr("sb3_chac.chac.chac.MOST_CHOICES", 20)
    model = make_guided(CHAC, switch_after=30, prefit_steps=0)
    model.learn(100, log_interval=None)
    assert model.stage == 2 and len(model.choices) == 20


@pytest.mark.slow
def test_chaos(tmp_path):
    """Kills in both stages, a damaged checkpoint, a full disk: the small size of benchmarks/chaos.py."""
    command = [sys.executable, str(BENCHMARKS / "chaos.py"), "--kills", "3", "--steps", "160", "--seed", "1"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=FOREVER)
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_the_command_answers_a_signal_with_one_sentence(tmp_path, number):
    command = [
        sys.executable,
        "-m",
        "sb3_chac",
        "train",
        "--algo",
        "sac",
        "--env",
        "SafeDrive-v0",
        "-n",
        "100000",
        "-f",
        "logs",
    ]
    command += ["--eval-freq", "-1", "--save-freq", "50000", "-params", "learning_starts:100000", "buffer_size:100000"]
    with (tmp_path / "output").open("w") as output:
        process = subprocess.Popen(command, cwd=tmp_path, stdout=output, stderr=subprocess.STDOUT)
        run = tmp_path / "logs" / "sac" / "SafeDrive-v0_1"
        wait_until(lambda: (run / "progress.csv").exists() or process.poll() is not None)
        process.send_signal(number)
        assert process.wait(FOREVER) == 128 + number
    text = (tmp_path / "output").read_text()
    assert "Traceback" not in text and f"Stopped by {signal.Signals(number).name} at step" in text.splitlines()[-1]
    assert "sb3-chac resume logs/sac/SafeDrive-v0_1" in text.splitlines()[-1]
    (checkpoint,) = checkpoints(run / "checkpoints")
    verify(checkpoint)
    assert (run / "SafeDrive-v0.zip").is_file()


@pytest.mark.filterwarnings("ignore:.*no human is in the loop", "ignore:.*mini-batch")
@pytest.mark.parametrize("name", [name for name in ALL if name not in OFFLINE])
def test_an_error_of_the_environment_leaves_what_was_driven_before(name, tmp_path):
    class Breaks(Walk):
        count = 0

        def step(self, action):
            Breaks.count += 1
            observation, *rest = super().step(action)
            return observation * (np.nan if Breaks.count > 40 else 1), *rest

    model, checkpoint = make_any(name, Breaks()), ResumableCheckpoint(10_000, tmp_path, "Walk-v0")
    manager = SimpleNamespace(callbacks=[checkpoint], steps_done=None)
    with pytest.raises(
        ValueError, match=r"^observation of environment 0.*Stopped by this error at step \d+; go on: sb3-chac resume"
    ):
        learn_ours(lambda model: model.learn(100, callback=checkpoint), manager, model)
    newest = newest_checkpoint(checkpoint.folder)
    assert newest is not None and int(newest.name) >= 36
    loaded = type(model).load(newest / "Walk-v0.zip", **({"dataset": demonstrations()} if name == "GAIL" else {}))
    assert loaded.num_timesteps == model.num_timesteps


def test_an_error_before_the_first_step_leaves_nothing(tmp_path):
    checkpoint = ResumableCheckpoint(10_000, tmp_path, "Walk-v0")

    def fails(model):
        raise ValueError("no such thing")

    with pytest.raises(ValueError, match=r"^no such thing$"):
        learn_ours(fails, SimpleNamespace(callbacks=[checkpoint], steps_done=None), make_any("DSAC", Walk()))
    assert not checkpoint.folder.exists()
