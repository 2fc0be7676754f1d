"""Mistakes on RL-Zoo3's command line and in its yaml files: one line each, in place of a traceback."""

import argparse
import importlib.util
import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from sb3_chac.common.arguments import describe
from sb3_chac.common.checks import check_range
from sb3_chac.zoo.wrappers import check_classes, check_normalization

TRACEBACK = "SB3_CHAC_TRACEBACK"  # environment variable that brings it back


# What RL-Zoo3 takes for its own hyperparameters
KINDS = {
    "normalize": bool | dict | str,
    "callback": str | dict | list,
    "env_wrapper": str | dict | list,
    "vec_env_wrapper": str | dict | list,
    "policy_kwargs": dict | str,
    "replay_buffer_kwargs": dict | str,
    "monitor_kwargs": dict | str,
    "env_kwargs": dict,
}
EVALUATED = ("policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs", "monitor_kwargs", "normalize")  # if they are text
NOISES = ("normal", "ornstein-uhlenbeck")


@contextmanager
def one_line(*kinds: type[Exception]) -> Iterator[None]:
    """
    End the process with one line for an error inside the block.

    :param kinds: of errors that end the process with one line inside the block
    """
    try:
        yield
    except kinds as error:
        if os.environ.get(TRACEBACK):
            raise
        message = " ".join(str(error).split())
        if not message or not isinstance(error, ValueError | OSError | RuntimeError | AssertionError | ImportError):
            message = f"{type(error).__name__}: {message}"
        sys.stderr.write(f"rl_zoo3 train: error: {message} ({TRACEBACK}=1 shows where.)\n")
        raise SystemExit(2) from error


def check_options(args: Any) -> None:
    """
    Check the options of the command line.

    :param args: of ``rl_zoo3 train``
    :raises ValueError: names the option that is out of its range
    """
    if args.n_timesteps < -1 or args.n_timesteps == 0:
        raise ValueError(f"-n must be at least 1 (or left out: the yaml's n_timesteps), got {args.n_timesteps}.")
    for name, low in (("eval_episodes", 1), ("n_eval_envs", 1), ("n_trials", 1), ("n_jobs", 1), ("save_freq", -1)):
        value = getattr(args, name, low)
        if value is not None and value < low:
            raise ValueError(f"--{name.replace('_', '-')} must be at least {low}, got {value}.")
    config = getattr(args, "conf_file", None)
    if config and Path(config).suffix not in (".yml", ".yaml", ".py") and not is_module(config):
        raise ValueError(f"--conf-file must be a .yml file, or a Python module, got {config!r}.")
    for name in ("trained_agent", "conf_file"):
        value = getattr(args, name, None)
        if value and Path(value).suffix in (".zip", ".yml", ".yaml", ".py") and not Path(value).is_file():
            raise ValueError(f"--{name.replace('_', '-')}: there is no file {value}.")


def is_module(name: str) -> bool:
    """Return whether there is a Python module of this name."""
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def check_file(config: str, env_id: str) -> None:
    """
    Check a hyperparameters file.

    :param config: hyperparameters file of RL-Zoo3
    :param env_id: of the environment
    :raises ValueError: if it is not a mapping of environments to mappings, or holds none for this one
    """
    if Path(config).suffix not in (".yml", ".yaml"):
        return
    try:
        text = Path(config).read_text()
        content = yaml.safe_load(text)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{config} is no YAML: {error}") from error
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{config} must map environments to their hyperparameters, it holds {content!r:.60}.")
    check_twice(config, yaml.compose(text, yaml.SafeLoader), env_id if env_id in content else "default")
    found = content.get(env_id, content.get("default", {}))
    if not isinstance(found, dict):
        raise ValueError(f"{config}: the hyperparameters of {env_id} must be a mapping, got {found!r:.60}.")


def check_twice(config: str, node: yaml.Node | None, entry: str) -> None:
    """
    Check that nothing is written twice: YAML would take the last one.

    :param config: hyperparameters file, for the message
    :param node: of its content, a mapping
    :param entry: of the environment; those of others are left alone
    :raises ValueError: names what is there twice
    """
    seen: set[int] = set()  # aliases may lead in circles

    def check(node: yaml.Node | None, keys_of_interest: tuple[str, ...] | None = None) -> None:
        if id(node) in seen:
            return
        seen.add(id(node))
        lines: dict[str, int] = {}
        for part in node.value if isinstance(node, yaml.MappingNode | yaml.SequenceNode) else ():
            key, value = part if isinstance(part, tuple) else (None, part)
            if key is not None and isinstance(key, yaml.ScalarNode):
                if keys_of_interest is not None and key.value not in keys_of_interest:
                    continue
                line = key.start_mark.line + 1
                if key.value in lines:
                    raise ValueError(f"{config} has {key.value!r} twice, in lines {lines[key.value]} and {line}: remove one.")
                lines[key.value] = line
            check(value)

    check(node, (entry,))


def check_hyperparameters(hyperparams: dict[str, Any], n_timesteps: int) -> None:
    """
    Check the hyperparameters of RL-Zoo3.

    :param hyperparams: of RL-Zoo3, before it takes its own out
    :param n_timesteps: of the command line, which win if they are positive
    :raises ValueError: names the one that is no number, or out of its range
    """
    for name, value in hyperparams.items():
        if isinstance(value, str) and is_a_number(value):
            raise ValueError(f"{name}: {value!r} is text; YAML reads a number only with a point in it: {float(value):.1e}.")
        if isinstance(value, str) and name in ("learning_rate", "clip_range", "clip_range_vf", "ent_coef_lr"):
            schedule, _, start = value.partition("_")
            if name == "ent_coef_lr" or schedule != "lin" or not is_a_number(start):
                raise ValueError(f"{name} must be a number, or lin_ and one (a linear schedule), got {value!r}.")
    for name, kinds in KINDS.items():
        if not isinstance(hyperparams.get(name), kinds | None):
            raise ValueError(f"{name} must be {describe(kinds)}, got {hyperparams[name]!r}.")
    if not isinstance(hyperparams.get("policy"), str):
        raise ValueError(f"policy must be the name of one, such as MlpPolicy, got {hyperparams.get('policy')!r}.")
    check_noise(hyperparams)
    check_classes(hyperparams)
    if isinstance(hyperparams.get("normalize"), dict):
        check_normalization(hyperparams["normalize"])
    if n_timesteps <= 0 and "n_timesteps" not in hyperparams:
        raise ValueError("n_timesteps is missing: give -n, or write it into the yaml.")
    for name, low in (("n_timesteps", 1), ("n_envs", 1), ("frame_stack", 1)):
        value = hyperparams.get(name)
        # RL-Zoo3's own files write 1e6, which is a float
        if value is not None and (isinstance(value, bool | str) or not is_whole(value) or value < low):
            raise ValueError(f"{name} must be a whole number of at least {low}, got {value!r}.")


def check_noise(hyperparams: dict[str, Any]) -> None:
    """
    Check the noise that is added to actions.

    :param hyperparams: of RL-Zoo3
    :raises ValueError: for a type that is none, a standard deviation that is none, or one without the other
    """
    if "noise_type" not in hyperparams and "noise_std" not in hyperparams:
        return
    if not any(known in str(hyperparams.get("noise_type")) for known in NOISES):
        raise ValueError(f"noise_type must be one of {', '.join(NOISES)}, got {hyperparams.get('noise_type')!r}.")
    if "noise_std" not in hyperparams:
        raise ValueError("noise_type needs noise_std, the standard deviation of the noise.")
    check_range("noise_std", hyperparams["noise_std"], low=0.0)


@contextmanager
def evaluating(hyperparams: dict[str, Any]) -> Iterator[None]:
    """
    Name hyperparameters that cannot be evaluated as Python.

    :param hyperparams: that RL-Zoo3 evaluates inside the block, if they are text
    :raises ValueError: names those that may not be Python
    """
    texts = [name for name in EVALUATED if isinstance(hyperparams.get(name), str)]
    try:
        yield
    except (NameError, SyntaxError) as error:
        raise ValueError(f"{' or '.join(texts)} cannot be evaluated: {error}") from error


def is_a_number(text: str) -> bool:
    """Tell whether a text is a finite number."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def is_whole(value: Any) -> bool:
    """Tell whether a value is a finite whole number, of any type."""
    return isinstance(value, int | float) and math.isfinite(value) and value == int(value)


def store_dict(original: Callable[..., None]) -> Callable[..., None]:
    """
    Wrap RL-Zoo3's parser of pairs, so that its errors name the option.

    :param original: ``__call__`` of RL-Zoo3's ``StoreDict``
    :return: the same, whose error names the option and the pair
    """

    def call(self: argparse.Action, parser: Any, namespace: Any, values: list[str], option: str | None = None) -> None:
        found: dict[str, Any] = {}
        for pair in values:
            try:
                original(self, parser, namespace, [pair], option)
            except Exception as error:
                hint = "must look like KEY:VALUE with a Python value, e.g. gamma:0.99 or ent_coef:\"'auto'\""
                raise argparse.ArgumentError(self, f"{hint}, got {pair!r} ({error}).") from error
            found |= getattr(namespace, self.dest)
        setattr(namespace, self.dest, found)

    call.__wrapped__ = original  # type: ignore[attr-defined]
    return call
