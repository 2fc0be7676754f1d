from sb3_chac.datasets.recording import WatchedEnv, record
from sb3_chac.datasets.replay import Replay
from sb3_chac.datasets.writer import DatasetWriter

__all__ = ["DatasetWriter", "Replay", "WatchedEnv", "record"]
