"""Optuna search spaces of our algorithms, for ``rl_zoo3 train -optimize``, and the way back for ``--trial-id``."""

from collections.abc import Callable
from typing import Any

import optuna
from rl_zoo3.hyperparams_opt import (
    convert_offpolicy_params,
    convert_onpolicy_params,
    sample_her_params,
    sample_ppo_params,
    sample_sac_params,
)


def sample_dsac_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sample hyperparameters of DSAC.

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


def sample_pvp_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sample hyperparameters of PVP.

    :return: keyword arguments of PVP. For the parameters see ``sample_dsac_params``
    """
    return convert_offpolicy_params(_suggest_guided(trial))


def sample_dpvp_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sample hyperparameters of D-PVP.

    :return: keyword arguments of DPVP. For the parameters see ``sample_dsac_params``
    """
    return convert_offpolicy_params(_suggest_dpvp(trial))


def sample_chac_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    ``switch_after`` is not among them: it has to fit the number of steps of a trial, so set it with ``-params``.

    :return: keyword arguments of CHAC. For the parameters see ``sample_dsac_params``
    """
    confidence = {
        "delta": trial.suggest_float("delta", 0.05, 0.5),
        "sigma_scale": trial.suggest_float("sigma_scale", 0.003, 1.0, log=True),
        "tau_c": trial.suggest_float("tau_c", 0.005, 0.05, log=True),
        "max_deviation": trial.suggest_categorical("max_deviation", [0.05, 0.1, 0.2, 2.0]),
        "anchor_coef": trial.suggest_float("anchor_coef", 1.0, 300.0, log=True),
        "cost_coef": trial.suggest_float("cost_coef", 10.0, 1000.0, log=True),
    }
    return convert_offpolicy_params(_suggest_dpvp(trial) | confidence)


def _suggest_guided(trial: optuna.Trial) -> dict[str, Any]:
    """Suggest what all algorithms that learn from takeovers have in common, before the conversion."""
    params: dict[str, Any] = {
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.003, 0.1, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 6, 9),  # 64 to 512
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 0.002, log=True),
        "tau": trial.suggest_float("tau", 0.001, 0.05, log=True),
        "policy_delay": trial.suggest_int("policy_delay", 1, 3),
        "net_arch": trial.suggest_categorical("net_arch", ["small", "medium", "large"]),
        "pv_coef": trial.suggest_float("pv_coef", 0.3, 3.0, log=True),
        "pv_min_diff": trial.suggest_float("pv_min_diff", 0.0, 0.3),
    }
    trial.set_user_attr("gamma", 1 - params["one_minus_gamma"])
    trial.set_user_attr("batch_size", 2 ** params["batch_size_pow"])
    return params


def _suggest_dpvp(trial: optuna.Trial) -> dict[str, Any]:
    return _suggest_guided(trial) | {
        "ent_coef": trial.suggest_float("ent_coef", 1e-4, 0.05, log=True),
        "weight_decay": trial.suggest_float("weight_decay", 0.1, 10.0, log=True),
        "average_tau": trial.suggest_float("average_tau", 2e-4, 0.02, log=True),
    }


def sample_sac_lag_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    ``cost_limit`` is the task's and not tuned. A study that looks at the return alone finds out how to evade it: read the cost
    of its trials, too.

    :return: keyword arguments of SACLag. For the parameters see ``sample_dsac_params``
    """
    return sample_sac_params(trial, n_actions, n_envs, additional_args) | _suggest_multiplier(trial)


def sample_ppo_lag_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sample hyperparameters of PPOLag. For ``cost_limit`` see ``sample_sac_lag_params``.

    :return: keyword arguments. For the parameters see ``sample_dsac_params``
    """
    return sample_ppo_params(trial, n_actions, n_envs, additional_args) | _suggest_multiplier(trial)


def _suggest_multiplier(trial: optuna.Trial) -> dict[str, Any]:
    return {
        "pid_kp": trial.suggest_float("pid_kp", 0.01, 2.0, log=True),
        "pid_ki": trial.suggest_float("pid_ki", 1e-3, 0.2, log=True),
        "pid_kd": trial.suggest_float("pid_kd", 1e-3, 1.0, log=True),
        "pid_tau": trial.suggest_float("pid_tau", 0.02, 1.0, log=True),
        "lagrange_init": trial.suggest_float("lagrange_init", 0.0, 5.0),
    }


def sample_bc_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sample hyperparameters of BC.

    :return: keyword arguments of BC. For the parameters see ``sample_dsac_params``
    """
    params: dict[str, Any] = {
        "batch_size_pow": trial.suggest_int("batch_size_pow", 6, 10),  # 64 to 1024
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 0.003, log=True),
        "weight_decay": trial.suggest_float("weight_decay", 1e-6, 0.1, log=True),
        "loss": trial.suggest_categorical("loss", ["mse", "nll"]),
        "net_arch": trial.suggest_categorical("net_arch", ["small", "medium", "large"]),
    }
    trial.set_user_attr("batch_size", 2 ** params["batch_size_pow"])
    return convert_bc_params(params)


def convert_bc_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    Convert sampled values to keyword arguments.

    :param sampled_params: as Optuna stores them
    :return: keyword arguments of BC, HGDagger or IWR, which have no discount factor
    """
    params = convert_offpolicy_params(sampled_params | {"one_minus_gamma": 0.0})
    del params["gamma"]
    return params


def sample_cql_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sample hyperparameters of CQL.

    :return: keyword arguments of CQL. For the parameters see ``sample_dsac_params``
    """
    params: dict[str, Any] = {
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.003, 0.1, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 6, 8),  # 64 to 256
        "learning_rate": trial.suggest_float("learning_rate", 3e-5, 0.001, log=True),
        "actor_lr": trial.suggest_float("actor_lr", 3e-5, 0.001, log=True),
        "tau": trial.suggest_float("tau", 0.002, 0.02, log=True),
        "conservative_weight": trial.suggest_float("conservative_weight", 0.3, 10.0, log=True),
        "net_arch": trial.suggest_categorical("net_arch", ["small", "medium", "large"]),
    }
    trial.set_user_attr("gamma", 1 - params["one_minus_gamma"])
    trial.set_user_attr("batch_size", 2 ** params["batch_size_pow"])
    return convert_offpolicy_params(params)


def sample_gail_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sample hyperparameters of GAIL.

    :return: keyword arguments of GAIL. For the parameters see ``sample_dsac_params``
    """
    return sample_ppo_params(trial, n_actions, n_envs, additional_args) | {
        "disc_learning_rate": trial.suggest_float("disc_learning_rate", 1e-5, 0.003, log=True),
        "n_disc_updates": trial.suggest_int("n_disc_updates", 1, 32, log=True),
        "disc_batch_size": trial.suggest_categorical("disc_batch_size", [128, 256, 512, 1024]),
        "gradient_penalty": trial.suggest_categorical("gradient_penalty", [0.0, 1.0, 10.0]),
    }


def sample_dagger_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    The budgets of the human are the task's and not tuned.

    :return: keyword arguments of HGDagger and IWR. For the parameters see ``sample_dsac_params``
    """
    params = sample_bc_params(trial, n_actions, n_envs, additional_args)
    return params | {"n_epochs": trial.suggest_int("n_epochs", 5, 80, log=True)}


# Algorithms that are not listed search as the nearest one does that they derive from
HYPERPARAMS_SAMPLER: dict[str, Callable[..., dict[str, Any]]] = {
    "dsac": sample_dsac_params,
    "pvp": sample_pvp_params,
    "dpvp": sample_dpvp_params,
    "chac": sample_chac_params,
    "sac_lag": sample_sac_lag_params,
    "ppo_lag": sample_ppo_lag_params,
    "bc": sample_bc_params,
    "cql": sample_cql_params,
    "gail": sample_gail_params,
    "hg_dagger": sample_dagger_params,
}
HYPERPARAMS_CONVERTER: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    **dict.fromkeys(HYPERPARAMS_SAMPLER, convert_offpolicy_params),
    "ppo_lag": convert_onpolicy_params,
    "gail": convert_onpolicy_params,
    **dict.fromkeys(("bc", "hg_dagger"), convert_bc_params),
}
