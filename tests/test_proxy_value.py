"""The proxy value losses of PVP and D-PVP: exact on hand-made batches, and what they make of one state."""

import numpy as np
import pytest
import torch as th
from guided_toys import CHAC, DPVP, PVP, Limited, make_batch, make_guided, parameters, same, silent

from sb3_chac.common.distributional import gaussian_surrogate_loss

GAMMA, B = 0.9, 2.0
N_ROWS = 6
TAKEOVERS = [0, 1, 0, 1, 1, 0]
STARTS = [0, 1, 0, 0, 1, 0]


def make_model(algorithm, **kwargs):
    kwargs = {"gamma": GAMMA, "proxy_value": B, "learning_rate": 0.1, **kwargs}
    if algorithm is PVP:
        kwargs["target_policy_noise"] = 0.0
    else:
        kwargs = {"pv_min_diff": 0.0, "ent_coef": 0.01, "bounded_targets": True, "weight_decay": 0.0} | kwargs
    # Plain gradient descent, so that the change of the parameters shows the gradient
    policy_kwargs = dict(net_arch=[8], optimizer_class=th.optim.SGD, activation_fn=th.nn.Tanh)
    return silent(make_guided(algorithm, Limited(), policy_kwargs=policy_kwargs, **kwargs))


def mixed_batch(takeovers=TAKEOVERS, starts=STARTS, **kwargs):
    rng = np.random.default_rng(0)
    obs, next_obs, actions, proposed = (rng.uniform(-1, 1, (N_ROWS, 2)) for _ in range(4))
    human = np.array(takeovers, bool)[:, None]
    columns = {
        "next_observations": next_obs,
        "novice_actions": np.where(human, proposed, actions),
        "takeover_starts": starts,
        "dones": [0, 0, 1, 0, 1, 0],
        "rewards": rng.normal(size=N_ROWS),
        **kwargs,
    }
    return make_batch(obs, actions, takeovers, **columns)


# --- PVP


def pvp_loss(model, batch, pv_coef=1.0, differ=None, td=None, discounts=GAMMA):
    """Row by row, as it is written in the paper, of one batch; td: rows that have temporal differences."""
    total = th.zeros(())
    for row in range(N_ROWS):
        obs, next_obs = batch.observations[[row]], batch.next_observations[[row]]
        discount = discounts if isinstance(discounts, float) else discounts[row]
        with th.no_grad():
            next_q = min(model.critic_target(next_obs, model.actor_target(next_obs))).item()
        target = discount * (1 - batch.dones[row].item()) * next_q
        for q_network in range(2):
            q_executed = model.critic(obs, batch.actions[[row]])[q_network].squeeze()
            if td is None or td[row]:
                total = total + (q_executed - target) ** 2 / N_ROWS
            if batch.takeovers[row]:
                total = total + pv_coef * (q_executed - B) ** 2 / N_ROWS
                if differ is None or differ[row]:
                    q_novice = model.critic(obs, batch.novice_actions[[row]])[q_network].squeeze()
                    total = total + pv_coef * (q_novice + B) ** 2 / N_ROWS
    return total


@pytest.mark.parametrize("takeovers", [TAKEOVERS, [0] * N_ROWS, [1] * N_ROWS], ids=["mixed", "novice", "human"])
@pytest.mark.parametrize("pv_coef", [1.0, 0.3, 0.0])
def test_pvp_loss(takeovers, pv_coef):
    model, batch = make_model(PVP, pv_coef=pv_coef), mixed_batch(takeovers)
    expected = pvp_loss(model, batch, pv_coef)
    wanted = th.autograd.grad(expected, list(model.critic.parameters()))
    stats = model._update_critic(batch)
    assert stats["critic_loss"] == pytest.approx(expected.item(), rel=1e-5)
    for param, grad in zip(model.critic.parameters(), wanted, strict=True):
        assert th.allclose(param.grad, grad, atol=1e-6)
    assert ("q_human" in stats) == any(takeovers)


def test_pvp_labels_are_averaged_over_the_full_batch():
    """Twice the rows, the new ones the novice's: temporal differences stay in place, labels weigh half."""
    model = make_model(PVP, learning_rate=0.0, gamma=0.0)
    one = make_batch([[0.3, 0.1]], [[0.5, 0.5]], [1], novice_actions=[[-0.5, 0.0]])
    two = make_batch([[0.3, 0.1]] * 2, [[0.5, 0.5]] * 2, [1, 0], novice_actions=[[-0.5, 0.0], [0.5, 0.5]])
    td_only = make_batch([[0.3, 0.1]], [[0.5, 0.5]], [0])
    loss_1, loss_2, td = (model._update_critic(batch)["critic_loss"] for batch in (one, two, td_only))
    assert loss_2 - td == pytest.approx((loss_1 - td) / 2, rel=1e-4)


@pytest.mark.parametrize("stop, td", [(False, [1] * 6), (True, [1, 0, 1, 1, 0, 1])])
def test_pvp_takeover_stop_td(stop, td):
    model, batch = make_model(PVP, takeover_stop_td=stop), mixed_batch()
    expected = pvp_loss(model, batch, td=td).item()
    assert model._update_critic(batch)["critic_loss"] == pytest.approx(expected, rel=1e-5)


# Differences of the rows 1, 3 and 4: root mean squares of 0.1, 0.2 and 0.4
NEARLY = np.zeros((6, 2))
NEARLY[[1, 3, 4]] = [[0.1, 0.1], [0.2 * 2**0.5, 0], [-0.4, 0.4]]


@pytest.mark.parametrize(
    "pv_min_diff, differ", [(0.0, [1] * 6), (0.15, [1, 0, 1, 1, 1, 1]), (0.3, [1, 0, 1, 0, 1, 1]), (9, [0] * 6)]
)
def test_pvp_min_diff(pv_min_diff, differ):
    batch = mixed_batch()
    batch = batch._replace(novice_actions=batch.actions + th.as_tensor(NEARLY, dtype=th.float32))
    model = make_model(PVP, pv_min_diff=pv_min_diff)
    expected = pvp_loss(model, batch, differ=differ).item()
    assert model._update_critic(batch)["critic_loss"] == pytest.approx(expected, rel=1e-5)


def test_pvp_discounts_of_returns_of_several_steps():
    discounts = [0.9, 0.81, 0.7, 0.9, 0.5, 0.2]
    model, batch = make_model(PVP), mixed_batch(discounts=discounts)
    expected = pvp_loss(model, batch, discounts=discounts).item()
    assert model._update_critic(batch)["critic_loss"] == pytest.approx(expected, rel=1e-5)


# --- D-PVP


def dpvp_loss(model, batch, seed, pv_coef=1.0, differ=None, td=None, eta=1.0, eta_pv=1.0, bound=B):
    """With ``gaussian_surrogate_loss``, which test_distributional.py holds to its equations; row by row."""
    alpha = 0.01
    with th.no_grad():
        # Noise as the algorithm draws it: of the target actor for the batch, then of the return
        th.manual_seed(seed)
        next_actions, log_prob = model.actor_target.action_log_prob(batch.next_observations)
        q_all, std_all = model.critic_target(batch.next_observations, next_actions)
        noise = th.randn_like(q_all[0]).clamp(-3, 3) / 0.9973370  # root of the variance of clipped noise
        stds = model.critic(batch.observations, batch.actions)[1]
        b = stds.mean(dim=1, keepdim=True)
    total = th.zeros(())
    for row in range(N_ROWS):
        m = q_all[:, row].argmin()
        discount = GAMMA * (1 - batch.dones[row].item())
        y_q = discount * (q_all[m, row] - alpha * log_prob[row])
        y_z = (y_q + discount * noise[row] * std_all[m, row]).clamp(-bound, bound)
        y_q = y_q.clamp(-bound, bound)
        q, std = model.critic(batch.observations[[row]], batch.actions[[row]])
        if td is None or td[row]:
            total = total + gaussian_surrogate_loss(q, std, y_q, y_z, b, eta).sum() / N_ROWS
        if batch.takeovers[row]:
            label = th.tensor(model.proxy_value)
            total = total + pv_coef * gaussian_surrogate_loss(q, std, label, label, b, eta_pv).sum() / N_ROWS
            if differ is None or differ[row]:
                q, std = model.critic(batch.observations[[row]], batch.novice_actions[[row]])
                total = total + pv_coef * gaussian_surrogate_loss(q, std, -label, -label, b, eta_pv).sum() / N_ROWS
    return total


def update_proxy_critic(model, batch, seed=0):
    th.manual_seed(seed)
    return model._update_critic(batch, model._current_ent_coef())


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"pv_coef": 0.3},
        {"eta": 3.0, "eta_pv": 3.0},
        {"eta": 1.0, "eta_pv": 2.0},
        {"takeover_stop_td": True},
        {"pv_min_diff": 0.3},
        {"proxy_value": 0.2},
        {"proxy_value": 0.2, "bounded_targets": False},
    ],
    ids=str,
)
@pytest.mark.parametrize("takeovers", [TAKEOVERS, [0] * N_ROWS, [1] * N_ROWS], ids=["mixed", "novice", "human"])
def test_dpvp_loss(kwargs, takeovers):
    batch = mixed_batch(takeovers)
    batch = batch._replace(novice_actions=batch.actions + th.as_tensor(NEARLY, dtype=th.float32) * batch.takeovers)
    model = make_model(DPVP, **kwargs)
    expected = {key: value for key, value in kwargs.items() if key in ("pv_coef", "eta", "eta_pv")}
    expected["bound"] = kwargs.get("proxy_value", B) if kwargs.get("bounded_targets", True) else 1e6
    if "takeover_stop_td" in kwargs:
        expected["td"] = [1 - start for start in STARTS]
    if "pv_min_diff" in kwargs:
        expected["differ"] = [False, False, False, False, True, False]
    loss = dpvp_loss(model, batch, seed=0, **expected)
    wanted = th.autograd.grad(loss, list(model.critic.parameters()))
    stats = update_proxy_critic(model, batch)
    for param, grad in zip(model.critic.parameters(), wanted, strict=True):
        assert th.allclose(param.grad, grad, atol=1e-5, rtol=1e-3)
    assert ("q_novice" in stats) == any(takeovers)


def test_dpvp_eta_of_the_labels_is_that_of_the_rest_unless_given():
    grads = []
    for kwargs in ({"eta": 3.0}, {"eta": 3.0, "eta_pv": 3.0}, {"eta": 3.0, "eta_pv": 1.0}):
        model = make_model(DPVP, **kwargs)
        update_proxy_critic(model, mixed_batch())
        grads.append(th.cat([param.grad.flatten() for param in model.critic.parameters()]))
    assert th.equal(grads[0], grads[1]) and not th.allclose(grads[0], grads[2])


@pytest.mark.parametrize("algorithm", [PVP, DPVP, CHAC])
def test_reward_is_for_the_confidence_alone(algorithm):
    """Other rewards change nothing in what the human guides; they change Z_c of C-HAC."""
    trained = []
    for scale in (0.0, 100.0):
        model = make_guided(algorithm, learning_starts=200).learn(60)
        for store in (model.replay_buffer.novice, model.replay_buffer.human):
            store.arrays["reward"] *= scale
        np.random.seed(0)
        th.manual_seed(0)
        model.train(gradient_steps=10, batch_size=16)
        trained.append(model)
    for part in ("actor.", "actor_target.", "critic.", "critic_target."):
        assert same(parameters(trained[0], part), parameters(trained[1], part)), part
    if algorithm is CHAC:
        for part in ("confidence_critic.", "confidence_critic_target."):
            assert not same(parameters(trained[0], part), parameters(trained[1], part)), part


# --- One state, in which the human does +0.5 where the novice proposes -0.5


def label_one_state(algorithm, n_updates=400, **kwargs):
    """:return: the model's mean Q of the human's and of the novice's action, and sigma of both (None for PVP)"""
    kwargs |= {} if algorithm is PVP else {"weight_decay": 0.0}
    model = silent(
        make_guided(algorithm, Limited(), proxy_value=B, learning_rate=1e-2, policy_kwargs=dict(net_arch=[16]), **kwargs)
    )
    batch = make_batch([[0, 0]], [[0.5, 0]], [1], novice_actions=[[-0.5, 0]], dones=[1], takeover_starts=[1])
    for _ in range(n_updates):
        model._n_updates += 1
        model._update_critic(batch) if algorithm is PVP else model._gradient_step(batch)
    with th.no_grad():
        outputs = model.critic(th.zeros(2, 2), th.tensor([[0.5, 0.0], [-0.5, 0.0]]))
    if algorithm is PVP:
        return th.cat(outputs, dim=1).mean(dim=1).tolist(), None
    return outputs[0].mean(dim=0).tolist(), outputs[1]


@pytest.mark.parametrize("algorithm", [PVP, DPVP])
def test_labels_are_reached_in_one_state(algorithm):
    """
    The episode ends, so that temporal differences draw Q of the human's action to 0 as strongly as the label draws it to B:
    it settles half-way. Nothing but the label acts on the novice's action.
    """
    q_values, _ = label_one_state(algorithm)
    assert q_values == pytest.approx([B / 2, -B], abs=0.2)


@pytest.mark.parametrize("algorithm", [PVP, DPVP])
def test_without_temporal_differences_both_labels_are_reached(algorithm):
    q_values, stds = label_one_state(algorithm, takeover_stop_td=True)
    assert q_values == pytest.approx([B, -B], abs=0.2)
    if algorithm is DPVP:  # certain of it
        assert (stds < 0.5).all()


@pytest.mark.parametrize("algorithm", [PVP, DPVP])
def test_the_novice_comes_to_do_as_the_human(algorithm):
    kwargs = dict(learning_rate=1e-2, policy_kwargs=dict(net_arch=[16]), batch_size=16)
    model = silent(make_guided(algorithm, Limited(), **kwargs))
    action, novice = np.array([[0.5, 0.0]], np.float32), np.array([-0.5, 0.0], np.float32)
    obs = np.zeros((1, 2), np.float32)
    for _ in range(20):
        infos = [{"takeover": True, "takeover_start": True, "novice_action": novice}]
        model.replay_buffer.add(obs, obs, action, np.zeros(1), np.ones(1), infos)
    model.train(gradient_steps=400, batch_size=16)
    assert model.predict(obs, deterministic=True)[0][0, 0] > 0.3
