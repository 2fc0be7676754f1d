"""DualReplayBuffer: which transition stands where, what a batch is made of, and what returns of several steps add up to."""

import io
import pickle

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from takeover_toys import Integrator

from sb3_chac.common.buffers import DualReplayBuffer

GAMMA = 0.5
OBS = spaces.Box(-1e6, 1e6, (2,), np.float32)
ACTIONS = spaces.Box(-1, 1, (2,), np.float32)


def make_buffer(n_envs=1, capacity=100, obs_space=OBS, action_space=ACTIONS, **kwargs):
    kwargs = {"gamma": GAMMA, **kwargs}
    return DualReplayBuffer(capacity, obs_space, action_space, device="cpu", n_envs=n_envs, **kwargs)


def add(buffer, t, takeover=False, done=False, timeout=False, reward=None, start=False):
    """
    Step t of all environments: environment i goes from the observation [t, i] to [t + 1, i], executes [t, i] / 100 where the
    novice proposed the opposite, and gets the reward t. The arguments are one value for all or a list.
    """
    n_envs = buffer.n_envs

    def each(value):
        return value if isinstance(value, list) else [value] * n_envs

    obs, next_obs = (np.array([[time, idx] for idx in range(n_envs)], np.float32) for time in (t, t + 1))
    infos = [
        {"takeover": bool(human), "takeover_start": first, "novice_action": -obs[idx] / 100, "TimeLimit.truncated": late}
        for idx, (human, first, late) in enumerate(zip(each(takeover), each(start), each(timeout), strict=True))
    ]
    rewards = np.array(each(t if reward is None else reward), np.float32)
    buffer.add(obs, next_obs, obs / 100, rewards, np.array(each(done)), infos)


def fill(buffer, novice=0, human=0):
    for t in range(novice):
        add(buffer, t)
    for t in range(human):
        add(buffer, 1000 + t, takeover=True)


def rows(store, *names):
    """The filled rows of some columns, as lists."""
    return [tuple(np.squeeze(store.arrays[name][row]).tolist() for name in names) for row in range(len(store))]


def times(store):
    return [int(obs[0]) for (obs,) in rows(store, "observation/")]


@pytest.mark.parametrize("takeovers", ["0011100", "1111", "0000", "0101"])
def test_the_humans_steps_go_to_the_humans_store(takeovers):
    buffer = make_buffer()
    for t, driver in enumerate(takeovers):
        add(buffer, t, takeover=driver == "1")
    assert times(buffer.human) == [t for t, driver in enumerate(takeovers) if driver == "1"]
    assert times(buffer.novice) == [t for t, driver in enumerate(takeovers) if driver == "0"]
    assert buffer.size() == len(takeovers)
    assert [flag for (flag,) in rows(buffer.human, "takeover")] == [1.0] * takeovers.count("1")
    assert [flag for (flag,) in rows(buffer.novice, "takeover")] == [0.0] * takeovers.count("0")


def test_each_environment_has_its_own_driver():
    buffer = make_buffer(n_envs=3)
    add(buffer, 0, takeover=[False, True, False], start=[False, True, False])
    add(buffer, 1, takeover=[True, True, False], start=[True, False, False])
    assert [obs for (obs,) in rows(buffer.human, "observation/")] == [[0, 1], [1, 0], [1, 1]]
    assert [obs for (obs,) in rows(buffer.novice, "observation/")] == [[0, 0], [0, 2], [1, 2]]
    assert [flag for (flag,) in rows(buffer.human, "takeover_start")] == [1, 1, 0]


@pytest.mark.parametrize("n_envs", [1, 3])
def test_next_observations_are_explicit(n_envs):
    """The stores are fed in turns, and rows of several environments alternate: the next row is not what followed."""
    buffer = make_buffer(n_envs)
    for t in range(12):
        add(buffer, t, takeover=[(t + idx) % 2 == 0 for idx in range(n_envs)])
    for store in (buffer.novice, buffer.human):
        assert len(store) == 6 * n_envs
        for obs, next_obs, action, novice_action, reward in rows(
            store, "observation/", "next_observation/", "action", "novice_action", "reward"
        ):
            assert next_obs == [obs[0] + 1, obs[1]]
            assert action == pytest.approx([obs[0] / 100, obs[1] / 100])
            assert novice_action == pytest.approx([-obs[0] / 100, -obs[1] / 100])
            assert reward == obs[0]
    batch = buffer.sample(64)
    assert th.equal(batch.next_observations, batch.observations + th.tensor([1.0, 0.0]))
    assert th.allclose(batch.actions, batch.observations / 100) and th.allclose(batch.novice_actions, -batch.actions)
    assert th.equal(batch.rewards, batch.observations[:, :1])
    assert th.equal(batch.takeovers, (batch.observations.sum(dim=1, keepdim=True) + 1) % 2)


def test_rows_are_copies():
    buffer = make_buffer()
    obs, action, info = np.ones((1, 2), np.float32), np.full((1, 2), 0.5, np.float32), {"takeover": True}
    buffer.add(obs, obs, action, np.ones(1), np.zeros(1), [info])
    obs[:] = action[:] = 7
    assert rows(buffer.human, "observation/", "action", "novice_action") == [([1, 1], [0.5, 0.5], [0.5, 0.5])]


@pytest.mark.parametrize("n_steps", [1, 2])
@pytest.mark.parametrize(
    "timeout, handle_timeout_termination, stored", [(False, True, 1), (True, True, 0), (True, False, 1), (False, False, 1)]
)
def test_time_limits_are_no_terminations(timeout, handle_timeout_termination, stored, n_steps):
    buffer = make_buffer(handle_timeout_termination=handle_timeout_termination, n_steps=n_steps)
    add(buffer, 0)
    add(buffer, 1, done=True, timeout=timeout)
    assert [done for (done,) in rows(buffer.novice, "done")] == [0 if n_steps == 1 else stored, stored]
    assert buffer.sample(8).dones.shape == (8, 1)


def test_each_store_overwrites_its_own_oldest_row():
    buffer = make_buffer(capacity=3)
    fill(buffer, novice=5, human=2)
    assert sorted(times(buffer.novice)) == [2, 3, 4]
    assert times(buffer.human) == [1000, 1001]
    assert buffer.size() == 5
    drawn = [buffer.sample(3, human_share=0.0).observations[:, 0] for _ in range(30)]
    assert set(th.cat(drawn).tolist()) == {2, 3, 4}


@pytest.mark.parametrize("human_share, n_human", [(0, 0), (0.25, 2), (0.5, 4), (1, 8)])
def test_a_batch_takes_its_share_from_each_store(human_share, n_human):
    buffer = make_buffer()
    fill(buffer, novice=8, human=8)
    batch = buffer.sample(8, human_share=human_share)
    assert batch.takeovers.flatten().tolist() == [0] * (8 - n_human) + [1] * n_human
    assert ((batch.observations[:, 0] >= 1000) == batch.takeovers.flatten().bool()).all()
    assert batch.discounts is None


@pytest.mark.parametrize(
    "novice, human, human_share, n_human",
    [
        (20, 3, 0.5, 0),  # the human's store is short of its 4 rows
        (20, 4, 0.5, 4),
        (3, 20, 0.5, 8),  # the novice's is
        (4, 20, 0.5, 4),
        (20, 0, 0.5, 0),
        (0, 20, 0.5, 8),
        (1, 1, 0.5, 0),  # both are
        (0, 1, 0.5, 8),
        (1, 0, 0.5, 0),
        (1, 5, 0.0, 8),
        (0, 5, 0.0, 8),
        (5, 1, 1.0, 0),
        (0, 1, 1.0, 8),
        (20, 1, 0.25, 0),
        (20, 2, 0.25, 2),
    ],
)
def test_all_rows_are_the_others_while_one_store_is_short(novice, human, human_share, n_human):
    buffer = make_buffer()
    fill(buffer, novice, human)
    batch = buffer.sample(8, human_share=human_share)
    assert batch.takeovers.sum() == n_human
    assert all(len(column) == 8 for column in batch if column is not None)


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("human_share", [0.0, 0.5, 1.0])
def test_an_empty_buffer_says_so(human_share, n_steps):
    buffer = make_buffer(n_steps=n_steps)
    with pytest.raises(ValueError, match=r"replay buffer is empty: collect transitions"):
        buffer.sample(4, human_share=human_share)
    fill(buffer, novice=2 * n_steps, human=2 * n_steps)
    buffer.reset()
    assert buffer.size() == 0
    with pytest.raises(ValueError, match=r"replay buffer is empty"):
        buffer.sample(4, human_share=human_share)


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"optimize_memory_usage": True}, "optimize_memory_usage must be False"),
        ({"n_steps": 0}, "n_steps must be an integer of at least 1"),
        ({"n_steps": 1.5}, "n_steps must be an integer"),
        ({"gamma": 1.5}, "gamma must be a finite number"),
        ({"gamma": float("nan")}, "gamma must be a finite number"),
        ({"capacity": 0}, "buffer_size must be an integer of at least 1"),
    ],
)
def test_argument_errors(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_buffer(**kwargs)


IMAGE = spaces.Box(0, 255, (3, 6, 6), np.uint8)


@pytest.mark.parametrize(
    "space",
    [
        IMAGE,
        spaces.Box(-1, 1, (2, 3), np.float64),
        spaces.Discrete(5),
        spaces.MultiBinary(4),
        spaces.Dict({"camera": IMAGE, "speed": spaces.Box(-1, 1, (1,), np.float32)}),
        spaces.Dict({"gear": spaces.Discrete(4), "": OBS}),
    ],
    ids=["image", "float64", "discrete", "binary", "dict", "dict with a nameless key"],
)
@pytest.mark.parametrize("n_steps", [1, 2])
def test_observation_spaces(space, n_steps):
    n_envs = 2
    buffer = make_buffer(n_envs, obs_space=space, n_steps=n_steps)
    space.seed(0)

    def observe():
        samples = [space.sample() for _ in range(n_envs)]
        if isinstance(space, spaces.Dict):
            return {key: np.stack([sample[key] for sample in samples]) for key in space.spaces}
        return np.stack(samples)

    seen = [observe() for _ in range(5)]
    for t in range(4):
        infos = [{"takeover": t % 2 == 1}] * n_envs
        buffer.add(seen[t], seen[t + 1], np.zeros((n_envs, 2)), np.full(n_envs, t), np.full(n_envs, True), infos)
    batch = buffer.sample(16)

    def row(of, t, idx):  # the observation as SB3's policies get it
        values = {key: value[t][idx] for key, value in of.items()}
        return {key: np.asarray(value).reshape(-1).tolist() for key, value in values.items()}

    by_key = isinstance(space, spaces.Dict)
    keys = list(space.spaces) if by_key else [None]
    sources = {key: [obs[key] if by_key else obs for obs in seen] for key in keys}
    for kind, offset in (("observations", 0), ("next_observations", 1)):
        tensors = getattr(batch, kind) if by_key else {None: getattr(batch, kind)}
        assert tensors.keys() == set(keys)
        for key, tensor in tensors.items():
            subspace = space.spaces[key] if by_key else space
            assert tensor.shape[1:] == ((1,) if isinstance(subspace, spaces.Discrete) else subspace.shape)
            assert tensor.dtype == th.as_tensor(np.zeros(1, subspace.dtype)).dtype
        for i in range(16):
            t = int(batch.rewards[i])
            got = {key: tensor[i].reshape(-1).tolist() for key, tensor in tensors.items()}
            assert got in [row(sources, t + offset, idx) for idx in range(n_envs)]


@pytest.mark.parametrize("n_steps", [1, 2])
def test_actions_of_any_shape_are_stored_flat(n_steps):
    """As in SB3's ReplayBuffer; actors put out flat actions."""
    buffer = make_buffer(n_envs=2, action_space=spaces.Box(-1, 1, (2, 3), np.float32), n_steps=n_steps)
    action = np.arange(12, dtype=np.float32).reshape(2, 2, 3) / 12
    obs = np.zeros((2, 2), np.float32)
    infos = [{"novice_action": -action[idx], "takeover": idx == 1} for idx in range(2)]
    buffer.add(obs, obs, action, np.zeros(2), np.ones(2), infos)
    assert rows(buffer.novice, "action", "novice_action") == [(action[0].flatten().tolist(), (-action[0].flatten()).tolist())]
    assert buffer.sample(1, human_share=1.0).actions.tolist() == [action[1].flatten().tolist()]


# Below step t has the reward t + 1, and gamma is 0.5. A row is (t, return, t of its next observation, discount, done)
def episode(buffer, takeovers, done_at=(), timeout_at=()):
    for t, driver in enumerate(takeovers):
        done = t in (*done_at, *timeout_at)
        add(buffer, t, takeover=driver == "1", done=done, timeout=t in timeout_at, reward=t + 1)


def returns(store, env=0):
    names = "observation/", "reward", "next_observation/", "discount", "done"
    return [
        (int(obs[0]), reward, int(next_obs[0]), discount, int(done))
        for obs, reward, next_obs, discount, done in rows(store, *names)
        if obs[1] == env
    ]


def test_returns_of_several_steps():
    buffer = make_buffer(n_steps=3)
    episode(buffer, "00000")
    expected = [(0, 1 + 2 / 2 + 3 / 4, 3, 0.125, 0), (1, 2 + 3 / 2 + 4 / 4, 4, 0.125, 0), (2, 3 + 4 / 2 + 5 / 4, 5, 0.125, 0)]
    assert returns(buffer.novice) == expected
    buffer.end_trajectories()
    expected += [(3, 4 + 5 / 2, 5, 0.25, 0), (4, 5, 5, 0.5, 0)]
    assert returns(buffer.novice) == expected
    buffer.end_trajectories()
    assert returns(buffer.novice) == expected
    batch = buffer.sample(50)
    assert batch.discounts.shape == (50, 1)
    assert set(batch.discounts.flatten().tolist()) == {0.125, 0.25, 0.5}


def test_returns_belong_to_one_driver():
    buffer = make_buffer(n_steps=3)
    episode(buffer, "0011110")
    # They end where the human takes over, at step 2, ...
    assert returns(buffer.novice) == [(0, 1 + 2 / 2, 2, 0.25, 0), (1, 2, 2, 0.5, 0)]
    # ... and where it hands back, at step 6
    assert returns(buffer.human) == [
        (2, 3 + 4 / 2 + 5 / 4, 5, 0.125, 0),
        (3, 4 + 5 / 2 + 6 / 4, 6, 0.125, 0),
        (4, 5 + 6 / 2, 6, 0.25, 0),
        (5, 6, 6, 0.5, 0),
    ]
    buffer.end_trajectories()
    assert returns(buffer.novice)[2:] == [(6, 7, 7, 0.5, 0)]


@pytest.mark.parametrize("kind, done", [("done_at", 1), ("timeout_at", 0)])
@pytest.mark.parametrize("driver", "01")
def test_returns_end_with_the_episode(kind, done, driver):
    buffer = make_buffer(n_steps=3)
    episode(buffer, driver * 4, **{kind: [1]})
    store = buffer.human if driver == "1" else buffer.novice
    # Steps 2 and 3, of the next episode, are incomplete
    assert returns(store) == [(0, 1 + 2 / 2, 2, 0.25, done), (1, 2, 2, 0.5, done)]


def test_returns_of_several_environments_do_not_mix():
    buffer = make_buffer(n_envs=3, n_steps=2)
    for t in range(3):
        add(
            buffer,
            t,
            takeover=[False, t == 1, False],
            done=[False, False, t == 0],
            reward=[t + 1, 10 * (t + 1), 100 * (t + 1)],
        )
    assert returns(buffer.novice, env=0) == [(0, 1 + 2 / 2, 2, 0.25, 0), (1, 2 + 3 / 2, 3, 0.25, 0)]
    assert returns(buffer.novice, env=1) == [(0, 10, 1, 0.5, 0)]
    assert returns(buffer.human, env=1) == [(1, 20, 2, 0.5, 0)]
    assert returns(buffer.novice, env=2) == [(0, 100, 1, 0.5, 1), (1, 200 + 300 / 2, 3, 0.25, 0)]
    buffer.end_trajectories()
    assert returns(buffer.novice, env=1)[1:] == [(2, 30, 3, 0.5, 0)]
    assert len(buffer.novice) + len(buffer.human) == 9


def test_takeover_flags_are_those_of_the_first_step_of_a_return():
    buffer = make_buffer(n_steps=2)
    add(buffer, 0, takeover=True, start=True)
    add(buffer, 1, takeover=True, done=True)
    assert rows(buffer.human, "takeover", "takeover_start") == [(1, 1), (1, 0)]


def test_vec_normalize_acts_on_batches_only():
    env = VecNormalize(DummyVecEnv([Integrator]), norm_obs=True, norm_reward=True)
    env.obs_rms.mean, env.obs_rms.var = np.array([2.0, 0.0]), np.array([4.0, 1.0])
    env.ret_rms.var = np.array(25.0)
    buffer = make_buffer(obs_space=Integrator.observation_space)
    add(buffer, 6, reward=10.0)
    assert rows(buffer.novice, "observation/", "next_observation/", "reward") == [([6, 0], [7, 0], 10)]
    batch = buffer.sample(1, env)
    assert batch.observations.tolist() == [pytest.approx([2, 0], abs=1e-5)]
    assert batch.next_observations.tolist() == [pytest.approx([2.5, 0], abs=1e-5)]
    assert batch.rewards.item() == pytest.approx(2)
    assert batch.observations.dtype == batch.rewards.dtype == th.float32
    assert buffer.sample(1).rewards.item() == 10
    assert rows(buffer.novice, "observation/", "reward") == [([6, 0], 10)]


def test_a_pickle_holds_filled_rows_only(tmp_path):
    buffer = make_buffer(capacity=1_000_000)
    fill(buffer, novice=100, human=20)
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    assert (tmp_path / "buffer.pkl").stat().st_size < 50_000
    assert load_from_pkl(tmp_path / "buffer.pkl").size() == 120


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("n_rows", [0, 3, 5, 7])
def test_a_pickle_comes_back_exactly_and_goes_on(n_rows, n_steps):
    """Also where the ring stands, and transitions whose return is not complete."""
    buffer = make_buffer(capacity=5, n_steps=n_steps)
    fill(buffer, novice=n_rows, human=2)
    file = io.BytesIO()
    save_to_pkl(file, buffer)
    file.seek(0)
    loaded = load_from_pkl(file)

    def same():
        stores = zip((buffer.novice, buffer.human), (loaded.novice, loaded.human), strict=True)
        return all(
            a.added == b.added and all(np.array_equal(a.arrays[name], b.arrays[name]) for name in a.columns) for a, b in stores
        )

    assert same()
    for each in (buffer, loaded):
        fill(each, novice=4, human=4)
        each.end_trajectories()
    assert same()
    assert len(loaded.human) == 5
    for each in (buffer, loaded):
        each.first = (np.random.seed(0), each.sample(6))[1]
    assert all(th.equal(a, b) for a, b in zip(buffer.first, loaded.first, strict=True) if a is not None)


def test_returns_are_cut_short_rather_than_missing():
    """A model that learns from its first step on would find an empty buffer."""
    buffer = make_buffer(n_steps=3)
    add(buffer, 0, reward=1.0)
    assert buffer.sample(2).rewards.flatten().tolist() == [1, 1]
    assert returns(buffer.novice) == [(0, 1, 1, 0.5, 0)]


def test_a_buffer_takes_steps_of_more_environments_than_before():
    """Of a model that was loaded with another number of environments."""
    buffer = make_buffer(n_envs=1, n_steps=2)
    add(buffer, 0, reward=1)
    buffer.n_envs = 2
    add(buffer, 1, reward=2, done=True)
    assert returns(buffer.novice, env=0) == [(0, 2, 2, 0.25, 1), (1, 2, 2, 0.5, 1)]
    assert returns(buffer.novice, env=1) == [(1, 2, 2, 0.5, 1)]


@pytest.mark.parametrize("n_steps, expected", [(1, [1.0, 0.0, 2.0]), (2, [1.0, GAMMA * 2.0, 2.0])])
def test_costs_are_kept_and_summed_up_as_rewards_are(n_steps, expected):
    buffer = make_buffer(n_steps=n_steps)
    for t, cost in enumerate([1.0, 0.0, 2.0]):
        obs = np.array([[t, 0]], np.float32)
        buffer.add(obs, obs + 1, obs / 100, np.zeros(1), np.array([t == 2]), [{"cost": cost}])
    assert [cost for (cost,) in rows(buffer.novice, "cost")] == expected
    assert set(buffer.sample(50).costs.flatten().tolist()) == set(expected)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_a_buffer_of_an_older_version_has_no_costs(n_steps):
    buffer = make_buffer(n_steps=n_steps)
    fill(buffer, novice=5, human=5)
    for store in (buffer.novice, buffer.human):
        store.columns = {name: column for name, column in store.columns.items() if name != "cost"}
        del store.arrays["cost"]
    for row in buffer.pending[0]:
        row.pop("cost")
    older = pickle.loads(pickle.dumps(buffer))
    assert not older.sample(20).costs.any()
    for t in range(5, 10):
        add(older, t)
    older.end_trajectories()
    assert times(older.novice) == list(range(10))


@pytest.mark.parametrize("n_steps", [1, 2])
@pytest.mark.parametrize(
    "takeovers, done_at, marked",
    [
        ("000110010", (), [2, 6]),
        ("0011", (1,), []),  # another episode: the human drove from its first step on
        ("1100", (), []),
        ("0101", (), [0, 2]),
    ],
)
def test_the_step_before_a_takeover_is_marked(takeovers, done_at, marked, n_steps):
    buffer = make_buffer(n_steps=n_steps)
    for t, human in enumerate(takeovers):
        start = human == "1" and (t == 0 or takeovers[t - 1] == "0")
        add(buffer, t, takeover=human == "1", start=start, done=t in done_at)
    buffer.end_trajectories()
    following = {int(obs[0]): value for obs, value in rows(buffer.novice, "observation/", "takeover_follows")}
    assert {t: value for t, value in following.items() if value} == dict.fromkeys(marked, 1.0)
    assert not any(value for (value,) in rows(buffer.human, "takeover_follows"))


def test_each_environment_marks_its_own_step():
    buffer = make_buffer(n_envs=2)
    add(buffer, 0)
    add(buffer, 1, takeover=[False, True], start=[False, True])
    assert rows(buffer.novice, "observation/", "takeover_follows") == [([0.0, 0.0], 0.0), ([0.0, 1.0], 1.0), ([1.0, 0.0], 0.0)]


def test_a_row_that_was_overwritten_is_not_marked():
    buffer = make_buffer(n_envs=2, capacity=1)
    add(buffer, 0)  # the second environment overwrites the first one's row
    add(buffer, 1, takeover=[True, False], start=[True, False])
    assert not any(value for (value,) in rows(buffer.novice, "takeover_follows"))


def test_rows_of_before_have_a_share_of_their_own_until_they_are_overwritten():
    buffer = make_buffer(capacity=10)
    fill(buffer, novice=4)
    buffer.end_guidance()
    for last, early in ((9, {0, 1, 2, 3}), (11, {2, 3}), (13, set())):
        for t in range(buffer.novice.added, last + 1):
            add(buffer, t)
        drawn = np.concatenate([buffer.sample(8, human_share=0.0, guided_share=0.5).observations[:, 0] for _ in range(80)])
        assert set(drawn.astype(int)) == set(range(last - 9, last + 1))
        share = np.isin(drawn, list(early)).mean()
        assert share == pytest.approx(0.5 + 0.5 * len(early) / 10 if early else 0.0, abs=0.1)
