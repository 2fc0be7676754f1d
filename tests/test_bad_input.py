"""Each mistake gives one exception that names the argument and the remedy, before anything is lost."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env

from sb3_chac import DSAC
from sb3_chac.envs.safedrive import SafeDriveEnv


def small():
    return dict(net_arch=[8])  # SB3 writes into it


class OneStep(gym.Env):
    """An environment whose observation or reward goes wrong at a given step."""

    observation_space: spaces.Space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, action_space=None, bad_obs_at=None, bad_reward_at=None, bad_value=np.nan, terminate_at=None):
        self.action_space = action_space or spaces.Box(-1, 1, (1,), np.float32)
        self.bad_obs_at, self.bad_reward_at, self.bad_value = bad_obs_at, bad_reward_at, bad_value
        self.terminate_at = terminate_at
        self.steps = 0

    def obs(self):
        return np.array([0.0, self.bad_value if self.steps == self.bad_obs_at else 0.5], np.float32)

    def reset(self, seed=None, options=None):
        obs = self.obs()
        if self.terminate_at:
            obs = np.zeros(2, np.float32)
        return obs, {}

    def step(self, action):
        self.steps += 1
        reward = self.bad_value if self.steps == self.bad_reward_at else 1.0
        return self.obs(), reward, self.steps == self.terminate_at, False, {}


class OneStepDict(OneStep):
    observation_space = spaces.Dict({"camera": OneStep.observation_space, "speed": OneStep.observation_space})

    def obs(self):
        return {"camera": np.zeros(2, np.float32), "speed": super().obs()}


@pytest.mark.parametrize(
    "action_space, message",
    [
        (spaces.Discrete(3), r"env: .*continuous .*Box.*Discrete\(3\).*DQN"),
        (spaces.MultiBinary(2), "env: .*continuous"),
        (spaces.Box(-np.inf, np.inf, (1,), np.float32), "env: .*finite bounds.*ClipAction"),
        (spaces.Box(np.array([0, 1.0]), np.array([1, 1.0])), "env: .*low < high"),
    ],
)
def test_action_spaces(action_space, message):
    with pytest.raises(ValueError, match=message):
        DSAC("MlpPolicy", OneStep(action_space))


@pytest.mark.parametrize(
    "kwargs",
    [
        {"learning_rate": -3e-4},
        {"learning_rate": float("nan")},
        {"learning_rate": "3e-4"},
        {"learning_rate": lambda remaining: remaining - 0.5},
        {"ent_coef_lr": -1.0},
        {"buffer_size": 0},
        {"batch_size": -1},
        {"learning_starts": -1},
        {"tau": 1.5},
        {"gamma": -0.1},
        {"gradient_steps": -2},
        {"n_steps": 0},
        {"ent_coef": "automatic"},
        {"ent_coef": "auto_-1"},
        {"ent_coef": -0.1},
        {"target_entropy": "low"},
        {"target_update_interval": 0},
        {"policy_delay": 0},
        {"policy_delay": 1.5},
        {"eta": 0.0},
        {"tau_b": 2.0},
    ],
    ids=lambda kwargs: "-".join(f"{name}={value if not callable(value) else 'schedule'}" for name, value in kwargs.items()),
)
def test_arguments_out_of_range(kwargs):
    (name,) = kwargs
    with pytest.raises(ValueError, match=rf"^{name} must be"):
        DSAC("MlpPolicy", "Pendulum-v1", policy_kwargs=small(), **kwargs)


def test_schedule_that_goes_negative_names_the_remedy():
    with pytest.raises(ValueError, match=r"learning_rate must be .*got -0.5.*schedule that stays positive"):
        DSAC("MlpPolicy", "Pendulum-v1", learning_rate=lambda remaining: remaining - 0.5)


def test_zero_learning_rate_is_allowed():
    """RL-Zoo3's enjoy loads models with it."""
    assert DSAC("MlpPolicy", "Pendulum-v1", learning_rate=0.0, policy_kwargs=small()).lr_schedule(1) == 0


@pytest.mark.parametrize("algorithm", [SAC, PPO])
def test_checkpoint_of_another_algorithm(tmp_path, algorithm):
    algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=small()).save(tmp_path / "other")
    with pytest.raises(
        ValueError, match=r"policy: DSAC needs a DSACPolicy, got (SACPolicy|ActorCriticPolicy).*class that saved it"
    ):
        DSAC.load(tmp_path / "other")


@pytest.mark.parametrize("other", ["SAC", "other net_arch", "fixed ent_coef"])
def test_parameters_of_another_model_change_nothing(tmp_path, other):
    model = DSAC("MlpPolicy", "Pendulum-v1", policy_kwargs=small())
    before = {name: param.clone() for name, param in model.policy.state_dict().items()}
    saved = {
        "SAC": lambda: SAC("MlpPolicy", "Pendulum-v1", policy_kwargs=small()),
        "other net_arch": lambda: DSAC("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[9])),
        "fixed ent_coef": lambda: DSAC("MlpPolicy", "Pendulum-v1", policy_kwargs=small(), ent_coef=0.1),
    }[other]()
    saved.save(tmp_path / "other")
    with pytest.raises(ValueError, match=r"set_parameters: not the parameters of this DSAC.*Nothing was changed"):
        model.set_parameters(tmp_path / "other.zip")
    assert all((before[name] == param).all() for name, param in model.policy.state_dict().items())


def test_missing_and_broken_checkpoints(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.zip"):
        DSAC.load(tmp_path / "nowhere")
    (tmp_path / "broken.zip").write_bytes(b"not a zip file")
    with pytest.raises(ValueError, match=r"broken\.zip|wasn't a zip-file"):
        DSAC.load(tmp_path / "broken.zip")


@pytest.mark.parametrize("bad_value", [np.nan, np.inf])
@pytest.mark.parametrize(
    "env, message",
    [
        (dict(bad_reward_at=12), "reward of environment 0 is NaN or infinite at step 12: mend the environment"),
        (dict(bad_obs_at=12), "observation of environment 0 is NaN or infinite at step 12"),
        (dict(bad_obs_at=12, terminate_at=12), "terminal observation of environment 0 is NaN or infinite at step 12"),
        (dict(bad_obs_at=0), "observation of environment 0 is NaN or infinite at step 0"),
    ],
)
def test_nan_never_reaches_the_replay_buffer(env, message, bad_value, tmp_path):
    model = DSAC("MlpPolicy", OneStep(**env, bad_value=bad_value), policy_kwargs=small(), buffer_size=50, learning_starts=5)
    with pytest.raises(ValueError, match=message):
        model.learn(40)
    stored = model.replay_buffer.pos
    assert stored == max(env.values()) - 1 if max(env.values()) else stored == 0
    assert np.isfinite(model.replay_buffer.next_observations).all() and np.isfinite(model.replay_buffer.rewards).all()
    model.save(tmp_path / "kept")
    assert DSAC.load(tmp_path / "kept")._n_updates == model._n_updates


def test_nan_in_a_dict_observation_names_the_key_and_the_environment():
    envs = [lambda: OneStepDict(), lambda: OneStepDict(bad_obs_at=3)]
    env = make_vec_env(lambda: envs.pop(0)(), n_envs=2)
    model = DSAC("MultiInputPolicy", env, policy_kwargs=small(), buffer_size=50)
    with pytest.raises(ValueError, match=r"observation 'speed' of environment 1 is NaN or infinite at step 6"):
        model.learn(20)


@pytest.mark.parametrize(
    "action", [[np.nan, 0], [0, np.inf], [0], [0, 0, 0], "left", None, [0, 1j], np.array([0, 1j]), ["0", "1"]]
)
def test_actions_that_are_none_do_not_move_the_car(action):
    env = SafeDriveEnv(horizon=5)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^action must be two finite numbers.*got.*did not make a step"):
        env.step(action)
    assert env.steps == 0
