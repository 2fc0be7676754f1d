"""Policies leave SB3: copied, as TorchScript and as ONNX, they act as ``predict(deterministic=True)`` does."""

import copy
import functools
import io
import warnings

import numpy as np
import onnxruntime
import pytest
import torch as th
from eleven import ALL, Walk, make_any

import sb3_chac

OBSERVATIONS = np.random.default_rng(0).uniform(-3, 3, (40, 2)).astype(np.float32)

# C-HAC acts otherwise in each stage
CASES = [(name, {}) for name in ALL if name != "CHAC"]
STAGES = {
    "CHAC 1": {"switch_after": 999},
    "CHAC 2": {"switch_after": 20, "delta": 0.5},
    "CHAC 2, self": {"switch_after": 20, "shared_control": False},
}
CASES += [("CHAC", kwargs) for kwargs in STAGES.values()]
IDS = [name for name in ALL if name != "CHAC"] + list(STAGES)
each_case = pytest.mark.parametrize("name, kwargs", CASES, ids=IDS)


class Deterministic(th.nn.Module):
    """What SB3's documentation exports."""

    def __init__(self, policy):
        super().__init__()
        self.policy = policy

    def forward(self, observation):
        actions = self.policy(observation, deterministic=True)
        return actions[0] if isinstance(actions, tuple) else actions


@pytest.fixture(autouse=True)
def no_warnings_of_tracing():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def trained(name, kwargs):
    """A model that has learned, made once, and what it does: actions as ``predict`` gives them."""
    return make_trained(name, tuple(kwargs.items()))


@functools.cache
def make_trained(name, items):
    kwargs = dict(items)
    model = make_any(name, Walk(), **kwargs).learn(40)
    if name == "CHAC":
        assert model.stage == (1 if kwargs["switch_after"] == 999 else 2)
    return model, model.predict(OBSERVATIONS, deterministic=True)[0]


def as_predicted(model, actions):
    """As ``predict``, which scales or clips what the policy gives."""
    actions = np.asarray(actions)
    return model.policy.unscale_action(actions) if model.policy.squash_output else np.clip(actions, -1, 1)


@each_case
def test_copies(name, kwargs):
    model = make_any(name, Walk(), **kwargs).learn(40)  # right after learning
    policy = copy.deepcopy(model.policy)
    expected = model.predict(OBSERVATIONS, deterministic=True)[0]
    assert (policy.predict(OBSERVATIONS, deterministic=True)[0] == expected).all()
    before = {key: value.clone() for key, value in policy.state_dict().items()}
    model.learn(40, reset_num_timesteps=False)
    assert all(th.equal(value, policy.state_dict()[key]) for key, value in before.items())


@each_case
@pytest.mark.parametrize("n_example", [1, 40])
def test_torchscript(name, kwargs, n_example):
    model, expected = trained(name, kwargs)
    traced = th.jit.trace(Deterministic(model.policy), th.as_tensor(OBSERVATIONS[:n_example]))
    file = io.BytesIO()
    th.jit.save(traced, file)
    file.seek(0)
    with th.no_grad():
        actions = th.jit.load(file)(th.as_tensor(OBSERVATIONS))
    assert np.allclose(as_predicted(model, actions), expected, atol=1e-5)


@each_case
def test_onnx(name, kwargs, tmp_path, monkeypatch):
    check_onnx(name, kwargs, False, tmp_path, monkeypatch)


# The others have the policy of one of these
SLOW_CASES = [case for case in CASES if case[0] not in ("DSAC", "PVP", "SACLag", "PPOLag", "BC") and case != CASES[-2]]


@pytest.mark.parametrize(
    "name, kwargs",
    [pytest.param(*case, marks=pytest.mark.slow) if case in SLOW_CASES else case for case in CASES],
    ids=IDS,
)
def test_onnx_with_dynamo(name, kwargs, tmp_path, monkeypatch):
    check_onnx(name, kwargs, True, tmp_path, monkeypatch)


def check_onnx(name, kwargs, dynamo, tmp_path, monkeypatch):
    # SB3's distributions check their parameters, a branch on data that torch.export refuses (of SB3's SAC and PPO, too)
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", not dynamo)
    model, expected = trained(name, kwargs)
    file = str(tmp_path / "policy.onnx")
    batch = {"dynamic_shapes": ({0: th.export.Dim("batch")},)} if dynamo else {"dynamic_axes": {"observation": {0: "batch"}}}
    th.onnx.export(
        Deterministic(model.policy).eval(),
        (th.as_tensor(OBSERVATIONS[:3]),),
        file,
        input_names=["observation"],
        opset_version=18,
        dynamo=dynamo,
        **batch,
    )
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    (actions,) = session.run(None, {"observation": OBSERVATIONS})
    assert np.allclose(as_predicted(model, actions), expected, atol=1e-5)


def test_the_stage_travels():
    """A policy that was exported in stage 1 and one in stage 2 differ, and the shared one is neither of the two alone."""
    model, shared = trained("CHAC", STAGES["CHAC 2"])
    assert isinstance(model, sb3_chac.CHAC)
    acts = [model.predict(OBSERVATIONS, deterministic=True, control=control)[0] for control in ("guided", "self")]
    assert not np.allclose(acts[0], acts[1])
    assert np.logical_or(*(np.isclose(act, shared).all(axis=1) for act in acts)).all()
