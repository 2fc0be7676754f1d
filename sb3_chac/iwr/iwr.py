from typing import TypeVar

import numpy as np
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_chac.common.buffers import TransitionStore
from sb3_chac.hg_dagger.hg_dagger import HGDagger, filled

SelfIWR = TypeVar("SelfIWR", bound="IWR")


class IWR(HGDagger):
    """
    Intervention-weighted regression (IWR): ``HGDagger`` that also imitates what the novice did where the human let it,
    and gives the interventions half of the weight, however few they are.
    Paper: "Human-in-the-Loop Imitation Learning using Remote Teleoperation" (Mandlekar et al. 2020,
    https://arxiv.org/abs/2012.06733).

    What the human drove in the rounds is one class; the demonstrations and what the novice drove in the rounds are the other.
    Batches are drawn so that both are equally likely, see ``intervention_weights``.

    For the parameters see ``HGDagger``.
    """

    def _training_set(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        human, novice = self.replay_buffer.human, self.replay_buffer.novice
        observations, actions = (np.concatenate(pair) for pair in zip(filled(human), filled(novice), strict=True))
        is_intervention = np.zeros(len(actions), dtype=bool)
        is_intervention[: len(human)] = row_numbers(human) >= self.demonstrated_rows
        return observations, actions, intervention_weights(is_intervention)

    def learn(
        self: SelfIWR,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "IWR",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfIWR:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)


def row_numbers(store: TransitionStore) -> np.ndarray:
    """
    :return: for each row how many the store got before it, shape (n_rows,)
    """
    rows = np.arange(len(store))
    return store.added - len(store) + (rows - store.added) % max(len(store), 1)


def intervention_weights(is_intervention: np.ndarray) -> np.ndarray:
    """
    :param is_intervention: shape (n,), bool
    :return: probability of each sample, shape (n,): both classes sum up to 1/2; equal for all if one of them is empty
    """
    n, n_interventions = len(is_intervention), np.count_nonzero(is_intervention)
    if n_interventions in (0, n):
        return np.full(n, 1 / max(n, 1))
    return np.where(is_intervention, 0.5 / n_interventions, 0.5 / (n - n_interventions))
