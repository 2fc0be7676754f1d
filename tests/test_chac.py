"""C-HAC: who acts, when the second stage begins, and what learns in which stage."""

import inspect
import operator
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from guided_toys import Limited, column, make_batch, make_guided, parameters, same, scripted, silent, wrapper
from scipy.stats import norm
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import set_random_seed

from sb3_chac import CHAC, DPVP, DSAC
from sb3_chac.common.buffers import DualReplayBufferSamples
from sb3_chac.common.distributional import probability_of_improvement
from sb3_chac.zoo.algorithms import hyperparams_file

OBS = np.random.default_rng(0).normal(size=(40, 2)).astype(np.float32)


def make_chac(env=None, **kwargs):
    return make_guided(CHAC, env, **kwargs)


def own_actors(model):
    """pi_r, its target and its average."""
    return model.self_actor, model.self_actor_target, model.policy.averaged_self_actor


@th.no_grad()
def shift_pi_r(model, shift):
    for actor in own_actors(model):
        actor.mu.bias += shift


def in_stage_2(env=None, shift=0.5, **kwargs):
    """A model in stage 2 whose pi_r is ``shift`` to the right of pi_g."""
    model = silent(make_chac(env, **kwargs))
    model._start_stage_2() if len(model.replay_buffer.novice) else model.policy.start_stage_2()
    shift_pi_r(model, shift)
    return model


class HandSet:
    """A critic whose Q and sigma are functions of the action."""

    def __init__(self, q_value, std):
        self.q_value, self.std = q_value, std

    def pessimistic(self, obs, actions):
        ones = th.ones(len(actions))
        return ones * self.q_value(actions), ones * self.std(actions)


def set_critic(model, q_value, std=lambda actions: 1.0):
    model.confidence_critic.pessimistic = HandSet(q_value, std).pessimistic


def predict(model, who, obs=OBS, deterministic=True):
    return model.predict(obs, deterministic=deterministic, control=who)[0]


# --- The page of the paper's symbols


def test_the_papers_symbols_are_where_the_page_says():
    page = (Path(__file__).parents[1] / "docs" / "modules" / "chac.md").read_text(encoding="utf-8")
    table = page.partition("| symbol | attribute |\n|---|---|\n")[2].partition("\n\n")[0]
    model = silent(make_chac())
    model.learn(1)
    rows = [line.split("|") for line in table.splitlines()]
    symbols = {symbol.strip().partition(",")[0] for _, symbol, _, _ in rows}
    assert {"π_g", "π_r", "Z_g", "Z_c", "B_h", "I", "T_c", "N_g", "θ_c", "κ", "δ"} <= symbols
    for _, symbol, cell, _ in rows:
        names = re.findall(r"`([^`]+)`( of a batch)?", cell)
        assert names, symbol
        for name, of_a_batch in names:
            if of_a_batch:
                assert name in DualReplayBufferSamples._fields
            elif key := re.fullmatch(r'info\["(\w+)"\]', name):
                assert key[1] in model.get_env().step(np.zeros((1, 2)))[3][0]
            else:
                operator.attrgetter(name)(model)


# --- Confidence and choice


def test_probability_of_improvement_is_that_of_normal_distributions():
    rng = np.random.default_rng(0)
    q, baseline_q = rng.normal(size=(2, 200)) * 3
    std, baseline_std = rng.uniform(0.1, 3, size=(2, 200))
    expected = norm.cdf((q - baseline_q) / np.hypot(std, baseline_std))
    actual = probability_of_improvement(*(th.as_tensor(x) for x in (q, std, baseline_q, baseline_std)))
    assert np.allclose(actual, expected, atol=1e-12)
    swapped = probability_of_improvement(*(th.as_tensor(x) for x in (baseline_q, baseline_std, q, std)))
    assert th.allclose(actual + swapped, th.ones(200, dtype=th.float64))


def test_equal_distributions_are_a_toss_up():
    ones = th.ones(3)
    assert probability_of_improvement(ones, ones, ones, ones).tolist() == [0.5] * 3


def test_probability_of_improvement_is_what_samples_show():
    rng = np.random.default_rng(0)
    wins = (rng.normal(1.0, 2.0, 100_000) > rng.normal(0.5, 1.0, 100_000)).mean()
    assert probability_of_improvement(*map(th.tensor, (1.0, 2.0, 0.5, 1.0))).item() == pytest.approx(wins, abs=0.01)


# The gain of pi_r at which Phi(gain / sqrt(2)) is 0.85
GAIN = norm.ppf(0.85) * 2**0.5


@pytest.mark.parametrize(
    "gain, std, sigma_scale, self_drives",
    [
        (GAIN * 1.01, 1.0, 1.0, True),
        (GAIN * 0.99, 1.0, 1.0, False),
        (-GAIN, 1.0, 1.0, False),
        (GAIN * 0.51, 0.5, 1.0, True),  # the less spread, the smaller a gain is enough
        (GAIN * 0.49, 0.5, 1.0, False),
        (GAIN * 0.101, 1.0, 0.1, True),
        (GAIN * 0.099, 1.0, 0.1, False),
    ],
)
def test_pi_r_acts_where_one_can_be_confident(gain, std, sigma_scale, self_drives):
    policy = in_stage_2(sigma_scale=sigma_scale, delta=0.15).policy
    obs = th.as_tensor(OBS)
    guided = policy.actor(obs, deterministic=True).detach()
    ours = guided + 0.25
    with th.no_grad():
        choice = policy.choose(obs, ours, HandSet(lambda actions: gain * (actions - guided)[:, 0] / 0.25, lambda actions: std))
    assert choice.self_drives.tolist() == [self_drives] * len(OBS)
    assert th.equal(choice.actions, ours if self_drives else guided)
    assert choice.confidence.numpy() == pytest.approx(norm.cdf(gain / (sigma_scale * std * 2**0.5)), abs=1e-4)
    assert choice.q_self.numpy() == pytest.approx(gain, abs=1e-4) and choice.q_guided.numpy() == pytest.approx(0, abs=1e-4)
    assert (choice.std_self == std).all() and (choice.std_guided == std).all()


def test_each_state_has_its_own_choice():
    policy = in_stage_2(delta=0.5).policy
    obs = th.as_tensor(OBS)
    guided = policy.actor(obs, deterministic=True)
    better = th.arange(len(OBS)) % 3 == 0
    choice = policy.choose(
        obs, guided + 0.1, HandSet(lambda a: th.where(better, 1.0, -1.0) * (a - guided)[:, 0], lambda a: 1.0)
    )
    assert th.equal(choice.self_drives, better)
    assert th.equal(choice.actions, guided + 0.1 * better.unsqueeze(1))


def test_the_critic_with_the_smaller_mean_decides():
    model = in_stage_2(delta=0.5)
    obs, actions = th.as_tensor(OBS), th.zeros(len(OBS), 2)
    with th.no_grad():
        q_values, _ = model.confidence_critic(obs, actions)
        model.confidence_critic.z_networks[-1].bias[0, ..., 0] -= (q_values[0] - q_values[1]).median()
        choice = model.policy.choose(obs, actions, model.confidence_critic)
        q_values, stds = model.confidence_critic(obs, actions)
    smaller = q_values.argmin(dim=0)
    assert 0 < smaller.sum() < len(OBS)
    assert th.equal(choice.q_self, q_values.min(dim=0).values)
    assert th.equal(choice.std_self, stds[smaller, th.arange(len(OBS))])


def tilted(sign):
    """Q rises or falls with the action, too little for any confidence."""
    return lambda actions: sign * 1e-3 * actions[:, 0]


@pytest.mark.parametrize(
    "delta, sign, expected", [(0.0, 1, "guided"), (1.0, -1, "self"), (0.5, 1, "self"), (0.5, -1, "guided")]
)
def test_extremes_of_delta(delta, sign, expected):
    """0: pi_g alone; 1: pi_r alone; 0.5: who has the greater mean ("No Confidence"), whatever sigma says."""
    model = in_stage_2(delta=delta)
    set_critic(model, tilted(sign), std=lambda actions: 1 + 5 * actions[:, 1].abs())
    assert np.array_equal(predict(model, "shared"), predict(model, expected))
    assert not np.allclose(predict(model, "self"), predict(model, "guided"), atol=0.01)


@pytest.mark.parametrize("gain", [1e6, -1e6])
def test_delta_0_leaves_pi_g_alone_however_great_the_gain(gain):
    model = in_stage_2(delta=0.0)
    set_critic(model, lambda actions: gain * actions[:, 0], std=lambda actions: 1e-6)
    assert np.array_equal(predict(model, "shared"), predict(model, "guided"))


def test_without_shared_control_pi_r_acts():
    """The ablation "No Share"; the other policies can still be asked for."""
    model = in_stage_2(shared_control=False, delta=0.0)
    assert np.array_equal(model.predict(OBS, deterministic=True)[0], predict(model, "self"))
    assert np.array_equal(predict(model, "shared"), predict(model, "guided"))


def test_shared_control_is_the_default_of_predict():
    model = in_stage_2(delta=0.5)
    set_critic(model, lambda actions: th.sign(actions[:, 0]) * actions[:, 0])
    shared = predict(model, "shared")
    assert np.array_equal(model.predict(OBS, deterministic=True)[0], shared)
    drives = model.policy.last_choice.self_drives.numpy()
    assert 0 < drives.sum() < len(OBS)
    assert np.array_equal(shared, np.where(drives[:, None], predict(model, "self"), predict(model, "guided")))


def test_samples_of_pi_r_compete_with_the_mode_of_pi_g():
    model = in_stage_2(delta=0.5)
    set_critic(model, tilted(-1))  # pi_r, shifted to the right, loses nearly always
    shift_pi_r(model, 5)
    assert np.array_equal(predict(model, "shared", deterministic=False), predict(model, "guided"))
    set_critic(model, tilted(1))
    set_random_seed(0)
    sampled = predict(model, "self", deterministic=False)
    set_random_seed(0)
    assert np.array_equal(predict(model, "shared", deterministic=False), sampled)
    assert not np.array_equal(sampled, predict(model, "self"))


def test_in_stage_1_pi_g_acts():
    model = make_chac()
    expected = predict(model, "guided")
    shift_pi_r(model, 1)
    for who in (None, "shared", "self"):
        assert np.array_equal(predict(model, who), expected)
    set_random_seed(0)
    a = predict(model, None, deterministic=False)
    assert not np.array_equal(a, expected)


@pytest.mark.parametrize("who", ["human", "", 3])
def test_unknown_policies_are_refused(who):
    model = in_stage_2()
    with pytest.raises(ValueError, match=r"^control must be one of 'guided', 'self', 'shared'"):
        predict(model, who)
    assert model.policy.control == "shared"


# --- The switch


def ready(**kwargs):
    """A model for which all conditions hold: 100 steps, some updates, sigma 1, log pi 0."""
    model = make_chac(switch_after=99, **kwargs)
    model.counts["total_steps"], model._n_updates = 100, 1
    model.confidence_critic.mean_std.fill_(1.0)
    model._mean_log_prob = lambda: 0.0
    return model


def test_the_guidance_ends_after_switch_after_steps():
    model = ready()
    assert model._guidance_is_over()
    model.counts["total_steps"] = 99
    assert not model._guidance_is_over()


@pytest.mark.parametrize(
    "kwargs, over",
    [
        ({"sigma_threshold": 1.1}, True),
        ({"sigma_threshold": 0.9}, False),
        ({"log_prob_threshold": 0.1}, True),
        ({"log_prob_threshold": -0.1}, False),
        ({"sigma_threshold": 1.1, "log_prob_threshold": 0.1}, True),
        ({"sigma_threshold": 0.9, "log_prob_threshold": 0.1}, False),
        ({"sigma_threshold": 1.1, "log_prob_threshold": -0.1}, False),
    ],
    ids=str,
)
def test_conditions_of_the_switch(kwargs, over):
    model = ready(**kwargs)
    assert model._guidance_is_over() == over
    model._n_updates = 0  # nothing is learned yet
    assert not model._guidance_is_over()


def test_mean_log_prob_is_that_of_pi_g():
    model = make_chac().learn(30)
    with th.no_grad():
        model.actor.mu.weight.zero_()
        model.actor.mu.bias.zero_()
        model.actor.log_std.weight.zero_()
        model.actor.log_std.bias.fill_(-3.0)
    # Two actions near 0, where tanh is the identity
    expected = 2 * norm(scale=np.exp(-3)).entropy()
    assert np.mean([model._mean_log_prob() for _ in range(300)]) == pytest.approx(-expected, abs=0.15)


@pytest.mark.parametrize(
    "kwargs, stage", [({"switch_after": 39}, 2), ({"switch_after": 40}, 1), ({"sigma_threshold": 1e-6}, 1)]
)
def test_the_switch_happens_in_the_run(kwargs, stage):
    model = make_chac(**({"switch_after": 0} | kwargs)).learn(40)
    assert model.stage == stage


def test_steps_of_all_environments_and_all_runs_count():
    model = make_chac(scripted("01" * 99, "10" * 99), switch_after=59).learn(40)
    assert model.stage == 1
    model.learn(20)
    assert model.stage == 2


@pytest.mark.parametrize("average_tau", [1.0, 0.01])
def test_pi_r_starts_where_pi_g_is(average_tau):
    """Where its average is, which is what pi_g is from then on."""
    model = make_chac(average_tau=average_tau).learn(40)
    model.self_actor.optimizer.state[model.self_actor.mu.bias]["step"] = th.tensor(5.0)
    guided = predict(model, "guided")
    before = parameters(model)
    model._start_stage_2()
    assert model.stage == 2
    average = dict(model.policy.averaged_actor.state_dict())
    actors = (model.actor, *own_actors(model))
    assert all(same(dict(actor.state_dict()), average) for actor in actors)
    assert len({param.data_ptr() for actor in actors for param in actor.parameters()}) == 4 * len(
        list(model.actor.parameters())
    )
    assert len(model.self_actor.optimizer.state) == 0
    for part in ("averaged_actor.", "critic.", "critic_target."):
        assert same(parameters(model, part), {name: value for name, value in before.items() if name.startswith(part)})
    changed = not same(parameters(model, "actor."), {k: v for k, v in before.items() if k.startswith("actor.")})
    assert changed == (average_tau < 1)
    for who in ("guided", "self"):
        assert np.array_equal(predict(model, who), guided)


@pytest.mark.parametrize("prefit_steps", [0, 7])
def test_z_c_is_fitted_at_the_switch(prefit_steps):
    model = make_chac(prefit_steps=prefit_steps).learn(40)
    before, n_updates, batches = parameters(model, "confidence_critic"), model._n_updates, []
    update = model._update_confidence_critic
    model._update_confidence_critic = lambda batch: batches.append(batch) or update(batch)
    model._start_stage_2()
    assert len(batches) == prefit_steps
    assert all(batch.takeovers.mean() == 0.5 for batch in batches)  # on both stores
    assert same(before, parameters(model, "confidence_critic")) == (prefit_steps == 0)
    assert model._n_updates == n_updates


def test_what_learns_in_each_stage():
    guided = ["actor.", "actor_target.", "averaged_actor.", "critic.", "critic_target."]
    confidence, own = (
        ["confidence_critic.", "confidence_critic_target."],
        ["self_actor.", "self_actor_target.", "averaged_self_actor."],
    )
    model = make_chac(ent_coef="auto_0.01")
    stages = [parameters(model)]
    for _ in range(3):
        model.learn(40, reset_num_timesteps=False)
        if model.stage == 1 and len(stages) == 2:
            model.switch_after = 0
        stages.append(parameters(model))
        if len(stages) == 2:
            assert model.stage == 1
    # learn(): stage 1; stage 1; stage 2, which begins with the first step
    for part in [*guided, *confidence]:
        assert not same(*({k: v for k, v in params.items() if k.startswith(part)} for params in stages[:2])), part
    for part in own:
        assert same(*({k: v for k, v in params.items() if k.startswith(part)} for params in stages[:2])), part
    model.learn(4, reset_num_timesteps=False)
    assert model.stage == 2
    before = parameters(model)
    human_steps = model.counts["human_steps"]
    model.learn(40, reset_num_timesteps=False)
    after = parameters(model)
    for part in guided:
        assert same(parameters(model, part), {k: v for k, v in before.items() if k.startswith(part)}), part
    for part in [*confidence, *own, "log_ent_coef"]:
        assert not same(*({k: v for k, v in params.items() if k.startswith(part)} for params in (before, after))), part
    assert model.counts["human_steps"] == human_steps


def test_the_human_is_no_longer_asked():
    model = make_chac(scripted("1" * 99), switch_after=30)
    model.learn(50)
    assert model.stage == 2
    assert len(model.replay_buffer.human) == 31 == wrapper(model).human_steps
    assert len(model.replay_buffer.novice) == 19
    assert wrapper(model).hud["stage"] == 2
    model.learn(10)
    assert len(model.replay_buffer.human) == 31
    assert len(wrapper(model).get_wrapper_attr("_supervisor").rule.proposed) == 31


@pytest.mark.parametrize("share, n_human", [(0.0, 0), (0.25, 4), (1.0, 16)])
def test_batches_of_each_stage(share, n_human):
    model = make_chac(stage2_human_share=share).learn(60)
    assert model._sample_batch(16).takeovers.sum() == 8
    model._start_stage_2()
    assert model._sample_batch(16).takeovers.sum() == n_human


@pytest.mark.parametrize("share, least", [(0.0, 0), (0.5, 8), (0.75, 12)])
def test_what_the_human_guarded_keeps_its_share_in_stage_2(share, least, tmp_path):
    """However much stage 2 adds, also after the buffer has been saved and loaded."""
    arguments = {"stage2_human_share": 0.25, "stage2_guided_share": share, "buffer_size": 1000}
    model = make_chac(switch_after=40, **arguments).learn(50)
    novice = model.replay_buffer.novice
    novice.arrays["takeover_follows"][:] = np.arange(len(novice.arrays["reward"]))[:, None] < model.replay_buffer.n_guided
    for row in ({name: array[-1] for name, array in novice.arrays.items()} for _ in range(900)):
        novice.append(row)
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = make_chac(**arguments)
    loaded.set_parameters(model.get_parameters())
    loaded.load_replay_buffer(tmp_path / "buffer")
    for one in (model, loaded):
        counts = [float(one._sample_batch(16).takeovers_follow.sum()) for _ in range(20)]
        assert min(counts) >= least and np.mean(counts) < least + 1


@pytest.mark.parametrize("shared_control", [True, False])
@pytest.mark.parametrize("sign, who", [(1, "self"), (-1, "guided")])
def test_the_executed_action_is_stored(shared_control, sign, who):
    """A sample of pi_r, or the mode of pi_g."""
    model = make_chac(scripted("1" * 99), switch_after=30, delta=0.5, shared_control=shared_control).learn(40)
    shift_pi_r(model, 3)
    for actor in own_actors(model):
        actor.log_std.bias.data.fill_(-1)
        for weight in (actor.log_std.weight, actor.mu.weight):
            weight.data.zero_()
    set_critic(model, tilted(sign))
    model.replay_buffer.reset()
    model.gradient_steps = 0
    model.learn(25)
    obs, actions = (column(model.replay_buffer.novice, name) for name in ("observation/", "action"))
    modes = {name: predict(model, name, obs) for name in ("guided", "self")}
    if shared_control and who == "guided":
        assert np.allclose(actions, modes["guided"], atol=1e-6)
    else:
        assert not np.allclose(actions, modes["self"], atol=1e-3)  # a sample
        assert np.abs(actions - modes["self"]).mean() < np.abs(actions - modes["guided"]).mean()


# --- The confidence distribution's target


@pytest.mark.parametrize(
    "stage, bootstrap, shared_control, expected",
    [
        (1, "executed", True, "guided sample"),
        (2, "self", True, "self sample"),
        (2, "executed", False, "self sample"),
        (2, "executed", True, "guided mode"),  # here pi_g wins
    ],
)
def test_z_c_bootstraps_on(stage, bootstrap, shared_control, expected):
    alpha = 0.05
    kwargs = dict(bootstrap=bootstrap, shared_control=shared_control, ent_coef=alpha, delta=0.0, gamma=0.5)
    model = make_chac(normalize_rewards=False, cost_coef=3.0, **kwargs).learn(30)
    if stage == 2:
        model.policy.start_stage_2()
        for actor in (model.self_actor, model.self_actor_target):
            actor.mu.bias.data += 1
    rng = np.random.default_rng(0)
    batch = make_batch(
        rng.normal(size=(6, 2)),
        rng.uniform(-1, 1, (6, 2)),
        [0, 1, 0, 1, 0, 1],
        next_observations=rng.normal(size=(6, 2)),
        rewards=rng.normal(size=6),
        dones=[0, 0, 0, 1, 0, 0],
        costs=[0, 1, 0, 0, 2, 0],
    )
    seen = {}
    model._critic_losses = lambda critic, batch, targets, eta: seen.update(critic=critic, targets=targets, eta=eta) or 1 / 0
    th.manual_seed(0)
    with pytest.raises(ZeroDivisionError):
        model._update_confidence_critic(batch)
    with th.no_grad():
        th.manual_seed(0)
        actor = model.actor_target if expected == "guided sample" else model.self_actor_target
        actions, log_prob = actor.action_log_prob(batch.next_observations)
        if expected == "guided mode":
            actions, log_prob = model.actor(batch.next_observations, deterministic=True), 0 * log_prob
        q_values = model.confidence_critic_target(batch.next_observations, actions)[0].min(dim=0).values
    rewards = (batch.rewards - 3 * batch.costs)[:, 0]
    y_q = rewards + 0.5 * (1 - batch.dones[:, 0]) * (q_values - alpha * log_prob)
    assert th.allclose(seen["targets"][0], y_q, atol=1e-6)
    assert seen["critic"] is model.confidence_critic


class Scaled(gym.RewardWrapper):
    """Rewards of another size."""

    def __init__(self, env, factor):
        super().__init__(env)
        self.factor = factor

    def reward(self, reward):
        return self.factor * reward


def test_stage_2_is_the_same_whatever_the_scale_of_the_reward():
    """All curves of the training, and what is learned."""
    learned = {}
    for factor in (1.0, 0.01, 100.0):
        set_random_seed(0)
        model = make_chac(Scaled(Limited(), factor), switch_after=60, prefit_steps=20, learning_rate=1e-3, seed=0).learn(150)
        assert model.stage == 2
        learned[factor] = [predict(model, who) for who in ("self", "guided", "shared")], model.reward_square**0.5
    actions, unit = learned[1.0]
    for factor, (others, other_unit) in learned.items():
        np.testing.assert_allclose(others, actions, atol=1e-3)
        assert other_unit == pytest.approx(factor * unit, rel=1e-4)


@pytest.mark.parametrize("anchor_coef", [0.0, 1.0, 1000.0])
def test_pi_r_climbs_the_mean_of_z_c_as_far_as_it_is_let(anchor_coef):
    """The maximum of -(a - 0.7)^2 - anchor_coef (a - a_g)^2 is between 0.7 and a_g."""
    model = in_stage_2(learning_rate=1e-2, ent_coef=0.0, anchor_coef=anchor_coef, policy_delay=1, average_tau=1.0)
    model.confidence_critic.forward = lambda obs, actions: (-((actions - 0.7) ** 2).sum(dim=1).expand(2, -1), None)
    model._update_confidence_critic = lambda batch: {}
    batch = make_batch(OBS, np.zeros((len(OBS), 2)), np.zeros(len(OBS)))
    for _ in range(300):
        model._n_updates += 1
        model._gradient_step(batch)
    expected = (0.7 + anchor_coef * predict(model, "guided")) / (1 + anchor_coef)
    assert np.abs(predict(model, "self") - expected).mean() < 0.1


@pytest.mark.parametrize("control", ["self", "shared"])
@pytest.mark.parametrize("deterministic", [True, False])
def test_pi_r_stays_near_pi_g(control, deterministic):
    """What it executes; how far it wants to go is left to the anchor."""
    model = in_stage_2(max_deviation=0.1, delta=0.999)
    shift_pi_r(model, 5.0)
    guided = predict(model, "guided")
    actions, _ = model.predict(OBS, deterministic=deterministic, control=control)
    deviation = np.abs(model.policy.scale_action(actions) - model.policy.scale_action(guided))
    assert deviation.max() == pytest.approx(0.1, abs=1e-5)
    model.policy.max_deviation = 2.0
    actions, _ = model.predict(OBS, deterministic=deterministic, control=control)
    assert np.abs(model.policy.scale_action(actions) - model.policy.scale_action(guided)).max() > 0.2


@pytest.mark.parametrize("arguments", [{}, {"bootstrap": "self"}, {"shared_control": False}])
def test_z_c_bootstraps_on_what_pi_r_may_execute(arguments):
    model = in_stage_2(max_deviation=0.1, delta=0.999, **arguments)
    shift_pi_r(model, 5.0)
    asked = []
    forward = model.confidence_critic_target.forward
    model.confidence_critic_target.forward = lambda obs, actions: (asked.append(actions), forward(obs, actions))[1]
    model._confidence_targets(make_batch(OBS, np.zeros((len(OBS), 2)), np.zeros(len(OBS))))
    of_pi_r, of_pi_g = asked
    assert float((of_pi_r - of_pi_g).abs().max()) == pytest.approx(0.1, abs=1e-5)


# --- Save and load


@pytest.mark.parametrize("stage", [1, 2])
@pytest.mark.parametrize("shared_control", [True, False])
def test_the_stage_survives(stage, shared_control, tmp_path):
    model = make_chac(switch_after=30 if stage == 2 else 1000, shared_control=shared_control, delta=0.4, sigma_scale=0.3)
    model.learn(60)
    assert model.stage == stage
    shift_pi_r(model, 0.5)
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    loaded, policy = CHAC.load(tmp_path / "model"), type(model.policy).load(tmp_path / "policy")
    fresh = make_chac(delta=0.4, sigma_scale=0.3, shared_control=shared_control)
    fresh.set_parameters(tmp_path / "model.zip")
    assert loaded.stage == fresh.stage == int(policy.stage) == stage
    assert (policy.delta, policy.sigma_scale, policy.control) == (0.4, 0.3, "shared" if shared_control else "self")
    expected = model.predict(OBS, deterministic=True)[0]
    for each in (loaded, fresh, policy):
        assert np.array_equal(each.predict(OBS, deterministic=True)[0], expected)
    for who in ("guided", "self", "shared"):
        assert np.array_equal(predict(loaded, who), predict(model, who))
    loaded.set_env(scripted("1" * 99))
    loaded.learn(10, reset_num_timesteps=False)
    assert loaded.counts["human_steps"] == model.counts["human_steps"] + (10 if stage == 1 else 0)


def test_delta_can_be_changed_on_loading(tmp_path):
    model = in_stage_2(delta=0.5)
    model.save(tmp_path / "model")
    assert CHAC.load(tmp_path / "model", delta=0.0).policy.delta == 0.0


# --- The paper read literally


@pytest.mark.parametrize("algorithm", [DPVP, CHAC])
def test_the_paper_read_literally(algorithm):
    model = algorithm("MlpPolicy", Limited(), policy_kwargs=dict(net_arch=[8]), buffer_size=10, **algorithm.PAPER)
    expected = algorithm.PAPER | {"target_entropy": -16.0}
    assert {name: getattr(model, name) for name in expected} == expected
    assert all(inspect.signature(algorithm).parameters[name].default != value for name, value in algorithm.PAPER.items())


@pytest.mark.parametrize("algorithm", [DPVP, CHAC])
def test_the_yaml_reads_the_paper_as_the_constant_does(algorithm):
    file = hyperparams_file(algorithm.__name__.lower())
    for env, params in yaml.safe_load((file.parent / "paper" / file.name).read_text()).items():
        own = {name: value for name, value in params.items() if name not in ("n_timesteps", "policy", "env_wrapper")}
        assert own == algorithm.PAPER, env


@pytest.mark.parametrize("algorithm", [DSAC, DPVP, CHAC])
@pytest.mark.parametrize("argument, value", [("auto", -2), ("auto_8", -16), ("auto_0.5", -1), (-3.0, -3)])
def test_target_entropies(algorithm, argument, value):
    make = {"policy_kwargs": dict(net_arch=[8]), "buffer_size": 10}
    assert algorithm("MlpPolicy", Limited(), target_entropy=argument, **make).target_entropy == value
    for wrong in ("auto_", "auto_x", "8", "auto_-1", float("nan")):
        with pytest.raises(ValueError, match="target_entropy"):
            algorithm("MlpPolicy", Limited(), target_entropy=wrong, **make)


@pytest.mark.parametrize("tau_c, tau", [(None, 0.25), (0.5, 0.5)])
def test_z_c_follows_its_target_with_tau_c(tau_c, tau):
    model = make_chac(tau=0.25, tau_c=tau_c).learn(30)
    before = parameters(model, "confidence_critic_target.")
    model._update_confidence_critic(model._sample_batch(8))
    online, after = parameters(model, "confidence_critic."), parameters(model, "confidence_critic_target.")
    for name in before:
        if "mean_std" not in name:
            expected = (1 - tau) * before[name] + tau * online[name.replace("_target", "")]
            assert th.allclose(after[name], expected, atol=1e-6), name


# --- Log


def read_log(path):
    header, *lines = (line.split(",") for line in (path / "progress.csv").read_text().splitlines())
    return [{name: float(value) for name, value in zip(header, line, strict=True) if value} for line in lines]


@pytest.mark.parametrize("sign, self_share", [(1, 1.0), (-1, 0.0)])
def test_log(tmp_path, sign, self_share):
    model = make_chac(scripted("0110" * 30, limit=10, infos={"cost": 0.5}), switch_after=30, delta=0.5)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    start = model._start_stage_2

    def start_stage_2():
        start()
        with th.no_grad():
            model.self_actor.mu.weight.zero_()
            model.self_actor.mu.bias.fill_(3.0)
            model.self_actor.log_std.weight.zero_()
            model.self_actor.log_std.bias.fill_(-20.0)
        set_critic(model, lambda actions: sign * actions[:, 0])

    model._start_stage_2 = start_stage_2
    model.learn(60, log_interval=1)
    rows = read_log(tmp_path)
    first, last = rows[0], rows[-1]
    assert (first["chac/stage"], last["chac/stage"]) == (1, 2)
    common = {"takeover/rate", "takeover/human_steps", "takeover/takeover_cost", "safety/safety_cost", "rollout/ep_cost_mean"}
    assert common <= first.keys() and common <= last.keys()
    assert last["safety/safety_cost"] == 30 and last["rollout/ep_cost_mean"] == 5
    choice = {f"chac/{name}" for name in ("self_share", "confidence_mean", "q_self", "q_guided", "std_self", "std_guided")}
    choice |= {f"chac/confidence_q{quantile}" for quantile in (10, 50, 90)}
    assert choice <= last.keys() and not choice & first.keys()
    assert last["chac/self_share"] == self_share
    assert (last["chac/confidence_mean"] > 0.5) == (sign == 1)
    assert last["chac/confidence_q10"] <= last["chac/confidence_q50"] <= last["chac/confidence_q90"]
    assert {"train/confidence_sigma_mean", "train/confidence_q_mean"} <= last.keys()


@pytest.mark.parametrize("share_features_extractor", [False, True])
def test_z_c_and_pi_r_learn_their_features(share_features_extractor):
    """Z_c is not the actor's, so that nothing else would teach its features extractor."""

    class Features(BaseFeaturesExtractor):
        def __init__(self, observation_space, features_dim=4):
            super().__init__(observation_space, features_dim)
            self.linear = th.nn.Linear(2, features_dim)

        def forward(self, observations):
            return self.linear(observations)

    kwargs = dict(features_extractor_class=Features, share_features_extractor=share_features_extractor)
    model = make_chac(switch_after=30, policy_kwargs=kwargs)
    before = parameters(model)
    model.learn(40)
    for part in ("confidence_critic.features_extractor.", "self_actor.features_extractor."):
        assert not same(parameters(model, part), {k: v for k, v in before.items() if k.startswith(part)}), part


def test_target_update_interval_holds_in_stage_2():
    model = make_chac(switch_after=10, target_update_interval=3, policy_delay=1).learn(30)
    assert model.stage == 2
    for _ in range(6):
        before = parameters(model, "self_actor_target.")
        model.train(gradient_steps=1, batch_size=8)
        assert same(before, parameters(model, "self_actor_target.")) == (model._n_updates % 3 != 0)
