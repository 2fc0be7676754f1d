"""Demonstrations: recorded, stored in Minari's format, loaded, described and driven again."""

import json
import multiprocessing
import os
import shutil
import signal
import sys
import types
import warnings
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import h5py
import imageio.v3 as imageio
import minari
import numpy as np
import pytest
import toy_env
from gymnasium import spaces
from shell import run
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecTransposeImage
from torch.utils import _pytree

from sb3_chac.cli.demos import main as command
from sb3_chac.common.demonstrations import Demonstrations, load_demonstrations
from sb3_chac.common.minari_datasets import DatasetError
from sb3_chac.datasets.recording import WatchedEnv, record
from sb3_chac.human import InterventionWrapper, TakeoverRule

TOY = "toy_env:ToyDrive-v0"
OBSERVATIONS, ACTIONS = toy_env.ToyDrive().observation_space, toy_env.ToyDrive().action_space
ARRAYS = ("observations", "actions", "next_observations", "rewards", "terminations", "truncations", "episodes")
OPTIONAL = ("takeovers", "novice_actions", "costs", "successes")
LAUNCHER = "import sys; from sb3_chac.cli.demos import main; main(sys.argv[1:])"


@pytest.fixture(autouse=True)
def datasets(tmp_path, monkeypatch) -> Path:
    """Where Minari keeps its datasets."""
    folder = tmp_path / "datasets"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    return folder


class Log(gym.Wrapper):
    """Writes down what happens, independently of what is tested."""

    def __init__(self, env):
        super().__init__(env)
        self.rows, self.resets = [], []

    def reset(self, **kwargs):
        self.observation, info = self.env.reset(**kwargs)
        self.resets.append(kwargs)
        return self.observation, info

    def step(self, action):
        before = self.observation
        self.observation, reward, terminated, truncated, info = self.env.step(action)
        self.rows.append((before, action, self.observation, reward, terminated, truncated, len(self.resets) - 1, info))
        return self.observation, reward, terminated, truncated, info


def crawl(observation) -> np.ndarray:
    """A novice that drives at 0.3 m/step."""
    return np.array([0.3], np.float32)


class EveryOther(TakeoverRule):
    """Takes over on every other step."""

    def __call__(self, observation, novice_action, expert_action, human_driving):
        return not human_driving


def same(one: Demonstrations, two: Demonstrations) -> None:
    for name in (*ARRAYS, *OPTIONAL):
        ours, theirs = getattr(one, name), getattr(two, name)
        if ours is None or theirs is None:
            assert ours is theirs is None, name
        else:
            np.testing.assert_array_equal(ours, theirs, strict=True)


def fails(capsys, *arguments: str | Path) -> str:
    with pytest.raises(SystemExit) as error:
        command([str(argument) for argument in arguments])
    assert error.value.code == 2
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err and not printed.out
    return printed.err


def damage(folder: Path, change) -> None:
    with h5py.File(folder / "data" / "main_data.hdf5", "r+") as file:
        change(file)


def test_round_trip_with_takeovers(datasets):
    logs = []

    def make() -> gym.Env:
        logs.append(Log(toy_env.ToyDrive()))
        return InterventionWrapper(logs[-1], "scripted", EveryOther(), armed=True)

    folder = record("toy/takeovers-v0", crawl, make, 25, scenarios="3:5", seed=7)
    assert folder == datasets / "toy" / "takeovers-v0"
    loaded = load_demonstrations("toy/takeovers-v0", OBSERVATIONS, ACTIONS)
    (log,) = logs
    columns = list(zip(*log.rows, strict=True))
    for name, column in zip(ARRAYS, columns[:-1], strict=True):
        dtype = {"rewards": np.float64, "episodes": np.int64}.get(name)
        np.testing.assert_array_equal(getattr(loaded, name), np.array(column, dtype), strict=True)
    assert 25 <= len(loaded) == len(log.rows) <= 34 and loaded.observations.dtype == np.float32
    # Every other step from the second on is the novice's; the first one is the expert's
    human = np.concatenate([np.arange(n) % 2 == 0 for n in np.bincount(loaded.episodes)])
    np.testing.assert_array_equal(loaded.takeovers, human, strict=True)
    np.testing.assert_array_equal(loaded.novice_actions, np.full((len(loaded), 1), 0.3, np.float32), strict=True)
    np.testing.assert_array_equal(loaded.actions[:, 0], np.where(human, 1.0, 0.3).astype(np.float32))
    np.testing.assert_array_equal(loaded.costs, [info["cost"] for info in columns[-1]])
    np.testing.assert_array_equal(loaded.successes, [info["is_success"] for info in columns[-1]])
    assert loaded.successes.sum() == loaded.terminations.sum() > 0 and loaded.costs.sum() > 0
    # Minari knows seed and scenario of each episode
    dataset = minari.load_dataset("toy/takeovers-v0")
    metadata = list(dataset.storage.get_episode_metadata(range(dataset.total_episodes)))
    assert [entry["options"]["scenario"] for entry in metadata] == [3, 4, 3, 4][: len(metadata)]
    assert [{"seed": entry["seed"], "options": entry["options"]} for entry in metadata] == log.resets[: len(metadata)]
    assert len({entry["seed"] for entry in metadata}) == len(metadata) > 2


def test_expert_alone_and_a_folder_in_place_of_an_id(tmp_path, datasets):
    folder = record(tmp_path / "elsewhere" / "toy-v1", "scripted", TOY, 8)
    loaded = load_demonstrations(folder)
    assert loaded.takeovers.all() and loaded.novice_actions is None and (loaded.actions == 1).all()
    same(loaded, load_demonstrations(folder / "data"))
    same(loaded, load_demonstrations(loaded, OBSERVATIONS, ACTIONS))
    assert not datasets.exists() or not list(datasets.iterdir())


@pytest.mark.parametrize(
    "folder, dataset_id",
    [("./ds", "ds-v0"), ("./two words.2", "two-words-2-v0"), ("./ds-v3", "ds-v3"), ("./_", "dataset-v0"), ("./a/b", "b-v0")],
)
def test_any_folder_can_be_named(folder, dataset_id, tmp_path, datasets, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    named = ["--dataset", folder]
    command(["record", "--expert", "scripted", "--env", TOY, "--steps", "5", "--jobs", "1", *named])
    assert f"{dataset_id}: " in capsys.readouterr().out and (tmp_path / folder / "data").is_dir()
    command(["info", *named])
    assert f"{dataset_id}: " in capsys.readouterr().out
    assert load_demonstrations(folder).actions.all() and not datasets.exists()


def test_the_dataset_does_not_depend_on_the_number_of_processes(tmp_path):
    model = SAC("MlpPolicy", TOY, buffer_size=10, seed=0)
    folders = [record(tmp_path / f"jobs{jobs}-v0", model, TOY, 45, seed=3, jobs=jobs) for jobs in (1, 2)]
    one, two = map(load_demonstrations, folders)
    same(one, two)
    assert len(one) >= 45 > len(one) - 10  # whole episodes of at most 10 steps
    other = load_demonstrations(record(tmp_path / "seed-v0", model, TOY, 45, seed=4))
    specs = [list(minari.MinariDataset(folder / "data").storage.get_episode_metadata([0])) for folder in folders]
    assert specs[0] == specs[1] and len(other) >= 45


def test_discrete_actions(tmp_path):
    folder = record(tmp_path / "blind-v0", lambda observation: 1, "toy_env:BlindDrive-v0", 3)
    loaded = load_demonstrations(folder, toy_env.BlindDrive.observation_space, toy_env.BlindDrive.action_space)
    assert loaded.actions.tolist() == [1, 1, 1] and loaded.rewards.tolist() == [2.0] * 3 and loaded.costs is None


def test_images_are_stored_as_they_were_and_transposed_for_the_model(tmp_path):
    class Camera(toy_env.BlindDrive):
        observation_space = spaces.Box(0, 255, (36, 40, 3), np.uint8)

        def reset(self, **kwargs):
            super().reset(**kwargs)
            return self.np_random.integers(0, 255, (36, 40, 3), np.uint8), {}

        def step(self, action):
            return np.zeros((36, 40, 3), np.uint8), 0.0, True, False, {}

    folder = record(tmp_path / "camera-v0", lambda observation: 0, Camera, 1, seed=0)
    raw = load_demonstrations(folder, Camera.observation_space)
    seed = int(np.random.SeedSequence([0, 0]).generate_state(1)[0])
    np.testing.assert_array_equal(raw.observations[0], Camera().reset(seed=seed)[0])
    seen_by_models = VecTransposeImage(DummyVecEnv([Camera])).observation_space
    transposed = load_demonstrations(folder, seen_by_models)
    np.testing.assert_array_equal(transposed.observations, raw.observations.transpose(0, 3, 1, 2))


def test_dataset_of_minaris_own_collector(monkeypatch, capsys):
    # It takes jax for one function, which torch has as well
    module = types.ModuleType("jax.tree_util")
    module.tree_map = _pytree.tree_map  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "jax", types.ModuleType("jax"))
    monkeypatch.setitem(sys.modules, "jax.tree_util", module)
    monkeypatch.setattr(sys.modules["jax"], "tree_util", module, raising=False)
    env = minari.DataCollector(gym.make("Pendulum-v1", max_episode_steps=15))
    rows = []
    for seed in range(2):
        observation, _ = env.reset(seed=seed)
        done = False
        while not done:
            action = env.action_space.sample()
            following, reward, terminated, truncated, _ = env.step(action)
            rows.append((observation, action, following, reward, terminated, truncated, seed))
            observation, done = following, terminated or truncated
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no author, no e-mail address
        env.create_dataset("pendulum/random-v0")
    loaded = load_demonstrations("pendulum/random-v0", env.observation_space, env.action_space)
    for name, column in zip(ARRAYS, zip(*rows, strict=True), strict=True):
        np.testing.assert_array_equal(getattr(loaded, name), np.array(column))
    command(["info", "--dataset", "pendulum/random-v0"])
    assert "2 episodes, 30 steps" in (output := capsys.readouterr().out) and "policy            not known" in output
    assert loaded.truncations.sum() == 2 and not loaded.terminations.any()
    assert all(getattr(loaded, name) is None for name in OPTIONAL)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("recorded") / "toy-v0", "scripted", TOY, 8)


def box(low, high, shape=(2,), dtype=np.float32) -> spaces.Box:
    return spaces.Box(low, high, shape, dtype)


@pytest.mark.parametrize(
    "expected, message",
    [
        ({"observation_space": box(-10, 10, (3,))}, r"observation space differs in shape: \(2,\) instead of \(3,\)"),
        ({"observation_space": box(-10, 10, dtype=np.float64)}, "dtype: float32 instead of float64"),
        ({"observation_space": box(-10, np.array([10, 5], np.float32))}, r"bounds: high\[1\] is 10 instead of 5"),
        ({"action_space": box(-2, 1, (1,))}, r"action space differs in bounds: low\[0\] is -1 instead of -2"),
        ({"action_space": spaces.Discrete(2)}, r"its kind: Box.* instead of Discrete"),
    ],
)
def test_spaces_that_differ(recorded, expected, message):
    with pytest.raises(DatasetError, match=rf"does not fit the environment.*{message}.*Use the environment"):
        load_demonstrations(recorded, **expected)


def delete_rewards(file):
    del file["episode_0"]["rewards"]


def drop_an_observation(file):
    values = file["episode_0"]["observations"]
    values.resize((len(values) - 1, 2))


def spoil(key, value):
    def change(file):
        file["episode_1"][key][0] = value

    return change


@pytest.mark.parametrize(
    "change, message",
    [
        (delete_rewards, "cannot be used, it is damaged.*rewards"),
        (drop_an_observation, "episode 0 has 4 rewards, but 4 observations, 4 actions"),
        (spoil("observations", np.nan), "observations are NaN or infinite at step 4"),
        (spoil("rewards", np.inf), "rewards are NaN or infinite at step 4"),
        (spoil("actions", 1.5), r"action of step 4 is out of bounds, \[1.5\] is not in .*clip"),
    ],
)
def test_damaged_data(recorded, tmp_path, change, message):
    folder = tmp_path / "toy-v0"
    shutil.copytree(recorded, folder)
    damage(folder, change)
    with pytest.raises(DatasetError, match=message):
        load_demonstrations(folder)


@pytest.mark.parametrize(
    "file, content, message",
    [
        ("main_data.hdf5", b"", "damaged"),
        ("main_data.hdf5", None, "No data found"),
        ("metadata.json", b"{", "damaged"),
        ("metadata.json", None, "No data found"),
    ],
)
def test_damaged_files(recorded, tmp_path, file, content, message):
    folder = tmp_path / "toy-v0"
    shutil.copytree(recorded, folder)
    path = folder / "data" / file
    path.unlink()
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DatasetError, match=message):
        load_demonstrations(folder)


def test_truncated_file(recorded, tmp_path):
    folder = tmp_path / "toy-v0"
    shutil.copytree(recorded, folder)
    os.truncate(folder / "data" / "main_data.hdf5", 5000)
    with pytest.raises(DatasetError, match=r"damaged or not Minari's.*Restore it from a copy"):
        load_demonstrations(folder)


def test_empty_missing_and_nonsense(recorded, tmp_path):
    with pytest.raises(DatasetError, match=r"no dataset 'toy/nothing-v0'.*demos record.*minari download"):
        load_demonstrations("toy/nothing-v0")
    with pytest.raises(DatasetError, match=r"no dataset '.*nowhere'"):
        load_demonstrations(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match="must be the id or folder"):
        load_demonstrations(3)  # type: ignore[arg-type]
    folder = tmp_path / "toy-v0"
    shutil.copytree(recorded, folder)
    metadata = json.loads((folder / "data" / "metadata.json").read_text())
    (folder / "data" / "metadata.json").write_text(json.dumps({**metadata, "total_episodes": 0, "total_steps": 0}))
    with pytest.raises(DatasetError, match="holds no steps"):
        load_demonstrations(folder)
    loaded = load_demonstrations(recorded)
    with pytest.raises(DatasetError, match=r"the demonstrations.*costs have shape \(3,\) instead of"):
        load_demonstrations(replace(loaded, costs=np.zeros(3)))


def test_dict_observations_are_refused(tmp_path):
    class Both(toy_env.BlindDrive):
        observation_space = spaces.Dict({"speed": box(-1, 1)})

    with pytest.raises(DatasetError, match=r"need Box observations.*FlattenObservation"):
        record(tmp_path / "both-v0", lambda observation: 0, Both, 1)
    assert not list(tmp_path.iterdir())


def test_names_that_are_taken_or_not_possible(datasets):
    record("toy/one-v0", "scripted", TOY, 1)
    before = load_demonstrations("toy/one-v0")
    with pytest.raises(DatasetError, match=r"exists already. Choose another name, or replace it with --overwrite"):
        record("toy/one-v0", "lazy", TOY, 30)
    same(before, load_demonstrations("toy/one-v0"))
    record("toy/one-v0", "lazy", TOY, 30, overwrite=True)
    assert len(load_demonstrations("toy/one-v0")) >= 30
    for name in ("toy/one", "toy one-v0"):
        with pytest.raises(DatasetError, match="must look like safedrive/scripted-v0"):
            record(name, "scripted", TOY, 1)
    (datasets / "taken-v0").mkdir()
    with pytest.raises(DatasetError, match=r"is not a dataset\. Choose another name"):
        record("taken-v0", "scripted", TOY, 1, overwrite=True)
    assert sorted(path.name for path in datasets.iterdir()) == ["taken-v0", "toy"]
    assert "toy/one-v0" in minari.list_local_datasets()


def test_an_environment_that_fails_leaves_nothing(datasets):
    class Fails(toy_env.ToyDrive):
        def step(self, action):
            if self.n_steps == 2 and self.scenario == 5:
                raise RuntimeError("a wheel came off")
            return super().step(action)

    with pytest.raises(RuntimeError, match="a wheel came off"):
        record("toy/fails-v0", "scripted", Fails, 30, scenarios="3:6")
    with pytest.raises(ValueError, match=r"episode 0 of .* has NaN or infinite values: mend the environment"):
        record("toy/nan-v0", "scripted", TOY, 30, env_kwargs={"reward": float("nan")})
    with pytest.raises(ValueError, match="policy must return finite numbers"):
        record("toy/complex-v0", lambda observation: np.array([0.5j]), TOY, 30)
    assert not datasets.exists()


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted(datasets, capsys, monkeypatch, number, code):
    """Ctrl-C, or kill, in the middle of the third episode."""

    def reset(self, **kwargs):
        seeds.append(kwargs["seed"])
        return original(self, **kwargs)

    def step(self, action):
        if len(seeds) == 3:
            assert len(list(datasets.parent.glob(".recording-*/new/data/main_data.hdf5"))) == 1
            os.kill(os.getpid(), number)
        return original_step(self, action)

    seeds: list[int] = []
    original, original_step = toy_env.ToyDrive.reset, toy_env.ToyDrive.step
    monkeypatch.setattr(toy_env.ToyDrive, "reset", reset)
    monkeypatch.setattr(toy_env.ToyDrive, "step", step)
    ours = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(SystemExit) as exit_code:
        command(["record", "--expert", "scripted", "--env", TOY, "--dataset", "toy/half-v0", "--jobs", "1"])
    assert exit_code.value.code == code and len(seeds) == 3
    assert not datasets.exists() and not list(datasets.parent.glob(".recording-*"))
    assert handlers == [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    signal.signal(signal.SIGINT, ours)


def test_commands(datasets, tmp_path):
    """As a user types them, on SafeDrive, with two processes."""
    env = {"MINARI_DATASETS_PATH": str(datasets)}
    launch = [sys.executable, "-c", LAUNCHER]
    options = ["--env-kwargs", "horizon:15", "blocks:1", "--scenarios", "100:102", "--seed", "5", "--jobs", "2"]
    dataset = ["--dataset", "safedrive/scripted-v0"]
    output = run(*launch, "record", "--expert", "scripted", "--steps", "40", *dataset, *options, cwd=tmp_path, env=env)
    assert "safedrive/scripted-v0: 3 episodes, 45 steps" in output and "40/40" in output
    assert f"Saved {datasets / 'safedrive' / 'scripted-v0'}" in output
    output = run(*launch, "replay", *dataset, "--episode", "1", "--video", "drive.mp4", cwd=tmp_path, env=env)
    assert "recorded 15 steps" in output and "the returns differ by 0, the observations by 0 at most" in output
    assert imageio.imread(tmp_path / "drive.mp4").shape == (16, 600, 800, 3)


def test_info(capsys):
    record("toy/info-v0", "lazy", TOY, 24, scenarios="3:6", env_kwargs={"reward": 2.0})
    command(["info", "--dataset", "toy/info-v0"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("toy/info-v0: 5 episodes, 28 steps, 0.")
    # 4, 5, 10, 4 and 5 steps of reward 2; only the lazy driver's third one fails
    assert lines[1:5] == [
        f"  return            {np.mean([8, 10, 20, 8, 10]):.3f} ± {np.std([8, 10, 20, 8, 10]):.3f}",
        "  safety cost       1.000 ± 0.000",
        "  success rate      0.800",
        "  takeover share    1.000",
    ]
    text = "\n".join(lines)
    assert "Box(-10, 10, (2,), float32)" in text and "Box(-1, 1, (1,), float32)" in text
    assert "seed 0, scenarios 3:6" in text and f"minari {minari.__version__}" in text and "sb3_chac 0." in text


def test_novice_and_expert_from_the_command_line(tmp_path, capsys):
    SAC("MlpPolicy", TOY, buffer_size=10, seed=0).save(tmp_path / "novice.zip")
    few = ["--steps", "5"]
    who = ["--expert", "scripted", "--novice", str(tmp_path / "novice.zip"), "--rule", "always"]
    command(["record", *who, "--env", TOY, "--dataset", "toy/watched-v0", "--jobs", "1", *few])
    assert "takeover share    1.000" in capsys.readouterr().out
    loaded = load_demonstrations("toy/watched-v0")
    assert (loaded.actions == 1).all() and (loaded.novice_actions != 1).all()
    command(
        ["record", "--expert", str(tmp_path / "novice.zip"), "--env", TOY, "--dataset", "toy/model-v0", "--jobs", "1", *few]
    )
    assert "policy            SAC" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["record", "--expert", "mad", "--dataset", "toy/x-v0"], "expert 'mad' is not available"),
        (["record", "--expert", "nothing.zip", "--dataset", "toy/x-v0"], "no model nothing.zip"),
        (["record", "--expert", "scripted", "--dataset", "toy/x"], "must look like safedrive/scripted-v0"),
        (["record", "--expert", "scripted", "--dataset", "toy/x-v0", "--steps", "0"], "--steps must be at least 1"),
        (["record", "--expert", "scripted", "--dataset", "toy/x-v0", "--jobs", "0"], "--jobs must be at least 1"),
        (["record", "--expert", "scripted", "--dataset", "toy/x-v0", "--scenarios", "5:3"], "range is empty"),
        (["record", "--expert", "scripted", "--dataset", "toy/x-v0", "--env-kwargs", "wings:2"], "cannot be made"),
        (["record", "--expert", "scripted", "--dataset", "toy/there-v0"], "exists already"),
        (["info", "--dataset", "toy/x-v0"], "There is no dataset 'toy/x-v0'"),
        (["replay", "--dataset", "toy/x-v0"], "There is no dataset 'toy/x-v0'"),
        (["replay", "--dataset", "toy/there-v0", "--episode", "9"], "there is no episode 9, they are 0 to 1"),
        (["replay", "--dataset", "toy/there-v0"], "does not say how its environment is made"),
        (["replay", "--dataset", "toy/there-v0", "--video", "x.png"], "must end with .mp4 or .gif"),
    ],
)
def test_errors_of_the_commands(arguments, message, recorded, datasets, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(recorded, datasets / "toy" / "there-v0")
    options = ["--env", TOY] if arguments[0] == "record" else []
    assert message in fails(capsys, *arguments, *options)
    assert {path.name for path in (datasets / "toy").iterdir()} == {"there-v0"}
    assert not multiprocessing.active_children()


def test_takeovers_are_driven_again_without_who_took_over(capsys):
    env = WatchedEnv("SafeDrive-v0", "scripted-ideal", "risk")
    full_speed = lambda observation: np.array([0.3, 1.0], np.float32)  # noqa: E731
    record("safedrive/watched-v0", full_speed, env, 50, env_kwargs={"horizon": 50, "blocks": 1})
    assert 0 < load_demonstrations("safedrive/watched-v0").takeovers.mean() < 1
    command(["replay", "--dataset", "safedrive/watched-v0"])
    assert "the returns differ by 0, the observations by 0 at most" in capsys.readouterr().out


def test_replay_says_how_far_it_led_elsewhere(capsys, tmp_path):
    still = lambda observation: np.zeros(1, np.float32)  # noqa: E731
    folder = record("pendulum/still-v0", still, "Pendulum-v1", 1)
    damage(folder, lambda file: file["episode_0"]["actions"].write_direct(np.full((200, 1), 0.5, np.float32)))
    command(["replay", "--dataset", "pendulum/still-v0"])
    output = capsys.readouterr().out
    assert "recorded 200 steps" in output and "the returns differ by 0," not in output
    assert "the first difference is after step 1" in output


def test_a_rule_without_a_novice_is_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        command(["record", "--expert", "scripted", "--dataset", "toys/rule-v0", "--steps", "5", "--rule", "never"])
    assert ended.value.code == 2 and "--rule never: " in capsys.readouterr().err


@pytest.mark.parametrize(
    "harm",
    [
        lambda file: file["episode_0"]["actions"].write_direct(np.full((200, 1), np.nan, np.float32)),
        lambda file: file["episode_0"].pop("actions"),
        lambda file: file["episode_0"].pop("observations"),
        lambda file: file["episode_0"].attrs.__setitem__("seed", -5),
        lambda file: file["episode_0"].attrs.__setitem__("seed", "x"),
    ],
    ids=["NaN", "no actions", "no observations", "negative seed", "seed of text"],
)
def test_replay_of_damaged_data_ends_with_one_line(capsys, tmp_path, harm):
    still = lambda observation: np.zeros(1, np.float32)  # noqa: E731
    damage(record("pendulum/still-v0", still, "Pendulum-v1", 1), harm)
    with pytest.raises(SystemExit) as ended:
        command(["replay", "--dataset", "pendulum/still-v0"])
    error = capsys.readouterr().err.strip()
    assert ended.value.code == 2 and "pendulum/still-v0" in error and "\n" not in error


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
@pytest.mark.parametrize("named", [2, 10**9, 10**30, "many"])
def test_episodes_that_are_named_and_not_there(capsys, data_format, named):
    still = lambda observation: np.zeros(1, np.float32)  # noqa: E731
    folder = record("pendulum/still-v0", still, "Pendulum-v1", 1) / "data"
    metadata = json.loads((folder / "metadata.json").read_text())
    if data_format == "arrow":
        (folder / "main_data.hdf5").unlink()
        (folder / "0").mkdir()
    (folder / "metadata.json").write_text(json.dumps(metadata | {"total_episodes": named, "data_format": data_format}))
    for arguments in (["info"], ["replay"]):
        with pytest.raises(SystemExit) as ended:
            command([*arguments, "--dataset", "pendulum/still-v0"])
        error = capsys.readouterr().err
        assert ended.value.code == 2 and error.count("\n") == 1 and "it is damaged" in error
        assert isinstance(named, str) or f"metadata.json names {named} episodes, but 1 are there" in error
