"""``sb3-chac evaluate`` and ``sb3_chac.evaluation.evaluate``, on the environments of toy_env.py."""

import csv
import json
import os
import pickle
import sys
from pathlib import Path

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest
import toy_env
from eleven import Walk, make_any
from rl_zoo3 import utils
from sb3_contrib import TQC, RecurrentPPO
from shell import run
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.sac.policies import SACPolicy

from sb3_chac import DSAC
from sb3_chac.cli.demos import main as demos
from sb3_chac.cli.evaluate import main as command
from sb3_chac.common.demonstrations import load_demonstrations
from sb3_chac.evaluation.episodes import NotEvaluable
from sb3_chac.evaluation.evaluation import evaluate, scenario_list
from sb3_chac.evaluation.models import find_algorithm
from sb3_chac.zoo.algorithms import ALGORITHMS

TOY = "toy_env:ToyDrive-v0"
QUICK = {"learning_starts": 10, "buffer_size": 100, "seed": 0}


def full_throttle(observation) -> np.ndarray:
    return np.ones(1, dtype=np.float32)


@pytest.fixture(scope="module")
def sac() -> SAC:
    return SAC("MlpPolicy", TOY, **QUICK).learn(12)


@pytest.fixture
def model(sac, tmp_path) -> Path:
    path = tmp_path / "model.zip"
    sac.save(path)
    return path


def fails(capsys, *arguments: str | Path) -> str:
    """
    :return: the message of a command that must fail before any episode runs
    """
    with pytest.raises(SystemExit) as error:
        command([str(argument) for argument in arguments])
    assert error.value.code == 2
    printed = capsys.readouterr()
    assert "mean" not in printed.out and "Traceback" not in printed.err
    return printed.err


def launch(folder: Path, *arguments: str | Path) -> str:
    python_path = {"PYTHONPATH": str(Path(__file__).parent)}
    return run(sys.executable, "-m", "sb3_chac", "evaluate", *arguments, cwd=folder, env=python_path)


def test_expert_from_the_command_line(tmp_path):
    files = ["--json", "result.json", "--plot", "paths.png", "--video", "drive.mp4", "--video-scenario", "4"]
    files += ["--steps", "steps.csv"]
    options = ["--scenarios", "3,4:6", "--env-kwargs", "reward:2.0", "--jobs", "2", "--seed", "5"]
    output = launch(tmp_path, "--expert", "lazy", "--env", TOY, *options, *files)
    assert "success rate          0.667 ± 0.471" in output and "Saved drive.mp4" in output and "3/3" in output

    result = json.loads((tmp_path / "result.json").read_text())
    records = result.pop("records")
    with (tmp_path / "steps.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["scenario", "step", "x", "y", "action_0", "cost"]
    assert [int(row["scenario"]) for row in rows] == [r["scenario"] for r in records for _ in range(r["steps"])]
    assert [row["step"] for row in rows[:3]] == ["0", "1", "2"]
    versions = result.pop("versions")
    assert set(versions) == {"sb3_chac", "stable_baselines3", "torch", "gymnasium"} and all(versions.values())
    assert result == {
        "episodes": 3,
        "return_mean": pytest.approx(38 / 3),  # 4, 5 and 10 steps of reward 2: the lazy driver stops at 5 m of 6
        "return_std": pytest.approx(np.std([8, 10, 20])),
        "cost_mean": 1.0,
        "cost_std": 0.0,
        "success_rate": pytest.approx(2 / 3),
        "success_rate_std": pytest.approx(np.std([1, 1, 0])),
        "route_completion_mean": pytest.approx((1 + 1 + 5 / 6) / 3),
        "route_completion_std": pytest.approx(np.std([1, 1, 5 / 6])),
        "steps_mean": pytest.approx(19 / 3),
        "steps_std": pytest.approx(np.std([4, 5, 10])),
        "policy": "lazy",
        "expert": "lazy",
        "env": TOY,
        "env_kwargs": {"reward": 2.0},
        "normalized": False,
        "scenarios": [3, 4, 5],
        "seed": 5,
    }
    seed = int(np.random.SeedSequence([5, 5]).generate_state(1)[0])
    noise = gym.utils.seeding.np_random(seed)[0].random(10)[-1]
    assert records[2] == {
        "scenario": 5,
        "seed": seed,
        "return": 20.0,
        "steps": 10,
        "cost": 1.0,
        "success": False,
        "route_completion": pytest.approx(5 / 6),
        "terminated": False,
        "truncated": True,
        "collisions": 1,
        "noise": noise,
    }
    assert imageio.improps(tmp_path / "paths.png").shape[0] > 400 and np.ptp(imageio.imread(tmp_path / "paths.png")) == 255
    frames = imageio.imread(tmp_path / "drive.mp4")
    assert frames.shape == (6, 32, 64, 3)  # scenario 4: after the reset and each of 5 steps
    assert frames[0].mean() > frames[-1].mean() + 20


def test_model_from_the_command_line(model, sac, tmp_path):
    output = launch(tmp_path, model, "--env", TOY, "--scenarios", "0:2", "--jobs", "1", "--json", "result.json")
    assert "model.zip: SAC" in output and "SAC on toy_env:ToyDrive-v0, 2 episodes" in output
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["model"] == str(model) and result["algo"] == "sac" and "expert" not in result
    assert result["records"] == evaluate(sac, TOY, "0:2").records


def test_results_do_not_depend_on_processes_or_order(sac):
    one = evaluate(sac, TOY, range(4), record_paths=True)
    two = evaluate(sac, TOY, range(4), record_paths=True, jobs=2)
    assert one.records == two.records and one.summary() == two.summary() and one.to_json() == two.to_json()
    assert all(np.array_equal(a.positions, b.positions) for a, b in zip(one.paths, two.paths, strict=True))
    assert evaluate(sac, TOY, [3, 1]).records == [one.records[3], one.records[1]]
    assert evaluate(sac, TOY, [3], seed=1).records[0]["noise"] != one.records[3]["noise"]


def test_functions_as_policy_and_as_environment(tmp_path):
    evaluation = evaluate(full_throttle, toy_env.ToyDrive, "0:3", env_kwargs={"length": 3}, record_paths=True, jobs=2)
    assert [record["steps"] for record in evaluation.records] == [3, 4, 5]
    assert evaluation.settings["policy"] == "full_throttle" and evaluation.settings["env"] == "ToyDrive"
    positions, costly, actions = evaluation.paths[0]
    assert actions.tolist() == [[1.0]] * 3
    np.testing.assert_allclose(positions, [[0, 0], [1, 0.1], [2, 0.2], [3, 0.3]])
    assert costly.tolist() == [False, False, True, False]
    assert evaluate(lambda _: np.zeros(1, np.float32), TOY, "0").summary()["success_rate"] == 0.0


def test_environment_without_scenarios(tmp_path):
    """Nothing in its info: only return and steps. Its discrete actions arrive as numbers."""
    model = DQN("MlpPolicy", "toy_env:BlindDrive-v0", buffer_size=10, seed=0)
    summary = evaluate(model, "toy_env:BlindDrive-v0", episodes=3).summary()
    assert set(summary) == {"episodes", "return_mean", "return_std", "steps_mean", "steps_std"}
    evaluation = evaluate(lambda observation: np.zeros(1, np.float32), "Pendulum-v1", episodes=2)
    assert [record["episode"] for record in evaluation.records] == [0, 1] and evaluation.settings["scenarios"] is None
    assert len({record["return"] for record in evaluation.records}) == 2
    assert "NaN" not in evaluation.to_json() and "cost" not in evaluation.table()


def test_recurrent_policy_remembers_within_an_episode_only():
    model = RecurrentPPO("MlpLstmPolicy", TOY, n_steps=8, policy_kwargs={"lstm_hidden_size": 4}, seed=0)
    env, state, actions = toy_env.ToyDrive(), None, []
    observation, _ = env.reset(options={"scenario": 1})
    for step in range(10):
        action, state = model.predict(observation, state, np.array([step == 0]), deterministic=True)
        actions.append(float(action[0]))
        observation = env.step(action)[0]
    path = evaluate(model, TOY, [0, 1], record_paths=True).paths[1]
    np.testing.assert_allclose(np.diff(path.positions[:, 0]), actions, atol=1e-6)


def test_observations_are_normalized_as_in_training(tmp_path, capsys, monkeypatch):
    env = VecNormalize(DummyVecEnv([toy_env.ToyDrive]))
    model = SAC("MlpPolicy", env, **QUICK).learn(20)
    env.obs_rms.mean[:] = 5.0
    folder = tmp_path / "sac" / "ToyDrive-v0_1"
    (folder / "ToyDrive-v0").mkdir(parents=True)
    model.save(folder / "best_model.zip")
    plain = evaluate(SAC.load(folder / "best_model.zip"), TOY, "0:2")
    expected = evaluate(model, TOY, "0:2")  # the statistics of its own env
    assert expected.settings["normalized"] and expected.records != plain.records

    with (folder / "ToyDrive-v0" / "vecnormalize.pkl").open("wb") as file:
        pickle.dump(env, file)
    options = ["--env", TOY, "--scenarios", "0:2", "--jobs", "1", "--json", str(tmp_path / "result.json")]
    command([str(folder / "best_model.zip"), *options])
    assert "observations normalized with" in capsys.readouterr().out
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["records"] == expected.records and result["normalized"]
    assert evaluate(model, TOY, "0:2", jobs=2).records == expected.records
    # At their defaults, the commands take as many processes as there are cores
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1}, raising=False)
    options = ["--env", TOY, "--scenarios", "0:2", "--json", str(tmp_path / "result.json")]
    command([str(folder / "best_model.zip"), *options])
    assert json.loads((tmp_path / "result.json").read_text())["records"] == expected.records
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    for name, jobs in (("default-v0", []), ("one-v0", ["--jobs", "1"])):
        demos(["record", "--expert", str(folder / "best_model.zip"), "--env", TOY, "--steps", "20", "--dataset", name, *jobs])
    assert np.array_equal(*(load_demonstrations(name).actions for name in ("default-v0", "one-v0")))


def test_more_scenarios_than_panels_and_a_gif(tmp_path, capsys):
    files = ["--plot", str(tmp_path / "paths.png"), "--video", str(tmp_path / "drive.gif")]
    command(["--expert", "scripted", "--env", TOY, "--scenarios", "0:14", "--jobs", "1", *files])
    assert imageio.imread(tmp_path / "paths.png").std() > 5
    assert imageio.imread(tmp_path / "drive.gif").shape == (5, 32, 64, 3)


@pytest.mark.parametrize(
    "algo, algorithm, arguments",
    [
        ("sac", SAC, QUICK),
        ("dsac", DSAC, QUICK),
        ("tqc", TQC, QUICK),
        ("ppo", PPO, {"n_steps": 8, "batch_size": 8}),
        ("a2c", A2C, {}),
        ("ppo_lstm", RecurrentPPO, {"n_steps": 8, "batch_size": 8, "policy_kwargs": {"lstm_hidden_size": 4}}),
    ],
)
def test_the_algorithm_is_read_from_the_file(algo, algorithm, arguments, tmp_path):
    policy = "MlpLstmPolicy" if algo == "ppo_lstm" else "MlpPolicy"
    algorithm(policy, TOY, **arguments).learn(12).save(tmp_path / "x.zip")
    assert find_algorithm(tmp_path / "x", None) == (tmp_path / "x.zip", algo, algorithm)


@pytest.mark.parametrize("algo, algorithm", [("td3", TD3), ("ddpg", DDPG)])
def test_td3_and_ddpg_are_told_apart_by_the_path(algo, algorithm, tmp_path, capsys):
    folder = tmp_path / algo / "ToyDrive-v0_1"
    model = algorithm("MlpPolicy", TOY, **QUICK)
    for path in [folder / "best_model.zip", tmp_path / f"{algo}-ToyDrive-v0.zip", tmp_path / "x.zip"]:
        model.save(path)
    assert (
        find_algorithm(folder / "best_model.zip", None)[1]
        == find_algorithm(tmp_path / f"{algo}-ToyDrive-v0.zip", None)[1]
        == algo
    )
    assert "ddpg, td3: name its algorithm with --algo" in fails(capsys, tmp_path / "x.zip", "--env", TOY)
    assert find_algorithm(tmp_path / "x.zip", algo)[2] is algorithm


@pytest.mark.parametrize("algo, name", ALGORITHMS.items())
def test_a_model_of_another_algorithm_is_refused(algo, name, tmp_path):
    path = tmp_path / f"{algo}-Walk-v0.zip"
    make_any(name, Walk()).save(path)
    assert find_algorithm(path, None)[1] == find_algorithm(path, algo)[1] == algo
    others = set(utils.ALGOS) - {algo}
    assert len(others) >= len(ALGORITHMS) - 1
    for other in others:
        with pytest.raises(NotEvaluable, match=rf"^--algo {other}: \S+.zip was saved by {algo}: give that, or leave --algo"):
            find_algorithm(path, other)


class OwnPolicy(SACPolicy):
    """A user's, which tells nothing of the algorithm."""


def test_a_policy_of_ones_own_leaves_the_algorithm_to_the_user(tmp_path):
    SAC(OwnPolicy, TOY, **QUICK).save(tmp_path / "x.zip")
    assert find_algorithm(tmp_path / "x.zip", "sac")[2] is SAC


@pytest.mark.parametrize("text, expected", [("1000", [1000]), ("3:5", [3, 4]), ("7, 1:3", [7, 1, 2]), (range(2), [0, 1])])
def test_scenarios(text, expected):
    assert scenario_list(text) == expected


@pytest.mark.parametrize("text", ["", "a", "5:", ":5", "1:2:3", "-3", "5:5", "5:4", "1,", "1,1", "0:3,2", [], [-1], [0.5]])
def test_malformed_scenarios(text):
    with pytest.raises(ValueError, match="scenarios"):
        scenario_list(text)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "either a MODEL.zip or --expert"),
        (["model.zip", "--expert", "scripted"], "either a MODEL.zip or --expert"),
        (["nothing.zip"], "no model nothing.zip"),
        (["toy.txt"], "toy.txt is not a model saved by Stable-Baselines3"),
        (["model.zip", "--algo", "sarsa"], "--algo 'sarsa' is not known, choose from a2c"),
        (["model.zip", "--algo", "dqn"], "--algo dqn: model.zip was saved by sac: give that, or leave --algo out"),
        (["model.zip", "--env", "Pendulum-v1", "--episodes", "1"], "Observation spaces do not match"),
        (["model.zip", "--env", "toy_env:BlindDrive-v0"], "cannot be loaded as sac"),
        (["--expert", "mad"], "expert 'mad' is not available"),
        (["--expert", "scripted", "--env", "Pendulum-v1", "--episodes", "1"], "has no scripted driver"),
        (["--expert", "os:system"], "expert 'os:system' raised TypeError"),
        (["--expert", "math:isfinite"], "expert 'math:isfinite' raised TypeError"),
        (["--expert", "numpy:zeros_like"], "must return finite numbers of shape (1,)"),
        (["--expert", "builtins:len"], "must return finite numbers of shape (1,), returned "),
        (["--expert", "scripted", "--env", "NoSuch-v0"], "`NoSuch` doesn't exist"),
        (["--expert", "scripted", "--env", "nowhere:NoSuch-v0"], "No module named 'nowhere'"),
        (["--expert", "scripted", "--env-kwargs", "wings:2"], "cannot be made with env_kwargs {'wings': 2}"),
        (["--expert", "scripted", "--env-kwargs", "length:long"], "must look like key:value"),
        (["--expert", "scripted", "--scenarios", "9:3"], "range is empty"),
        (["--expert", "scripted", "--scenarios", "9-12"], "must look like 1000:1050"),
        (["--expert", "scripted", "--jobs", "0"], "--jobs must be at least 1"),
        (["--expert", "scripted", "--episodes", "0"], "--episodes must be at least 1"),
        (["--expert", "scripted", "--scenarios", "1:3", "--episodes", "3"], "not allowed with argument"),
        (["--expert", "scripted", "--video-scenario", "5"], "not among those"),
        (["--expert", "scripted", "--json", "nowhere/x.json"], "the folder nowhere does not exist"),
        (["--expert", "scripted", "--json", "."], "cannot be written (Is a directory)"),
        (["--expert", "scripted", "--plot", "x.mp4"], "must end with .png"),
        (["--expert", "scripted", "--steps", "x.txt"], "must end with .csv"),
        (["--expert", "scripted", "--video", "x.png"], "must end with .mp4 or .gif"),
        (["model.zip", "--env", "toy_env:StillDrive-v0", "--video", "x.mp4"], "render_mode 'rgb_array'"),
        (["model.zip", "--env", "toy_env:StillDrive-v0", "--plot", "x.png"], "lacks ['position', 'plot_map']"),
    ],
)
def test_errors(model, arguments, message, capsys, monkeypatch):
    monkeypatch.chdir(model.parent)
    Path("toy.txt").write_text("no model")
    before = sorted(Path.cwd().iterdir())
    options = [] if "--env" in arguments else ["--env", TOY]
    assert message in fails(capsys, *arguments, *options)
    assert sorted(Path.cwd().iterdir()) == before


def test_errors_of_the_function(sac):
    with pytest.raises(ValueError, match="does not fit"):
        evaluate(sac, "Pendulum-v1", episodes=1)
    with pytest.raises(ValueError, match="no position"):
        evaluate(lambda _: 0, "toy_env:BlindDrive-v0", episodes=1, record_paths=True)
    with pytest.raises(ValueError, match="jobs must be an integer of at least 1"):
        evaluate(sac, TOY, jobs=0)
    with pytest.raises(ValueError, match=r"return of episode 1 of .* is nan"):
        evaluate(sac, TOY, [1], env_kwargs={"reward": float("nan")})
    for value in (1j, np.complex128(1j), "0.5", None):
        with pytest.raises(NotEvaluable, match=r"return of episode 1 of .* is nan: mend the environment"):
            evaluate(sac, TOY, [1], env_kwargs={"reward": value})


@pytest.mark.parametrize("action", [None, "0", ["0"], [1j], np.array([1j]), [0.0, 0.0], [np.nan]])
def test_a_policy_that_returns_no_action_is_refused(action):
    with pytest.raises(NotEvaluable, match=r"^policy must return finite numbers of shape \(1,\), returned"):
        evaluate(lambda _: action, TOY, [1])
    if np.size(action) == 1:
        with pytest.raises(NotEvaluable, match=r"^policy must return a whole number, the space being Discrete\(2\), returned"):
            evaluate(lambda _: action, "toy_env:BlindDrive-v0", episodes=1)
