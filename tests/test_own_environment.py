"""Experts, rules and environments of users, by name: in Python, in a yaml file and on the command line."""

import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from guided_toys import make_guided
from shell import run
from takeover_toys import EXPERT, NOVICE, Integrator, armed, bits, drive
from test_documentation import blocks

from sb3_chac import CHAC, __main__, chac
from sb3_chac.evaluation.episodes import NotEvaluable, Runner, Task
from sb3_chac.human import InterventionWrapper

PAGE = Path(__file__).parent.parent / "docs" / "guide" / "custom_env.md"
MODULE = """
import math

import gymnasium as gym
import numpy as np
from sb3_chac.human import RiskRule
from takeover_toys import EXPERT, Integrator

def constant(observation):
    return EXPERT.copy()

class Remembering:
    made = []

    def __init__(self, env):
        self.made.append(env)

    def reset(self, seed=None):
        pass

    def __call__(self, observation):
        return EXPERT.copy()

class Every:
    def __init__(self, period=2):
        self.period = period
        self.reset()

    def reset(self):
        self.steps = 0

    def __call__(self, observation, novice_action, expert_action, human_driving):
        self.steps += 1
        return self.steps % self.period == 0

def sometimes(observation, novice_action, expert_action):
    return bool(novice_action[0] > 0)

risky = RiskRule(lambda observation, action: 0.0, delay=1)
number = 3
gym.register("OfAUser-v0", entry_point=Integrator)
"""


@pytest.fixture
def of_a_user(tmp_path, monkeypatch):
    """A module in the working directory, which Python does not look into."""
    (tmp_path / "of_a_user.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield "of_a_user"
    sys.modules.pop("of_a_user", None)
    gym.registry.pop("OfAUser-v0", None)


@pytest.mark.parametrize(
    "rule, kwargs, driven",
    [("sometimes", None, "1111"), ("Every", None, "0101"), ("Every", {"period": 3}, "0010"), ("risky", None, "0111")],
)
def test_rules_by_name(of_a_user, rule, kwargs, driven):
    env = InterventionWrapper(Integrator(), f"{of_a_user}:constant", f"{of_a_user}:{rule}", armed=True, rule_kwargs=kwargs)
    env.reset(seed=0)
    assert drive(env, 4) == bits(driven)
    assert np.array_equal(env.unwrapped.executed[-1], EXPERT if driven[-1] == "1" else NOVICE)


def test_a_class_makes_an_expert_for_each_environment(of_a_user):
    first, second = armed("always", f"{of_a_user}:Remembering"), armed("always", f"{of_a_user}:Remembering")
    assert sys.modules[of_a_user].Remembering.made == [first.env, second.env]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (dict(expert="nowhere_at_all:f"), r"expert: 'nowhere_at_all:f' cannot be imported .*working directory"),
        (dict(expert="of_a_user:f"), r"expert: 'of_a_user:f' is not there, of_a_user has no 'f'"),
        (dict(expert="of_a_user:number"), r"expert must be .* got 3"),
        (dict(expert="of_a_user:constant", rule="of_a_user:number"), r"rule must be .* got 3"),
        (dict(expert="of_a_user:constant", rule="of_a_user:sometimes", rule_kwargs={"a": 1}), "rule_kwargs: only"),
    ],
)
def test_bad_names(of_a_user, arguments, message):
    with pytest.raises(ValueError, match=message):
        InterventionWrapper(Integrator(), **{"rule": "always"} | arguments)


def test_experts_by_name_are_evaluated(of_a_user):
    task = Task(f"{of_a_user}:constant", Integrator, {}, use_scenarios=False)
    with Runner(task) as runner:
        observation = runner.reset(0)
        assert np.array_equal(runner.driver(observation), EXPERT)
    with pytest.raises(NotEvaluable, match="has no 'f'"):
        Runner(task._replace(policy=f"{of_a_user}:f"))


@pytest.mark.parametrize("joined", [False, True], ids=["apart", "joined by ="])
def test_gym_packages_of_our_commands(of_a_user, capsys, joined):
    def written(*option):
        return ["=".join(option)] if joined else list(option)

    arguments = [*written("--env", "OfAUser-v0"), *written("--gym-packages", of_a_user), "--expert", "scripted"]
    expected = [*written("--env", "of_a_user:OfAUser-v0"), "--expert", "scripted"]
    assert __main__.import_packages("evaluate", arguments) == expected
    assert "OfAUser-v0" in gym.registry
    with pytest.raises(SystemExit):
        __main__.import_packages("evaluate", ["--gym-packages", "nowhere_at_all"])
    assert "--gym-packages nowhere_at_all" in capsys.readouterr().err
    assert __main__.import_packages("plot", ["logs/a", "--out", "b.png"]) == ["logs/a", "--out", "b.png"]


def test_a_stage_2_without_the_self_learning_policy_says_so(monkeypatch):
    monkeypatch.setattr(chac.chac, "QUIET_STEPS", 10)
    model = make_guided(CHAC, switch_after=20, sigma_scale=1e6)  # so the confidence is one half
    with pytest.warns(UserWarning, match=r"not acted in the first 10 steps .* reached 0\.50 .* exceed 1 - delta = 0\.85"):
        model.learn(45)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(20, reset_num_timesteps=False)  # once is enough
        make_guided(CHAC, switch_after=20, sigma_scale=1e6, delta=0.0).learn(45)  # as asked for


@pytest.mark.slow
def test_the_commands_of_the_page(tmp_path):
    module, yaml = blocks(PAGE)[0], PAGE.read_text(encoding="utf-8").split("```yaml\n")[1].split("```")[0]
    (tmp_path / "point.py").write_text(module)
    (tmp_path / "point.yml").write_text(yaml)
    scripts = Path(sys.executable).parent
    small = ["-n", "400", "-params", "switch_after:300", "prefit_steps:10", "--eval-freq", "200"]
    train = ["train", "--algo", "chac", "--env", "Point-v0", "--gym-packages", "point", "--conf-file", "point.yml"]
    run(scripts / "rl_zoo3", *train, *small, "-f", "logs", cwd=tmp_path)
    model = "logs/chac/Point-v0_1/Point-v0.zip"
    evaluate = [scripts / "sb3-chac", "evaluate", model, "--env", "Point-v0", "--gym-packages", "point"]
    output = run(*evaluate, "--scenarios", "1000:1004", "--beside", "guided", "point:around", "--jobs", "2", cwd=tmp_path)
    assert "point:around" in output and "success" in output
