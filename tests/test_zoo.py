"""RL-Zoo3's own commands with our algorithms, as a user types them. The package under test is the installed one."""

import inspect
import sys
import sysconfig
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from shell import run, zoo_train

from sb3_chac.cli.demos import main as demos
from sb3_chac.cli.evaluate import main as evaluate
from sb3_chac.common.demonstrations import Demonstrations
from sb3_chac.zoo import hyperparams_file
from sb3_chac.zoo.algorithms import ALGORITHMS

ZOO = Path(sysconfig.get_path("scripts")) / "rl_zoo3"
QUICK = ["--env", "Pendulum-v1", "-n", "300", "--eval-freq", "150", "--eval-episodes", "1", "-f", "logs", "--seed", "1"]
SMALL = ["-params", "learning_starts:100", "policy_kwargs:dict(net_arch=[8])"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A folder in which ``rl_zoo3 train --algo dsac`` ran, with checkpoints and the replay buffer."""
    folder = tmp_path_factory.mktemp("zoo")
    extra = ["--save-freq", "200", "--save-replay-buffer", "--vec-env", "subproc", "--progress"]
    output = run(ZOO, "train", "--algo", "dsac", *QUICK, *extra, *SMALL, cwd=folder)
    assert str(hyperparams_file("dsac")) in output
    return folder


def test_train_leaves_what_the_zoo_promises(trained):
    run_folder = trained / "logs" / "dsac" / "Pendulum-v1_1"
    expected = {"Pendulum-v1.zip", "best_model.zip", "rl_model_200_steps.zip", "replay_buffer.pkl", "evaluations.npz"}
    assert expected <= {path.name for path in run_folder.iterdir()}
    saved = yaml.unsafe_load((run_folder / "Pendulum-v1" / "config.yml").read_text())
    assert dict(saved)["learning_rate"] == 0.001  # ours, not the zoo's default


@pytest.mark.parametrize("algo", ["dsac", "pvp", "dpvp", "chac", "sac", "ppo", "sac_lag", "ppo_lag", "hg_dagger", "iwr"])
def test_our_environment(tmp_path, monkeypatch, capsys, algo):
    monkeypatch.chdir(tmp_path)
    few_steps = ["-params", "n_steps:64", "batch_size:64"]
    few_rounds = ["-params", "warm_up_steps:60", "round_human_steps:20"]
    stages = ["-params", "switch_after:100", "prefit_steps:5"]
    few = {"ppo": few_steps, "ppo_lag": few_steps, "hg_dagger": few_rounds, "iwr": few_rounds, "chac": stages}.get(algo, [])
    quick = ["--env", "SafeDrive-v0", "-n", "200", "--eval-freq", "100", "--eval-episodes", "1", "-f", "logs"]
    zoo_train(monkeypatch, "--algo", algo, *quick, *few, "--env-kwargs", "horizon:60", "blocks:2")
    output = capsys.readouterr().out
    assert str(hyperparams_file(algo)) in output and "Saving to" in output
    model = f"logs/{algo}/SafeDrive-v0_1/SafeDrive-v0.zip"
    evaluate([model, "--scenarios", "1000:1002", "--env-kwargs", "horizon:60", "blocks:2", "--jobs", "1"])
    assert "safety cost" in capsys.readouterr().out


def test_our_environment_as_a_user_types_it(tmp_path):
    """Two commands in processes of their own."""
    quick = ["--env", "SafeDrive-v0", "-n", "100", "--eval-freq", "100", "--eval-episodes", "1", "-f", "logs"]
    output = run(ZOO, "train", "--algo", "dpvp", *quick, "--env-kwargs", "horizon:60", "blocks:2", cwd=tmp_path)
    assert str(hyperparams_file("dpvp")) in output and "Saving to" in output
    model = tmp_path / "logs" / "dpvp" / "SafeDrive-v0_1" / "SafeDrive-v0.zip"
    few = ["--scenarios", "1000", "--env-kwargs", "horizon:60"]
    assert "safety cost" in run(sys.executable, "-m", "sb3_chac", "evaluate", model, *few, cwd=tmp_path)


def test_nobody_drives_in_evaluations_which_have_maps_of_their_own(tmp_path, monkeypatch):
    from sb3_chac import InterventionWrapper

    steps: dict[str, list[tuple[bool, bool, int]]] = {"training": [], "evaluation": []}
    original = InterventionWrapper.step

    def step(self, action):
        *result, info = original(self, action)
        kind = "training" if self.unwrapped.start_scenario == 100 else "evaluation"
        assert self.unwrapped.horizon == 60
        steps[kind].append((self.armed, info["takeover"], info["scenario"]))
        return *result, info

    monkeypatch.setattr(InterventionWrapper, "step", step)
    monkeypatch.chdir(tmp_path)
    command = "--algo dpvp --env SafeDrive-v0 -n 240 --eval-freq 80 --eval-episodes 2 --seed 1".split()
    zoo_train(monkeypatch, *command, "--env-kwargs", "horizon:60", "blocks:2", *SMALL)
    armed, takeovers, scenarios = map(set, zip(*steps["evaluation"], strict=True))
    assert armed == takeovers == {False} and len(steps["evaluation"]) > 100
    assert min(scenarios) >= 2000 and max(scenarios) <= 2049
    armed, takeovers, scenarios = map(set, zip(*steps["training"], strict=True))
    assert armed == {True} and takeovers == {True, False} and len(steps["training"]) == 240
    assert min(scenarios) >= 100 and max(scenarios) <= 119


@pytest.mark.parametrize(
    "own, expected",
    [
        ([], {"start_scenario": 2000, "num_scenarios": 50}),
        (["--env-kwargs", "start_scenario:500", "blocks:1"], {"start_scenario": 2000, "num_scenarios": 50, "blocks": 1}),
        (["--eval-env-kwargs", "start_scenario:3000"], {"start_scenario": 3000}),
    ],
)
def test_maps_of_evaluations(tmp_path, monkeypatch, own, expected):
    from rl_zoo3 import train as zoo

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(zoo.ExperimentManager, "learn", lambda *_: None)
    managers = []
    monkeypatch.setattr(zoo.ExperimentManager, "save_trained_model", lambda manager, _: managers.append(manager))
    monkeypatch.setattr(sys, "argv", ["rl_zoo3", "--algo", "sac", "--env", "SafeDrive-v0", *own])
    zoo.train()
    assert managers[0].eval_env_kwargs == expected


def test_enjoy(trained):
    output = run(ZOO, "enjoy", "--algo", "dsac", "--env", "Pendulum-v1", "-f", "logs", "--no-render", "-n", "400", cwd=trained)
    assert "Mean reward:" in output and "2 Episodes" in output


def test_continue_training_with_the_replay_buffer(trained):
    model = "logs/dsac/Pendulum-v1_1/Pendulum-v1.zip"
    output = run(ZOO, "train", "--algo", "dsac", *QUICK, "-i", model, *SMALL, cwd=trained)
    assert "Loading pretrained agent" in output and "Loading replay buffer" in output
    assert (trained / "logs" / "dsac" / "Pendulum-v1_2" / "Pendulum-v1.zip").is_file()


@pytest.mark.parametrize("algo", [*(pytest.param(algo, marks=pytest.mark.slow) for algo in ("pvp", "dpvp")), "chac"])
def test_optimize_on_our_environment(tmp_path, algo):
    search = ["-optimize", "--n-trials", "2", "--n-startup-trials", "2", "--n-evaluations", "1", "--no-optim-plots"]
    quick = ["--env", "SafeDrive-v0", "-n", "200", "--eval-episodes", "1", "--env-kwargs", "horizon:60", "blocks:2"]
    params = ["-params", "learning_starts:50", *(["switch_after:100", "prefit_steps:5"] if algo == "chac" else [])]
    output = run(ZOO, "train", "--algo", algo, *quick, *search, *params, cwd=tmp_path)
    assert "Number of finished trials:  2" in output
    assert output.count("finished with value") == 2  # RL-Zoo3 turns errors into pruned trials
    assert "'start_scenario': 2000" in output
    assert not list(tmp_path.rglob("checkpoints"))


def test_optimize_and_train_the_best_trial(tmp_path):
    study = ["--storage", "study.log", "--study-name", "dsac"]
    search = ["-optimize", "--n-trials", "2", "--n-startup-trials", "1", "--n-evaluations", "1", "--no-optim-plots"]
    output = run(ZOO, "train", "--algo", "dsac", *QUICK, *search, *study, "-params", "learning_starts:100", cwd=tmp_path)
    assert "Number of finished trials:  2" in output and "Best trial:" in output
    assert "pruned" not in output.lower().replace("pruner", "")  # RL-Zoo3 turns errors into pruned trials
    output = run(ZOO, "train", "--algo", "dsac", *QUICK, *study, "--trial-id", "1", cwd=tmp_path)
    assert "Loading from Optuna study..." in output
    saved = yaml.unsafe_load(next(tmp_path.glob("logs/dsac/Pendulum-v1_*/Pendulum-v1/config.yml")).read_text())
    assert 0.97 <= saved["gamma"] < 1 and saved["policy_delay"] in (1, 2, 3) and saved["policy_kwargs"]["net_arch"]


@pytest.mark.parametrize("module", ["rl_zoo3.train", "sb3_chac"])
def test_other_ways_to_start(tmp_path, module):
    command = [sys.executable, "-m", module, *(["train"] if module == "sb3_chac" else [])]
    run(*command, "--algo", "dsac", *QUICK, *SMALL, cwd=tmp_path)
    assert (tmp_path / "logs" / "dsac" / "Pendulum-v1_1" / "Pendulum-v1.zip").is_file()


def test_without_autoload_only_our_launcher_knows_dsac(tmp_path):
    env = {"SB3_CHAC_NO_AUTOLOAD": "1"}
    assert "invalid choice: 'dsac'" in run(ZOO, "train", "--algo", "dsac", cwd=tmp_path, env=env, fails=True)
    run(sys.executable, "-m", "sb3_chac", "train", "--algo", "dsac", *QUICK, *SMALL, cwd=tmp_path, env=env)


def test_launcher_names_its_commands(tmp_path):
    launcher = [sys.executable, "-m", "sb3_chac"]
    assert "'fly' is not a command, choose from train, enjoy" in run(*launcher, "fly", cwd=tmp_path, fails=True)
    assert "usage: sb3-chac {train," in run(*launcher, cwd=tmp_path, fails=True)
    assert "usage: sb3-chac {train," in run(*launcher, "--help", cwd=tmp_path)


def test_bad_hyperparameters(tmp_path):
    """One of many, in a process of its own: the others are in test_bad_command_lines.py."""
    output = run(ZOO, "train", "--algo", "dsac", *QUICK, "-params", "policy_delay:0", cwd=tmp_path, fails=True)
    assert "policy_delay must be an integer of at least 1" in output


def test_a_conf_file_of_ones_own_has_priority(tmp_path):
    (tmp_path / "own.yml").write_text("Pendulum-v1:\n  n_timesteps: 150\n  policy: MlpPolicy\n  learning_rate: 0.002\n")
    output = run(ZOO, "train", "--algo", "dsac", "--env", "Pendulum-v1", "-conf", "own.yml", "-f", "logs", cwd=tmp_path)
    assert "Loading hyperparameters from: own.yml" in output


def test_importing_the_package_is_cheap():
    code = (
        "import sys, sb3_chac; assert not {'torch', 'numpy', 'gymnasium', 'rl_zoo3'} & set(sys.modules); print(dir(sb3_chac))"
    )
    output = run(sys.executable, "-c", code, cwd=Path.cwd())
    assert "DSAC" in output


def test_unknown_names():
    import sb3_chac

    with pytest.raises(AttributeError, match="no attribute 'SARSA'"):
        _ = sb3_chac.SARSA
    with pytest.raises(FileNotFoundError, match=r"no hyperparameters for 'sarsa'.*dsac"):
        hyperparams_file("sarsa")


@pytest.mark.parametrize("broken", ["registration", "exports"])
def test_a_broken_installation_of_ours_only_warns(tmp_path, broken):
    """A module of ours that cannot be imported (here: shadowed by None) must not keep SAC from training."""
    module = {"registration": "sb3_chac.zoo.registration", "exports": "sb3_chac.dsac"}[broken]
    code = f"import sys; sys.modules['{module}'] = None; sys.argv[1:1] = []; from rl_zoo3.train import train; train()"
    quick = [*QUICK, "-params", "learning_starts:100", "policy_kwargs:dict(net_arch=[8])"]
    output = run(sys.executable, "-c", code, "--algo", "sac", *quick, cwd=tmp_path)
    assert "sb3_chac is not registered with rl_zoo3" in output


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_algorithm_has_hyperparameters_a_sampler_and_a_converter(algo):
    import optuna
    import rl_zoo3.exp_manager as zoo

    entries = yaml.safe_load(hyperparams_file(algo).read_text())
    assert "default" in entries
    assert all({"n_timesteps", "policy"} <= set(entry) for entry in entries.values())
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(20):
        trial = study.ask()
        sampled = zoo.HYPERPARAMS_SAMPLER[algo](trial, 1, 1, {"using_her_replay_buffer": False, "her_kwargs": {}})
        assert zoo.HYPERPARAMS_CONVERTER[algo](trial.params) == sampled
        needed = {"buffer_size": 10, "dataset": swings()}
        accepted = inspect.signature(zoo.ALGOS[algo]).parameters
        given = {name: value for name, value in needed.items() if name in accepted}
        zoo.ALGOS[algo]("MlpPolicy", "Pendulum-v1", **given, **sampled)


def swings():
    """Two episodes of five steps on Pendulum-v1, as demonstrations."""
    env = gym.make("Pendulum-v1")
    observations = np.stack([env.observation_space.sample() for _ in range(10)])
    is_last = np.arange(10) % 5 == 4
    return Demonstrations(
        observation_space=env.observation_space,
        action_space=env.action_space,
        observations=observations,
        actions=np.zeros((10, 1), np.float32),
        next_observations=observations,
        rewards=np.zeros(10),
        terminations=np.zeros(10, bool),
        truncations=is_last,
        episodes=np.arange(10) // 5,
    )


def test_demonstrations_are_recorded_and_learned_from(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    monkeypatch.delenv("SB3_CHAC_TRACEBACK", raising=False)
    quick = "--env SafeDrive-v0 -n 60 --eval-freq 30 --eval-episodes 1 --eval-env-kwargs horizon:30".split()
    with pytest.raises(SystemExit):
        zoo_train(monkeypatch, "--algo", "bc", *quick)
    assert "sb3_chac demos record" in capsys.readouterr().err
    demos("record --expert scripted --steps 300 --dataset safedrive/scripted-v0 --jobs 1".split())
    for algo in ("bc", "cql", "gail"):
        params = ["-params", "n_envs:1", "n_steps:30", "batch_size:30"] if algo == "gail" else []
        zoo_train(monkeypatch, "--algo", algo, *quick, *params)
        (model,) = (tmp_path / "logs" / algo).glob("*/SafeDrive-v0.zip")
        capsys.readouterr()
        evaluate([str(model), "--scenarios", "1000", "--env-kwargs", "horizon:30", "--jobs", "1"])
        assert "safety cost" in capsys.readouterr().out
