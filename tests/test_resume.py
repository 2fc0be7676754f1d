"""Trainings that are killed in each stage, and while a checkpoint is written, go on where the last checkpoint was."""

import json
import shutil
import signal
import subprocess
import sys
import sysconfig
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from shell import clean_environment, run, zoo_train
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.save_util import load_from_pkl

from sb3_chac import CHAC, DPVP, DSAC
from sb3_chac.cli.plot import read_progress
from sb3_chac.cli.resume import main as resume
from sb3_chac.common.checkpoint_files import checkpoint_step, checkpoints, newest_checkpoint
from sb3_chac.common.checkpoints import ResumableCheckpoint
from sb3_chac.common.files import SparseWriter
from sb3_chac.envs.safedrive import SafeDriveEnv
from sb3_chac.zoo.runs import find_training, steps

SCRIPTS = Path(sysconfig.get_path("scripts"))
RUNS = Path("logs") / "chac"
SWITCH_AFTER, TOTAL = 150, 300
TRAIN = [
    *("--algo", "chac", "--env", "SafeDrive-v0", "-n", str(TOTAL), "--save-freq", "60", "--eval-freq", "150"),
    *("--eval-episodes", "1", "-f", "logs", "--seed", "1", "--env-kwargs", "horizon:60", "blocks:2"),
    *(
        "-params",
        "learning_starts:50",
        "train_freq:1",
        "buffer_size:1000",
        "batch_size:32",
        "policy_kwargs:dict(net_arch=[8])",
    ),
    *(f"switch_after:{SWITCH_AFTER}", "prefit_steps:5"),
]

# rl_zoo3 train, and kill -9 in the middle of the second checkpoint: the model is there in part, the replay buffer is not
DIE_WHILE_WRITING = """
import os, signal
from stable_baselines3.common.base_class import BaseAlgorithm
from rl_zoo3.train import train

save = BaseAlgorithm.save

def die(self, path, *args, **kwargs):
    save(self, path, *args, **kwargs)
    if getattr(path, "name", "").endswith("120.tmp/SafeDrive-v0.zip"):
        path.truncate(1000)
        os.kill(os.getpid(), signal.SIGKILL)

BaseAlgorithm.save = die
train()
"""


# sb3-chac, and kill -9 in stage 2, 20 steps after a checkpoint
DIE_IN_STAGE_2 = """
import os, signal
from sb3_chac.__main__ import main
from sb3_chac.common.checkpoints import ResumableCheckpoint

def die(self):
    if self.model.num_timesteps == 260:
        os.kill(os.getpid(), signal.SIGKILL)
    return True

ResumableCheckpoint._on_step = die
main()
"""


def run_killed(*command: str | Path, cwd: Path) -> None:
    """Runs a command that kills itself."""
    ended = subprocess.run(list(map(str, command)), cwd=cwd, env=clean_environment(), capture_output=True, text=True)
    assert ended.returncode == -signal.SIGKILL, ended.stdout + ended.stderr


@pytest.fixture(scope="module")
def killed(tmp_path_factory) -> Path:
    """A folder with three runs: killed in stage 1 while it wrote a checkpoint, resumed and killed in stage 2, resumed."""
    folder = tmp_path_factory.mktemp("resume")
    run_killed(sys.executable, "-c", DIE_WHILE_WRITING, *TRAIN, cwd=folder)
    run_killed(sys.executable, "-c", DIE_IN_STAGE_2, "resume", RUNS / "SafeDrive-v0_1", cwd=folder)
    (folder / "output").write_text(run(SCRIPTS / "sb3-chac", "resume", RUNS / "SafeDrive-v0_2", cwd=folder))
    return folder


def load(checkpoint: Path) -> CHAC:
    model = CHAC.load(checkpoint / "SafeDrive-v0.zip")
    model.load_replay_buffer(checkpoint / "replay_buffer.pkl")
    return model


def check_consistent(model: CHAC) -> None:
    """Steps, rows in both stores, counts and the wrapper's counts tell the same story."""
    counts = model.counts
    assert counts["total_steps"] == model.num_timesteps == len(model.replay_buffer.novice) + len(model.replay_buffer.human)
    assert counts["human_steps"] == len(model.replay_buffer.human) > 0
    assert model.stage == (1 if model.num_timesteps <= SWITCH_AFTER else 2)


def check_wrapper(model: CHAC) -> None:
    (wrapper,) = model.wrapper_states
    assert wrapper["human_steps"] == model.counts["human_steps"]
    assert wrapper["total_steps"] == min(model.num_timesteps, SWITCH_AFTER + 1)  # the human watches in stage 1 only


def test_killed_while_writing_a_checkpoint_in_stage_1(killed):
    folder = killed / RUNS / "SafeDrive-v0_1" / "checkpoints"
    assert {path.name for path in folder.iterdir()} == {"60", "120.tmp"}
    assert not zipfile.is_zipfile(folder / "120.tmp" / "SafeDrive-v0.zip")
    model = load(folder / "60")
    assert model.num_timesteps == 60
    check_consistent(model)
    check_wrapper(model)


def test_killed_in_stage_2(killed):
    folder = killed / RUNS / "SafeDrive-v0_2" / "checkpoints"
    checkpoint = newest_checkpoint(folder)
    assert checkpoint is not None and checkpoint.name == "240"
    model = load(checkpoint)
    assert model.stage == 2
    check_consistent(model)
    check_wrapper(model)


def test_resumed_twice_it_ends_with_all_steps(killed):
    model = load(killed / RUNS / "SafeDrive-v0_3" / "checkpoints" / str(TOTAL))
    assert model.num_timesteps == TOTAL
    check_consistent(model)
    before = load(newest_checkpoint(killed / RUNS / "SafeDrive-v0_2" / "checkpoints"))  # type: ignore[arg-type]
    assert model.counts["human_steps"] == before.counts["human_steps"]  # the human drove no more
    assert model._n_updates - before._n_updates == TOTAL - before.num_timesteps
    # What was stored before is still there, in both stores
    rows = len(before.replay_buffer.novice)
    for name in ("action", "observation/"):
        arrays = [store.replay_buffer.novice.arrays[name][:rows] for store in (before, model)]
        np.testing.assert_array_equal(*arrays)
        arrays = [store.replay_buffer.human.arrays[name] for store in (before, model)]
        np.testing.assert_array_equal(*arrays)


def test_counts_of_the_wrapper_after_resuming_in_stage_2(killed):
    check_wrapper(load(killed / RUNS / "SafeDrive-v0_3" / "checkpoints" / str(TOTAL)))


def test_what_resume_says(killed):
    output = (killed / "output").read_text()
    left = newest_checkpoint(killed / RUNS / "SafeDrive-v0_2" / "checkpoints").name  # type: ignore[union-attr]
    assert f"Resuming at step {left}, {TOTAL - int(left)} of {TOTAL} steps remain. Seed: {1 + int(left)}" in output
    assert "stage 2 begins" not in output  # it had begun
    finished = run(SCRIPTS / "sb3-chac", "resume", RUNS / "SafeDrive-v0_3", cwd=killed)
    assert f"nothing remains to be done, all {TOTAL} steps were made" in finished
    assert not (killed / RUNS / "SafeDrive-v0_4").exists()


def test_the_command_line_stays_as_it_was(killed):
    for number in (1, 2, 3):
        saved = killed / RUNS / f"SafeDrive-v0_{number}" / "SafeDrive-v0" / "argv.json"
        assert json.loads(saved.read_text()) == TRAIN
    # RL-Zoo3's own files are there as well
    names = {path.name for path in (killed / RUNS / "SafeDrive-v0_3").iterdir()}
    assert {"SafeDrive-v0.zip", f"rl_model_{TOTAL}_steps.zip", "0.monitor.csv"} <= names


def test_what_cannot_be_resumed(killed, tmp_path, monkeypatch, capsys):
    def refused(folder: Path) -> str:
        with pytest.raises(SystemExit) as exit_code:
            resume([str(folder)])
        assert exit_code.value.code == 2
        error = capsys.readouterr().err
        assert error.startswith("sb3-chac resume: error: ")
        return error

    monkeypatch.chdir(tmp_path)
    assert "change to the folder where the training was started" in refused(killed / RUNS / "SafeDrive-v0_1")
    monkeypatch.chdir(killed)
    assert "there is no such folder" in refused(Path("nowhere"))
    assert "is not the folder of a run" in refused(RUNS)
    early = tmp_path / RUNS / "SafeDrive-v0_9"
    shutil.copytree(killed / RUNS / "SafeDrive-v0_1" / "SafeDrive-v0", early / "SafeDrive-v0")
    output = refused(early)
    assert "holds no checkpoint yet" in output and f"rl_zoo3 train --algo chac --env SafeDrive-v0 -n {TOTAL} " in output
    shutil.copytree(killed / RUNS / "SafeDrive-v0_3" / "checkpoints", early / "checkpoints")
    for path in early.glob("checkpoints/*"):
        (path / "replay_buffer.pkl").unlink()
    output = refused(early)
    assert "holds no checkpoint that is sound" in output and "replay_buffer.pkl is missing" in output
    for text in ("[", "3", "null", "[]", '"text"', '{"--algo": "chac"}', '[["--algo"], null]'):
        (early / "SafeDrive-v0" / "argv.json").write_text(text)
        assert "cannot be read" in refused(early)


def test_a_damaged_checkpoint_costs_what_is_said(killed, tmp_path, monkeypatch, capsys):
    folder = tmp_path / RUNS / "SafeDrive-v0_3"
    shutil.copytree(killed / RUNS / "SafeDrive-v0_3", folder)
    monkeypatch.chdir(tmp_path)
    newest, older = checkpoints(folder / "checkpoints")
    (newest / "replay_buffer.pkl").write_bytes(b"damaged.")
    (folder / "checkpoints" / "99999").mkdir()
    command, model = find_training(RUNS / "SafeDrive-v0_3")
    assert command == TRAIN and model == RUNS / "SafeDrive-v0_3" / "checkpoints" / older.name / "SafeDrive-v0.zip"
    (line,) = capsys.readouterr().err.splitlines()
    assert f"which costs {int(newest.name) - int(older.name)} steps" in line and "is damaged" in line


def test_more_steps_with_other_environments_and_normalization(tmp_path, monkeypatch, capsys):
    """The checkpoint works with the stock command too, for algorithms with SB3's replay buffer as well."""
    monkeypatch.chdir(tmp_path)
    command = ["--algo", "dsac", "--env", "Pendulum-v1", "--eval-freq", "-1", "--save-freq", "50", "--seed", "1"]
    params = ["-params", "n_envs:2", "normalize:True", "learning_starts:20", "policy_kwargs:dict(net_arch=[8])"]
    zoo_train(monkeypatch, *command, "-n", "120", *params)
    checkpoint = Path("logs/dsac/Pendulum-v1_1/checkpoints/120")
    assert (checkpoint / "Pendulum-v1" / "vecnormalize.pkl").is_file()
    zoo_train(monkeypatch, *command, "-n", "200", *params, "-i", str(checkpoint / "Pendulum-v1.zip"))
    assert "Loading saved VecNormalize stats" in capsys.readouterr().out
    checkpoint = Path("logs/dsac/Pendulum-v1_2/checkpoints/200")
    assert steps(checkpoint / "Pendulum-v1.zip") == (200, 200)
    assert load_from_pkl(checkpoint / "replay_buffer.pkl").pos == 100  # rows of two environments


@pytest.mark.parametrize(
    ("algo", "params"),
    [
        ("sac", ["learning_starts:50", "buffer_size:1000", "policy_kwargs:dict(net_arch=[8])"]),
        ("ppo", ["n_envs:1", "n_steps:50", "batch_size:50", "policy_kwargs:dict(net_arch=[8])"]),
    ],
)
def test_algorithms_of_sb3_in_our_environments_go_on_with_their_safety_cost(tmp_path, monkeypatch, algo, params):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(SafeDriveEnv, "step", with_cost(SafeDriveEnv.step))
    command = ["--algo", algo, "--env", "SafeDrive-v0", "--eval-freq", "-1", "--save-freq", "100", "--seed", "1"]
    zoo_train(monkeypatch, *command, "-n", "100", "-params", *params)
    checkpoint = Path("logs", algo, "SafeDrive-v0_1", "checkpoints", "100", "SafeDrive-v0.zip")
    zoo_train(monkeypatch, *command, "-n", "250", "-params", *params, "-i", str(checkpoint))
    for number, first, end in [(1, 1, 100), (2, 100, 250)]:  # before the first step nothing has been measured
        costs = read_progress(Path("logs", algo, f"SafeDrive-v0_{number}", "progress.csv"))["safety/safety_cost"]
        assert first <= costs[0, 0] <= 100 and costs[-1, 0] == end
        assert costs[:, 1].tolist() == (0.5 * costs[:, 0]).tolist()


def with_cost(step):
    """Each step costs .5, so that the sum says how many were counted."""

    def costly(self, action):
        *rest, info = step(self, action)
        return *rest, info | {"cost": 0.5}

    return costly


@pytest.mark.parametrize("options", [["--save-freq", "0"], ["-optimize"]])
def test_no_checkpoints(tmp_path, monkeypatch, options):
    monkeypatch.chdir(tmp_path)
    search = ["--n-trials", "1", "--n-evaluations", "1", "--no-optim-plots"]
    quick = ["-n", "60", "--eval-freq", "-1", "--eval-episodes", "1", "-params", "learning_starts:20"]
    zoo_train(monkeypatch, "--algo", "dsac", "--env", "Pendulum-v1", *search, *options, *quick)
    assert not list(tmp_path.rglob("checkpoints"))


def test_a_full_disk_does_not_stop_the_training(tmp_path, monkeypatch):
    model = DPVP("MlpPolicy", "Pendulum-v1", buffer_size=100, policy_kwargs={"net_arch": [8]})
    save, attempts = DPVP.save_replay_buffer, []

    def fail_later(self, path):
        attempts.append(self.num_timesteps)
        if len(attempts) in (2, 3):
            raise OSError(28, "No space left on device")
        save(self, path)

    monkeypatch.setattr(DPVP, "save_replay_buffer", fail_later)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(45, callback=ResumableCheckpoint(10, tmp_path, "Pendulum-v1"))
    messages = [str(warning.message) for warning in caught if "No checkpoint" in str(warning.message)]
    assert attempts == [10, 20, 30, 40, 45] and len(messages) == 2
    assert "at step 20" in messages[0] and "No space left on device" in messages[0]
    assert f"{tmp_path / 'checkpoints' / '10'} is there to resume from" in messages[0]
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"45", "40"}


def test_a_training_that_a_callback_stops_writes_no_half_step(tmp_path):
    model = DSAC("MlpPolicy", "Pendulum-v1", buffer_size=100, policy_kwargs={"net_arch": [8]})
    checkpoints = ResumableCheckpoint(10, tmp_path, "Pendulum-v1")
    stop = ConvertCallback(lambda local_variables, _: local_variables["self"].num_timesteps < 20)
    model.learn(20, callback=[checkpoints, stop])
    assert newest_checkpoint(tmp_path / "checkpoints").name == "10"  # type: ignore[union-attr]


def test_zeros_take_no_space(tmp_path):
    values = np.zeros((3, 100_000))
    values[1, 5] = 1.0
    with SparseWriter((tmp_path / "sparse").open("wb", buffering=0)) as file:
        file.write(values)
        file.write(b"end")
    assert (tmp_path / "sparse").read_bytes() == values.tobytes() + b"end"
    model = DSAC("MlpPolicy", "Pendulum-v1", buffer_size=100_000, policy_kwargs={"net_arch": [8]})
    model.learn(20)
    with SparseWriter((tmp_path / "buffer").open("wb", buffering=0)) as file:
        model.save_replay_buffer(file)
    loaded = load_from_pkl(tmp_path / "buffer")
    assert loaded.pos == 20
    for name in ("observations", "next_observations", "actions", "rewards"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(model.replay_buffer, name))
    assert (tmp_path / "buffer").stat().st_blocks * 512 < 0.2 * (tmp_path / "buffer").stat().st_size


def test_paths_of_checkpoints():
    assert checkpoint_step("logs/chac/SafeDrive-v0_1/checkpoints/300/SafeDrive-v0.zip") == 300
    for other in ("", "logs/chac/SafeDrive-v0_1/SafeDrive-v0.zip", "checkpoints/300.tmp/model.zip", "runs/300/model.zip"):
        assert checkpoint_step(other) is None
