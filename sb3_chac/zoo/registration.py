"""Registration of our algorithms with RL-Zoo3, and of our environments with gymnasium."""

import contextlib
import functools
import importlib
import os
import sys
from types import ModuleType

import sb3_chac
from sb3_chac.zoo.algorithms import ALGORITHMS
from sb3_chac.zoo.stopping import check_threads, known_options, one_sentence


def register() -> None:
    """
    Add our environments to gymnasium, and our algorithms, hyperparameters and Optuna samplers to RL-Zoo3.

    Calling it again changes nothing.
    """
    add_environments(importlib.import_module("gymnasium.envs"))
    add_algorithms(importlib.import_module("rl_zoo3.utils"))
    add_experiments(importlib.import_module("rl_zoo3.exp_manager"))
    add_training(importlib.import_module("rl_zoo3.train"))


def add_environments(envs: ModuleType) -> None:
    """
    Register our environments.

    :param envs: ``gymnasium.envs``, whose registry our package fills when it is imported
    """
    importlib.import_module("sb3_chac.envs")


def add_algorithms(utils: ModuleType) -> None:
    """
    Register our algorithms with RL-Zoo3.

    :param utils: ``rl_zoo3.utils``, whose ``ALGOS`` the rest of RL-Zoo3 shares by reference
    """
    from sb3_chac.zoo.errors import store_dict

    utils.ALGOS.update({algo: getattr(sb3_chac, name) for algo, name in ALGORITHMS.items()})
    if not hasattr(utils.StoreDict.__call__, "__wrapped__"):
        utils.StoreDict.__call__ = store_dict(utils.StoreDict.__call__)


def add_experiments(exp_manager: ModuleType) -> None:
    """
    Extend RL-Zoo3's experiments. An algorithm without a search space gets that of the nearest one that it derives from.

    :param exp_manager: ``rl_zoo3.exp_manager``
    """
    from sb3_chac.zoo.experiments import extend
    from sb3_chac.zoo.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    samplers, converters = exp_manager.HYPERPARAMS_SAMPLER, exp_manager.HYPERPARAMS_CONVERTER
    samplers.update(HYPERPARAMS_SAMPLER)
    converters.update(HYPERPARAMS_CONVERTER)
    names = {algorithm: algo for algo, algorithm in exp_manager.ALGOS.items()}
    for algo in ALGORITHMS.keys() - samplers.keys():
        parent = next((names[base] for base in exp_manager.ALGOS[algo].__mro__ if names.get(base) in samplers), None)
        if parent is not None:
            samplers[algo], converters[algo] = samplers[parent], converters[parent]
    extend(exp_manager.ExperimentManager)


def add_training(train: ModuleType) -> None:
    """
    Extend RL-Zoo3's training command.

    :param train: ``rl_zoo3.train``, whose command ends in one line for what is wrong with its arguments, and with one sentence
        when it is stopped before our algorithms, or others in our environments, learn
    """
    from sb3_chac.envs import ENVIRONMENTS
    from sb3_chac.zoo.errors import one_line

    if "--gym-packages" in sys.argv and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # where a user's own environment may be
    command = train.train
    if hasattr(command, "__wrapped__"):
        return

    @functools.wraps(command)
    def checked_command() -> None:
        options = known_options(sys.argv[1:])
        is_ours = options.algo in ALGORITHMS or options.env in ENVIRONMENTS
        with one_sentence("rl_zoo3 train") if is_ours else contextlib.nullcontext():
            with one_line(ValueError, AssertionError, ImportError, OSError):
                check_threads(options.num_threads)
                command()

    train.train = checked_command  # type: ignore[attr-defined]


def add_metadata(push_to_hub: ModuleType) -> None:
    """
    Give ``rl_zoo3.push_to_hub`` the function that it imports: later versions call it otherwise, and return an object.

    :param push_to_hub: ``huggingface_sb3.push_to_hub``
    """
    if not hasattr(push_to_hub, "generate_metadata"):
        push_to_hub.generate_metadata = lambda *args: push_to_hub._generate_metadata(*args).to_dict()  # type: ignore[attr-defined]
