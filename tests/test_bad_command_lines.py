"""Mistakes on the command line of ``rl_zoo3 train`` and in its yaml files, and of our own commands: one line each."""

import math
import re
import sys
from pathlib import Path

import gymnasium as gym
import pytest
import rl_zoo3
import yaml
from test_demo import write_run

from sb3_chac.__main__ import main as sb3_chac
from sb3_chac.zoo import register
from sb3_chac.zoo.errors import check_file, check_hyperparameters
from sb3_chac.zoo.wrappers import check_classes, check_normalization, checked_wrapper

QUICK = ["--eval-freq", "-1", "-n", "10", "-f", "logs"]
# Arguments of rl_zoo3 train, and what the line must name
ZOO = [
    ("-n 0", "-n"),
    ("-n -5", "-n"),
    ("-n many", "-n"),
    ("--algo nonsense", "--algo"),
    ("--env Nowhere-v0", "Nowhere-v0"),
    ("--env-kwargs nonsense:1", "nonsense"),
    ("--env-kwargs horizon", "horizon"),
    ("--env-kwargs horizon:0 --env SafeDrive-v0", "horizon"),
    ("--env-kwargs horizon:text --env SafeDrive-v0", "horizon"),
    ("--eval-episodes 0", "--eval-episodes"),
    ("--n-eval-envs 0", "--n-eval-envs"),
    ("--save-freq -7", "--save-freq"),
    ("--device nonsense", "device"),
    ("--seed 99999999999999", "eed"),
    ("--seed text", "--seed"),
    ("--vec-env nonsense", "--vec-env"),
    ("-i nowhere.zip", "trained"),
    ("--conf-file nowhere.yml", "nowhere.yml"),
    ("--gym-packages nowhere", "nowhere"),
    ("-f file", "file"),
    ("-params nonsense:1", "nonsense"),
    ("-params gamma", "gamma"),
    ("-params gamma:", "gamma"),
    ("-params gamma:nonsense", "gamma"),
    ("-params gamma:(", "gamma"),
    ("-params gamma:2", "gamma"),
    ("-params gamma:float('nan')", "gamma"),
    ("-params gamma:'0.9'", "gamma"),
    ("-params learning_rate:'1e-3'", "learning_rate"),
    ("-params learning_rate:-1", "learning_rate"),
    ("-params learning_rate:'quick'", "learning_rate"),
    ("-params learning_rate:None", "learning_rate"),
    ("-params learning_rate:[1]", "learning_rate"),
    ("-params batch_size:0", "batch_size"),
    ("-params batch_size:1.5", "batch_size"),
    ("-params buffer_size:-1", "buffer_size"),
    ("-params train_freq:0", "train_freq"),
    ("-params train_freq:[1,'year']", "train_freq"),
    ("-params policy:'Nonsense'", "policy"),
    ("-params policy_kwargs:1", "policy_kwargs"),
    ("-params policy_kwargs:'dict(nonsense=1)'", "nonsense"),
    ("-params policy_kwargs:'dict('", "policy_kwargs"),
    ("-params policy_kwargs:'dict(net_arch=text)'", "policy_kwargs"),
    ("-params n_envs:0", "n_envs"),
    ("-params n_envs:-1", "n_envs"),
    ("-params n_envs:1.5", "n_envs"),
    ("-params n_envs:'two'", "n_envs"),
    ("-params n_envs:True", "n_envs"),
    ("-params n_timesteps:'many' -n -1", "n_timesteps"),
    ("-params n_timesteps:0 -n -1", "n_timesteps"),
    ("-params normalize:'nonsense'", "normalize"),
    ("-params normalize:1.5", "normalize"),
    ("-params frame_stack:0", "frame_stack"),
    ("-params env_wrapper:'nowhere.Wrapper'", "nowhere"),
    ("-params env_wrapper:1", "env_wrapper"),
    ("-params env_wrapper:[{'sb3_chac.human.InterventionWrapper':{'nonsense':1}}]", "nonsense"),
    ("-params env_wrapper:[{'sb3_chac.human.InterventionWrapper':{'budget':-1}}] --env SafeDrive-v0", "budget"),
    ("-params vec_env_wrapper:'nowhere.Wrapper'", "nowhere"),
    ("-params callback:'nowhere.Callback'", "nowhere"),
    ("-params callback:1", "callback"),
    ("-params noise_type:'nonsense'", "noise_type"),
    ("-params noise_type:'normal'", "noise_std"),
    ("-params noise_std:0.1", "noise_type"),
    *(
        (f"-params noise_type:'normal' noise_std:{value}", "noise_std must be a finite number of at least 0")
        for value in ("'big'", "-1", "float('nan')", "None", "[0.1]", "True", "1j")
    ),
    ("-params n_stack:0", "n_stack"),
    ("-params frame_stack:1.5", "frame_stack"),
    *((f"-params {name}:'nope'", name) for name in ("env_wrapper", "vec_env_wrapper", "callback")),
    *((f"-params {name}:''", name) for name in ("env_wrapper", "vec_env_wrapper", "callback")),
    *((f"-params {name}:[1]", name) for name in ("env_wrapper", "vec_env_wrapper", "callback")),
    *((f"-params {name}:['math.nope']", name) for name in ("env_wrapper", "vec_env_wrapper", "callback")),
    *((f"-params {name}:['math.pi']", name) for name in ("env_wrapper", "vec_env_wrapper", "callback")),
    *((f"-params {name}:['math.sqrt']", name) for name in ("env_wrapper", "vec_env_wrapper", "callback")),
    *((f"-params {name}:[{{'a.A':{{}},'b.B':{{}}}}]", name) for name in ("env_wrapper", "vec_env_wrapper", "callback")),
    *((f"-params {name}:[{{'gymnasium.Wrapper':3}}]", name) for name in ("env_wrapper", "vec_env_wrapper", "callback")),
    ("-params callback:[{'stable_baselines3.common.callbacks.CheckpointCallback':{'nonsense':1}}]", "nonsense"),
    ("-params vec_env_wrapper:[{'stable_baselines3.common.vec_env.VecFrameStack':{'n_stack':0}}]", "vec_env_wrapper leaves"),
    ("-params vec_env_wrapper:[{'stable_baselines3.common.vec_env.VecFrameStack':{'nonsense':1}}]", "nonsense"),
    ("-params vec_env_wrapper:'gymnasium.wrappers.ClipReward'", "vec_env_wrapper"),
    ("-params env_wrapper:'stable_baselines3.common.vec_env.VecCheckNan'", "env_wrapper"),
    ("-params normalize:{'clip_obs':-1}", "normalize"),
    ("-params normalize:{'clip_obs':0}", "normalize"),
    ("-params normalize:{'clip_reward':'far'}", "normalize"),
    ("-params normalize:{'gamma':2}", "normalize"),
    ("-params normalize:{'epsilon':-1}", "normalize"),
    ("-params normalize:{'epsilon':float('nan')}", "normalize"),
    ("-params normalize:{'norm_obs':'no'}", "normalize"),
    ("-params normalize:{'nonsense':1}", "normalize"),
    ("-params normalize:{1:1}", "normalize"),
    ("-params normalize:\"{'clip_obs':-1}\"", "normalize"),
    ('-params normalize:"dict(norm_obs_keys=3)"', "normalize"),
    ("-params env_kwargs:3", "env_kwargs"),
    ("-params monitor_kwargs:{'nonsense':1}", "nonsense"),
    ("-params replay_buffer_kwargs:{'nonsense':1}", "nonsense"),
    ("-params replay_buffer_class:'nonsense'", "replay_buffer_class"),
    ("-params replay_buffer_kwargs:1", "replay_buffer_kwargs"),
    ("-params monitor_kwargs:1", "monitor_kwargs"),
    ("-params policy_delay:0", "policy_delay"),
    ("-params delta:3 --algo chac", "delta"),
    ("-params bootstrap:'nonsense' --algo chac", "bootstrap"),
    ("-params dataset:'nowhere-v0' --algo bc", "nowhere-v0"),
    ("-params cost_limit:-1 --algo sac_lag", "cost_limit"),
    ("-params clip_range:'nonsense' --algo ppo_lag", "clip_range"),
    ("-params clip_range:float('nan') --algo ppo_lag", "clip_range"),
    ("-params gae_lambda:-1 --algo ppo_lag", "gae_lambda"),
]
FILES = [
    ("", "bad.yml"),
    ("text", "bad.yml"),
    ("- a\n- b", "bad.yml"),
    ("a: [", "bad.yml"),
    ("\x00", "bad.yml"),
    ("Pendulum-v1:", "bad.yml"),
    ("Pendulum-v1: 3", "bad.yml"),
    ("Other-v0: {n_timesteps: 10}", "Pendulum-v1"),
    ("Pendulum-v1: {policy: MlpPolicy}", "n_timesteps"),
    ("Pendulum-v1: {n_timesteps: 10}", "policy"),
    ("Pendulum-v1: {policy: MlpPolicy, n_timesteps: 1e3}", "n_timesteps"),
    ("Pendulum-v1: {policy: MlpPolicy, n_timesteps: 10, learning_rate: 1e-3}", "learning_rate"),
    ("Pendulum-v1: {policy: MlpPolicy, n_timesteps: 10, nonsense: 1}", "nonsense"),
    ("Pendulum-v1: {policy: MlpPolicy, n_timesteps: 10, gamma: .nan}", "gamma"),
    ("Pendulum-v1: {policy: MlpPolicy, n_timesteps: 10, gamma: }", "gamma"),
    ("Pendulum-v1: {policy: , n_timesteps: 10}", "policy"),
    ("1: {policy: MlpPolicy, n_timesteps: 10}", "Pendulum-v1"),
    ("Pendulum-v1: {policy: MlpPolicy, n_timesteps: 10}\nPendulum-v1: {policy: }", "'Pendulum-v1' twice, in lines 1 and 2"),
    ("Pendulum-v1: {policy: MlpPolicy, n_timesteps: 10, gamma: 0.9, gamma: 0.99}", "'gamma' twice"),
    ("Pendulum-v1:\n  policy: MlpPolicy\n  n_timesteps: 10\n  normalize: {gamma: 0.9, gamma: 0.99}", "'gamma' twice"),
]


@pytest.fixture
def complaint(tmp_path, monkeypatch, capsys):
    """
    Runs a command that must end in one line.

    :return: function of the command, which returns the line
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SB3_CHAC_TRACEBACK", raising=False)
    (tmp_path / "file").write_text("in the way")
    register()

    def run(arguments: list[str]) -> str:
        monkeypatch.setattr(sys, "argv", ["sb3-chac", *arguments])
        with pytest.raises(SystemExit) as ended:
            sb3_chac()
        assert ended.value.code == 2
        # argparse tells how it is used first, and there may be a progress bar
        printed = capsys.readouterr().err.splitlines()
        lines = [line for line in printed if line and not re.search("^usage:|^ |Warning|episode/s|s/episode", line)]
        assert len(lines) == 1, lines
        return lines[0]

    return run


@pytest.mark.parametrize("arguments, named", ZOO, ids=[arguments for arguments, _ in ZOO])
def test_arguments_of_rl_zoo3(complaint, arguments, named):
    algo = [] if "--algo" in arguments else ["--algo", "dsac"]
    env = [] if "--env " in arguments else ["--env", "Pendulum-v1"]
    assert named in complaint(["train", *QUICK, *algo, *env, *arguments.split()])


@pytest.mark.parametrize("content, named", FILES, ids=[repr(content) for content, _ in FILES])
def test_hyperparameters_files(complaint, tmp_path, content, named):
    (tmp_path / "bad.yml").write_text(content)
    quick = ["--eval-freq", "-1", "-f", "logs"]
    assert named in complaint(["train", "--algo", "dsac", "--env", "Pendulum-v1", *quick, "--conf-file", "bad.yml"])


def test_what_files_may_hold(tmp_path):
    """Another environment's entry, merged keys and aliases in circles are none of our business."""
    file = tmp_path / "good.yml"
    file.write_text(
        "default: &base {policy: MlpPolicy, n_timesteps: 10, gamma: 0.9}\n"
        "Other-v0: {}\nOther-v0: {gamma: 1, gamma: 2}\n"
        "Pendulum-v1: {<<: *base, gamma: 0.99, policy_kwargs: &circle {again: *circle}}\n"
    )
    check_file(str(file), "Pendulum-v1")
    with pytest.raises(ValueError, match=r"'Other-v0' twice, in lines 2 and 3: remove one\."):
        check_file(str(file), "Other-v0")


def test_hyperparameters_of_rl_zoo3_and_ours_are_fine():
    folders = (Path(__file__).parent.parent, Path(rl_zoo3.__file__).parent)
    checked = 0
    for file in [file for folder in folders for file in folder.glob("hyperparams/*.yml")]:
        for env_id, hyperparams in yaml.safe_load(file.read_text()).items():
            check_file(str(file), env_id)
            check_hyperparameters({**hyperparams, "env_wrapper": None}, 10)  # some are of packages that are not installed
            checked += 1
    assert checked > 100


def test_wrappers_and_normalization_that_are_fine():
    limit = {"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 5}}
    check_classes({"env_wrapper": ["rl_zoo3.wrappers.TimeFeatureWrapper", limit], "callback": None, "vec_env_wrapper": []})
    check_normalization({"clip_obs": math.inf, "clip_reward": 5, "norm_obs": False, "gamma": 1.0})
    wrap = checked_wrapper("env_wrapper", lambda env: gym.wrappers.TimeLimit(env, 5))
    assert isinstance(wrap(gym.make("Pendulum-v1")), gym.wrappers.TimeLimit)
    assert checked_wrapper("env_wrapper", None) is None


def test_numbers_of_rl_zoo3_files_are_fine():
    check_hyperparameters(yaml.safe_load("{policy: MlpPolicy, n_timesteps: !!float 1e6, learning_rate: lin_7.3e-4}"), -1)


OWN = [
    ("evaluate --expert scripted --scenarios 0:1000000000", "0:1000000000"),
    ("evaluate --expert scripted --scenarios 10:5", "10:5"),
    ("evaluate --expert scripted --scenarios 5,5", "5,5"),
    ("evaluate --expert scripted --scenarios " + "9" * 5000, "scenarios"),
    ("evaluate --expert scripted --json nowhere/a.json", "nowhere"),
    ("evaluate --expert scripted --env Nowhere-v0", "Nowhere-v0"),
    ("evaluate nowhere.zip", "nowhere.zip"),
    ("resume nowhere", "nowhere"),
    ("plot nowhere", "nowhere"),
    ("demos info --dataset nowhere-v0", "nowhere-v0"),
    ("drive --serve 0 -params foo:1", "foo"),
    ("drive --serve 0 -params foo", "foo"),
    ("drive --serve 0 --env CartPole-v1", "CartPole-v1"),
    ("drive --serve 0 --env Pendulum-v1", "Pendulum"),
    ("drive --serve 0 --tls-key key.pem", "--tls-key"),
    ("drive --serve 0 --tls-cert nowhere.pem", "--tls-cert"),
    ("drive --serve " + "9" * 5000, "--serve"),
    ("drive --resume nowhere", "nowhere"),
    ("drive --recover nowhere", "nowhere"),
]


@pytest.mark.parametrize("arguments, named", OWN, ids=[arguments[:50] for arguments, _ in OWN])
def test_our_own_commands(complaint, arguments, named):
    assert named in complaint(arguments.split())


# A full disk: whatever is written to this device fails with "No space left on device"


def test_evaluate_on_a_full_disk(complaint):
    quick = ["--scenarios", "1000", "--env-kwargs", "horizon:3", "blocks:1", "--jobs", "1"]
    assert "No space left" in complaint(["evaluate", "--expert", "scripted", *quick, "--json", "/dev/full"])


def test_plot_on_a_full_disk(complaint, tmp_path):
    run = write_run(tmp_path / "run", [100])
    (tmp_path / "curves.png").symlink_to("/dev/full")
    assert "No space left" in complaint(["plot", str(run), "--out", "curves.png"])
