"""Description of an exported policy: what goes in, what comes out, and where it comes from. It is stored in the ONNX file."""

import json
import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

KEY = "sb3_chac"  # of the ONNX file's metadata properties
FORMAT = 1


class NotDeployable(ValueError):
    """Raised for what cannot be exported or run: a model, a file or an argument."""


@dataclass(frozen=True)
class Input:
    """
    One tensor that the policy reads, without the batch dimension.

    :param key: of a Dict observation, "" if the observation is a single array
    :param low: least value that the environment's space allows, one for all elements or one each; None if unbounded
    :param high: greatest value, alike
    """

    key: str
    shape: tuple[int, ...]
    dtype: str
    low: float | list[float] | None = None
    high: float | list[float] | None = None

    @property
    def tensor(self) -> str:
        """Name of the tensor in the graph."""
        return f"observation.{self.key}" if self.key else "observation"

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        """Size of one observation in bytes."""
        return self.size * np.dtype(self.dtype).itemsize


@dataclass(frozen=True)
class Metadata:
    """
    Description of a policy for a runtime.

    :param inputs: the tensors that one observation consists of, in the order of the graph
    :param low: least action, in the units of the environment, shape (action_dim,)
    :param high: greatest action
    :param rate: decisions per second that the policy was trained with
    :param action_names: of the action's elements
    :param brake: action that stops the vehicle as fast as is reasonable, None for elements that keep their value (steering);
        None if it is not known
    :param coast: upper bounds of a held action's elements (no acceleration), None for elements without one
    :param layout: what the elements of the observation mean: dictionaries with "name", "start", "stop", "unit", "meaning"
    :param algorithm: name of the class
    :param control: C-HAC's ("guided", "self" or "shared"), None for other algorithms
    :param stage: C-HAC's, None for other algorithms
    :param delta: C-HAC's accepted probability that the self-learning policy does worse, None for other algorithms
    :param environment: id
    :param model_sha256: hash of the model's file, or of its parameters if it was exported from memory
    :param versions: of the packages that made the file
    """

    inputs: tuple[Input, ...]
    low: list[float]
    high: list[float]
    rate: float = 10.0
    action_names: list[str] = field(default_factory=list)
    brake: list[float | None] | None = None
    coast: list[float | None] | None = None
    layout: list[dict[str, Any]] = field(default_factory=list)
    algorithm: str = ""
    control: str | None = None
    stage: int | None = None
    delta: float | None = None
    environment: str | None = None
    model_sha256: str = ""
    versions: dict[str, str] = field(default_factory=dict)

    @property
    def action_dim(self) -> int:
        """Number of elements of an action."""
        return len(self.low)

    def to_json(self) -> str:
        """Return the text that is stored."""
        return json.dumps({"format": FORMAT, **asdict(self)}, allow_nan=False, sort_keys=True)

    @classmethod
    def from_json(cls, text: str, source: str) -> "Metadata":
        """
        Read what ``to_json`` wrote.

        :param source: for the message
        :raises NotDeployable: for another text
        """
        try:
            values = json.loads(text)
            found = values.pop("format")
            if found != FORMAT:
                raise NotDeployable(f"{source} has format {found!r}, this version reads format {FORMAT}: export it again.")
            values["inputs"] = tuple(Input(**{**entry, "shape": tuple(entry["shape"])}) for entry in values["inputs"])
            return cls(**values)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            if isinstance(error, NotDeployable):
                raise
            raise NotDeployable(f"{source} was not written by 'sb3-chac export': {error}.") from error
