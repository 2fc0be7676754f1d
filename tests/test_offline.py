"""BC and CQL: learning from demonstrations, without acting."""

import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from scipy import stats
from scipy.special import logsumexp
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_chac.bc import BC
from sb3_chac.bc.policies import gaussian_nll, squared_errors
from sb3_chac.common.checkpoint_files import newest_checkpoint
from sb3_chac.common.checkpoints import ResumableCheckpoint
from sb3_chac.common.demonstrations import Demonstrations
from sb3_chac.common.minari_datasets import DatasetError
from sb3_chac.common.offline import DatasetSampler
from sb3_chac.cql import CQL
from sb3_chac.cql.cql import conservative_gap

LOW, HIGH = np.array([-1.0, 0.0], np.float32), np.array([1.0, 10.0], np.float32)
GAIN = np.array([[0.5, -0.3], [0.2, 0.4], [0.0, 0.3]], np.float32)  # of the expert, in scaled actions


class Board(gym.Env):
    """One step from a random place. Its reward is the first action."""

    observation_space = spaces.Box(-1, 1, (3,), np.float32)
    action_space: spaces.Space = spaces.Box(LOW, HIGH)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(-1, 1, 3).astype(np.float32), {}

    def step(self, action):
        return np.zeros(3, np.float32), float(np.ravel(action)[0]), True, False, {}


class Switch(Board):
    action_space = spaces.Discrete(3, start=1)


def unscaled(actions: np.ndarray) -> np.ndarray:
    return (LOW + (actions + 1) / 2 * (HIGH - LOW)).astype(np.float32)


def demonstrations(n_steps=400, length=10, action_space=Board.action_space, actions=None, noise=0.0, **fields):
    """Steps of a linear expert, in episodes of ``length`` steps."""
    rng = np.random.default_rng(1)
    observations = rng.uniform(-1, 1, (n_steps, 3)).astype(np.float32)
    if actions is None:
        actions = unscaled(np.clip(observations @ GAIN + noise * rng.normal(size=(n_steps, 2)), -1, 1))
    ends = np.arange(n_steps) % length == length - 1
    return Demonstrations(
        Board.observation_space,
        action_space,
        observations,
        actions,
        np.roll(observations, -1, axis=0),
        **{"rewards": rng.normal(size=n_steps), **fields},
        terminations=ends,
        truncations=np.zeros(n_steps, bool),
        episodes=np.arange(n_steps) // length,
    )


def small(algorithm, dataset=None, env=None, **kwargs):
    dataset = demonstrations() if dataset is None else dataset
    return algorithm(
        "MlpPolicy",
        env or Board(),
        dataset=dataset,
        **{"batch_size": 32, "seed": 0, "device": "cpu", "policy_kwargs": {"net_arch": [16]}, **kwargs},
    )


ALGORITHMS = [BC, CQL]


class Calls(BaseCallback):
    def __init__(self, stop_at=math.inf):
        super().__init__()
        self.steps, self.stop_at, self.weights = [], stop_at, []

    def _on_step(self):
        self.steps.append((self.num_timesteps, self.model._n_updates))
        self.weights.append(next(self.model.policy.parameters()).detach().clone())
        return self.num_timesteps < self.stop_at


def logged(model, folder):
    model.set_logger(configure(str(folder), ["csv"]))
    return model


def read_csv(folder) -> dict[str, list[float]]:
    lines = [line.split(",") for line in (folder / "progress.csv").read_text().splitlines()]
    return {
        name: [float(row[column]) if row[column] else math.nan for row in lines[1:]] for column, name in enumerate(lines[0])
    }


def test_squared_errors():
    means, actions = th.tensor([[0.0, 1.0], [2.0, -1.0]]), th.tensor([[1.0, 1.0], [-1.0, 0.0]])
    np.testing.assert_allclose(squared_errors(means, actions), [(1 + 0) / 2, (9 + 1) / 2])


def test_gaussian_nll():
    means, stds, actions = np.array([[0.0, 1.0], [2.0, -1.0]]), np.array([[1.0, 0.5], [2.0, 0.1]]), np.array([[1, 1], [-1, 0]])
    expected = -stats.norm(means, stds).logpdf(actions).sum(axis=1)
    np.testing.assert_allclose(gaussian_nll(*map(th.tensor, (means, np.log(stds), actions))), expected)


def test_conservative_gap_of_hand_made_numbers():
    rng = np.random.default_rng(0)
    sampled, densities, data = rng.normal(size=(2, 4, 6)), rng.uniform(0.1, 3, (4, 6)), rng.normal(size=(2, 4))
    for temperature in (1.0, 0.5):
        expected = np.empty((2, 4))
        for critic in range(2):
            for row in range(4):
                integral = sum(math.exp(sampled[critic, row, i] / temperature) / densities[row, i] for i in range(6)) / 6
                expected[critic, row] = temperature * math.log(integral) - data[critic, row]
        tensors = map(th.tensor, (sampled, np.log(densities), data))
        np.testing.assert_allclose(conservative_gap(*tensors, temperature), expected)
    # Large values do not overflow
    large = conservative_gap(th.tensor([[1e4, 1e4]]), th.zeros(1, 2), th.tensor([0.0]))
    np.testing.assert_allclose(large, 1e4)


def test_conservative_gap_is_the_integral():
    """Of exp(Q) with Q(b) = -3 b^2, from uniform and from Gaussian samples at once."""
    rng = np.random.default_rng(0)
    samples = np.concatenate([rng.uniform(-1, 1, 20000), stats.truncnorm(-2, 2, scale=0.5).rvs(20000, random_state=rng)])
    densities = np.concatenate([np.full(20000, 0.5), stats.truncnorm(-2, 2, scale=0.5).pdf(samples[20000:])])
    estimate = conservative_gap(th.tensor(-3 * samples**2)[None], th.tensor(np.log(densities))[None], th.tensor([0.0]))
    grid = np.linspace(-1, 1, 100001)
    assert estimate.item() == pytest.approx(logsumexp(-3 * grid**2) + math.log(grid[1] - grid[0]), abs=0.01)


def test_actions_that_the_gap_is_estimated_from():
    model = small(CQL, n_action_samples=4000)
    batch = model._batch(np.arange(2))
    q_values, log_densities = model._sampled_q_values(batch)
    assert q_values.shape == (2, 2, 12000) and log_densities.shape == (2, 12000)
    assert (log_densities[:, :4000] == -2 * math.log(2)).all()
    # The others come from the actor in s and in s'
    for part, observations in [(slice(4000, 8000), batch.observations), (slice(8000, 12000), batch.next_observations)]:
        _, own_log_prob = model.actor.action_log_prob(observations.repeat_interleave(4000, dim=0))
        np.testing.assert_allclose(
            log_densities[:, part].mean(dim=1), own_log_prob.detach().view(2, 4000).mean(dim=1), atol=0.1
        )


def test_targets_of_cql():
    dataset = demonstrations(rewards=np.full(400, 2.0), length=2)
    model = small(CQL, dataset, gamma=0.5, entropy_backup=True)
    for parameter in model.critic_target.parameters():
        parameter.data.zero_()
    model.critic_target.q_networks[0][-1].bias.data.fill_(3.0)
    model.critic_target.q_networks[1][-1].bias.data.fill_(4.0)
    batch = model._batch(np.arange(4))
    model.entropy_backup = False
    np.testing.assert_allclose(model._q_targets(batch, th.tensor(0.1)), [3.5, 2.0, 3.5, 2.0])
    model.entropy_backup = True
    th.manual_seed(0)
    _, log_prob = model.actor.action_log_prob(batch.next_observations)
    th.manual_seed(0)
    expected = 2 + 0.5 * np.array([1, 0, 1, 0]) * (3 - 0.1 * log_prob.detach().numpy())
    np.testing.assert_allclose(model._q_targets(batch, th.tensor(0.1)), expected, rtol=1e-5)


@pytest.mark.parametrize("loss, noise", [("mse", 0.0), ("nll", 0.2)])
def test_bc_fits_a_linear_expert(loss, noise, tmp_path):
    dataset = demonstrations(2000, noise=noise)
    model = small(BC, dataset, loss=loss, learning_rate=3e-3, policy_kwargs={"net_arch": []})
    logged(model, tmp_path).learn(1500, log_interval=500)
    observations = np.random.default_rng(2).uniform(-1, 1, (50, 3)).astype(np.float32)
    actions, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(actions, unscaled(observations @ GAIN), atol=0.02 * (HIGH - LOW).max() if noise else 0.01)
    columns = read_csv(tmp_path)
    assert columns["time/total_timesteps"] == [500, 1000, 1500] and columns["train/n_updates"] == [500, 1000, 1500]
    assert columns["train/epochs"] == pytest.approx([500 * 32 / 1800, 1000 * 32 / 1800, 1500 * 32 / 1800])
    kept = model._sampler.validation
    errors = model.policy.scale_action(dataset.actions[kept]) - dataset.observations[kept] @ GAIN
    expected = -stats.norm(0, noise).logpdf(errors).sum(axis=1).mean() if noise else 0.0
    assert columns["train/validation_loss"][-1] == pytest.approx(expected, abs=0.05 if noise else 1e-4)
    assert columns["train/loss"][-1] < columns["train/loss"][0]
    samples = np.array([model.predict(observations[0])[0] for _ in range(300)])
    spread = samples.std(axis=0) / ((HIGH - LOW) / 2)
    np.testing.assert_allclose(spread, noise, atol=0.04)
    assert (samples >= LOW).all() and (samples <= HIGH).all()


def test_bc_with_discrete_actions():
    dataset = demonstrations(1000, action_space=Switch.action_space, actions=np.zeros(1000, np.int64))
    dataset = replace(dataset, actions=1 + (dataset.observations[:, 0] > 0) + (dataset.observations[:, 0] > 0.5))
    model = small(BC, dataset, Switch(), loss="nll", learning_rate=1e-2).learn(500)
    observations = np.array([[-0.5, 0, 0], [0.25, 0, 0], [0.9, 0, 0]], np.float32)
    assert model.predict(observations, deterministic=True)[0].tolist() == [1, 2, 3]
    assert model.predict(observations[0])[0] in (1, 2, 3)


def test_weight_decay_shrinks():
    norms = []
    for weight_decay in (0.0, 10.0):
        model = small(BC, weight_decay=weight_decay, learning_rate=1e-2).learn(100)
        norms.append(sum(parameter.square().sum() for parameter in model.policy.parameters()))
    assert norms[1] < 0.5 * norms[0]


def test_cql_keeps_q_high_at_the_data_only(tmp_path):
    """Demonstrated are actions around 0.5 and no rewards: only the conservative term tells them from others."""
    rng = np.random.default_rng(0)
    actions = unscaled(np.clip(0.5 + 0.05 * rng.normal(size=(400, 2)), -1, 1))
    dataset = demonstrations(actions=actions, rewards=np.zeros(400))
    gaps = {}
    for weight in (0.0, 5.0):
        model = small(CQL, dataset, conservative_weight=weight, learning_rate=3e-3, actor_lr=3e-3, ent_coef=0.1)
        model.learn(300)
        observations = th.as_tensor(dataset.observations)
        elsewhere = th.as_tensor(rng.uniform(-1, 1, (400, 2)), dtype=th.float32)
        with th.no_grad():
            q_data = th.cat(model.critic(observations, th.as_tensor(model.policy.scale_action(actions))), dim=1)
            q_random = th.cat(model.critic(observations, elsewhere), dim=1)
        gaps[weight] = (q_data - q_random).mean().item()
        if weight:
            action, _ = model.predict(dataset.observations, deterministic=True)
            np.testing.assert_allclose(model.policy.scale_action(action).mean(axis=0), 0.5, atol=0.2)
    assert gaps[5.0] > 1.0 and gaps[5.0] > gaps[0.0] + 1.0


def test_cql_takes_the_better_of_the_demonstrated_actions():
    """Half of the demonstrators steer to the wrong side: behaviour cloning goes straight on, CQL does what was rewarded."""
    rng = np.random.default_rng(0)
    dataset = demonstrations(length=1)
    sides, right = rng.choice([-0.5, 0.5], 400), 0.5 * np.sign(dataset.observations[:, 0])
    actions = unscaled(np.stack([sides, np.zeros(400)], axis=1) + 0.05 * rng.normal(size=(400, 2)))
    dataset = replace(dataset, actions=actions, rewards=5.0 * (sides == right))
    observations = np.array([[-0.8, 0, 0], [0.8, 0, 0]], np.float32)
    bc = small(BC, dataset, learning_rate=3e-3).learn(400)
    assert np.abs(bc.predict(observations, deterministic=True)[0][:, 0]).max() < 0.25
    cql = small(CQL, dataset, learning_rate=3e-3, actor_lr=3e-3, ent_coef=0.1).learn(400)
    steering = cql.predict(observations, deterministic=True)[0][:, 0]
    assert steering[0] < -0.3 and steering[1] > 0.3


def test_lagrange_form():
    """The weight grows where the gap is above the threshold, and shrinks where it is below."""
    weights = []
    for threshold in (0.01, 1000.0):
        model = small(CQL, lagrange_threshold=threshold, lagrange_lr=0.01).learn(20)
        weights.append(model.policy.log_conservative_weight.exp().item())
    assert weights[0] > 5.0 > weights[1]
    assert small(CQL, conservative_weight=3.0).learn(5).policy.log_conservative_weight.exp().item() == pytest.approx(3.0)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_deterministic(algorithm):
    models = [small(algorithm, seed=seed).learn(40) for seed in (0, 0, 1)]
    states = [list(model.policy.state_dict().values()) for model in models]
    assert all(th.equal(one, two) for one, two in zip(states[0], states[1], strict=True))
    assert not all(th.equal(one, two) for one, two in zip(states[0], states[2], strict=True))


@pytest.mark.parametrize(
    "algorithm, kwargs",
    [(BC, {}), (BC, {"loss": "nll"}), (CQL, {}), (CQL, {"lagrange_threshold": 2.0}), (CQL, {"ent_coef": 0.2})],
)
def test_save_load_and_go_on(algorithm, kwargs, tmp_path):
    dataset = demonstrations()
    model = small(algorithm, dataset, **kwargs).learn(30)
    model.save(tmp_path / "model")
    assert (tmp_path / "model.zip").stat().st_size < 60_000  # without the dataset
    observations = dataset.observations[:20]
    expected, _ = model.predict(observations, deterministic=True)
    loaded = algorithm.load(tmp_path / "model")
    np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], expected)
    for name, values in model.get_parameters().items():
        if name == "policy":
            assert all(th.equal(value, loaded.get_parameters()[name][key]) for key, value in values.items())
        else:
            assert str(values) == str(loaded.get_parameters()[name])  # optimizers
    assert loaded.num_timesteps == loaded._n_updates == 30
    with pytest.raises(DatasetError, match="has none"):
        loaded.learn(1)
    loaded.set_dataset(dataset)
    with pytest.raises(ValueError, match=r"^env: pass it to"):
        loaded.learn(1)
    going_on = algorithm.load(tmp_path / "model", env=Board(), dataset=dataset)
    going_on.learn(10, reset_num_timesteps=False)
    assert going_on.num_timesteps == going_on._n_updates == 40
    policy = going_on.policy_class.load(_saved_policy(model, tmp_path))
    np.testing.assert_array_equal(policy.predict(observations, deterministic=True)[0], expected)


def _saved_policy(model, folder):
    model.policy.save(folder / "policy")
    return folder / "policy"


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_callbacks_are_called_after_each_gradient_step(algorithm, tmp_path):
    calls = Calls()
    evaluation = EvalCallback(Board(), eval_freq=10, n_eval_episodes=2, log_path=str(tmp_path), verbose=0)
    checkpoints = CheckpointCallback(10, str(tmp_path))
    resumable = ResumableCheckpoint(10, tmp_path, "Board")
    small(algorithm).learn(25, [calls, evaluation, checkpoints, resumable], progress_bar=True)
    assert calls.steps == [(step, step) for step in range(1, 26)]
    assert all(not th.equal(one, two) for one, two in zip(calls.weights[:-1], calls.weights[1:], strict=True))
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [10, 20]
    assert {path.name for path in tmp_path.glob("*.zip")} == {"rl_model_10_steps.zip", "rl_model_20_steps.zip"}
    assert newest_checkpoint(tmp_path / "checkpoints").name == "25"


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_callback_stops_it(algorithm, tmp_path):
    model = logged(small(algorithm), tmp_path).learn(100, Calls(stop_at=7))
    assert model.num_timesteps == 7
    assert read_csv(tmp_path)["time/total_timesteps"] == [7]


def test_learning_rate_schedules(tmp_path):
    model = small(CQL, learning_rate=lambda left: 1e-3 * left, actor_lr=lambda left: 2e-3 * left)
    logged(model, tmp_path).learn(10, log_interval=5)
    assert read_csv(tmp_path)["train/learning_rate"] == pytest.approx([0.6e-3, 0.1e-3])
    assert model.actor.optimizer.param_groups[0]["lr"] == pytest.approx(0.2e-3)
    assert model.critic.optimizer.param_groups[0]["lr"] == pytest.approx(0.1e-3)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_vec_normalize_takes_the_statistics_of_the_dataset(algorithm):
    dataset = demonstrations()
    env = VecNormalize(DummyVecEnv([Board]))
    model = small(algorithm, dataset, env=env).learn(5)
    np.testing.assert_allclose(env.obs_rms.mean, dataset.observations.mean(axis=0), atol=1e-4)
    np.testing.assert_allclose(env.obs_rms.var, dataset.observations.var(axis=0), atol=1e-4)
    batch = model._batch(np.arange(3))
    np.testing.assert_allclose(batch.observations, env.normalize_obs(dataset.observations[:3]), atol=1e-6)
    np.testing.assert_allclose(batch.rewards, dataset.rewards[:3], rtol=1e-6)


def test_images():
    class Camera(Board):
        observation_space = spaces.Box(0, 255, (36, 36, 1), np.uint8)

        def reset(self, *, seed=None, options=None):
            return self.observation_space.sample(), {}

    images = np.random.default_rng(0).integers(0, 255, (40, 36, 36, 1), np.uint8)
    dataset = replace(
        demonstrations(40), observation_space=Camera.observation_space, observations=images, next_observations=images
    )
    for algorithm, net_arch in [(BC, [8]), (CQL, [8])]:
        model = algorithm("CnnPolicy", Camera(), dataset, batch_size=4, policy_kwargs={"net_arch": net_arch}).learn(2)
        assert model.predict(images[0])[0].shape == (2,)


def test_sampler_goes_through_all_in_passes():
    sampler = DatasetSampler(np.repeat(np.arange(10), 5), 15, 0.2, seed=0)
    assert len(sampler.validation) == 10 and len(set(sampler.validation // 5)) == 2  # two whole episodes
    passes = [np.concatenate([sampler.draw(), sampler.draw()]) for _ in range(2)]
    assert all(len(set(drawn)) == 30 and not set(drawn) & set(sampler.validation) for drawn in passes)
    assert not np.array_equal(*passes) and sampler.epochs == 60 / 40
    np.testing.assert_array_equal(DatasetSampler(np.repeat(np.arange(10), 5), 15, 0.2, seed=1).validation, sampler.validation)
    assert len(DatasetSampler(np.repeat(np.arange(10), 5), 15, 0.0, seed=0).validation) == 0
    assert len(DatasetSampler(np.repeat(np.arange(10), 5), 15, 0.01, seed=0).validation) == 5  # at least one episode
    assert DatasetSampler(np.zeros(20, int), 100, 0.25, seed=0).validation.tolist() == [15, 16, 17, 18, 19]
    assert DatasetSampler(np.zeros(20, int), 100, 0.25, seed=0).batch_size == 15


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_dataset_that_is_missing_or_does_not_fit(algorithm, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    name = algorithm.__name__
    with pytest.raises(DatasetError, match=rf"{name} learns from demonstrations.*{name}\(\.\.\., dataset=.*demos record"):
        algorithm("MlpPolicy", Board())
    with pytest.raises(DatasetError, match="There is no dataset 'toy/nothing-v0'"):
        algorithm("MlpPolicy", Board(), "toy/nothing-v0")
    with pytest.raises(DatasetError, match=r"observation space differs in shape: \(3,\) instead of \(2,\)"):
        small(algorithm, env=gym.make("MountainCarContinuous-v0"))
    with pytest.raises(DatasetError, match="dataset: must be the id or folder of a dataset"):
        small(algorithm, dataset=7)


@pytest.mark.parametrize(
    "algorithm, kwargs",
    [
        *[(algorithm, {"learning_rate": -1.0}) for algorithm in ALGORITHMS],
        *[(algorithm, {"batch_size": 0}) for algorithm in ALGORITHMS],
        (BC, {"validation_share": 1.0}),
        (BC, {"loss": "mae"}),
        (BC, {"weight_decay": -1.0}),
        (CQL, {"tau": 2.0}),
        (CQL, {"gamma": -1.0}),
        (CQL, {"ent_coef": "automatic"}),
        (CQL, {"target_entropy": "low"}),
        (CQL, {"actor_lr": -1.0}),
        (CQL, {"conservative_weight": -1.0}),
        (CQL, {"n_action_samples": 0}),
        (CQL, {"temperature": 0.0}),
        (CQL, {"lagrange_threshold": 0.0}),
        (CQL, {"lagrange_lr": -1.0}),
    ],
)
def test_arguments_out_of_range(algorithm, kwargs):
    (name,) = kwargs
    with pytest.raises(ValueError, match=rf"^{name} must be"):
        small(algorithm, **kwargs)


def test_other_mistakes(tmp_path):
    with pytest.raises(ValueError, match=r"^loss must be 'nll' for Discrete"):
        small(BC, env=Switch())
    with pytest.raises(ValueError, match=r"env: the action space must be continuous"):
        small(CQL, env=Switch())
    SAC("MlpPolicy", Board(), buffer_size=10, policy_kwargs={"net_arch": [8]}).save(tmp_path / "sac")
    for algorithm in ALGORITHMS:
        with pytest.raises(ValueError, match=r"needs a (BC|CQL)Policy, got SACPolicy.*class that saved it"):
            algorithm.load(tmp_path / "sac")
    with pytest.raises(ValueError, match="log_interval must be"):
        small(BC).learn(1, log_interval=0)
