"""Intervention weighted regression (IWR)."""

from typing import TypeVar

import numpy as np
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_chac.hg_dagger.hg_dagger import HGDagger, filled

SelfIWR = TypeVar("SelfIWR", bound="IWR")


class IWR(HGDagger):
    """
    Intervention-weighted regression (IWR): ``HGDagger`` that also imitates what the novice did where the human let it,
    and gives what the human drove half of the weight, however little it is.
    Paper: "Human-in-the-Loop Imitation Learning using Remote Teleoperation" (Mandlekar et al. 2020,
    https://arxiv.org/abs/2012.06733).

    What the human drove is one class, what the novice drove in the rounds the other; batches are drawn so that both are
    equally likely, see ``class_weights``. In the paper the demonstrations of the warm-up belong to the novice's class. Here
    they are the human's: on SafeDrive success then does not dip after the first round (benchmarks/NOTES.md).

    For the parameters see ``HGDagger``.
    """

    def _training_set(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        human, novice = self.replay_buffer.human, self.replay_buffer.novice
        observations, actions = (np.concatenate(pair) for pair in zip(filled(human), filled(novice), strict=True))
        return observations, actions, class_weights(np.arange(len(actions)) < len(human))

    def learn(
        self: SelfIWR,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "IWR",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfIWR:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)


def class_weights(is_human: np.ndarray) -> np.ndarray:
    """
    Weight both classes equally.

    :param is_human: shape (n,), bool
    :return: probability of each sample, shape (n,): both classes sum up to 1/2; equal for all if one of them is empty
    """
    n, n_human = len(is_human), np.count_nonzero(is_human)
    if n_human in (0, n):
        return np.full(n, 1 / max(n, 1))
    return np.where(is_human, 0.5 / n_human, 0.5 / (n - n_human))
