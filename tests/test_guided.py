"""What PVP, D-PVP and C-HAC share: asking the human, storing who drove, counting, and going on after a restart."""

import warnings

import numpy as np
import pytest
import torch as th
from guided_toys import (
    ALGORITHMS,
    Limited,
    Tracking,
    Witness,
    column,
    make_guided,
    parameters,
    same,
    scripted,
    silent,
    tracking_expert,
    wrapper,
)
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from takeover_toys import EXPERT, DictIntegrator, Integrator, NoisyDriver, bits, constant

from sb3_chac import CHAC, DPVP, DSAC, PVP
from sb3_chac.common.buffers import DualReplayBuffer
from sb3_chac.human import InterventionWrapper

each_algorithm = pytest.mark.parametrize("algorithm", ALGORITHMS)


def stores(model):
    return model.replay_buffer.novice, model.replay_buffer.human


# --- What is stored


@each_algorithm
@pytest.mark.parametrize("script", ["0011100", "1100110", "1111111", "0000000", "0101010"])
def test_takeovers_are_stored_as_they_happened(algorithm, script):
    """Start, middle and end of a takeover; actions that were executed and those that the novice proposed; who goes where."""
    low, high = np.array([-2.0, 0.0]), np.array([2.0, 4.0])
    env = scripted(script, low=low, high=high)
    model = make_guided(algorithm, env).learn(len(script))
    novice, human = stores(model)
    assert (len(novice), len(human)) == (script.count("0"), script.count("1"))

    def scaled(action):
        return 2 * (np.array(action) - low) / (high - low) - 1

    executed, proposed = wrapper(model).unwrapped.executed, wrapper(model).get_wrapper_attr("_supervisor").rule.proposed
    taken = np.array(bits(script))
    assert np.allclose(column(novice, "action"), scaled(executed)[~taken].reshape(-1, 2), atol=1e-6)
    assert np.allclose(column(human, "action"), scaled(EXPERT), atol=1e-6)
    for store, mask in ((novice, ~taken), (human, taken)):
        assert np.allclose(column(store, "novice_action"), scaled(proposed)[mask].reshape(-1, 2), atol=1e-6)
        assert (column(store, "reward") == 1 + np.flatnonzero(mask)).all()
        # The position is the sum of what was executed
        moved = column(store, "next_observation/") - column(store, "observation/")
        assert np.allclose(moved, np.array(executed)[mask].reshape(-1, 2), atol=1e-5)
    starts = [bit and (t == 0 or not bits(script)[t - 1]) for t, bit in enumerate(bits(script))]
    assert column(human, "takeover_start").tolist() == [start for start, bit in zip(starts, taken, strict=True) if bit]
    assert not column(novice, "takeover_start").any()
    assert model.counts["takeovers"] == sum(starts)


@pytest.mark.parametrize("kwargs, done", [({"length": 3}, 1), ({"limit": 3}, 0)], ids=["termination", "time limit"])
@each_algorithm
def test_the_episode_ends_during_a_takeover(algorithm, kwargs, done):
    env = scripted("0111100", **kwargs)
    model = make_guided(algorithm, env).learn(7)
    novice, human = stores(model)
    assert column(human, "reward").tolist() == [2, 3, 1, 2]
    assert column(human, "done").tolist() == [0, done, 0, 0]
    assert column(human, "takeover_start").tolist() == [1, 0, 1, 0]  # a new episode, a new takeover
    assert column(novice, "done").tolist() == [0, done, 0]
    for store in (novice, human):  # also at the end of an episode, whose next observation is not the next episode's first
        moved = column(store, "next_observation/") - column(store, "observation/")
        assert np.allclose(moved, column(store, "action"), atol=1e-5)


@each_algorithm
def test_several_environments(algorithm):
    env = scripted("0110", "1001", "0000")
    model = make_guided(algorithm, env, learning_starts=100).learn(12)
    novice, human = stores(model)
    assert column(human, "reward").tolist() == [1, 2, 3, 4]  # the step, in the order of the steps
    assert column(human, "takeover_start").tolist() == [1, 1, 0, 1]
    assert len(novice) == 8
    proposed = [wrapper(model, idx).get_wrapper_attr("_supervisor").rule.proposed for idx in range(3)]
    expected = [proposed[idx][t] for t, idx in ((0, 1), (1, 0), (2, 0), (3, 1))]
    assert np.allclose(column(human, "novice_action"), expected, atol=1e-6)
    assert model.counts["human_steps"] == 4 and model.counts["total_steps"] == 12
    assert model.wrapper_states == [{"human_steps": human, "total_steps": 4} for human in (2, 2, 0)]


class SelfDriven(Limited):
    """It does the takeovers itself, in each second pair of steps, and reports them with HIL-SERL's key alone."""

    action_key = "intervene_action"

    def step(self, action):
        takeover = self.steps % 4 >= 2
        obs, reward, terminated, truncated, info = super().step(EXPERT if takeover else action)
        return obs, reward, terminated, truncated, info | ({self.action_key: EXPERT} if takeover else {})


@each_algorithm
def test_environments_that_do_the_takeovers_themselves(algorithm):
    model = make_guided(algorithm, DummyVecEnv([lambda: SelfDriven(low=-2, high=2, limit=7)]))
    model.learn(12)
    novice, human = stores(model)
    assert column(human, "reward").tolist() == [3, 4, 7, 3, 4]
    assert column(human, "takeover_start").tolist() == [1, 0, 1, 1, 0]
    assert np.allclose(column(human, "action"), EXPERT / 2)
    assert not np.allclose(column(human, "novice_action"), EXPERT / 2, atol=0.05)
    assert np.allclose(
        2 * column(novice, "action"), column(novice, "next_observation/") - column(novice, "observation/"), atol=1e-5
    )
    assert model.counts["human_steps"] == 5 and model.counts["takeovers"] == 3


@each_algorithm
def test_a_takeover_without_the_action_that_was_executed_is_refused(algorithm):
    env = DummyVecEnv([lambda: Limited(infos={"takeover": True})])
    with pytest.raises(ValueError, match=r"info\['takeover'\] .*environment 0.*applied_action"):
        make_guided(algorithm, env).learn(3)


@each_algorithm
def test_noise_belongs_to_what_the_novice_proposed(algorithm):
    noise = NormalActionNoise(np.full(2, 5.0), np.zeros(2))  # beyond the bounds: clipped
    model = make_guided(algorithm, scripted("0101"), action_noise=noise, learning_starts=0, gradient_steps=0).learn(4)
    novice, human = stores(model)
    assert (column(human, "novice_action") == 1).all()
    assert (column(novice, "action") == 1).all()
    assert np.allclose(column(human, "action"), EXPERT)


# --- Counts


@each_algorithm
def test_counts(algorithm, tmp_path):
    infos = {"cost": 0.5, "collision": True, "out_of_road": False}
    model = make_guided(algorithm, scripted("01101110", limit=5, infos=infos), learning_starts=3)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(10, log_interval=1)
    counts = model.counts
    takeover_cost = counts.pop("takeover_cost")
    assert 0 < takeover_cost <= 6
    assert counts == {
        "total_steps": 10,
        "human_steps": 5,
        "takeovers": 3,  # a takeover that goes on in the next episode is a new one
        "safety_cost": 5.0,
        "safety_cost_human": 2.5,
        "collisions": 10,
        "departures": 0,
    }
    assert list(model.ep_cost_buffer) == [2.5, 2.5]
    header, *_, last = (line.split(",") for line in (tmp_path / "progress.csv").read_text().splitlines())
    logged = {name: float(value) for name, value in zip(header, last, strict=True) if value}
    expected = {f"takeover/{name}": counts[name] for name in ("human_steps", "total_steps", "takeovers")}
    expected |= {f"safety/{name}": counts[name] for name in ("safety_cost", "safety_cost_human", "collisions", "departures")}
    expected |= {"takeover/rate": 0.5, "takeover/takeover_cost": takeover_cost, "rollout/ep_cost_mean": 2.5}
    assert {name: logged[name] for name in expected} == pytest.approx(expected, rel=1e-4)


@each_algorithm
def test_counts_go_on_in_the_next_learn(algorithm):
    model = make_guided(algorithm, scripted("0110", infos={"cost": 1.0}, limit=8)).learn(4)
    model.learn(4, reset_num_timesteps=False)
    assert (model.counts["total_steps"], model.counts["human_steps"], model.counts["safety_cost"]) == (8, 2, 8)
    assert wrapper(model).total_steps == 8
    assert list(model.ep_cost_buffer) == [8]  # of the whole episode, which both calls of learn() drove
    model.learn(4)  # with a reset
    assert model.counts["total_steps"] == 12


# --- Arming


class Watch(BaseCallback):
    """Notes at each step whether the human is asked; then stops or fails."""

    def __init__(self, stop_at=None, fail_at=None):
        super().__init__()
        self.stop_at, self.fail_at, self.armed = stop_at, fail_at, []

    def _on_step(self):
        self.armed += self.training_env.get_attr("armed")
        if self.num_timesteps == self.fail_at:
            raise ZeroDivisionError
        return self.num_timesteps != self.stop_at


@each_algorithm
def test_the_human_is_asked_while_the_model_learns(algorithm):
    model, watch = make_guided(algorithm, scripted("1" * 99, "1" * 99)), Watch()
    assert not any(model.get_env().get_attr("armed"))
    model.learn(30, callback=watch)
    assert watch.armed == [True] * 30
    assert not any(model.get_env().get_attr("armed"))


@each_algorithm
@pytest.mark.parametrize("how", ["callback", "exception", "interrupt", "environment"])
def test_the_human_is_let_go_however_learning_ends(algorithm, how):
    model = make_guided(algorithm, scripted("1" * 99))
    if how == "callback":
        model.learn(30, callback=Watch(stop_at=5))
        assert model.num_timesteps == 5
    elif how == "environment":
        wrapper(model).unwrapped.step = None
        with pytest.raises(TypeError):
            model.learn(30)
    else:

        def fail(*args, **kwargs):
            raise KeyboardInterrupt if how == "interrupt" else ZeroDivisionError

        model.train = fail
        with pytest.raises(KeyboardInterrupt if how == "interrupt" else ZeroDivisionError):
            model.learn(30)
        assert len(model.replay_buffer.human) == 21
    assert model.get_env().get_attr("armed") == [False]


@each_algorithm
def test_the_first_error_is_the_one_to_be_seen(algorithm):
    """If the environments are gone, so that the human cannot be taken out, that is not what one wants to read."""
    model = make_guided(algorithm, scripted("1" * 99))

    class Closing(BaseCallback):
        def _on_step(self):
            self.training_env.env_method = self.training_env.get_attr = None
            raise ZeroDivisionError

    with pytest.warns(UserWarning, match="could not be taken out"), pytest.raises(ZeroDivisionError):
        model.learn(30, callback=Closing())


@each_algorithm
def test_the_human_never_drives_an_evaluation(algorithm):
    drivers = {"train": NoisyDriver(), "evaluation": NoisyDriver()}
    env, evaluation = (
        DummyVecEnv([lambda driver=driver: InterventionWrapper(Limited(limit=5), driver, "always")])
        for driver in drivers.values()
    )
    seen = []

    class Evaluate(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 10:
                evaluate_policy(
                    self.model, evaluation, 2, callback=lambda local, _: seen.append(local["info"]["takeover"]), warn=False
                )
            return True

    model = make_guided(algorithm, env).learn(15, callback=Evaluate())
    assert seen == [False] * 10
    assert drivers["evaluation"].observations == []
    asked = len(drivers["train"].observations)
    assert asked == 15
    evaluate_policy(model, env, 2, warn=False)  # in the training environment too, once learning is over
    assert len(drivers["train"].observations) == asked


def test_works_in_subprocesses():
    """Nothing of a wrapper need be sent but what it says (not with fork, which may hang once torch has its threads)."""
    env = SubprocVecEnv([lambda: InterventionWrapper(Limited(), constant, Witness("01" * 9))] * 2)
    try:
        model = make_guided(DPVP, env).learn(12)
        assert len(model.replay_buffer.human) == 6
        assert env.get_attr("armed") == [False] * 2
        assert model.wrapper_states == [{"human_steps": 3, "total_steps": 6}] * 2
    finally:
        env.close()


# --- Budget


@each_algorithm
def test_the_budget_holds_and_survives_a_restart(algorithm, tmp_path):
    model = make_guided(algorithm, scripted("1" * 99, budget=5)).learn(3)
    assert len(model.replay_buffer.human) == 3
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=scripted("1" * 99, budget=5))
    assert loaded.counts == model.counts and loaded.wrapper_states == model.wrapper_states
    loaded.learn(6, reset_num_timesteps=False)
    assert len(loaded.replay_buffer.human) == 2
    assert loaded.counts["human_steps"] == wrapper(loaded).human_steps == 5
    assert loaded.counts["total_steps"] == wrapper(loaded).total_steps == 9
    loaded.learn(6, reset_num_timesteps=False)  # nothing is left
    assert loaded.counts["human_steps"] == 5


@pytest.mark.parametrize("n_before, n_after, steps", [(3, 2, [4, 5]), (1, 3, [1, 1, 1]), (2, 1, [6])])
@each_algorithm
def test_counts_are_dealt_out_to_another_number_of_environments(algorithm, n_before, n_after, steps, tmp_path):
    model = make_guided(algorithm, scripted(*["1" * 99] * n_before)).learn(3 * n_before)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=scripted(*["0" * 99] * n_after))
    assert loaded.n_envs == n_after
    loaded.learn(n_after, reset_num_timesteps=False)
    assert [wrapper(loaded, idx).human_steps for idx in range(n_after)] == steps
    assert sum(wrapper(loaded, idx).total_steps for idx in range(n_after)) == 3 * n_before + n_after
    assert loaded.counts["human_steps"] == 3 * n_before


# --- Saving and loading


@pytest.mark.parametrize("algorithm, stage", [(PVP, 1), (DPVP, 1), (CHAC, 1), (CHAC, 2)])
def test_training_goes_on_as_if_never_saved(algorithm, stage, tmp_path):
    """Networks, targets, optimizers, the phase of the policy delay, both stores and where their rings stand."""
    kwargs = {"switch_after": 25} if stage == 2 else {}
    model = make_guided(algorithm, scripted("0011" * 99), buffer_size=25, **kwargs).learn(61)
    assert model._n_updates == 41
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    resumed = algorithm.load(tmp_path / "model")
    resumed.load_replay_buffer(tmp_path / "buffer")
    assert same(parameters(model), parameters(resumed))
    if algorithm is CHAC:
        assert model.stage == resumed.stage == stage
    for mine, theirs in zip(stores(model), stores(resumed), strict=True):
        assert mine.added == theirs.added
        assert all(np.array_equal(mine.arrays[name], theirs.arrays[name]) for name in mine.columns)
    for each in (model, resumed):
        silent(each)
        set_random_seed(0)
        each.train(gradient_steps=9, batch_size=8)
    assert same(parameters(model), parameters(resumed))


@each_algorithm
def test_a_loaded_model_predicts_as_the_saved_one(algorithm, tmp_path):
    model = make_guided(algorithm).learn(30)
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    loaded = algorithm.load(tmp_path / "model")
    policy = type(model.policy).load(tmp_path / "policy")
    obs = np.random.default_rng(0).normal(size=(20, 2)).astype(np.float32)
    expected = model.predict(obs, deterministic=True)[0]
    assert np.array_equal(loaded.predict(obs, deterministic=True)[0], expected)
    assert np.array_equal(policy.predict(obs, deterministic=True)[0], expected)
    for each in (model, loaded):
        set_random_seed(0)
        each.sampled = each.predict(obs)[0]
    assert np.array_equal(loaded.sampled, model.sampled)


@pytest.mark.parametrize("n_steps", [1, 3])
@each_algorithm
def test_a_loaded_model_learns_on_in_more_environments(algorithm, n_steps, tmp_path):
    model = make_guided(algorithm, scripted("0011" * 20), n_steps=n_steps).learn(30)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = algorithm.load(tmp_path / "model", env=scripted("0011" * 20, "01" * 40))
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(20, reset_num_timesteps=False)
    loaded.replay_buffer.end_trajectories()
    assert loaded.replay_buffer.size() == 50
    assert loaded._n_updates == model._n_updates + 10  # of two steps each, and no new warm-up
    assert loaded.replay_buffer.n_steps == n_steps


@each_algorithm
def test_the_replay_buffer_of_another_algorithm_is_refused(algorithm, tmp_path):
    DSAC("MlpPolicy", Limited(), buffer_size=10, policy_kwargs=dict(net_arch=[8])).save_replay_buffer(tmp_path / "buffer")
    model = make_guided(algorithm).learn(10)
    with pytest.raises(ValueError, match=r"load_replay_buffer: .*buffer.* holds no DualReplayBuffer, got ReplayBuffer"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.size() == 10  # kept


# --- Runs


@each_algorithm
def test_same_seed_same_run(algorithm):
    kwargs = {"switch_after": 30} if algorithm is CHAC else {}

    def run(seed):
        env = DummyVecEnv([lambda: InterventionWrapper(Limited(limit=9), NoisyDriver(), "disagreement")] * 2)
        model = make_guided(algorithm, env, seed=seed, **kwargs).learn(60)
        return parameters(model) | {"executed": th.as_tensor(np.array(wrapper(model).unwrapped.executed))}

    a, b, other = (run(seed) for seed in (3, 3, 4))
    assert same(a, b)
    assert not same(a, other)


RUNS = {
    "n_steps": ({"n_steps": 3}, ALGORITHMS),
    "gSDE": ({"use_sde": True, "sde_sample_freq": 4, "use_sde_at_warmup": True}, [DPVP, CHAC]),
    "noise": ({"action_noise": NormalActionNoise(np.zeros(2), np.full(2, 0.1))}, ALGORITHMS),
    "episodes": ({"train_freq": (1, "episode"), "gradient_steps": -1}, ALGORITHMS),
    "schedule": ({"learning_rate": lambda remaining: 1e-3 * remaining}, ALGORITHMS),
    "auto": ({"ent_coef": "auto_0.01", "target_entropy": -4.0}, [DPVP, CHAC]),
    "sizes": ({"policy_kwargs": dict(net_arch=dict(pi=[8], qf=[16, 16]), n_critics=3)}, ALGORITHMS),
    "labels": ({"takeover_stop_td": True, "pv_min_diff": 0.5, "proxy_value": 2.0, "pv_coef": 0.5}, ALGORITHMS),
    "etas": ({"eta": 3.0, "eta_pv": 2.0, "tau_b": 0.1, "policy_delay": 3, "target_update_interval": 2}, [DPVP, CHAC]),
    "target noise": ({"target_policy_noise": 0.0, "target_noise_clip": 0.0, "policy_delay": 3}, [PVP]),
}


@pytest.mark.parametrize(
    "algorithm, name",
    [
        pytest.param(algorithm, name, id=f"{algorithm.__name__}-{name}")
        for name, (_, algorithms) in RUNS.items()
        for algorithm in algorithms
    ],
)
def test_options(algorithm, name, tmp_path):
    """Train in two environments, through C-HAC's second stage, save, load, train on."""
    kwargs = RUNS[name][0] | ({"switch_after": 40} if algorithm is CHAC else {})
    if "action_noise" in kwargs and algorithm is CHAC:
        kwargs["shared_control"] = False  # pi_r alone, once
    scripts = ["00111" * 20, "01" * 50]
    env = scripted(*scripts[: 1 if "train_freq" in kwargs else 2], limit=7)
    model = make_guided(algorithm, env, **kwargs)
    initial = parameters(model)
    model.learn(80)
    trained = parameters(model)
    parts = ["actor.", "actor_target.", "critic.", "critic_target."]
    if algorithm is CHAC:
        assert model.stage == 2
        parts += ["confidence_critic.", "confidence_critic_target.", "self_actor.", "self_actor_target."]
    for part in parts:
        assert any(not th.equal(trained[key], initial[key]) for key in trained if key.startswith(part)), part
    assert all(th.isfinite(value).all() for value in trained.values())
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=model.get_env())
    assert same(trained, parameters(loaded))
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.num_timesteps >= 100 and not same(trained, parameters(loaded))


@each_algorithm
def test_returns_of_several_steps_reach_the_stores(algorithm):
    model = make_guided(algorithm, scripted("00110", "11000", limit=5), n_steps=3, gamma=0.5).learn(10)
    novice, human = stores(model)
    # The reward of step t is t; each return ends with the driver or the episode
    assert sorted(column(human, "reward")) == sorted([3 + 4 / 2, 4, 1 + 2 / 2, 2])
    assert sorted(column(human, "discount")) == [0.25, 0.25, 0.5, 0.5]
    assert sorted(column(novice, "reward")) == sorted([1 + 2 / 2, 2, 5, 3 + 4 / 2 + 5 / 4, 4 + 5 / 2, 5])
    assert not column(novice, "done").any()  # the time limit


class Camera(Limited):
    """What it shows is a picture: bright where the position is positive."""

    observation_space = spaces.Box(0, 255, (36, 36, 1), np.uint8)

    def obs(self):
        return np.full((36, 36, 1), 255 * (self.position[0] > 0), np.uint8)


@each_algorithm
def test_images(algorithm):
    env = DummyVecEnv([lambda: InterventionWrapper(Camera(limit=6), constant, Witness("0011" * 10))])
    kwargs = dict(features_extractor_kwargs=dict(features_dim=8))
    kwargs |= {} if algorithm is PVP else {"share_features_extractor": False}
    more = {"switch_after": 26} if algorithm is CHAC else {}
    model = make_guided(algorithm, env, policy="CnnPolicy", policy_kwargs=kwargs, **more).learn(32)
    batch = model.replay_buffer.sample(4)
    assert batch.observations.dtype == th.uint8 and batch.observations.shape == (4, 1, 36, 36)
    assert model._n_updates == 12
    assert model.predict(model.get_env().reset())[0].shape == (1, 2)


class DictLimited(DictIntegrator):
    observation_space = spaces.Dict({"position": Limited.observation_space, "speed": spaces.Box(-1, 1, (1,), np.float32)})


@pytest.mark.parametrize("normalize", [False, True])
@each_algorithm
def test_dict_observations(algorithm, normalize):
    env = DummyVecEnv([lambda: InterventionWrapper(DictLimited(length=6), constant, Witness("0011" * 10))] * 2)
    env = VecNormalize(env) if normalize else env
    more = {"switch_after": 30} if algorithm is CHAC else {}
    model = make_guided(algorithm, env, policy="MultiInputPolicy", **more).learn(40)
    novice, human = stores(model)
    assert len(human) == (20 if algorithm is not CHAC else 16)
    for store in (novice, human):
        moved = column(store, "next_observation/position") - column(store, "observation/position")
        assert np.allclose(moved, column(store, "action"), atol=1e-4)
    assert model.predict(model.get_env().reset())[0].shape == (2, 2)


@each_algorithm
def test_vec_normalize_stores_what_the_environment_gave(algorithm):
    env = VecNormalize(scripted("0011" * 10, "01" * 20, limit=9))
    model = make_guided(algorithm, env).learn(60)
    for store in stores(model):
        assert set(column(store, "reward")) <= set(range(1, 10))
        moved = column(store, "next_observation/") - column(store, "observation/")
        assert np.allclose(moved, column(store, "action"), atol=1e-3)
    batch = model._sample_batch(30) if algorithm is not PVP else model.replay_buffer.sample(30, env=model._vec_normalize_env)
    assert batch.rewards.abs().max() < 5
    assert batch.observations.abs().max() <= 10


@each_algorithm
def test_actions_of_any_shape(algorithm):
    class Matrix(Limited):
        def __init__(self):
            super().__init__(limit=9)
            self.action_space = spaces.Box(-1, 1, (2, 2), np.float32)

        def step(self, action):
            return super().step(action.sum(axis=0))

    expert = np.array([[0.5, -0.5], [0.25, 0.0]], np.float32)
    env = DummyVecEnv([lambda: InterventionWrapper(Matrix(), lambda obs: expert, Witness("0011" * 20))])
    more = {"switch_after": 26} if algorithm is CHAC else {}
    model = make_guided(algorithm, env, **more).learn(40)
    assert (column(model.replay_buffer.human, "action") == expert.flatten()).all()
    assert model.predict(model.get_env().reset())[0].shape == (1, 2, 2)


# --- Bad input


@pytest.mark.parametrize(
    "kwargs, algorithms",
    [
        ({"batch_size": 0}, ALGORITHMS),
        ({"buffer_size": 0}, ALGORITHMS),
        ({"learning_rate": -1.0}, ALGORITHMS),
        ({"gamma": 1.1}, ALGORITHMS),
        ({"n_steps": 0}, ALGORITHMS),
        ({"policy_delay": 0}, ALGORITHMS),
        ({"proxy_value": 0.0}, ALGORITHMS),
        ({"proxy_value": float("nan")}, ALGORITHMS),
        ({"pv_coef": -1.0}, ALGORITHMS),
        ({"pv_min_diff": -0.1}, ALGORITHMS),
        ({"optimize_memory_usage": True}, ALGORITHMS),
        ({"replay_buffer_class": ReplayBuffer}, ALGORITHMS),
        ({"target_policy_noise": -0.1}, [PVP]),
        ({"target_noise_clip": -0.1}, [PVP]),
        ({"ent_coef": -1.0}, [DPVP, CHAC]),
        ({"eta_pv": 0.0}, [DPVP, CHAC]),
        ({"delta": 1.5}, [CHAC]),
        ({"delta": -0.1}, [CHAC]),
        ({"switch_after": -1}, [CHAC]),
        ({"switch_after": 1e4}, [CHAC]),
        ({"sigma_threshold": "low"}, [CHAC]),
        ({"log_prob_threshold": float("inf")}, [CHAC]),
        ({"eta_c": 0.0}, [CHAC]),
        ({"sigma_scale": 0.0}, [CHAC]),
        ({"tau_c": 1.5}, [CHAC]),
        ({"prefit_steps": -1}, [CHAC]),
        ({"bootstrap": "guided"}, [CHAC]),
        ({"stage2_human_share": 1.5}, [CHAC]),
        ({"stage2_guided_share": 1.5}, [CHAC]),
        ({"max_deviation": 2.5}, [CHAC]),
        ({"weight_decay": -1.0}, [DPVP, CHAC]),
        ({"average_tau": 1.5}, [DPVP, CHAC]),
        ({"anchor_coef": -1.0}, [CHAC]),
    ],
    ids=lambda value: (
        "-".join(f"{k}={getattr(v, '__name__', v)}" for k, v in value.items()) if isinstance(value, dict) else ""
    ),
)
def test_bad_arguments(kwargs, algorithms):
    (name,) = kwargs
    for algorithm in algorithms:
        with pytest.raises(ValueError, match=rf"^{name} must"):
            make_guided(algorithm, **kwargs)


@pytest.mark.parametrize("algorithm", [DPVP, CHAC])
@pytest.mark.parametrize("ent_coef", ["auto", 0.5])
def test_an_entropy_bonus_that_swamps_the_labels_is_pointed_out(algorithm, ent_coef):
    with pytest.warns(UserWarning, match=r"^ent_coef=.*swamp"):
        make_guided(algorithm, ent_coef=ent_coef)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_guided(algorithm, ent_coef=ent_coef, proxy_value=20.0)
        make_guided(algorithm)


@each_algorithm
def test_a_derived_replay_buffer_is_accepted(algorithm):
    class Mine(DualReplayBuffer):
        pass

    model = make_guided(algorithm, replay_buffer_class=Mine, n_steps=2)
    assert type(model.replay_buffer) is Mine and model.replay_buffer.n_steps == 2
    assert model.replay_buffer.gamma == model.gamma


@each_algorithm
def test_discrete_actions_are_refused(algorithm):
    class Discrete(Integrator):
        action_space = spaces.Discrete(2)

    with pytest.raises(ValueError, match=r"env: .*continuous"):
        make_guided(algorithm, Discrete())


@each_algorithm
def test_nan_is_never_stored(algorithm):
    class Broken(Limited):
        def step(self, action):
            obs, reward, *rest = super().step(action)
            return obs, np.nan if self.steps == 6 else reward, *rest

    env = DummyVecEnv([lambda: InterventionWrapper(Broken(), constant, Witness("01" * 10))])
    model = make_guided(algorithm, env)
    with pytest.raises(ValueError, match="reward of environment 0 is NaN or infinite at step 6"):
        model.learn(20)
    assert model.replay_buffer.size() == model.counts["total_steps"] == 5
    assert model.get_env().get_attr("armed") == [False]


# --- Learning


@pytest.mark.parametrize("algorithm", [PVP, DPVP])
def test_reaches_the_expert(algorithm):
    """Without reward, in 800 steps of a task in which the best action is a function of the state."""
    env = DummyVecEnv([lambda: InterventionWrapper(Tracking(), tracking_expert, "disagreement")])
    policy_kwargs = dict(net_arch=[64, 64], activation_fn=th.nn.ReLU)
    kwargs = dict(learning_rate=1e-3, batch_size=64, gamma=0.5, policy_kwargs=policy_kwargs)
    kwargs |= {} if algorithm is PVP else {"average_tau": 0.01, "weight_decay": 0.0}
    model = make_guided(algorithm, env, learning_starts=50, **kwargs)
    obs = np.random.default_rng(0).uniform(-1, 1, (500, 2)).astype(np.float32)

    def errors():
        return np.sqrt(np.mean((model.predict(obs, deterministic=True)[0] - tracking_expert(obs)) ** 2, axis=1))

    before = errors()
    model.learn(800)
    after = errors()
    assert after.mean() < 0.4 * before.mean()
    assert (after < 0.3).mean() > 0.9  # the threshold of the rule
    assert model.counts["human_steps"] < 400
