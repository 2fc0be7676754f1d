"""Arguments of constructors: what one cannot be gives one error that begins with its name, before anything is built."""

import fractions
import inspect
import math
import typing

import gymnasium as gym
import numpy as np
import pytest
from eleven import ALL, OFFLINE, Walk, make_any
from gymnasium import spaces
from test_zoo import swings

import sb3_chac
from sb3_chac.common.arguments import RANGES, annotations, fits
from sb3_chac.common.buffers import DualReplayBuffer
from sb3_chac.envs.safedrive import SafeDriveEnv
from sb3_chac.human import DisagreementRule, InterventionWrapper, RiskRule
from sb3_chac.zoo.algorithms import ALGORITHMS

BOX = spaces.Box(-1, 1, (2,), np.float32)
OWNERS = {
    **{name: getattr(sb3_chac, name) for name in ALGORITHMS.values()},
    "InterventionWrapper": InterventionWrapper,
    "RiskRule": RiskRule,
    "DisagreementRule": DisagreementRule,
    "DualReplayBuffer": DualReplayBuffer,
    "SafeDriveEnv": SafeDriveEnv,
}
VALUES = {"NaN": math.nan, "inf": math.inf, "text": "nonsense", "list": [1], "-1": -1, "0": 0, "True": True}
# -1 is one of several, 0 switches something off or is the lowest: they are as good as any other number
GOOD = {
    "-1": {"gradient_steps", "sde_sample_freq", "target_entropy", "log_prob_threshold", "start_scenario", "sigma_threshold"},
    "0": {
        *(name for name, limits in RANGES.items() if 0 in limits),
        *("learning_rate", "ent_coef_lr", "actor_lr", "lagrange_lr", "disc_learning_rate", "learning_starts", "tau", "tau_b"),
        *("tau_c", "target_entropy", "log_prob_threshold", "sigma_threshold", "pv_coef", "pv_min_diff", "weight_decay"),
        *(
            "average_tau",
            "delta",
            "switch_after",
            "prefit_steps",
            "relapse_window",
            "stage2_human_share",
            "stage2_guided_share",
            "anchor_coef",
            "max_deviation",
            "cost_coef",
            "takeover_cost",
            "validation_share",
        ),
        *("conservative_weight", "gradient_penalty", "cost_limit", "cost_gamma", "cost_gae_lambda", "cost_vf_coef"),
        *("lagrange_start", "lagrange_init", "lagrange_max", "pid_kp", "pid_ki", "pid_kd", "pid_tau", "warm_up_steps"),
        *("n_rounds", "target_policy_noise", "target_noise_clip", "budget", "delay", "smoothing", "threshold"),
        *("start_scenario", "traffic_density", "obstacle_density", "displacement_reward", "speed_reward", "gradient_steps"),
        *("cost_coef", "collision_penalty", "arrival_reward", "out_of_road_penalty"),
    },
    "text": {"tensorboard_log", "dataset"},  # a folder; what is not there is told when it is read
}
NOT_CHECKED = {"self", "_init_setup_model", "kwargs"}


def required(owner):
    """What the constructor needs besides."""
    env = gym.make("Pendulum-v1")
    parameters = inspect.signature(owner).parameters
    found = {"policy": "MlpPolicy", "env": env, "expert": lambda observation: [0.0], "rule": "never", "threshold": 0.1}
    found |= {"time_to_trouble": lambda observation, action: 1.0, "observation_space": BOX, "action_space": BOX}
    found |= {"buffer_size": 10, "policy_kwargs": {"net_arch": [8]}}
    return {name: value for name, value in found.items() if name in parameters}


def bad_values(owner, values=VALUES):
    """
    :return: names of arguments, and values that they cannot have
    """
    hints = annotations(owner.__init__)
    for name in inspect.signature(owner).parameters:
        if name in NOT_CHECKED:
            continue
        for label, value in values.items():
            may_be = hints.get(name) is not typing.Any and fits(value, hints.get(name))
            if name in GOOD.get(label, ()) and may_be:
                continue
            if label == "True" and may_be:
                continue
            yield name, label, value


@pytest.mark.parametrize("owner", OWNERS.values(), ids=OWNERS)
def test_what_an_argument_cannot_be_is_named(owner):
    others = required(owner)
    tried, silent, unnamed = 0, [], []
    for name, label, value in bad_values(owner):
        tried += 1
        try:
            owner(**{**others, name: value})
        except Exception as error:
            if not isinstance(error, ValueError) or name not in str(error):
                unnamed.append(f"{name}={label}: {type(error).__name__}: {error}")
        else:
            silent.append(f"{name}={label}")
    assert tried > 10
    assert not silent and not unnamed, f"of {tried}, taken: {silent}; without a name: {unnamed}"


OTHERS = {
    "400 digits": 10**400,
    "fraction": fractions.Fraction(1, 2),
    "complex": 1j,
    "float32 NaN": np.float32("nan"),
}


@pytest.mark.parametrize("value", OTHERS.values(), ids=OTHERS)
@pytest.mark.parametrize("owner", OWNERS.values(), ids=OWNERS)
def test_numbers_that_are_none_of_ours_are_named(owner, value):
    hints, others, tried = annotations(owner.__init__), required(owner), 0
    for name in inspect.signature(owner).parameters:
        if name in NOT_CHECKED or hints.get(name) is typing.Any or fits(value, hints.get(name)):
            continue
        tried += 1
        with pytest.raises(ValueError, match=name):
            owner(**{**others, name: value})
    assert tried >= 2


@pytest.mark.parametrize("name", ["policy", "replay_buffer_class", "rollout_buffer_class"])
@pytest.mark.parametrize("algorithm", [getattr(sb3_chac, name) for name in ALGORITHMS.values()])
def test_a_class_of_another_kind_is_named(algorithm, name):
    if name in inspect.signature(algorithm).parameters:
        with pytest.raises(ValueError, match=f"^{name} must be .*class"):
            algorithm(**{**required(algorithm), name: int})


@pytest.mark.parametrize("owner", OWNERS.values(), ids=OWNERS)
def test_what_signatures_say_is_what_the_defaults_are(owner):
    hints = annotations(owner.__init__)
    for name, parameter in inspect.signature(owner).parameters.items():
        if name not in NOT_CHECKED and parameter.default is not inspect.Parameter.empty:
            assert fits(parameter.default, hints[name]), name


@pytest.mark.parametrize(
    "schedule, is_good",
    [
        (lambda left: 0.2 * left, True),
        (lambda left: math.nan, False),
        (lambda left: -left, False),
        (lambda left: 1 / 0, False),
        (lambda left: "quick", False),
        (lambda left: None, False),
        (lambda: 0.1, False),
    ],
)
@pytest.mark.parametrize("name", ["clip_range", "clip_range_vf", "learning_rate"])
@pytest.mark.parametrize("algorithm", [sb3_chac.PPOLag, sb3_chac.GAIL])
def test_schedules_are_looked_into(algorithm, name, schedule, is_good):
    dataset = {"dataset": swings()} if algorithm is sb3_chac.GAIL else {}

    def make():
        return algorithm("MlpPolicy", "Pendulum-v1", **dataset, **{name: schedule})

    if is_good:
        make()
    else:
        with pytest.raises(ValueError, match=f"^{name} must be"):
            make()


@pytest.mark.parametrize("name", ALL)
def test_arguments_of_learn_are_checked_before_anything_is_changed(name):
    env = Walk()
    env.reset()
    model, position = make_any(name, env), env.position
    bad = {
        "total_timesteps": ["a", None, math.nan, math.inf, -1, 1.5, True, 1j, [3], 10**400],
        "log_interval": ["a", 0, -1, math.nan, 2.5, 1j],
        "callback": ["a", 3],
        "reset_num_timesteps": ["no"],
        "progress_bar": ["no"],
    }
    for argument, values in bad.items():
        for value in values:
            with pytest.raises(ValueError, match=f"^{argument} must be .*, got "):
                model.learn(**{"total_timesteps": 6, argument: value})
    assert model.num_timesteps == 0 and model._last_obs is None
    assert env.position is position, "it was reset"


@pytest.mark.parametrize("name", ALL)
def test_whole_numbers_of_any_type_are_a_number_of_steps(name):
    model = make_any(name, Walk())
    model.learn(0)
    assert model.num_timesteps == 0
    log_interval = 10 if name in OFFLINE else None
    for steps in (12.0, np.float32(12), np.int64(12)):
        model.learn(steps, log_interval=log_interval)
        assert model.num_timesteps == 12


@pytest.mark.parametrize("name", ALL)
def test_learning_without_an_environment_says_where_to_pass_one(name, tmp_path):
    model = make_any(name, Walk())
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", **({"dataset": model.dataset} if name in (*OFFLINE, "GAIL") else {}))
    with pytest.raises(ValueError, match=rf"^env: pass it to {name}\.load\(\.\.\., env=\.\.\.\)"):
        loaded.learn(10)
