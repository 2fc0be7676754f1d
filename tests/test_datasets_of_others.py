"""Data that others recorded: how its episodes end, in which forms it is handed over, and what other versions made."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import minari
import numpy as np
import pytest
from eleven import GUIDED, OFFLINE, Walk, demonstrations, make_any
from guided_toys import column

from sb3_chac.common.buffers import DualReplayBuffer
from sb3_chac.common.demonstrations import load_demonstrations
from sb3_chac.common.minari_datasets import DatasetError
from sb3_chac.datasets.recording import record

LENGTH = 6


def flags(*steps):
    marked = np.zeros(3 * LENGTH, bool)
    marked[list(steps)] = True
    return marked


# Ends of three episodes: terminations, truncations
ENDS = {
    "none": (flags(), flags()),
    "terminated": (flags(5, 11), flags()),
    "truncated": (flags(), flags(5, 11, 17)),
    "both": (flags(5, 11, 17), flags(5, 11, 17)),
    "mixed": (flags(5, 11), flags(11)),
}


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("n_steps", [1, 3, 50])
@pytest.mark.parametrize("name", ["PVP", "DPVP", "CHAC", "HGDagger", "IWR"])
def test_ends_of_episodes(name, n_steps, ends):
    terminations, truncations = ENDS[ends]
    n = 3 * LENGTH
    data = demonstrations(n, terminations=terminations, truncations=truncations, rewards=np.ones(n))
    kwargs = {"n_steps": n_steps} if name in ("PVP", "DPVP", "CHAC") else {}
    if not kwargs:
        kwargs = {"replay_buffer_kwargs": {"n_steps": n_steps, "gamma": 0.99}}
    model = make_any(name, Walk(), **kwargs)
    model.store_demonstrations(data)
    store = model.replay_buffer.human
    assert isinstance(model.replay_buffer, DualReplayBuffer) and len(store) == n
    left = LENGTH - np.arange(n) % LENGTH  # steps until the episode is over
    counted = np.minimum(left, n_steps)
    assert np.allclose(column(store, "reward"), (1 - 0.99**counted) / (1 - 0.99), rtol=1e-4)
    last = np.arange(n) + counted - 1
    assert (column(store, "done") == terminations[last]).all()  # a termination beside a truncation is one
    assert np.allclose(column(store, "next_observation/"), data.next_observations[last])
    assert column(store, "takeover_start").tolist() == [float(i % LENGTH == 0) for i in range(n)]


def test_conservative_q_learning_takes_terminations_beside_truncations():
    terminations = flags(5, 11)
    model = make_any("CQL", Walk(), dataset=demonstrations(18, terminations=terminations, truncations=flags(5, 17)))
    model.learn(1)
    assert (model._batch(np.arange(18)).dones.numpy() == terminations).all()


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("datasets") / "walk-v0"
    return record(made, lambda observation: np.clip(-observation, -1, 1).astype(np.float32), Walk, 30)


FORMS = {
    "opened": minari.MinariDataset,
    "filtered": lambda data: minari.MinariDataset(data).filter_episodes(lambda episode: episode.id in (1, 3)),
    "list": lambda data: [data.parent, str(data.parent)],
    "list of opened": lambda data: [minari.MinariDataset(data), demonstrations(12)],
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", [*OFFLINE, "GAIL", *GUIDED])
def test_forms_of_datasets(name, form, folder):
    dataset = FORMS[form](folder / "data")
    whole = load_demonstrations(folder)
    data = load_demonstrations(dataset)
    if form == "opened":
        assert np.array_equal(data.actions, whole.actions)
    elif form == "filtered":
        assert np.array_equal(data.actions, whole.actions[np.isin(whole.episodes, (1, 3))])
    elif form == "list":
        assert np.array_equal(data.actions, np.tile(whole.actions, (2, 1)))
        assert np.array_equal(data.episodes, np.concatenate([whole.episodes, whole.episodes + 5]))
    else:
        assert len(data) == 42 and data.takeovers.all() and data.costs is None
        assert data.episodes[-1] == 6 and data.ends.sum() == 7
    if name in GUIDED:
        model = make_any(name, Walk())
        model.store_demonstrations(dataset)
        assert np.allclose(column(model.replay_buffer.human, "action"), data.actions, atol=1e-6)
    else:
        model = make_any(name, Walk(), dataset=dataset)
        assert len(model._demonstrations) == len(data)


def test_lists_that_do_not_do(folder):
    with pytest.raises(DatasetError, match="list is empty"):
        load_demonstrations([])
    other = demonstrations(12)
    other = replace(other, observation_space=Walk.action_space)
    with pytest.raises(DatasetError, match="observation spaces of the datasets of the list differ in bounds"):
        load_demonstrations([folder, other])
    nothing = minari.MinariDataset(folder / "data").filter_episodes(lambda episode: False)
    with pytest.raises(DatasetError, match="holds no steps"):
        load_demonstrations(nothing)


@pytest.mark.parametrize("version", ["0.3.1", "9.0.0"])
def test_other_versions_are_named(version, folder, tmp_path):
    shutil.copytree(folder, tmp_path / "old-v0")
    path = tmp_path / "old-v0" / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"minari_version": version}))
    with pytest.raises(DatasetError, match=rf"was made by Minari {version}, which the installed Minari {minari.__version__}"):
        load_demonstrations(tmp_path / "old-v0")
