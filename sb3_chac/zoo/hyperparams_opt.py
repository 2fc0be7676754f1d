"""Optuna search spaces of our algorithms, for ``rl_zoo3 train -optimize``, and the way back for ``--trial-id``."""

from collections.abc import Callable
from typing import Any

import optuna
from rl_zoo3.hyperparams_opt import convert_offpolicy_params, sample_her_params


def sample_dsac_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    :param trial: the trial to suggest values in
    :param n_actions: number of actions
    :param n_envs: number of parallel environments
    :param additional_args: RL-Zoo3's, tells whether HER is used
    :return: keyword arguments of DSAC
    """
    params: dict[str, Any] = {
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.0001, 0.03, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 6, 10),  # 64 to 1024
        "learning_rate": trial.suggest_float("learning_rate", 3e-5, 0.002, log=True),
        "ent_coef_lr": trial.suggest_float("ent_coef_lr", 1e-4, 0.002, log=True),
        "train_freq": trial.suggest_int("train_freq", 1, 10),
        "tau": trial.suggest_float("tau", 0.001, 0.08, log=True),
        "policy_delay": trial.suggest_int("policy_delay", 1, 3),
        "net_arch": trial.suggest_categorical("net_arch", ["small", "medium", "large"]),
    }
    trial.set_user_attr("gamma", 1 - params["one_minus_gamma"])
    trial.set_user_attr("batch_size", 2 ** params["batch_size_pow"])
    if additional_args["using_her_replay_buffer"]:
        params = sample_her_params(trial, params, additional_args["her_kwargs"])
    return convert_offpolicy_params(params)


HYPERPARAMS_SAMPLER: dict[str, Callable[..., dict[str, Any]]] = {"dsac": sample_dsac_params}
HYPERPARAMS_CONVERTER: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {"dsac": convert_offpolicy_params}
