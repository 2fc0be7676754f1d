"""Saved models: find the algorithm of a file, load it for acting, and find the statistics of its observations."""

import inspect
import json
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from huggingface_sb3 import EnvironmentName
from rl_zoo3 import utils
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_chac.common.checkpoints import statistics
from sb3_chac.common.saved_by import name_in
from sb3_chac.envs import ENVIRONMENTS
from sb3_chac.envs.driving.corridors import corridors_remedy
from sb3_chac.evaluation.episodes import NotEvaluable, SavedModel, control_of
from sb3_chac.zoo.registration import add_algorithms

DEFAULT_ENV = "SafeDrive-v0"


def env_of(model: Path | None) -> str:
    """
    Guess the environment of a model from its path.

    :param model: a file such as logs/chac/SafeDrive-v0_1/best_model.zip or chac-SafeDrive-v0.zip
    :return: the first of our environments whose name occurs in that of the file or of its folder, else ``DEFAULT_ENV``
    """
    names = f"{model.absolute().parent.name}/{model.name}" if model else ""
    return next((env for env in ENVIRONMENTS if env in names), DEFAULT_ENV)


def find_algorithm(path: Path, algo: str | None) -> tuple[Path, str, type[BaseAlgorithm]]:
    """
    Find the algorithm of a saved model.

    :param path: a saved model, with or without ".zip"
    :param algo: name of the algorithm, read from the file if None: the module of the model's policy and the arguments stored
        with it tell, and the path where they do not
    :return: path of the file, name and class of the algorithm
    :raises FileNotFoundError: if there is no such file
    :raises NotEvaluable: if it is not a model of Stable-Baselines3, its algorithm is not known, or is another than ``algo``
    """
    add_algorithms(utils)
    if algo is not None and algo not in utils.ALGOS:
        raise NotEvaluable(f"--algo {algo!r} is not known, choose from {', '.join(sorted(utils.ALGOS))}.")
    if not path.is_file() and path.name and path.with_name(path.name + ".zip").is_file():
        path = path.with_name(path.name + ".zip")
    if not path.is_file():
        raise FileNotFoundError(f"There is no model {path}.")
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
        module = data["policy_class"]["__module__"]
    except (zipfile.BadZipFile, KeyError, ValueError, TypeError) as error:
        raise NotEvaluable(f"{path} is not a model saved by Stable-Baselines3.") from error
    saver = name_in(data)
    named = [name for name, algorithm in utils.ALGOS.items() if algorithm.__name__ == saver]
    savers = named or possible_algorithms(module, set(data), utils.ALGOS)
    if algo is None:
        algo = choose_by_path(path, savers or list(utils.ALGOS))
    elif savers and algo not in savers:
        raise NotEvaluable(f"--algo {algo}: {path} was saved by {' or '.join(savers)}: give that, or leave --algo out.")
    return path, algo, utils.ALGOS[algo]


def possible_algorithms(module: str, stored: set[str], algorithms: dict[str, type[BaseAlgorithm]]) -> list[str]:
    """
    Find out which algorithms may have saved a model.

    :param module: the one that defines its policy
    :param stored: names of the attributes stored with it
    :param algorithms: classes by name
    :return: names of those that have such policies, and whose arguments fit best; none if the policy is a user's
    """

    def fit(algo: str) -> int:
        parameters = set(inspect.signature(algorithms[algo]).parameters)
        return len(parameters & stored) - len(parameters - stored)

    candidates = [
        algo
        for algo, algorithm in algorithms.items()
        if module in {policy.__module__ for policy in algorithm.policy_aliases.values()}
    ]
    best = [algo for algo in candidates if fit(algo) == max(map(fit, candidates))]
    return ["ddpg", "td3"] if "td3" in best else best  # DDPG stores what TD3 stores


def choose_by_path(path: Path, candidates: list[str]) -> str:
    """
    Choose the algorithm that the path of a saved model names.

    :param path: of the saved model, e.g. logs/<algo>/<env>_1/<env>.zip or <algo>-<env>.zip
    :param candidates: names of algorithms that may have saved it
    :return: name of the algorithm, the only candidate whatever the path
    :raises NotEvaluable: if the path names none
    """
    if len(candidates) == 1:
        return candidates[0]
    folders = {folder.name for folder in path.resolve().parents[:2]}
    named = [
        algo for algo in candidates if algo in folders or path.stem == algo or path.name.startswith((f"{algo}-", f"{algo}_"))
    ]
    if named:
        return max(named, key=len)
    raise NotEvaluable(f"{path} may be any of {', '.join(sorted(candidates))}: name its algorithm with --algo.")


def load_model(
    path: Path, algo: str, algorithm: type[BaseAlgorithm], env: gym.Env, control: str | None = None
) -> BaseAlgorithm:
    """
    Load a saved model for acting.

    :param algo: name of the algorithm, for the message
    :param algorithm: its class
    :param env: the environment that the model is to act in
    :param control: who acts of a C-HAC model: "guided", "self" or "shared"; as in its training if None
    :return: the model, on the CPU, fit for acting only
    :raises NotEvaluable: if it does not load, does not fit the environment, or has no such policy (yet)
    """
    try:
        model = SavedModel(algorithm, path.read_bytes()).load(env)
    except Exception as error:  # whatever a model of another algorithm, version or environment leads to
        reason = f"{error or type(error).__name__}{remedy_for(path, env)}"
        raise NotEvaluable(f"{path} cannot be loaded as {algo} for {env.unwrapped}: {reason}") from error
    broken = [name for name, value in model.policy.state_dict().items() if not th.isfinite(value).all()]
    if broken:
        raise NotEvaluable(f"{path} holds weights that are NaN or infinite ({broken[0]}): take another checkpoint.")
    if control is not None:
        if control_of(model) is None:
            raise NotEvaluable(f"{control!r} is a policy of C-HAC models, {path} is a model of {algo}.")
        policy: Any = model.policy
        if control in ("self", "shared") and policy.stage == 1:
            raise NotEvaluable(f"{path} is in stage 1, where the guided policy acts alone: there is no {control!r} yet.")
        policy.control = control
    return model


def remedy_for(path: Path, env: gym.Env) -> str:
    """
    Say how to make the environment that a saved model fits, if that is known.

    :return: a sentence, with a full stop and a blank before it, or ""
    """
    try:
        data, _, _ = load_from_zip_file(path, device="cpu")
    except Exception:  # that is why it cannot be loaded
        return ""
    remedy = corridors_remedy((data or {}).get("observation_space"), env.observation_space)
    return remedy and f".{remedy}"


def find_normalization(model: Path, env_id: str, env: gym.Env) -> tuple[Path, VecNormalize | None]:
    """
    Find the statistics of a model's observations.

    :param env: that the model fits
    :return: where RL-Zoo3 leaves them, and the VecNormalize there, None if there is none
    :raises NotEvaluable: if the file cannot be read, or holds numbers that are NaN or infinite
    """
    path = model.parent / EnvironmentName(env_id.rpartition(":")[2]) / "vecnormalize.pkl"
    if not path.is_file():
        return path, None
    try:
        normalize = VecNormalize.load(str(path), DummyVecEnv([lambda: env]))
        broken = [name for name, values in statistics(normalize).items() if not np.isfinite(values).all()]
    except Exception as error:  # pickle raises nearly anything
        raise NotEvaluable(f"{path} cannot be read: {error}") from error
    if broken:
        raise NotEvaluable(f"{path} holds statistics that are NaN or infinite ({broken[0]}): take another checkpoint.")
    return path, normalize
