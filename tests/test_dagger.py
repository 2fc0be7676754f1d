"""HG-DAgger and IWR: rounds of takeovers, and what is learned from them."""

import numpy as np
import pytest
import torch as th
from guided_toys import Limited, Tracking, scripted, tracking_expert
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from takeover_toys import EXPERT, DictIntegrator, constant

from sb3_chac import IWR, HGDagger, InterventionWrapper
from sb3_chac.common.demonstrations import Demonstrations
from sb3_chac.common.minari_datasets import DatasetError
from sb3_chac.iwr.iwr import class_weights

each_algorithm = pytest.mark.parametrize("algorithm", [HGDagger, IWR])


def small(algorithm, env=None, **kwargs):
    """The human drives every third step after a warm-up of 6 steps, a round has 4 steps of the human."""
    kwargs = {"warm_up_steps": 6, "round_human_steps": 4, "n_rounds": 2, "n_epochs": 3, "batch_size": 4, "seed": 0, **kwargs}
    kwargs = {"buffer_size": 500, "policy_kwargs": {"net_arch": [8]}, "device": "cpu", **kwargs}
    return algorithm("MlpPolicy", scripted("001" * 500) if env is None else env, **kwargs)


class Fits(BaseCallback):
    """Remembers the step at which each round began, and the weights then."""

    def __init__(self):
        super().__init__()
        self.steps, self.weights = [], []

    def _on_rollout_start(self):
        while len(self.steps) < self.model.round:
            self.steps.append(self.num_timesteps)
            self.weights.append(next(self.model.policy.parameters()).detach().clone())

    def _on_step(self):
        return True


def demonstrations(n=50):
    rng = np.random.default_rng(0)
    observations = rng.uniform(-1, 1, (n, 2)).astype(np.float32)
    ends = np.arange(n) % 10 == 9
    return Demonstrations(
        Tracking.observation_space,
        Tracking.action_space,
        observations,
        tracking_expert(observations),
        np.roll(observations, -1, axis=0),
        rewards=np.zeros(n),
        terminations=ends & (np.arange(n) < 20),
        truncations=ends & (np.arange(n) >= 20),
        episodes=np.arange(n) // 10,
    )


def test_class_weights():
    weights = class_weights(np.array([True, False, False, True, False, False, False, False]))
    np.testing.assert_allclose(weights, [1 / 4, 1 / 12, 1 / 12, 1 / 4, 1 / 12, 1 / 12, 1 / 12, 1 / 12], rtol=1e-12)
    for is_human in (True, False):
        np.testing.assert_allclose(class_weights(np.full(4, is_human)), [0.25] * 4)
    assert len(class_weights(np.zeros(0, bool))) == 0


@each_algorithm
def test_rounds(algorithm):
    fits = Fits()
    model = small(algorithm).learn(200, fits)
    human, novice = model.replay_buffer.human, model.replay_buffer.novice
    # All of the warm-up is the human's, then every third step
    assert fits.steps == [6, 18]  # the third fit is the end
    assert model.num_timesteps == 30 and model.round == 3 and model.is_finished
    assert len(human) == 6 + 4 + 4 and len(novice) == 16
    assert model.counts["human_steps"] == 14 and model.demonstrated_rows == 6
    assert (human.arrays["action"][:14] == EXPERT).all()
    n_samples = {HGDagger: [6, 10, 14], IWR: [6, 18, 30]}[algorithm]
    assert model._n_updates == sum(3 * -(-n // 4) for n in n_samples)
    assert not th.equal(*fits.weights)
    # Nobody drives an evaluation, and there is nothing left to do
    assert not model.env.envs[0].armed
    assert model.learn(100).num_timesteps == 0
    model.n_rounds = 3
    assert model.learn(100).num_timesteps == 12 and model.round == 4


def test_what_is_learned_from():
    """HG-DAgger imitates the human alone, IWR also the novice where it was left to drive."""
    for algorithm, n in ((HGDagger, 14), (IWR, 30)):
        model = small(algorithm).learn(200)
        observations, actions, weights = model._training_set()
        assert observations.shape == (n, 2) and actions.shape == (n, 2)
        assert (actions[:14] == EXPERT).all()
        if algorithm is HGDagger:
            assert weights is None
            continue
        np.testing.assert_array_equal(actions[14:], model.replay_buffer.novice.arrays["action"][:16])
        # The human has half of the weight, the novice the other half
        np.testing.assert_allclose(weights, [0.5 / 14] * 14 + [0.5 / 16] * 16)


@each_algorithm
def test_an_unfinished_round_is_learned_from(algorithm):
    model = small(algorithm).learn(9)
    assert model.round == 1 and model._n_updates == 3 * 2 + 3 * {HGDagger: 2, IWR: 3}[algorithm]
    assert small(algorithm, warm_up_steps=100).learn(8)._n_updates == 3 * 2
    assert small(algorithm, n_rounds=None).learn(100).num_timesteps == 100
    assert small(algorithm, n_rounds=0).learn(100).num_timesteps == 6


def tracking(rule, **kwargs):
    return InterventionWrapper(Tracking(), tracking_expert, rule, **kwargs)


def far_from_expert(observation, novice_action, expert_action):
    return np.abs(novice_action - expert_action).max() > 0.2


@each_algorithm
@pytest.mark.parametrize("loss", ["mse", "nll"])
def test_learns_from_takeovers(algorithm, loss):
    model = small(
        algorithm, tracking(far_from_expert), loss=loss, warm_up_steps=200, round_human_steps=100, n_rounds=3, n_epochs=40,
        batch_size=64, learning_rate=3e-3, policy_kwargs={"net_arch": [32, 32]}, buffer_size=5000,
    ).learn(5000)  # fmt: skip
    observations = np.random.default_rng(1).uniform(-1, 1, (200, 2)).astype(np.float32)
    errors = np.abs(model.predict(observations, deterministic=True)[0] - tracking_expert(observations))
    assert errors.mean() < 0.1


@each_algorithm
def test_a_dataset_in_place_of_the_warm_up(algorithm):
    data = demonstrations()
    model = small(algorithm, tracking("always"), warm_up_steps=None, dataset=data, n_rounds=1)
    human = model.replay_buffer.human
    assert model.warm_up_steps == 0 and len(human) == 50
    np.testing.assert_array_equal(human.arrays["observation/"][:50], data.observations)
    np.testing.assert_allclose(human.arrays["action"][:50], data.actions, atol=1e-6)
    np.testing.assert_array_equal(human.arrays["done"][:50, 0], data.terminations)  # not at time limits
    fits = Fits()
    model.learn(100, fits)
    assert fits.steps == [0] and model.num_timesteps == 4  # it is fitted before it drives
    assert model.demonstrated_rows == 50 and len(human) == 54 and model.counts["human_steps"] == 4
    # Both, if asked for
    model = small(algorithm, tracking("always"), dataset=data).learn(6)
    assert model.round == 1 and len(model.replay_buffer.human) == model.demonstrated_rows == 56
    with pytest.raises(DatasetError, match="does not fit the environment"):
        small(algorithm, dataset=data)


@each_algorithm
def test_save_load_and_go_on(algorithm, tmp_path):
    model = small(algorithm).learn(8)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = algorithm.load(tmp_path / "model", env=scripted("001" * 500))
    assert (loaded.round, loaded.demonstrated_rows, loaded.counts) == (1, 6, model.counts)
    loaded.load_replay_buffer(tmp_path / "buffer")
    observations = np.random.default_rng(0).normal(size=(5, 2)).astype(np.float32)
    np.testing.assert_array_equal(loaded.predict(observations)[0], model.predict(observations)[0])
    loaded.learn(100, reset_num_timesteps=False)
    assert loaded.is_finished and len(loaded.replay_buffer.human) == 14
    forgetful = algorithm.load(tmp_path / "model", env=scripted("001" * 500))
    with pytest.warns(UserWarning, match="they will be forgotten"):
        forgetful.learn(5, reset_num_timesteps=False)


@each_algorithm
def test_deterministic(algorithm):
    states = [list(small(algorithm, seed=seed).learn(200).policy.state_dict().values()) for seed in (0, 0, 1)]
    assert all(th.equal(one, two) for one, two in zip(states[0], states[1], strict=True))
    assert not all(th.equal(one, two) for one, two in zip(states[0], states[2], strict=True))


def test_several_environments_and_normalization():
    env = VecNormalize(DummyVecEnv([lambda: tracking("always") for _ in range(3)]))
    model = small(
        HGDagger, env, n_epochs=60, policy_kwargs={"net_arch": [32]}, learning_rate=1e-2, warm_up_steps=300, n_rounds=0
    )
    model.learn(1000)
    assert model.num_timesteps == 300 and len(model.replay_buffer.human) == 300
    raw = np.random.default_rng(1).uniform(-1, 1, (100, 2)).astype(np.float32)
    np.testing.assert_array_equal(model.replay_buffer.human.arrays["observation/"][:300].max() <= 1.0, True)
    errors = np.abs(model.predict(env.normalize_obs(raw), deterministic=True)[0] - tracking_expert(raw))
    assert errors.mean() < 0.15


def test_actions_of_other_bounds():
    low, high = np.array([-2.0, 0.0]), np.array([2.0, 4.0])
    env = scripted("0", low=low, high=high, expert=lambda observation: np.array([1.0, 3.0]))
    model = small(HGDagger, env, warm_up_steps=50, n_rounds=0, n_epochs=100, learning_rate=1e-2).learn(100)
    np.testing.assert_allclose(model.replay_buffer.human.arrays["action"][:50], [[0.5, 0.5]] * 50)
    action, _ = model.predict(np.zeros(2, np.float32), deterministic=True)
    np.testing.assert_allclose(action, [1.0, 3.0], atol=0.1)


def test_logs(tmp_path):
    model = small(HGDagger)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(200)
    header, *lines = [line.split(",") for line in (tmp_path / "progress.csv").read_text().splitlines()]
    rows = [dict(zip(header, line, strict=True)) for line in lines]
    assert [row["train/round"] for row in rows] == ["0", "1", "2"]
    assert [row["train/samples"] for row in rows] == ["6", "10", "14"]
    assert [float(row["takeover/human_steps"]) for row in rows] == [6, 10, 14]
    assert all(float(row["train/loss"]) >= 0 for row in rows)


def test_progress_bar_tells_the_round(capsys):
    from sb3_chac.common.callbacks import GuidedProgressBar

    bar = GuidedProgressBar()
    model = small(HGDagger).learn(8, bar)
    assert bar.text().startswith("round 1, human 75 % (6 steps)") and model.round == 1


@each_algorithm
def test_mistakes(algorithm):
    for name, value in [
        ("warm_up_steps", -1),
        ("round_human_steps", 0),
        ("n_rounds", -1),
        ("n_epochs", 0),
        ("loss", "mae"),
        ("weight_decay", -1.0),
        ("learning_rate", -1.0),
        ("batch_size", 0),
    ]:
        with pytest.raises(ValueError, match=rf"^{name} must be"):
            small(algorithm, **{name: value})
    with pytest.raises(ValueError, match="need Box observations"):
        small(algorithm, InterventionWrapper(DictIntegrator(), constant, "never"))
    with pytest.warns(UserWarning, match="no human is in the loop"):
        small(algorithm, DummyVecEnv([Limited])).learn(5)


def test_images():
    class Camera(Limited):
        observation_space = spaces.Box(0, 255, (36, 36, 1), np.uint8)

        def obs(self):
            return self.observation_space.sample()

    model = HGDagger(
        "CnnPolicy", InterventionWrapper(Camera(), constant, "always"), warm_up_steps=8, n_rounds=0, n_epochs=1, batch_size=4
    ).learn(20)
    assert model._n_updates == 2 and model.predict(np.zeros((36, 36, 1), np.uint8))[0].shape == (2,)
