"""Copies of what environments hand out in the training, which may go on using their arrays."""

import copy
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv


class _Info(dict[str, Any]):
    """A copy of what a step says, so that environments that hand out one ``info`` do not share it; keeps copies itself."""

    def __setitem__(self, key: str, value: Any) -> None:
        super().__setitem__(key, copy.deepcopy(value))


class _Infos(list[Any]):
    """Infos of all environments, one ``_Info`` each."""

    def __setitem__(self, idx: Any, info: Any) -> None:
        super().__setitem__(idx, _Info(info))


def keep_last_observations(env: VecEnv) -> None:
    """
    ``DummyVecEnv`` puts the last observation of an episode into ``info`` and then resets the environment, which overwrites it
    if the environment has but one array for its observations. From now on a copy is put there.

    :param env: the environments, nothing is done unless they are those of a ``DummyVecEnv``
    """
    base: Any = env.unwrapped
    if isinstance(base, DummyVecEnv) and not isinstance(base.buf_infos, _Infos):
        base.buf_infos = _Infos(map(_Info, base.buf_infos))
