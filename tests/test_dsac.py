"""DSAC by behaviour: what SB3's users expect of an off-policy algorithm, beyond what test_sb3_suite.py borrows from SB3."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv, FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

from sb3_chac import DSAC


def make_model(env="Pendulum-v1", **kwargs) -> DSAC:
    kwargs = {
        "learning_starts": 20,
        "batch_size": 16,
        "buffer_size": 500,
        "seed": 0,
        "policy_kwargs": dict(net_arch=[16]),
        **kwargs,
    }
    return DSAC(kwargs.pop("policy", "MlpPolicy"), env, **kwargs)


def assert_same_parameters(a: DSAC, b: DSAC, same: bool = True) -> None:
    a_params, b_params = a.policy.state_dict(), b.policy.state_dict()
    assert a_params.keys() == b_params.keys()
    assert all(th.equal(a_params[key], b_params[key]) for key in a_params) == same


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"use_sde": True, "sde_sample_freq": 4, "use_sde_at_warmup": True},
        {"action_noise": NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))},
        {"n_steps": 3},
        {"ent_coef": "auto_0.1", "target_entropy": -2.0, "ent_coef_lr": lambda remaining: 1e-3 * remaining},
        {"ent_coef": 0.0},
        {"learning_rate": lambda remaining: 1e-3 * remaining},
        {"train_freq": (1, "episode"), "gradient_steps": -1},
        {"policy_delay": 3, "target_update_interval": 2, "eta": 3.0, "tau_b": 0.1},
        {"policy_kwargs": dict(net_arch=dict(pi=[8], qf=[16, 16]), n_critics=3, activation_fn=th.nn.ReLU)},
        {"policy_kwargs": dict(net_arch=[16], optimizer_class=th.optim.RMSprop, optimizer_kwargs=dict(alpha=0.9))},
        {"replay_buffer_kwargs": dict(handle_timeout_termination=False), "optimize_memory_usage": True},
    ],
)
def test_learns_saves_and_loads(kwargs, tmp_path):
    model = make_model(**kwargs)
    initial = {name: param.clone() for name, param in model.policy.state_dict().items()}
    model.learn(250)
    trained = model.policy.state_dict()
    assert all(th.isfinite(param).all() for param in trained.values())
    for part in ("actor.", "actor_target.", "critic.", "critic_target."):
        assert any(not th.equal(trained[name], initial[name]) for name in trained if name.startswith(part)), part
    assert all((trained["critic.mean_std"] > 0).flatten())

    model.save(tmp_path / "model")
    loaded = DSAC.load(tmp_path / "model", env=model.get_env())
    assert_same_parameters(model, loaded)
    obs = model.get_env().reset()
    assert np.array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    loaded.learn(50, reset_num_timesteps=False)
    assert loaded.num_timesteps >= 300
    assert loaded._n_updates > model._n_updates


def test_defaults_are_the_papers():
    model = DSAC("MlpPolicy", "Pendulum-v1")
    hidden = [layer.out_features for layer in model.actor.latent_pi if isinstance(layer, th.nn.Linear)]
    assert hidden == [256, 256, 256]
    assert isinstance(model.actor.latent_pi[1], th.nn.GELU)
    assert model.critic.n_critics == 2
    assert (model.lr_schedule(1), model.ent_coef_lr, model.gamma, model.tau) == (1e-4, 3e-4, 0.99, 0.005)
    assert (model.policy_delay, model.batch_size, model.buffer_size, model.eta) == (2, 256, 1_000_000, 1.0)
    assert model.target_entropy == -1.0
    assert model.log_ent_coef.exp().item() == 1.0


@pytest.mark.parametrize("policy, n_envs", [("CnnPolicy", 1), ("MultiInputPolicy", 2), ("MlpPolicy", 3)])
def test_policies_and_parallel_environments(policy, n_envs):
    make_env = {
        "CnnPolicy": lambda: FakeImageEnv(screen_height=40, screen_width=40, n_channels=1, discrete=False),
        "MultiInputPolicy": lambda: SimpleMultiObsEnv(discrete_actions=False, channel_last=False),
        "MlpPolicy": lambda: gym.make("Pendulum-v1"),
    }[policy]
    model = make_model(make_vec_env(make_env, n_envs=n_envs), policy=policy, train_freq=4, gradient_steps=2)
    model.learn(80)
    assert model._n_updates > 0
    assert model.predict(model.get_env().reset())[0].shape == (n_envs, *model.action_space.shape)


def test_shared_features_extractor_learns_from_the_actor_alone():
    env = FakeImageEnv(screen_height=40, screen_width=40, n_channels=1, discrete=False)
    kwargs = dict(net_arch=[16], share_features_extractor=True, features_extractor_kwargs=dict(features_dim=8))
    model = make_model(env, policy="CnnPolicy", policy_kwargs=kwargs, learning_starts=100, policy_delay=2)
    model.learn(30)
    assert model.actor.features_extractor is model.critic.features_extractor
    before = [param.clone() for param in model.actor.features_extractor.parameters()]
    model.train(gradient_steps=1, batch_size=8)  # critics only
    assert all(th.equal(a, b) for a, b in zip(before, model.actor.features_extractor.parameters(), strict=True))
    model.train(gradient_steps=1, batch_size=8)  # critics and actor
    assert not any(th.equal(a, b) for a, b in zip(before, model.actor.features_extractor.parameters(), strict=True))


def test_hindsight_experience_replay():
    env = BitFlippingEnv(n_bits=3, continuous=True)
    model = make_model(env, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer)
    model.learn(100)
    assert model._n_updates > 0


def test_n_steps_uses_sb3s_buffer():
    assert isinstance(make_model(n_steps=4).replay_buffer, NStepReplayBuffer)


def test_policy_delay():
    """Critics move every gradient step; actor, entropy coefficient and all targets every policy_delay-th."""
    model = make_model(policy_delay=3, learning_starts=100).learn(50)
    names = ["critic.", "actor.", "log_ent_coef", "critic_target.z", "actor_target."]
    for step in range(1, 7):
        before = {name: param.clone() for name, param in model.policy.state_dict().items()}
        model.train(gradient_steps=1, batch_size=16)
        after = model.policy.state_dict()
        moved = {prefix: any(not th.equal(before[n], after[n]) for n in before if n.startswith(prefix)) for prefix in names}
        assert moved == {prefix: prefix == "critic." or step % 3 == 0 for prefix in names}


@pytest.mark.parametrize("use_sde", [False, True])
def test_same_seed_same_run(use_sde):
    a, b, other = (make_model(use_sde=use_sde, seed=seed).learn(150) for seed in (3, 3, 4))
    assert_same_parameters(a, b)
    assert_same_parameters(a, other, same=False)


@pytest.mark.parametrize("through_set_parameters", [False, True])
def test_training_goes_on_as_if_never_saved(tmp_path, through_set_parameters):
    """Networks, targets, running stds, entropy coefficient, all optimizers and the phase of the policy delay."""
    model = make_model(policy_delay=2).learn(101)  # an odd number of gradient steps
    assert model._n_updates % 2 == 1
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    if through_set_parameters:
        resumed = make_model(seed=7)
        resumed.set_parameters(tmp_path / "model")
        resumed._n_updates = model._n_updates
    else:
        resumed = DSAC.load(tmp_path / "model")
    resumed.load_replay_buffer(tmp_path / "buffer")
    assert_same_parameters(model, resumed)
    for each in (model, resumed):
        each.set_logger(configure(None, []))
        set_random_seed(0)
        each.train(gradient_steps=9, batch_size=16)
    assert_same_parameters(model, resumed)


def test_vec_normalize_stores_unnormalized_transitions(tmp_path):
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=2, seed=0))
    model = make_model(env, gradient_steps=2).learn(200)
    rewards = model.replay_buffer.rewards[: model.replay_buffer.pos]
    assert rewards.min() < -2  # Pendulum's own scale, VecNormalize's is below 1 here
    assert model.replay_buffer.sample(8, env).rewards.abs().max() < 5


class EightStepsOfOne(gym.Env):
    """Reward 1 for ever, one state; cut off every 8 steps by the time limit."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(1, np.float32), 1.0, False, self.steps >= 8, {}


def test_time_limits_do_not_end_the_return():
    """Bootstrapped through the time limit the value is 1 / (1 - gamma) = 10, cut off there it would be at most 5.7."""
    kwargs = dict(gamma=0.9, tau=0.5, learning_rate=1e-2, ent_coef=0.0, policy_delay=1)
    model = make_model(EightStepsOfOne(), **kwargs).learn(1000)
    q_values, _ = model.critic(th.zeros(1, 1), th.zeros(1, 1))
    assert q_values.mean().item() == pytest.approx(10, abs=1)


def test_logs_what_the_critic_learns(tmp_path):
    model = make_model(policy_delay=2)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(450, log_interval=1)
    header = (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")
    names = ("n_updates", "critic_nll", "q_mean", "sigma_mean", "actor_loss", "entropy", "ent_coef", "learning_rate")
    assert {f"train/{name}" for name in names} <= set(header)


def test_masters_a_toy_task():
    """Hit the target that the observation shows; the best return of an episode is 0, a random one near -10."""

    class Hit(gym.Env):
        observation_space = spaces.Box(-1, 1, (1,), np.float32)
        action_space = spaces.Box(-2, 2, (1,), np.float32)

        def reset(self, seed=None, options=None):
            super().reset(seed=seed)
            self.obs = self.np_random.uniform(-1, 1, 1).astype(np.float32)
            self.steps = 0
            return self.obs, {}

        def step(self, action):
            reward = -float(abs(action - self.obs).item())
            self.obs = self.np_random.uniform(-1, 1, 1).astype(np.float32)
            self.steps += 1
            return self.obs, reward, False, self.steps >= 10, {}

    model = make_model(Hit(), learning_rate=3e-3, gamma=0.5, batch_size=64, buffer_size=5000, ent_coef=0.01).learn(1500)
    assert evaluate_policy(model, model.get_env(), n_eval_episodes=20)[0] > -1.5
