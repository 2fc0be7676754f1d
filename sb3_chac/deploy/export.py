"""A trained model as one ONNX graph, from the raw observation to the action in its units."""

import hashlib
import importlib.metadata
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_chac.chac.policies import CHACPolicy
from sb3_chac.common.checks import check_action_space
from sb3_chac.deploy.metadata import KEY, Input, Metadata, NotDeployable
from sb3_chac.deploy.policy import OnnxPolicy
from sb3_chac.evaluation.episodes import ModelDriver

OPSET = 17
TOLERANCE = 1e-5  # of actions, as a share of half their range


class Deployable(nn.Module):
    """
    Function of tensors that computes what ``model.predict(observation, deterministic=True)`` does.

    :param policy: of the model
    :param keys: of a Dict observation, in the order of the arguments of ``forward``; empty for a single tensor
    :param transposed: of the tensors, whether each comes as (height, width, channels) and the model wants channels first
    :param normalize: statistics that the observations are normalized with
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(
        self, policy: BasePolicy, keys: list[str], transposed: list[bool], normalize: VecNormalize | None = None
    ) -> None:
        super().__init__()
        self.policy, self.keys, self.transposed = policy, keys, transposed
        space = policy.action_space
        assert isinstance(space, spaces.Box)
        self.register_buffer("low", th.as_tensor(space.low))
        self.register_buffer("high", th.as_tensor(space.high))
        self.statistics: dict[str, tuple[th.Tensor, th.Tensor]] = {}
        self.clip = 0.0
        if normalize is not None and normalize.norm_obs:
            self.clip = float(normalize.clip_obs)
            found = normalize.obs_rms
            for key, rms in found.items() if isinstance(found, dict) else [("", found)]:
                # In double precision, as VecNormalize computes
                self.statistics[key] = (th.as_tensor(rms.mean), th.as_tensor(np.sqrt(rms.var + normalize.epsilon)))

    def forward(self, *tensors: th.Tensor) -> tuple[th.Tensor, ...]:
        """
        Compute actions.

        :param tensors: of the raw observation, shape (batch_size, ...) each
        :return: actions; of shared control also the guided policy's actions, who drives and the confidence
        """
        prepared = []
        for key, tensor, transposed in zip(self.keys or [""], tensors, self.transposed, strict=True):
            if key in self.statistics:
                mean, std = self.statistics[key]
                tensor = th.clamp((tensor.double() - mean) / std, -self.clip, self.clip).float()
            prepared.append(tensor.permute(0, 3, 1, 2) if transposed else tensor)
        observation: Any = dict(zip(self.keys, prepared, strict=True)) if self.keys else prepared[0]
        policy = self.policy
        if not (isinstance(policy, CHACPolicy) and shares_control(policy)):
            actions = policy._predict(observation, deterministic=True)
            return (self.in_units(actions),)
        choice = policy.choose(observation, policy.averaged_self_actor(observation, True), policy.confidence_critic)
        guided = policy.averaged_actor(observation, True)
        return self.in_units(choice.actions), self.in_units(guided), choice.self_drives, choice.confidence

    def in_units(self, actions: th.Tensor) -> th.Tensor:
        """Scale or clip as ``predict`` does. Clipping to the bounds also takes away what rounding adds to them."""
        actions = actions.reshape(-1, *self.low.shape)
        if self.policy.squash_output:
            actions = self.low + 0.5 * (actions + 1.0) * (self.high - self.low)
        return th.minimum(th.maximum(actions, self.low), self.high)


def shares_control(policy: BasePolicy) -> bool:
    """Return whether it is C-HAC's in stage 2, with control "shared"."""
    return isinstance(policy, CHACPolicy) and policy.control == "shared" and int(policy.stage) == 2


def export(
    model: BaseAlgorithm,
    file: str | Path,
    *,
    normalize: VecNormalize | None = None,
    observation_space: spaces.Space | None = None,
    env: Any = None,
    rate: float | None = None,
    model_sha256: str | None = None,
) -> Metadata:
    """
    Write a model as an ONNX file that acts as ``predict(deterministic=True)`` does.

    :param model: of an algorithm with continuous actions
    :param file: to write, its name ends with .onnx
    :param normalize: statistics of the observations, by default those of the model's own environment
    :param observation_space: of the raw observations, by default that of ``env``, or the model's. They may differ in the
        order of an image's dimensions
    :param env: environment whose description (layout of observation and action, rate) goes into the file
    :param rate: decisions per second, by default ``env.metadata["render_fps"]``, or 10
    :param model_sha256: hash of the file that the model was loaded from, by default that of its parameters
    :return: what the file tells of itself
    :raises NotDeployable: if the model cannot be exported, or a package is missing
    """
    try:
        import onnx
    except ImportError as error:
        raise NotDeployable("onnx is missing: pip install 'sb3_chac[deploy]'.") from error
    file = Path(file)
    if file.suffix != ".onnx":
        raise NotDeployable(f"file: the name must end with .onnx, got {file}.")
    try:
        check_action_space(model.action_space)
    except ValueError as error:
        raise NotDeployable(f"model: its actions cannot be limited by a runtime. {error}") from error
    policy = model.policy
    if policy is None or hasattr(policy, "lstm_actor"):
        raise NotDeployable(f"model: {type(model).__name__} has a memory, which the exported graph has not.")
    if normalize is None:
        normalize = model.get_vec_normalize_env()
    described = getattr(env, "unwrapped", None)
    if observation_space is None:
        observation_space = env.observation_space if env is not None else model.observation_space
    raw, wanted = (spaces_of(space) for space in (observation_space, model.observation_space))
    keys = list(raw) if isinstance(observation_space, spaces.Dict) else []
    metadata = Metadata(
        inputs=tuple(input_of(key, space) for key, space in raw.items()),
        low=floats(model.action_space.low),  # type: ignore[attr-defined]
        high=floats(model.action_space.high),  # type: ignore[attr-defined]
        rate=float(rate or getattr(described, "metadata", {}).get("render_fps") or 10.0),
        action_names=list(getattr(described, "action_names", [])),
        brake=listed(getattr(described, "brake_action", None)),
        coast=listed(getattr(described, "coast_action", None)),
        layout=list(getattr(described, "observation_layout", [])),
        algorithm=type(model).__name__,
        control=getattr(policy, "control", None),
        stage=int(policy.stage) if isinstance(policy, CHACPolicy) else None,
        delta=float(policy.delta) if isinstance(policy, CHACPolicy) else None,
        environment=env.spec.id if env is not None and env.spec is not None else None,
        model_sha256=model_sha256 or hash_of(policy),
        versions=versions(),
    )
    policy.set_training_mode(False)
    transposed = [space.shape != wanted[key].shape for key, space in raw.items()]
    module = Deployable(policy.cpu(), keys, transposed, normalize).eval()
    n_outputs = 4 if shares_control(policy) else 1
    outputs = ["action", "guided_action", "self_drives", "confidence"][:n_outputs]
    inputs = [entry.tensor for entry in metadata.inputs]
    example = tuple(th.as_tensor(np.stack([space.sample() for _ in range(2)])) for space in raw.values())
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(), th.no_grad():
        # Tracing warns of branches on shapes, and that torch has another exporter, which cannot export SB3's distributions
        warnings.simplefilter("ignore")
        th.onnx.export(
            module,
            example,
            f"{folder}/policy.onnx",
            input_names=inputs,
            output_names=outputs,
            opset_version=OPSET,
            dynamo=False,
            dynamic_axes={name: {0: "batch"} for name in [*inputs, *outputs]},
        )
        graph = onnx.load(f"{folder}/policy.onnx")
    onnx.helper.set_model_props(graph, {KEY: metadata.to_json()})
    onnx.checker.check_model(graph)
    file.write_bytes(graph.SerializeToString())
    return metadata


def spaces_of(space: spaces.Space) -> dict[str, spaces.Space]:
    """
    Split a space into its parts.

    :return: the parts of a Dict space, or the space itself under ""
    :raises NotDeployable: for spaces within spaces
    """
    parts = dict(space.spaces) if isinstance(space, spaces.Dict) else {"": space}
    for part in parts.values():
        if not isinstance(part, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
            raise NotDeployable(f"model: observations of {part} cannot be exported.")
    return parts


def input_of(key: str, space: spaces.Space) -> Input:
    """Describe one part of an observation."""
    assert space.shape is not None and space.dtype is not None
    low: Any = None
    high: Any = None
    if isinstance(space, spaces.Box) and space.is_bounded():
        low, high = (floats(bound) for bound in (space.low, space.high))
        if len({*low}) == 1 and len({*high}) == 1:
            low, high = low[0], high[0]
    elif isinstance(space, spaces.Discrete):
        low, high = float(space.start), float(space.start + space.n - 1)
    elif isinstance(space, spaces.MultiDiscrete):
        low, high = floats(space.start), floats(space.start + space.nvec - 1)
    elif isinstance(space, spaces.MultiBinary):
        low, high = 0.0, 1.0
    return Input(key, tuple(space.shape), np.dtype(space.dtype).name, low, high)


def listed(values: Any) -> list[Any] | None:
    """Return a list of the elements, None for None."""
    return None if values is None else list(values)


def floats(values: np.ndarray) -> list[float]:
    """Return the elements as Python's numbers."""
    return [float(value) for value in np.ravel(values)]


def hash_of(policy: BasePolicy) -> str:
    """Return the SHA-256 of all parameters and buffers, with their names."""
    digest = hashlib.sha256()
    for name, value in sorted(policy.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Return those of the packages that have a say in the file."""
    names = ("sb3_chac", "stable_baselines3", "torch", "onnx", "gymnasium")
    return {name: importlib.metadata.version(name) for name in names}


class Comparison:
    """
    Differences between an exported policy and ``predict``, over the observations of episodes.

    :param steps: number of observations
    :param difference: greatest difference of an action, as a share of half the range of its element
    :param other_source: in how many observations another policy drives than in ``predict`` (shared control)
    """

    def __init__(self) -> None:
        self.steps, self.difference, self.other_source = 0, 0.0, 0

    @property
    def equal(self) -> bool:
        """Tell whether the differences are those of rounding."""
        return self.difference <= TOLERANCE and self.other_source == 0

    def __str__(self) -> str:
        text = f"{self.steps} observations: actions differ by up to {self.difference:.2g} (half the range is 1)"
        return f"{text}, another policy drives in {self.other_source}"


def compare(
    model: BaseAlgorithm,
    exported: OnnxPolicy,
    env: Any,
    steps: int,
    *,
    normalize: VecNormalize | None = None,
    scenarios: list[int] | None = None,
) -> Comparison:
    """
    Drive with ``predict`` and ask the exported policy about each observation.

    :param env: in which the model drives
    :param steps: number of observations
    :param scenarios: take turns, None leaves the choice to the environment
    """
    driver = ModelDriver(model, env, normalize)
    policy: Any = model.policy
    half = (np.array(exported.metadata.high) - np.array(exported.metadata.low)) / 2
    result = Comparison()
    episode, done, observation = 0, True, None
    while result.steps < steps:
        if done:
            options = {"scenario": scenarios[episode % len(scenarios)]} if scenarios else None
            observation, _ = env.reset(seed=episode, options=options)
            driver.reset()
            episode += 1
        action = driver(observation)
        proposal = exported(observation)
        result.difference = max(result.difference, float((np.abs(proposal.action - action).ravel() / half).max()))
        if proposal.self_drives is not None:
            result.other_source += proposal.self_drives != bool(policy.last_choice.self_drives.item())
        observation, _, terminated, truncated, _ = env.step(action)
        done = terminated or truncated
        result.steps += 1
    return result
