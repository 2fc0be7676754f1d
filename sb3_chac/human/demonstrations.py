"""Former place of ``sb3_chac.common.demonstrations``, for programs that import from it."""

from sb3_chac.common.demonstrations import Demonstrations, load_demonstrations
from sb3_chac.common.minari_datasets import DatasetError, open_dataset

__all__ = ["DatasetError", "Demonstrations", "load_demonstrations", "open_dataset"]
