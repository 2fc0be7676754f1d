"""``sb3-chac export``: one graph that acts as ``predict(deterministic=True)`` does, for every algorithm and observation."""

import hashlib
import json

import gymnasium as gym
import numpy as np
import onnx
import pytest
from eleven import ALL, Walk, make_any
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_chac.__main__ import main as sb3_chac
from sb3_chac.deploy.export import compare, export
from sb3_chac.deploy.metadata import KEY, Metadata, NotDeployable
from sb3_chac.deploy.policy import OnnxPolicy, check_observation

RNG = np.random.default_rng(0)
OBSERVATIONS = RNG.uniform(-3, 3, (20, 2)).astype(np.float32)
STAGES = [
    ("CHAC", {"switch_after": 999}),
    ("CHAC", {"switch_after": 20, "delta": 0.5}),
    ("CHAC", {"switch_after": 20, "shared_control": False}),
]


def small(seed=0):
    """Keyword arguments of a small model, which SB3 changes."""
    return {"policy_kwargs": {"net_arch": [8]}, "seed": seed, "device": "cpu"}


class Units(Walk):
    """Other units than [-1, 1]."""

    action_space = spaces.Box(np.array([-0.6, -4.0], np.float32), np.array([0.6, 2.0], np.float32))


class Seen(gym.Env):
    """Observations of all kinds in a Dict, or one of them alone."""

    parts = {  # noqa: RUF012
        "action": spaces.Box(-1, 1, (2,), np.float32),  # as the output of the graph is called
        "camera": spaces.Box(0, 255, (40, 36, 3), np.uint8),
        "command": spaces.Discrete(3),
        "lights": spaces.MultiBinary(2),
        "gears": spaces.MultiDiscrete([2, 3]),
    }
    action_space = spaces.Box(-2, 1, (2,), np.float32)

    def __init__(self, key=None):
        self.observation_space = self.parts[key] if key else spaces.Dict(self.parts)
        self.observation_space.seed(0)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), float(action[0]), False, bool(self.np_random.random() < 0.2), {}


def assert_equal(model, file, observations, normalize=None):
    exported = OnnxPolicy(file)
    for observation in observations:
        assert check_observation(observation, exported.metadata) is None
        seen = observation if normalize is None else normalize.normalize_obs(observation)
        expected = model.predict(seen, deterministic=True)[0]
        assert np.allclose(exported(observation).action, expected, atol=1e-5)


@pytest.mark.parametrize("name, kwargs", [(name, {}) for name in ALL if name != "CHAC"] + STAGES)
def test_every_algorithm(name, kwargs, tmp_path):
    model = make_any(name, Walk() if name in ("BC", "CQL", "GAIL") else Units(), **kwargs).learn(40)
    metadata = export(model, tmp_path / "policy.onnx")
    assert_equal(model, tmp_path / "policy.onnx", OBSERVATIONS)
    assert metadata.algorithm == name and metadata.low == pytest.approx(model.action_space.low.tolist())
    proposal = OnnxPolicy(tmp_path / "policy.onnx")(OBSERVATIONS[0])
    assert (proposal.confidence is None) == (kwargs != {"switch_after": 20, "delta": 0.5})


@pytest.mark.parametrize("algorithm", [SAC, PPO, TD3])
def test_algorithms_of_stable_baselines3(algorithm, tmp_path):
    model = algorithm("MlpPolicy", Units(), **small())
    export(model, tmp_path / "policy.onnx")
    assert_equal(model, tmp_path / "policy.onnx", OBSERVATIONS)


def test_shared_control_tells_who_drives(tmp_path):
    model = make_any("CHAC", Units(), switch_after=20, delta=0.5).learn(60)
    metadata = export(model, tmp_path / "policy.onnx")
    assert (metadata.stage, metadata.control, metadata.delta) == (2, "shared", 0.5)
    exported, drivers = OnnxPolicy(tmp_path / "policy.onnx"), set()
    for observation in OBSERVATIONS:
        proposal = exported(observation)
        model.predict(observation, deterministic=True)
        choice = model.policy.last_choice
        assert proposal.self_drives == bool(choice.self_drives)
        assert proposal.confidence == pytest.approx(float(choice.confidence), abs=1e-5)
        assert np.allclose(
            proposal.guided_action, model.predict(observation, deterministic=True, control="guided")[0], atol=1e-5
        )
        drivers.add(proposal.self_drives)
    assert drivers == {True, False}


def test_normalization_is_inside(tmp_path):
    env = VecNormalize(DummyVecEnv([Units]), clip_obs=1.0)
    model = SAC("MlpPolicy", env, learning_starts=10, batch_size=8, **small()).learn(60)
    export(model, tmp_path / "own.onnx")
    assert_equal(model, tmp_path / "own.onnx", OBSERVATIONS, env)
    export(SAC("MlpPolicy", Units(), **small()), tmp_path / "other.onnx", normalize=env)
    without = SAC("MlpPolicy", Units(), **small())
    export(without, tmp_path / "without.onnx")
    acts = [OnnxPolicy(tmp_path / file)(OBSERVATIONS[0]).action for file in ("other.onnx", "without.onnx")]
    assert not np.allclose(*acts)
    assert np.allclose(acts[0], without.predict(env.normalize_obs(OBSERVATIONS[0]), deterministic=True)[0], atol=1e-5)


@pytest.mark.parametrize("key, policy", [(None, "MultiInputPolicy"), ("camera", "CnnPolicy"), ("command", "MlpPolicy")])
def test_observations_of_other_kinds(key, policy, tmp_path):
    env = Seen(key)
    model = PPO(policy, env, n_steps=8, batch_size=8, seed=0, device="cpu")
    export(model, tmp_path / "policy.onnx", env=env)
    assert_equal(model, tmp_path / "policy.onnx", [env.observation_space.sample() for _ in range(5)])


def test_normalization_of_some_keys(tmp_path):
    venv = VecNormalize(DummyVecEnv([Seen]), norm_obs_keys=["action"])
    model = PPO("MultiInputPolicy", venv, n_steps=8, batch_size=8, seed=0, device="cpu").learn(16)
    export(model, tmp_path / "policy.onnx", observation_space=venv.observation_space)
    observations = [venv.observation_space.sample() for _ in range(5)]
    assert_equal(model, tmp_path / "policy.onnx", observations, venv)


def test_the_file_describes_itself(tmp_path):
    model = SAC("MlpPolicy", Units(), **small())
    metadata = export(model, tmp_path / "policy.onnx", rate=20)
    stored = {entry.key: entry.value for entry in onnx.load(tmp_path / "policy.onnx").metadata_props}
    assert Metadata.from_json(stored[KEY], "file") == metadata
    assert metadata.rate == 20 and metadata.versions["torch"] and metadata.inputs[0].low == -100
    again = export(SAC("MlpPolicy", Units(), **small(1)), tmp_path / "other.onnx")
    assert len(metadata.model_sha256) == 64 and metadata.model_sha256 != again.model_sha256


def test_what_cannot_be_exported(tmp_path):
    file = tmp_path / "policy.onnx"
    with pytest.raises(NotDeployable, match="continuous"):
        export(PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8), file)
    with pytest.raises(NotDeployable, match="memory"):
        export(RecurrentPPO("MlpLstmPolicy", "Pendulum-v1", n_steps=8, batch_size=8), file)
    with pytest.raises(NotDeployable, match="must end with"):
        export(SAC("MlpPolicy", Units(), **small()), tmp_path / "policy.pt")
    assert not file.exists()
    onnx.save(onnx.helper.make_model(onnx.helper.make_graph([], "empty", [], [])), file)
    with pytest.raises(NotDeployable, match=r"policy\.onnx"):
        OnnxPolicy(file)
    with pytest.raises(NotDeployable, match="format 0"):
        Metadata.from_json(json.dumps({"format": 0}), "file")
    with pytest.raises(NotDeployable, match="not written by"):
        Metadata.from_json(json.dumps({"format": 1, "strange": 0}), "file")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        OnnxPolicy(tmp_path / "nowhere.onnx")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A policy for Units, whose observations are within [-100, 100]."""
    file = tmp_path_factory.mktemp("exported") / "policy.onnx"
    export(SAC("MlpPolicy", Units(), **small()), file)
    return OnnxPolicy(file)


@pytest.mark.parametrize(
    "observation, problem",
    [
        (np.zeros(3, np.float32), "shape"),
        (np.array([0, np.nan], np.float32), "NaN"),
        (np.array([0, 101], np.float32), "outside"),
        (np.array(["a", "b"]), "dtype"),
        ({"": np.zeros(2, np.float32)}, "an array"),
    ],
)
def test_observations_are_checked(exported, observation, problem):
    assert problem in check_observation(observation, exported.metadata)
    assert check_observation(np.array([0, 100.1]), exported.metadata) is None  # a double, within the tolerance


def test_command_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = SAC("MlpPolicy", "Pendulum-v1", **small())
    model.save("sac-Pendulum-v1.zip")
    sb3 = ["sb3-chac", "export", "sac-Pendulum-v1.zip", "policy.onnx", "--env", "Pendulum-v1"]
    monkeypatch.setattr("sys.argv", [*sb3, "--check", "30"])
    sb3_chac()
    assert "30 observations" in (output := capsys.readouterr().out) and output.endswith("equal\n")
    metadata = OnnxPolicy("policy.onnx").metadata
    assert metadata.model_sha256 == hashlib.sha256((tmp_path / "sac-Pendulum-v1.zip").read_bytes()).hexdigest()
    assert metadata.environment == "Pendulum-v1" and metadata.rate == 30
    for wrong, named in [(["--check", "0"], "--check"), (["--rate", "nan"], "--rate"), (["--control", "self"], "C-HAC")]:
        monkeypatch.setattr("sys.argv", [*sb3, *wrong])
        with pytest.raises(SystemExit, match="2"):
            sb3_chac()
        assert named in capsys.readouterr().err


def test_a_difference_is_found(tmp_path):
    env = Units()
    models = [SAC("MlpPolicy", env, **small(seed)) for seed in (0, 1)]
    export(models[0], tmp_path / "policy.onnx")
    assert compare(models[0], OnnxPolicy(tmp_path / "policy.onnx"), env, 20).equal
    assert not compare(models[1], OnnxPolicy(tmp_path / "policy.onnx"), env, 20).equal


def test_safedrive_describes_observation_and_action(tmp_path):
    for corridors in (False, True):
        env = gym.make("SafeDrive-v0", corridors=corridors)
        metadata = export(SAC("MlpPolicy", env, buffer_size=10, **small()), tmp_path / "policy.onnx", env=env)
        assert metadata.layout[0]["start"] == 0 and metadata.layout[-1]["stop"] == env.observation_space.shape[0]
        assert all(a["stop"] == b["start"] for a, b in zip(metadata.layout, metadata.layout[1:], strict=False))
        assert metadata.brake == [None, -1.0] and metadata.action_names == ["steering", "acceleration"]
        assert metadata.rate == 10 and metadata.environment == "SafeDrive-v0"
