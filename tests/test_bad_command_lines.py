"""Mistakes on the command line of ``rl_zoo3 train`` and in its yaml files, and of our own commands: one line each."""

import re
import sys

import pytest
import yaml
from test_demo import write_run

from sb3_chac.__main__ import main as sb3_chac
from sb3_chac.zoo import register

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


def test_numbers_of_rl_zoo3_files_are_fine():
    from sb3_chac.zoo.errors import check_hyperparameters

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
