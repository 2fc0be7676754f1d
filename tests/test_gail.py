"""GAIL: PPO with the reward of a discriminator."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_chac import GAIL
from sb3_chac.common.demonstrations import Demonstrations
from sb3_chac.common.minari_datasets import DatasetError
from sb3_chac.gail.discriminator import Discriminator, discriminator_loss, imitation_rewards

LOW, HIGH = np.array([-1.0, 0.0], np.float32), np.array([1.0, 10.0], np.float32)


class Walk(gym.Env):
    """Somewhere else at each step. Episodes are cut off after five steps; the reward of the environment is 100."""

    observation_space: spaces.Space = spaces.Box(-1, 1, (3,), np.float32)
    action_space: spaces.Space = spaces.Box(LOW, HIGH)

    def obs(self):
        return self.np_random.uniform(-1, 1, 3).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.obs(), {}

    def step(self, action):
        self.steps += 1
        return self.obs(), 100.0, False, self.steps == 5, {}


class Buttons(Walk):
    action_space = spaces.Discrete(3)


def expert(observations):
    """:return: scaled to [-1, 1]"""
    return np.clip(observations @ np.array([[0.5, -0.3], [0.2, 0.4], [0.0, 0.3]], np.float32), -1, 1)


def demonstrations(n=200, env=Walk, actions=None, observations=None):
    if observations is None:
        observations = np.random.default_rng(1).uniform(-1, 1, (n, 3)).astype(np.float32)
    if actions is None:
        actions = (LOW + (expert(observations) + 1) / 2 * (HIGH - LOW)).astype(np.float32)
    ends = np.arange(n) % 5 == 4
    return Demonstrations(
        env.observation_space,
        env.action_space,
        observations,
        actions,
        np.roll(observations, -1, axis=0),
        rewards=np.zeros(n),
        terminations=np.zeros(n, bool),
        truncations=ends,
        episodes=np.arange(n) // 5,
    )


def small(dataset=None, env=None, **kwargs):
    kwargs = {"n_steps": 16, "batch_size": 16, "n_epochs": 2, "disc_batch_size": 32, "n_disc_updates": 2, "seed": 0, **kwargs}
    kwargs = {"policy_kwargs": {"net_arch": [8]}, "disc_kwargs": {"net_arch": [16]}, "device": "cpu", **kwargs}
    return GAIL("MlpPolicy", env or Walk(), demonstrations() if dataset is None else dataset, **kwargs)


def test_reward():
    for d in (0.1, 0.5, 0.9, 0.999):
        reward = imitation_rewards(th.tensor([math.log(d / (1 - d))], dtype=th.float64))
        assert reward.item() == pytest.approx(-math.log(1 - d))
    # The expert's get more; large logits do not overflow
    np.testing.assert_allclose(imitation_rewards(th.tensor([-1000.0, 0.0, 1000.0])), [0.0, math.log(2), 1000.0])


def test_discriminator_loss():
    expert_d, policy_d = np.array([0.9, 0.6]), np.array([0.2, 0.7])
    expert_logits, policy_logits = (th.tensor(np.log(d / (1 - d))) for d in (expert_d, policy_d))
    expected = -(np.log(expert_d).mean() + np.log(1 - policy_d).mean()) / 2
    assert discriminator_loss(expert_logits, policy_logits).item() == pytest.approx(expected)
    # It falls where the expert's logits grow and the policy's shrink
    assert discriminator_loss(expert_logits + 1, policy_logits - 1) < discriminator_loss(expert_logits, policy_logits)


def test_inputs_of_the_discriminator():
    network = Discriminator(Walk.observation_space, Walk.action_space, lambda _: 1e-3)
    observations = th.tensor([[0.1, 0.2, 0.3], [0.3, 0.2, -0.1]])
    network.normalize_by(observations.numpy())
    scaled, actions = network.inputs(observations, th.tensor([[0.5, 7.5], [3.0, -1.0]]))  # the second is clipped
    np.testing.assert_allclose(scaled, [[-1, 0, 1], [1, 0, -1]], atol=1e-5)
    np.testing.assert_allclose(actions, [[0.5, 0.5], [1.0, -1.0]])
    network = Discriminator(Buttons.observation_space, Buttons.action_space, lambda _: 1e-3)
    _, actions = network.inputs(observations, th.tensor([[2.0], [0.0]]))  # as in the rollout buffer
    np.testing.assert_array_equal(actions, [[0, 0, 1], [1, 0, 0]])


def test_gradient_penalty():
    model = small(disc_kwargs={"net_arch": []}, gradient_penalty=1.0)
    (layer,) = model.discriminator.logits
    layer.weight.data = th.tensor([[3.0, 0.0, 0.0, 4.0, 0.0]])  # a linear logit, the norm of its gradient is 5
    inputs = [(th.rand(4, 3), th.rand(4, 2)) for _ in range(2)]
    assert model._penalty(*inputs).item() == pytest.approx((5 - 1) ** 2)
    norms = []
    for weight in (0.0, 10.0):
        layer = small(disc_kwargs={"net_arch": []}, gradient_penalty=weight, disc_learning_rate=0.05).learn(400).discriminator
        norms.append(layer.logits[0].weight.norm().item())
    assert abs(norms[1] - 1) < 0.2 < abs(norms[0] - 1)


class Rollout(GAIL):
    """Looks at the rollout before PPO learns from it."""

    def train(self):
        observations, actions = self._rollout_inputs()
        with th.no_grad():
            expected = imitation_rewards(self._logits(observations, actions)).numpy().reshape(16, 2)
            expected = expected + self._beyond_time_limits
        np.testing.assert_allclose(self.rollout_buffer.rewards, expected, rtol=1e-5)
        self.checked = self.rollout_buffer.returns.copy(), expected, self.rollout_buffer.values.copy()
        super().train()


def test_rewards_of_the_rollout():
    env = DummyVecEnv([Walk, Walk])
    model = Rollout(
        "MlpPolicy", env, demonstrations(), n_steps=16, batch_size=16, gae_lambda=1.0, gamma=0.9, seed=0, disc_batch_size=20
    ).learn(32)
    returns, rewards, _ = model.checked
    # Time limits after steps 4, 9 and 14; what comes after them counts, but not as part of the episode
    limits = np.flatnonzero(model._beyond_time_limits.any(axis=1))
    np.testing.assert_array_equal(limits, [4, 9, 14])
    np.testing.assert_allclose(returns[4], rewards[4], rtol=1e-5)
    for step in (0, 3, 8):
        np.testing.assert_allclose(returns[step], rewards[step] + 0.9 * returns[step + 1], rtol=1e-4)
    assert rewards.max() < 50  # that of the environment is 100
    assert model.ep_info_buffer is not None


def test_imitates():
    model = GAIL(
        "MlpPolicy", DummyVecEnv([Walk] * 4), demonstrations(2000), n_steps=64, batch_size=64, n_epochs=5, learning_rate=3e-3,
        gamma=0.0, seed=0, policy_kwargs=dict(net_arch=[32], log_std_init=-1.0), disc_batch_size=256,
        disc_kwargs=dict(net_arch=[64]), disc_learning_rate=3e-3, gradient_penalty=1.0, n_disc_updates=32, device="cpu",
    )  # fmt: skip
    observations = np.random.default_rng(2).uniform(-1, 1, (500, 3)).astype(np.float32)

    def error():
        actions, _ = model.predict(observations, deterministic=True)
        return np.abs(2 * (actions - LOW) / (HIGH - LOW) - 1 - expert(observations)).mean()

    before = error()
    model.learn(20_000)
    assert error() < 0.15 < 0.3 < before


def test_imitates_with_discrete_actions():
    dataset = demonstrations(1000, Buttons, np.zeros(1000, np.int64))
    dataset.actions[:] = (dataset.observations[:, 0] > -0.3) + (dataset.observations[:, 0] > 0.3).astype(int)
    model = small(
        dataset, DummyVecEnv([Buttons] * 4), n_steps=64, batch_size=64, n_epochs=5, learning_rate=3e-3, gamma=0.0,
        disc_learning_rate=3e-3, disc_batch_size=256, n_disc_updates=8, disc_kwargs={"net_arch": [64]},
    ).learn(10_000)  # fmt: skip
    observations = np.array([[-0.8, 0, 0], [0.0, 0, 0], [0.8, 0, 0]], np.float32)
    assert model.predict(observations, deterministic=True)[0].tolist() == [0, 1, 2]


def test_save_load_and_go_on(tmp_path):
    model = small().learn(32)
    model.save(tmp_path / "model")
    assert (tmp_path / "model.zip").stat().st_size < 100_000  # without the dataset
    loaded = GAIL.load(tmp_path / "model", env=Walk())
    for name in ("policy", "discriminator"):
        for key, value in model.get_parameters()[name].items():
            assert th.equal(value, loaded.get_parameters()[name][key]), key
    assert loaded.get_parameters()["discriminator.optimizer"]["state"]
    with pytest.raises(DatasetError, match="GAIL learns from demonstrations, and has none"):
        loaded.learn(16)
    # One that goes on does as one that was not interrupted
    going_on = GAIL.load(tmp_path / "model", env=Walk(), dataset=demonstrations())
    assert going_on.learn(32, reset_num_timesteps=False).num_timesteps == 64
    by_another = PPO("MlpPolicy", Walk(), n_steps=16, batch_size=16, policy_kwargs={"net_arch": [8]})
    with pytest.raises(ValueError, match="discriminator"):
        model.set_parameters(by_another.get_parameters())


def test_deterministic():
    states = [list(small(seed=seed).learn(48).discriminator.state_dict().values()) for seed in (0, 0, 1)]
    assert all(th.equal(one, two) for one, two in zip(states[0], states[1], strict=True))
    assert not all(th.equal(one, two) for one, two in zip(states[0], states[2], strict=True))


def test_logs_and_callbacks(tmp_path):
    model = small(disc_learning_rate=lambda left: 1e-3 * left)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(
        64, EvalCallback(Walk(), eval_freq=32, n_eval_episodes=1, log_path=str(tmp_path), verbose=0), progress_bar=True
    )
    header, *lines = [line.split(",") for line in (tmp_path / "progress.csv").read_text().splitlines()]
    rows = [dict(zip(header, line, strict=True)) for line in lines if line[header.index("rollout/imitation_reward_mean")]]
    assert len(rows) == 4
    assert all(0 <= float(row["train/disc_accuracy_expert"]) <= 1 for row in rows)
    assert float(rows[-1]["rollout/ep_rew_mean"]) == 500  # the environment's
    assert 0 < float(rows[-1]["rollout/imitation_reward_mean"]) < 5
    assert model.discriminator.optimizer.param_groups[0]["lr"] == pytest.approx(0.25e-3)  # before the last rollout
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [32, 64]


def test_vec_normalize():
    env = VecNormalize(DummyVecEnv([Walk]), norm_reward=False)
    model = small(env=env).learn(64)
    assert (model.discriminator.obs_mean == 0).all()  # it sees what is normalized already
    scaled, _ = model._expert_inputs(np.arange(3))
    np.testing.assert_allclose(scaled, env.normalize_obs(demonstrations().observations[:3]), atol=1e-6)


def test_images():
    class Camera(Walk):
        observation_space = spaces.Box(0, 255, (36, 36, 1), np.uint8)

        def obs(self):
            return self.observation_space.sample()

    images = np.random.default_rng(0).integers(0, 255, (20, 36, 36, 1), np.uint8)
    data = demonstrations(20, Camera, np.tile(LOW, (20, 1)), images)
    model = GAIL("CnnPolicy", Camera(), data, n_steps=8, batch_size=8, n_epochs=1, n_disc_updates=1, disc_batch_size=4).learn(
        8
    )
    assert model.predict(images[0])[0].shape == (2,)


@pytest.mark.parametrize(
    "name, value",
    [
        ("learning_rate", -1.0),
        ("disc_learning_rate", -1.0),
        ("n_disc_updates", 0),
        ("disc_batch_size", 0),
        ("gradient_penalty", -1.0),
    ],
)
def test_arguments_out_of_range(name, value):
    with pytest.raises(ValueError, match=rf"^{name} must be"):
        small(**{name: value})


def test_other_mistakes():
    with pytest.raises(DatasetError, match="GAIL learns from demonstrations, and has none"):
        GAIL("MlpPolicy", Walk())
    with pytest.raises(DatasetError, match="does not fit the environment: the action space differs"):
        small(env=Buttons())
    with pytest.raises(DatasetError, match="need Box observations"):
        small(env=gym.make("Taxi-v4"))
    with pytest.raises(ValueError, match="must have finite bounds"):
        unbounded = Walk()
        unbounded.action_space = spaces.Box(-np.inf, np.inf, (2,))
        small(env=unbounded)
