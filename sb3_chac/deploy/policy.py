"""Exported policies in onnxruntime, without torch."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_chac.deploy.metadata import KEY, Metadata, NotDeployable


class Proposal(NamedTuple):
    """
    Proposal of a policy.

    :param action: in the units of the environment, shape (action_dim,)
    :param guided_action: what the human-guided policy alone would do; None unless the file holds shared control
    :param self_drives: whether ``action`` is the self-learning policy's
    :param confidence: that the self-learning policy does better, P(Q_r > Q_g)
    """

    action: np.ndarray
    guided_action: np.ndarray | None = None
    self_drives: bool | None = None
    confidence: float | None = None


class OnnxPolicy:
    """
    A policy that ``sb3-chac export`` wrote, in one thread on the CPU.

    :param file: path of the ONNX file
    :raises FileNotFoundError: if there is none
    :raises NotDeployable: if onnxruntime cannot load it, or it has no metadata of ours
    """

    def __init__(self, file: str | Path) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise NotDeployable("onnxruntime is missing: pip install 'sb3_chac[deploy]'.") from error
        self.file = Path(file)
        if not self.file.is_file():
            raise FileNotFoundError(f"There is no policy {self.file}.")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self.session = onnxruntime.InferenceSession(str(self.file), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime has no common base class for its errors
            raise NotDeployable(f"{self.file} cannot be loaded by onnxruntime: {error}") from error
        stored = self.session.get_modelmeta().custom_metadata_map
        self.metadata = Metadata.from_json(stored.get(KEY, "null"), str(self.file))
        self._outputs = [output.name for output in self.session.get_outputs()]

    def __call__(self, observation: Any) -> Proposal:
        """
        Decide on one observation. It is not checked, see ``check_observation``.

        :param observation: array of the shape and dtype of the environment's, or a dictionary of such arrays
        """
        inputs = self.metadata.inputs
        parts = observation if isinstance(observation, dict) else {"": observation}
        feed = {entry.tensor: np.asarray(parts[entry.key], entry.dtype)[None] for entry in inputs}
        found = dict(zip(self._outputs, self.session.run(None, feed), strict=True))
        if "confidence" not in found:
            return Proposal(found["action"][0])
        return Proposal(
            found["action"][0], found["guided_action"][0], bool(found["self_drives"][0]), float(found["confidence"][0])
        )


def check_observation(observation: Any, metadata: Metadata, tolerance: float = 1e-3) -> str | None:
    """
    Check shape, dtype, and that all numbers are finite and within the bounds of the environment's space.

    :param observation: array, or a dictionary of arrays
    :param tolerance: by which bounds may be exceeded, as a share of the distance between them
    :return: what is wrong, None if nothing is
    """
    if isinstance(observation, dict) != bool(metadata.inputs[0].key):
        return "the observation must be " + ("an array" if isinstance(observation, dict) else "a dictionary of arrays")
    parts = observation if isinstance(observation, dict) else {"": observation}
    for entry in metadata.inputs:
        if entry.key not in parts:
            return f"{entry.tensor} is missing"
        value = np.asarray(parts[entry.key])
        if value.shape != entry.shape:
            return f"{entry.tensor} has shape {value.shape}, not {entry.shape}"
        if not np.can_cast(value.dtype, entry.dtype, "same_kind"):
            return f"{entry.tensor} has dtype {value.dtype}, not {entry.dtype}"
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            return f"{entry.tensor} has NaN or infinite numbers"
        if entry.low is None or entry.high is None:
            continue
        low, high = (np.reshape(bound, entry.shape if np.ndim(bound) else ()) for bound in (entry.low, entry.high))
        slack = tolerance * (high - low)
        if (value < low - slack).any() or (value > high + slack).any():
            return f"{entry.tensor} has numbers outside of its bounds"
    return None
