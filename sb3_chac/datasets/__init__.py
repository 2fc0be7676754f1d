"""Datasets of demonstrations in Minari's format: recording and replay."""

from sb3_chac.datasets.recording import WatchedEnv, record
from sb3_chac.datasets.replay import Replay
from sb3_chac.datasets.writer import DatasetWriter

__all__ = ["DatasetWriter", "Replay", "WatchedEnv", "record"]
