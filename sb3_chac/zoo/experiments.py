"""Hooks added to RL-Zoo3's ExperimentManager for our algorithms and environments: see the function of each method."""

import atexit
import contextlib
import functools
import inspect
import json
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rl_zoo3.utils import ALGOS
from stable_baselines3.common.callbacks import ProgressBarCallback
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_chac.common.callbacks import PROGRESS_FILE, CSVProgress, GuidedProgressBar, SafetyCost
from sb3_chac.common.checkpoint_files import DamagedCheckpoint, checkpoint_step, stored_rows, verify
from sb3_chac.common.checkpoints import ResumableCheckpoint, StopSignals, TrainingStopped
from sb3_chac.common.guided import GuidedOffPolicyAlgorithm
from sb3_chac.common.lagrange import CostConstrainedAlgorithm
from sb3_chac.common.offline import OfflineAlgorithm
from sb3_chac.envs import ENVIRONMENTS, ONE_PER_PROCESS, VALIDATION
from sb3_chac.human.supervisor import ExpertError, RuleError
from sb3_chac.zoo.algorithms import ALGORITHMS, hyperparams_file
from sb3_chac.zoo.errors import check_file, check_hyperparameters, check_options, evaluating, one_line
from sb3_chac.zoo.wrappers import check_normalization, checked_wrapper

# Steps between two checkpoints unless --save-freq says otherwise: what a person does at most for nothing
SAVE_FREQ = 10_000


def extend(manager: type) -> None:
    """
    Calling it again changes nothing.

    :param manager: ``rl_zoo3.exp_manager.ExperimentManager``
    """
    for name, around in AROUND.items():
        original = getattr(manager, name)
        if not hasattr(original, "__wrapped__"):
            setattr(manager, name, _wrapped(original, around))


def _wrapped(original: Callable[..., Any], around: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(original)
    def method(self: Any, *args: Any, **kwargs: Any) -> Any:
        return around(functools.partial(original, self), self, *args, **kwargs)

    return method


def init(original: Callable[..., None], manager: Any, *args: Any, **kwargs: Any) -> None:
    """
    Our hyperparameters, unless others are named; subprocesses for environments that need them; and other seeds than those that
    a checkpoint began with: the episodes are not to be the same again.
    """
    arguments = inspect.signature(original).bind(*args, **kwargs).arguments
    algo = arguments["algo"]
    if algo not in ALGORITHMS and arguments["env_id"] not in ENVIRONMENTS:
        original(**arguments)
        manager.steps_done = None
        return
    with one_line_of(manager, Exception):
        check_options(arguments["args"])
        init_ours(original, manager, algo, arguments)


def init_ours(original: Callable[..., None], manager: Any, algo: str, arguments: dict[str, Any]) -> None:
    """
    Set up an experiment with our algorithms or environments.

    :param arguments: of RL-Zoo3's ``__init__``
    """
    if not arguments.get("config"):
        with contextlib.suppress(FileNotFoundError):  # then RL-Zoo3 says itself that it has none either
            arguments["config"] = str(hyperparams_file(algo))
    if arguments["env_id"] in ONE_PER_PROCESS:
        arguments["vec_env_type"] = "subproc"
    trained_agent = arguments.get("trained_agent", "")
    done = checkpoint_step(trained_agent)
    if done is not None:
        verify(Path(trained_agent).parent)
        arguments["seed"] = (arguments.get("seed", 0) + done) % 2**32
    original(**arguments)
    manager.steps_done = done


def is_ours(manager: Any) -> bool:
    """
    Tell whether an experiment concerns this package.

    :return: whether the algorithm or the environment is one of this package
    """
    return manager.algo in ALGORITHMS or manager.env_name.gym_id in ENVIRONMENTS


def one_line_of(manager: Any, *kinds: type[Exception]) -> contextlib.AbstractContextManager[None]:
    """
    Choose how errors are told.

    :return: see ``one_line``; nothing for those who tell errors themselves
    """
    return contextlib.nullcontext() if getattr(manager, "tells_errors", False) else one_line(*kinds)


def setup_experiment(original: Callable[..., Any], manager: Any) -> Any:
    """A mistake in the hyperparameters or the arguments of an environment ends in one line."""
    if not is_ours(manager):
        return original()
    with one_line_of(manager, Exception):
        check_file(manager.config, manager.env_name.gym_id)
        return original()


def create_envs(original: Callable[..., Any], manager: Any, *args: Any, **kwargs: Any) -> Any:
    """Create environments, whose processes leave signals to the one that trains: a terminal sends Ctrl-C to all of them."""
    if not is_ours(manager) or manager.vec_env_class is not SubprocVecEnv:
        return original(*args, **kwargs)
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        env = original(*args, **kwargs)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    atexit.register(end_processes, env.unwrapped)
    return env


def end_processes(env: SubprocVecEnv) -> None:
    """RL-Zoo3 leaves environments open, and multiprocessing would wait for ever for processes that ignore SIGTERM."""
    for process in env.processes:
        process.kill()


def preprocess_hyperparams(original: Callable[..., Any], manager: Any, hyperparams: dict[str, Any]) -> Any:
    """
    Mistakes are named before anything is made. Our environments are evaluated on maps that are neither those of the training
    nor those of the final test.
    """
    if not is_ours(manager):
        return original(hyperparams)
    check_hyperparameters(hyperparams, manager.n_timesteps)
    is_text = isinstance(hyperparams.get("normalize"), str)
    with evaluating(hyperparams):
        hyperparams, env_wrapper, callbacks, vec_env_wrapper = original(hyperparams)
    if is_text:
        check_normalization(manager.normalize_kwargs)
    env_id = manager.env_name.gym_id
    if manager._eval_env_kwargs_args is None and env_id in VALIDATION:
        manager.eval_env_kwargs = {**manager.env_kwargs, **VALIDATION[env_id]}
    wrappers = checked_wrapper("env_wrapper", env_wrapper), checked_wrapper("vec_env_wrapper", vec_env_wrapper)
    return hyperparams, wrappers[0], callbacks, wrappers[1]


def create_callbacks(original: Callable[..., None], manager: Any) -> None:
    """
    Our algorithms, and others in our environments, write progress.csv with the safety cost and, except with ``--save-freq 0``,
    checkpoints to resume from (neither in trials of Optuna). The progress bar of those that learn from takeovers tells what
    the human does.
    """
    save_freq = manager.save_freq  # it is changed
    original()
    if not is_ours(manager) or manager.optimize_hyperparameters:
        return
    algorithm = ALGOS[manager.algo]
    # Those count for themselves, or make no steps
    if not issubclass(algorithm, GuidedOffPolicyAlgorithm | CostConstrainedAlgorithm | OfflineAlgorithm):
        manager.callbacks.append(SafetyCost())
    if issubclass(algorithm, GuidedOffPolicyAlgorithm):
        manager.callbacks[:] = [
            GuidedProgressBar() if type(callback) is ProgressBarCallback else callback for callback in manager.callbacks
        ]
    manager.callbacks.append(CSVProgress(Path(manager.save_path, PROGRESS_FILE)))
    if save_freq != 0:
        save_freq = save_freq if save_freq > 0 else SAVE_FREQ
        manager.callbacks.append(ResumableCheckpoint(save_freq, manager.save_path, manager.env_name))


def save_config(original: Callable[..., None], manager: Any, saved_hyperparams: dict[str, Any]) -> None:
    """The command line in a form that can be repeated, without what ``sb3-chac resume`` adds to it."""
    original(saved_hyperparams)
    if is_ours(manager):
        arguments = sys.argv[1:]
        if manager.steps_done is not None and arguments[-2:] == ["-i", manager.trained_agent]:
            del arguments[-2:]
        Path(manager.params_path, "argv.json").write_text(json.dumps(arguments) + "\n")


def learn(original: Callable[..., None], manager: Any, model: Any) -> None:
    """
    Learn, from a checkpoint on only the steps that remain of the total. SIGTERM and Ctrl-C end the training after a
    checkpoint, if it writes any.
    """
    if is_ours(manager):
        with one_line_of(manager, OSError, ValueError, ExpertError, RuleError):
            learn_ours(original, manager, model)
    else:
        original(model)


def learn_ours(original: Callable[..., None], manager: Any, model: Any) -> None:
    """
    Learn with checkpoints and signals.

    :param original: RL-Zoo3's ``learn``
    """
    if manager.steps_done is not None:
        original = functools.partial(go_on, original, manager)
    checkpoint = next((entry for entry in manager.callbacks if isinstance(entry, ResumableCheckpoint)), None)
    if checkpoint is None:
        return original(model)
    try:
        with StopSignals() as checkpoint.signals:
            original(model)
    except TrainingStopped as stopped:
        manager.save_trained_model(model)  # as RL-Zoo3 does after Ctrl-C
        print(stopped, file=sys.stderr)
        sys.exit(stopped.exit_code)
    except OSError as error:  # such as a full disk
        raise OSError(checkpoint.farewell(str(error))) from error
    except (ValueError, ExpertError, RuleError) as error:  # what was driven before is kept
        if model.num_timesteps == (manager.steps_done or 0):
            raise
        checkpoint.save()
        raise type(error)(f"{error} {checkpoint.farewell('this error')}") from error


def go_on(original: Callable[..., None], manager: Any, model: Any) -> None:
    """
    Go on from a checkpoint.

    :param original: RL-Zoo3's ``learn``
    :param model: of a checkpoint
    :raises DamagedCheckpoint: if the replay buffer is not the one that belongs to it
    """
    rows = stored_rows(Path(manager.trained_agent).parent)
    if rows is not None and model.replay_buffer.size() != rows:
        raise DamagedCheckpoint(f"{manager.trained_agent}: {model.replay_buffer.size()} of {rows} stored steps were read.")
    remaining = max(manager.n_timesteps - model.num_timesteps, 0)
    print(f"Resuming at step {model.num_timesteps}, {remaining} of {manager.n_timesteps} steps remain. Seed: {manager.seed}")

    def learn_remaining(total_timesteps: int, **kwargs: Any) -> Any:
        return model.learn(remaining, reset_num_timesteps=False, **kwargs)

    original(SimpleNamespace(learn=learn_remaining, env=model.env))


# Method of ExperimentManager -> what is called in its place, with the original
AROUND: dict[str, Callable[..., Any]] = {
    "__init__": init,
    "setup_experiment": setup_experiment,
    "create_envs": create_envs,
    "_preprocess_hyperparams": preprocess_hyperparams,
    "create_callbacks": create_callbacks,
    "_save_config": save_config,
    "learn": learn,
}
