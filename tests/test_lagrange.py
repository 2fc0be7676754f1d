"""SAC-Lagrangian and PPO-Lagrangian: the multiplier, the maths, and what SB3's users expect of an algorithm."""

import itertools
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from cost_toys import Bill, SpeedLimit, SpeedLimitDict, SpeedLimitGears, SpeedLimitPicture
from gymnasium import spaces
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_chac.common.lagrange import PIDLagrangian, constrained_actor_loss, constrained_advantages
from sb3_chac.ppo_lag import PPOLag
from sb3_chac.sac_lag import SACLag
from sb3_chac.sac_lag.buffers import CostDictReplayBuffer, CostNStepReplayBuffer, CostReplayBuffer

ALGORITHMS = [SACLag, PPOLag]


def make_model(algorithm, env=None, policy="MlpPolicy", **kwargs):
    """A small model; SACLag learns from step 20 on, PPOLag has rollouts of 32 steps per environment."""
    own = {"learning_starts": 20, "buffer_size": 500, "lagrange_start": 0} if algorithm is SACLag else {}
    own |= {"n_steps": 32} if issubclass(algorithm, PPO) else {}
    kwargs = {"batch_size": 16, "seed": 0, "policy_kwargs": {}, **own, **kwargs}
    kwargs["policy_kwargs"] = dict(net_arch=[8]) | kwargs["policy_kwargs"]
    return algorithm(policy, SpeedLimit() if env is None else env, **kwargs)


def bills(*bills):
    return DummyVecEnv([lambda kwargs=kwargs: Bill(**kwargs) for kwargs in bills])


def assert_same_parameters(a, b):
    """Networks, optimizers and multiplier."""
    a, b = a.get_parameters(), b.get_parameters()
    assert a.keys() == b.keys()
    for part in a:
        flat_a, flat_b = ([x for _, x in walk(parameters[part])] for parameters in (a, b))
        assert len(flat_a) == len(flat_b)
        assert all(th.equal(x, y) if isinstance(x, th.Tensor) else x == y for x, y in zip(flat_a, flat_b, strict=True)), part


def walk(tree, path=()):
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else None
    if items is None:
        yield path, tree
    else:
        for key, value in items:
            yield from walk(value, (*path, key))


# ---- The multiplier ----


def test_the_recurrence_on_hand_made_numbers():
    pid = PIDLagrangian(2.0, pid_kp=0.5, pid_ki=0.1, pid_kd=1.0, pid_tau=0.5, pid_delay=2)
    assert pid.value == 0
    by_hand = [  # J, I, ema, lambda = 0.5 (ema - 2) + I + rise of the ema in two updates
        (4, 0.2, 4, 1.0 + 0.2),
        (2, 0.2, 3, 0.5 + 0.2),  # falls by 1 since the first
        (6, 0.6, 4.5, 1.25 + 0.6 + 0.5),  # two ago: 4
        (0, 0.4, 2.25, 0.125 + 0.4),  # two ago: 3
        (0, 0.2, 1.125, 0),  # -0.4375 + 0.2
        (0, 0.0, 0.5625, 0),
        (0, 0.0, 0.28125, 0),  # I would be -0.2
        (6, 0.4, 3.140625, 0.5703125 + 0.4 + 2.578125),  # two ago: 0.5625
    ]
    for cost, integral, mean_cost, multiplier in by_hand:
        assert pid.update(cost) == pid.value == pytest.approx(multiplier)
        assert (pid.integral.item(), pid.mean_costs[0].item()) == pytest.approx((integral, mean_cost))


def test_the_maximum_bounds_the_integral_too():
    pid = PIDLagrangian(1.0, pid_kp=0.0, pid_ki=0.5, pid_kd=0.0, lagrange_init=0.5, lagrange_max=2.0)
    assert pid.value == 0.5
    assert [pid.update(cost) for cost in (3, 3, 3, 0)] == [1.5, 2.0, 2.0, 1.5]


@pytest.mark.parametrize("gain", ["pid_kp", "pid_ki", "pid_kd"])
def test_grows_above_the_limit_and_falls_below(gain):
    pid = PIDLagrangian(1.0, **{"pid_kp": 0.0, "pid_ki": 0.0, "pid_kd": 0.0, gain: 0.1})
    growing = [pid.update(cost) for cost in range(2, 9)]
    assert growing == sorted(growing) and growing[-1] > 0
    falling = [pid.update(0) for _ in range(200)]
    assert falling[-1] == 0 and falling[20:] == sorted(falling[20:], reverse=True)


def test_a_restored_multiplier_goes_on_as_the_saved_one():
    costs = np.random.default_rng(0).exponential(2.0, 60)
    pid, restored = PIDLagrangian(1.5, pid_kd=0.3), PIDLagrangian(1.5, pid_kd=0.3)
    for cost in costs[:30]:
        pid.update(cost)
    restored.load_state_dict(pid.state_dict())
    assert [restored.update(cost) for cost in costs[30:]] == [pid.update(cost) for cost in costs[30:]]


# ---- SACLag's maths ----


def test_actor_loss_on_hand_made_numbers():
    log_prob, q_values = th.tensor([1.0, -2.0]), th.tensor([[5.0, 3.0], [0.0, 1.0]])
    costs = th.tensor([[1.0, 2.0], [4.0, 3.0]])
    # (0.5 * 1 - 3 + 3 * 2) / 4 = 0.875 and (0.5 * -2 - 0 + 3 * 4) / 4 = 2.75
    assert constrained_actor_loss(log_prob, q_values, costs, 0.5, 3.0).item() == pytest.approx((0.875 + 2.75) / 2)


def constant(critic, *values):
    with th.no_grad():
        for network, value in zip(critic.q_networks, values, strict=True):
            network[-1].weight.zero_()
            network[-1].bias.fill_(value)


@pytest.mark.parametrize("cost_gamma, cost_discount", [(None, 0.9), (0.5, 0.5)])
def test_targets_on_hand_made_numbers(cost_gamma, cost_discount):
    """Rewards take the smaller value and the entropy bonus; costs the greater one, and no bonus."""
    model = make_model(SACLag, gamma=0.9, cost_gamma=cost_gamma)
    constant(model.critic_target, 10.0, 20.0)
    constant(model.cost_critic_target, 3.0, 4.0)
    add = model.replay_buffer.add
    for reward, cost, done in ((1.0, 0.25, 0.0), (2.0, 0.75, 1.0)):
        add(np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), np.array([reward]), np.array([done]), [{"cost": cost}])
    batch = model.replay_buffer.sample(32)
    set_random_seed(1)
    targets, cost_targets = model._targets(batch, th.tensor(0.5))
    set_random_seed(1)
    _, log_prob = model.actor.action_log_prob(batch.next_observations)
    goes_on = 1 - batch.dones
    assert set(batch.costs.flatten().tolist()) == {0.25, 0.75}
    assert th.allclose(targets, batch.rewards + goes_on * 0.9 * (10 - 0.5 * log_prob[:, None].detach()))
    assert th.allclose(cost_targets, batch.costs + goes_on * cost_discount * 4)


def test_without_a_multiplier_sac_lag_learns_what_sac_learns():
    model = make_model(SACLag, pid_kp=0, pid_ki=0, pid_kd=0).learn(60)
    sac = make_model(SAC)
    sac.policy.load_state_dict(model.policy.state_dict(), strict=False)
    sac.log_ent_coef.data = model.log_ent_coef.detach().clone()
    for name in ("actor", "critic"):
        getattr(sac, name).optimizer.load_state_dict(deepcopy(getattr(model, name).optimizer.state_dict()))
    sac.ent_coef_optimizer.load_state_dict(deepcopy(model.ent_coef_optimizer.state_dict()))
    sac.replay_buffer = model.replay_buffer
    for each in (model, sac):
        each.set_logger(configure(None, []))
        set_random_seed(0)
        each.train(gradient_steps=5, batch_size=16)
    own = model.policy.state_dict()
    assert all(th.allclose(value, own[name], atol=1e-6) for name, value in sac.policy.state_dict().items())


def fill(buffer, n_steps, n_envs, done_at=()):
    """Rewards tell environment and step; a cost is a tenth of them."""
    space = buffer.observation_space
    for step in range(n_steps):
        rewards = np.array([100.0 * env + step for env in range(n_envs)])
        obs = {key: rewards[:, None] for key in space} if isinstance(space, spaces.Dict) else rewards[:, None]
        following = {key: value + 1 for key, value in obs.items()} if isinstance(obs, dict) else obs + 1
        infos = [{"cost": reward / 10} for reward in rewards]
        buffer.add(obs, following, np.zeros((n_envs, 1)), rewards, np.full(n_envs, step in done_at), infos)


@pytest.mark.parametrize("memory", ["plain", "optimized", "Dict"])
def test_costs_are_those_of_the_sampled_transitions(memory):
    kwargs = dict(optimize_memory_usage=True, handle_timeout_termination=False) if memory == "optimized" else {}
    buffer_class, env = (CostDictReplayBuffer, SpeedLimitDict) if memory == "Dict" else (CostReplayBuffer, SpeedLimit)
    buffer = buffer_class(30, env.observation_space, env.action_space, n_envs=3, **kwargs)
    for n_steps in (6, 20):  # the second time it is full and begins anew
        fill(buffer, n_steps, 3)
        batch = buffer.sample(200)
        obs = batch.observations["map"] if memory == "Dict" else batch.observations
        assert len(set(batch.rewards.flatten().tolist())) > 10
        assert th.allclose(batch.costs, batch.rewards / 10) and th.equal(batch.rewards, obs)
        assert batch.costs.shape == (200, 1)


def test_n_step_costs():
    model = make_model(SACLag, make_vec_env(SpeedLimit, 2), n_steps=3, gamma=0.9, cost_gamma=0.5)
    assert isinstance(model.replay_buffer, CostNStepReplayBuffer)
    fill(model.replay_buffer, 8, 2, done_at=(3,))
    batch = model.replay_buffer.sample(300)
    firsts, costs, discounts = (
        tensor.flatten().tolist() for tensor in (batch.observations, batch.costs, batch.cost_discounts)
    )
    for first, cost, cost_discount, discount in zip(firsts, costs, discounts, batch.discounts.flatten().tolist(), strict=True):
        step = int(first) % 100
        n_costs = min(3, (4 if step < 4 else 8) - step)  # ends after step 3, and with what there is
        assert cost == pytest.approx(sum(0.5**k * (first + k) / 10 for k in range(n_costs)))
        assert (cost_discount, discount) == pytest.approx((0.5**n_costs, 0.9**n_costs))
    model.learn(60)
    assert model._n_updates > 0


def test_critic_of_costs_reaches_their_discounted_sum():
    """Cost 1 for ever, cut off every 4 steps by the time limit: 1 / (1 - 0.8) = 5; Q of the reward has another discount."""
    kwargs = dict(gamma=0.5, cost_gamma=0.8, tau=0.5, learning_rate=1e-2, ent_coef=0.0)
    model = make_model(SACLag, Bill([1.0] * 4, blind=True), **kwargs).learn(400)
    obs, actions = th.zeros(1, 1), th.zeros(1, 1)
    assert th.cat(model.cost_critic(obs, actions), 1).mean().item() == pytest.approx(5, abs=0.5)
    assert th.cat(model.critic(obs, actions), 1).mean().item() == pytest.approx(2, abs=0.3)


# ---- PPOLag's maths ----


def test_combined_advantages_on_hand_made_numbers():
    rewards, costs = th.tensor([1.0, 3.0, 5.0]), th.tensor([0.0, 0.5, 4.0])
    raw = constrained_advantages(rewards, costs, 3.0, normalize=False)
    assert raw.tolist() == pytest.approx([0.25, 0.375, -1.75])
    # Standard deviation 2, as torch counts it; the mean of the costs is 1.5
    normalized = constrained_advantages(rewards, costs, 3.0, normalize=True)
    assert normalized.tolist() == pytest.approx([(-1 + 4.5) / 4, 3.0 / 4, (1 - 7.5) / 4])
    assert constrained_advantages(rewards[:1], costs[2:], 1.0, normalize=True).tolist() == [-1.5]


def test_cost_advantages_equal_an_independent_computation():
    """Two environments, one cut off by its time limit every 4 steps, one that ends after 3; the rollout ends in between."""
    gamma, gae_lambda, n_steps = 0.8, 0.7, 10
    costs = ([0.5, 0.0, 2.0, 1.0], [1.0, 3.0, 0.25])
    env = bills(dict(costs=costs[0], length=4), dict(costs=costs[1], length=3, truncated=False))
    model = make_model(PPOLag, env, n_steps=n_steps, batch_size=20, cost_gamma=gamma, cost_gae_lambda=gae_lambda, gamma=0.99)
    _, callback = model._setup_learn(100)
    assert model.collect_rollouts(env, callback, model.rollout_buffer, n_steps)
    buffer = model.rollout_buffer

    def value(steps):  # the observation is the number of steps
        return model.policy.predict_cost_values(th.full((1, 1), float(steps))).item()

    for idx, (bill, length) in enumerate(zip(costs, (4, 3), strict=True)):
        for start in range(n_steps):
            at, advantage = start % length, 0.0
            for k in itertools.count():
                step = at + k
                # Beyond the end of an episode there is nothing, beyond a time limit there is
                following = 0.0 if idx == 1 and step + 1 == length else value(step + 1)
                advantage += (gamma * gae_lambda) ** k * (bill[step] + gamma * following - value(step))
                if step + 1 == length or start + k + 1 == n_steps:
                    break
            assert buffer.cost_advantages[start, idx] == pytest.approx(advantage, abs=1e-5)
            assert buffer.cost_returns[start, idx] == pytest.approx(advantage + value(at), abs=1e-5)
    assert sorted(model.finished_costs) == [3.5, 3.5, 4.25, 4.25, 4.25]
    rewards = buffer.rewards[:, 1]
    assert np.array_equal(rewards, np.ones(n_steps))

    # Minibatches hold rows that belong together
    table = {(float(o), float(c)) for o, c in zip(buffer.observations.flatten(), buffer.cost_returns.flatten(), strict=True)}
    batch = next(buffer.get(7))
    assert {(o, c) for o, c in zip(batch.observations.flatten().tolist(), batch.cost_returns.tolist(), strict=True)} <= table


@pytest.mark.parametrize("gears", [False, True])
def test_without_a_multiplier_ppo_lag_learns_what_ppo_learns(gears):
    env = make_vec_env(SpeedLimitGears if gears else SpeedLimit, 2, seed=0)
    kwargs = dict(max_grad_norm=1e9, clip_range_vf=0.2, target_kl=0.05, ent_coef=0.01)
    model = make_model(PPOLag, env, pid_kp=0, pid_ki=0, pid_kd=0, **kwargs)
    ppo = make_model(PPO, env, n_steps=32, **kwargs)
    ppo.policy.load_state_dict(model.policy.state_dict(), strict=False)
    _, callback = model._setup_learn(100)
    model.collect_rollouts(env, callback, model.rollout_buffer, 32)
    for name in ("observations", "actions", "values", "log_probs", "advantages", "returns"):
        setattr(ppo.rollout_buffer, name, getattr(model.rollout_buffer, name).copy())
    ppo.rollout_buffer.full = True
    for each in (model, ppo):
        each.set_logger(configure(None, []))
        np.random.seed(0)
        each.train()
    own, logs = model.policy.state_dict(), ppo.logger.name_to_value
    assert all(th.allclose(value, own[name], atol=1e-6) for name, value in ppo.policy.state_dict().items())
    for name in logs.keys() - {"train/loss", "train/n_updates"}:
        assert model.logger.name_to_value[name] == pytest.approx(logs[name], abs=1e-5), name
    assert model._n_updates == ppo._n_updates


def test_cost_value_reaches_the_discounted_sum():
    model = make_model(PPOLag, Bill([1.0] * 4, blind=True), cost_gamma=0.8, learning_rate=1e-2).learn(800)
    assert model.policy.predict_cost_values(th.zeros(1, 1)).item() == pytest.approx(5, abs=0.3)


# ---- When the multiplier moves ----


def test_sac_lag_moves_it_after_every_episode_once_the_warm_up_is_over():
    env = bills(dict(costs=[1.0, 0.5]), dict(costs=[4.0], length=2))  # episode costs 1.5 after 4 steps, 4 after 2
    model = make_model(SACLag, env, lagrange_start=8, pid_kp=0, pid_kd=0, pid_ki=1.0, cost_limit=1.0)
    seen = []
    model.learn(24, callback=lambda local, _: seen.append(model.multiplier.value) is None)
    # The callback of a step (2 transitions) comes before it is counted; 3.5 = (1.5 - 1) + (4 - 1)
    assert seen == [0, 0, 0, 0, 0, 0, 3, 3, 6.5, 6.5, 9.5, 9.5]
    assert model.multiplier.value == 13.0
    assert model.safety_cost == 3 * 1.5 + 6 * 4.0
    assert list(model.ep_cost_buffer) == [4.0, 1.5, 4.0] * 3


def test_ppo_lag_moves_it_by_the_mean_of_the_rollout_before_the_policy():
    env = bills(dict(costs=[1.0, 0.5]), dict(costs=[4.0], length=2))
    model = make_model(PPOLag, env, n_steps=5, batch_size=10, pid_kp=0, pid_kd=0, pid_ki=1.0, cost_limit=1.0)
    used = []
    loss = model._loss
    model._loss = lambda batch: used.append(model.multiplier.value) or loss(batch)
    model.learn(30)
    # In the rollouts of 5 steps, episodes of cost 4 1.5 4 | 4 1.5 4 4 | 4 1.5 4 end
    means = np.array([9.5 / 3, 13.5 / 4, 9.5 / 3])
    assert sorted(set(used)) == pytest.approx(np.cumsum(means - 1))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_cost_of_an_episode_that_is_broken_off_is_forgotten(algorithm):
    model = make_model(algorithm, Bill([1.0] * 100, length=100))
    model.learn(64)
    assert model.episode_costs.sums == [64]
    model.learn(32, reset_num_timesteps=False)  # goes on in the same episode
    assert model.episode_costs.sums == [96]
    model.learn(32)
    assert model.episode_costs.sums == [32] and model.safety_cost == 128 and not model.ep_cost_buffer


# ---- As SB3's users expect ----


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("policy, make_env, n_envs", [
    ("MlpPolicy", SpeedLimit, 2), ("MultiInputPolicy", SpeedLimitDict, 2), ("CnnPolicy", SpeedLimitPicture, 1)
])  # fmt: skip
@pytest.mark.parametrize("share", [False, True])
def test_policies_and_parallel_environments(algorithm, policy, make_env, n_envs, share, tmp_path):
    extractor = dict(features_extractor_kwargs=dict(features_dim=8)) if policy == "CnnPolicy" else {}
    kwargs = dict(share_features_extractor=share, **extractor)
    model = make_model(algorithm, make_vec_env(make_env, n_envs, seed=0), policy, policy_kwargs=kwargs)
    initial = {name: param.clone() for name, param in model.policy.state_dict().items()}
    model.learn(60)
    assert model._n_updates > 0
    trained = model.policy.state_dict()
    for part in ("cost_critic.", "cost_critic_target.") if algorithm is SACLag else ("cost_value_net.",):
        assert any(not th.equal(trained[name], initial[name]) for name in trained if name.startswith(part)), part
    model.save(tmp_path / "model")
    obs = model.get_env().reset()
    loaded = algorithm.load(tmp_path / "model", model.get_env())
    assert np.array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])


@pytest.mark.parametrize(
    "algorithm, kwargs",
    [
        (SACLag, {"use_sde": True, "sde_sample_freq": 4, "use_sde_at_warmup": True}),
        (SACLag, {"ent_coef": 0.1, "train_freq": (1, "episode"), "gradient_steps": -1}),
        (SACLag, {"replay_buffer_kwargs": dict(handle_timeout_termination=False), "optimize_memory_usage": True}),
        (SACLag, {"n_steps": 3, "target_update_interval": 2}),
        (PPOLag, {"use_sde": True, "sde_sample_freq": 4, "policy_kwargs": dict(squash_output=True)}),
        (PPOLag, {"clip_range_vf": 0.2, "normalize_advantage": False, "target_kl": 1e-6}),
        (PPOLag, {"policy_kwargs": dict(net_arch=dict(pi=[4]), ortho_init=False)}),
    ],
)
def test_options_and_training_goes_on_as_if_never_saved(algorithm, kwargs, tmp_path):
    model = make_model(algorithm, **kwargs).learn(110)
    assert model.multiplier.value > 0
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=SpeedLimit())
    assert_same_parameters(model, loaded)
    assert (loaded.ep_cost_buffer, loaded.safety_cost) == (model.ep_cost_buffer, model.safety_cost)
    if algorithm is SACLag:
        model.save_replay_buffer(tmp_path / "buffer")
        loaded.load_replay_buffer(tmp_path / "buffer")
    model.set_env(SpeedLimit())
    for each in (model, loaded):
        set_random_seed(0)
        each.get_env().seed(0)
        each.learn(64, reset_num_timesteps=False)
    assert_same_parameters(model, loaded)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_set_parameters_and_new_arguments_on_loading(algorithm, tmp_path):
    model = make_model(algorithm).learn(110)
    other = make_model(algorithm, seed=5)
    other.set_parameters(model.get_parameters())
    assert_same_parameters(model, other)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", cost_limit=7.0, pid_ki=0.5)
    assert (loaded.multiplier.cost_limit, loaded.multiplier.ki) == (7.0, 0.5)
    assert loaded.multiplier.value == model.multiplier.value > 0


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_same_seed_same_run(algorithm):
    a, b = (make_model(algorithm, make_vec_env(SpeedLimit, 2, seed=3), seed=3).learn(130) for _ in range(2))
    assert_same_parameters(a, b)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_vec_normalize_leaves_costs_alone(algorithm):
    env = VecNormalize(bills(dict(costs=[50.0] * 4), dict(costs=[50.0] * 4)))
    model = make_model(algorithm, env, gamma=0.9, cost_gamma=0.0).learn(128)
    if algorithm is SACLag:
        batch = model.replay_buffer.sample(20, env)
        assert set(batch.costs.flatten().tolist()) == {50.0} and batch.rewards.abs().max() < 1.0
    else:
        assert set(model.rollout_buffer.costs.flatten()) == {50.0}
    assert set(model.ep_cost_buffer) == {200.0}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_logs(algorithm, tmp_path):
    model = make_model(algorithm, Bill([1.0, 1.0]), cost_limit=0.5)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(160, log_interval=1)
    names, *rows = [line.split(",") for line in (tmp_path / "progress.csv").read_text().splitlines()]
    last = dict(zip(names, rows[-1], strict=True))
    assert (float(last["rollout/ep_cost_mean"]), float(last["train/cost_limit"])) == (2.0, 0.5)
    assert float(last["safety/safety_cost"]) == 80
    assert float(last["train/lagrange_multiplier"]) > 0
    own = ("cost_q_mean", "cost_critic_loss") if algorithm is SACLag else ("cost_value_loss", "cost_explained_variance")
    assert {f"train/{name}" for name in own} <= set(names)


# ---- Mistakes ----


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize(
    "cost, got, remedy",
    [(None, "'none'", ".*wrap this one"), (np.nan, "nan", "mend the env"), ("a lot", "'a lot'", "mend the env")],
)
@pytest.mark.parametrize("step", [0, 30])
def test_missing_costs_are_one_error_and_nothing_is_lost(algorithm, cost, got, remedy, step, tmp_path):
    env = bills(dict(costs=[1.0] * 100, length=50), dict(costs=[1.0] * step + [cost], length=50))
    model = make_model(algorithm, env)
    message = rf"info\['cost'\] of environment 1 must be a finite number at every step, got {got}: {remedy}"
    with pytest.raises(ValueError, match=message):
        model.learn(100)
    buffer = model.replay_buffer if algorithm is SACLag else model.rollout_buffer
    assert buffer.pos == step and model.safety_cost == 2 * step
    model.save(tmp_path / "kept")
    assert algorithm.load(tmp_path / "kept").safety_cost == 2 * step


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize(
    "kwargs",
    [
        {"cost_limit": -1.0},
        {"cost_gamma": 1.5},
        {"gamma": -0.1},
        {"pid_kp": -0.1},
        {"pid_ki": float("nan")},
        {"pid_kd": "0.1"},
        {"pid_tau": 0.0},
        {"pid_delay": 0},
        {"lagrange_init": -1.0},
        {"lagrange_max": -1.0},
        {"learning_rate": -1.0},
    ],
    ids=str,
)
def test_arguments_out_of_range(algorithm, kwargs):
    (name,) = kwargs
    with pytest.raises(ValueError, match=rf"^{name} must be"):
        make_model(algorithm, **kwargs)


@pytest.mark.parametrize(
    "algorithm, kwargs, message",
    [
        (SACLag, {"lagrange_start": -1}, "^lagrange_start must be"),
        (SACLag, {"n_steps": 0}, "^n_steps must be"),
        (SACLag, {"env": SpeedLimitGears()}, "env: the action space must be continuous"),
        (SACLag, {"replay_buffer_class": HerReplayBuffer}, "replay_buffer_class must be a subclass of CostReplayBuffer"),
        (SACLag, {"env": SpeedLimitDict(), "policy": "MultiInputPolicy", "n_steps": 3}, "n_steps must be 1 for Dict"),
        (PPOLag, {"rollout_buffer_class": RolloutBuffer}, "rollout_buffer_class must be a subclass of CostRolloutBuffer"),
        (PPOLag, {"cost_gae_lambda": 1.1}, "^cost_gae_lambda must be"),
        (PPOLag, {"cost_vf_coef": -1}, "^cost_vf_coef must be"),
        (PPOLag, {"lagrange_init": 2.0, "lagrange_max": 1.0}, "^lagrange_init must be"),
    ],
)
def test_arguments_that_do_not_fit(algorithm, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_model(algorithm, **kwargs)


@pytest.mark.parametrize("algorithm, base, policy", [(SACLag, SAC, "SACLagPolicy"), (PPOLag, PPO, "CostActorCriticPolicy")])
def test_checkpoints_of_the_unconstrained_algorithm(algorithm, base, policy, tmp_path):
    other = base("MlpPolicy", SpeedLimit(), policy_kwargs=dict(net_arch=[8]))
    other.save(tmp_path / "other")
    with pytest.raises(ValueError, match=f"policy: {algorithm.__name__} needs a {policy}, got .*class that saved it"):
        algorithm.load(tmp_path / "other")


def test_a_replay_buffer_without_costs(tmp_path):
    model = make_model(SACLag)
    own = model.replay_buffer
    SAC("MlpPolicy", SpeedLimit(), buffer_size=10).save_replay_buffer(tmp_path / "plain")
    with pytest.raises(ValueError, match="holds no CostReplayBuffer, got ReplayBuffer"):
        model.load_replay_buffer(tmp_path / "plain")
    assert model.replay_buffer is own and type(own) is not ReplayBuffer


def test_ppo_lag_recommends_the_cpu_as_ppo_does():
    model = make_model(PPOLag)
    model.device = th.device("cuda")
    with pytest.warns(UserWarning, match="You are trying to run PPOLag on the GPU"):
        model._maybe_recommend_cpu()


# ---- The effect ----


def mean_cost(model, make_env):
    """Of 30 episodes, with the policy that acts in training."""
    costs = []
    env = make_vec_env(make_env, 1, seed=100)
    evaluate_policy(model, env, 30, deterministic=False, callback=lambda local, _: costs.append(local["infos"][0]["cost"]))
    return sum(costs) / 30


def test_sac_lag_keeps_to_the_limit_and_sac_does_not():
    kwargs = dict(gamma=0.5, learning_rate=3e-3, tau=0.05, ent_coef=0.01, train_freq=2, batch_size=64, learning_starts=100)
    kwargs |= dict(policy_kwargs=dict(net_arch=[32]), buffer_size=5000)
    assert mean_cost(make_model(SAC, **kwargs).learn(800), SpeedLimit) > 15
    model = make_model(SACLag, cost_limit=5.0, lagrange_start=200, **kwargs).learn(2000)
    assert 1.5 < mean_cost(model, SpeedLimit) < 7.5
    assert 0.3 < model.multiplier.value < 5


def test_ppo_lag_keeps_to_the_limit_and_ppo_does_not():
    kwargs = dict(gamma=0.5, gae_lambda=0.5, learning_rate=3e-3, n_steps=128, batch_size=64, n_epochs=5, ent_coef=0.01)
    kwargs |= dict(policy_kwargs=dict(net_arch=[32]))
    assert mean_cost(make_model(PPO, make_vec_env(SpeedLimitGears, 4, seed=0), **kwargs).learn(4000), SpeedLimitGears) > 15
    constraint = dict(cost_limit=5.0, pid_ki=0.1, pid_kp=1.0, pid_kd=0.0, pid_tau=1.0)
    model = make_model(PPOLag, make_vec_env(SpeedLimitGears, 4, seed=0), **constraint, **kwargs).learn(8000)
    assert 1.5 < mean_cost(model, SpeedLimitGears) < 7.5
    assert 0.3 < model.multiplier.value < 10
