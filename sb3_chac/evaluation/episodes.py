"""One evaluation episode at a time: what acts, in which environment, and the record of it."""

import copy
import io
import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import FloatSchedule, check_for_correct_spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_chac.envs  # noqa: F401  (registers our environments)
from sb3_chac.common.checks import happened_in, is_finite, number_or_nan, real_numbers
from sb3_chac.envs import REHEARSALS
from sb3_chac.envs.driving.corridors import corridors_remedy
from sb3_chac.human.experts import ModelExpert, make_expert

# Stored with a model, but of no use for acting (a schedule may not even load in another Python version)
NOT_FOR_ACTING = {
    "verbose": 0,
    "buffer_size": 1,
    "optimize_memory_usage": False,
    "learning_rate": 0.0,
    "lr_schedule": FloatSchedule(0.0),
    "clip_range": 0.0,
}


class NotEvaluable(ValueError):
    """Raised if policy, environment and scenarios cannot be evaluated together."""


class DrivenPath(NamedTuple):
    """
    Path of an episode: ``positions`` [m] of shape (steps + 1, 2), ``costly`` of shape (steps + 1,): cost arose there, and
    ``actions`` of shape (steps, *action_shape), in the units of the environment.
    """

    positions: np.ndarray
    costly: np.ndarray
    actions: np.ndarray


def make_env(env: str | EnvSpec | Callable[..., gym.Env], env_kwargs: dict[str, Any]) -> gym.Env:
    """
    Make an environment.

    :raises NotEvaluable: if there is no such environment, or it does not take ``env_kwargs``
    """
    try:
        return gym.make(env, **env_kwargs) if isinstance(env, str | EnvSpec) else env(**env_kwargs)
    except (gym.error.Error, ImportError) as error:
        raise NotEvaluable(f"env: {env!r} cannot be made: {error}") from error
    except (TypeError, ValueError) as error:
        raise NotEvaluable(f"env: {env!r} cannot be made with env_kwargs {env_kwargs}: {error}") from error


def registered_spec(spec: EnvSpec, source: str) -> EnvSpec:
    """
    A file says which environment it is about, not what is run: its entry point is the registered one, and nothing is imported.

    :param spec: as read from a file
    :param source: the file, for the message
    :return: the registered specification, with the file's keywords and time limit
    :raises NotEvaluable: if no such environment is registered, it stands in wrappers, or a keyword may name code
    """
    known = gym.registry.get(spec.id)
    if known is None:
        raise NotEvaluable(
            f"{source}: the environment {spec.id!r} is not registered, and files import nothing: import the package that "
            "registers it first."
        )
    if spec.id in REHEARSALS and "address" in spec.kwargs:
        raise NotEvaluable(f"{source}: {spec.id} at {spec.kwargs['address']} is a vehicle, which no file may drive.")
    if spec.additional_wrappers:
        names = ", ".join(wrapper.name for wrapper in spec.additional_wrappers)
        raise NotEvaluable(f"{source}: {spec.id} stands in wrappers ({names}), which are not imported from a file.")
    check_names_no_code({key: value for key, value in spec.kwargs.items() if value != known.kwargs.get(key)}, known, source)
    return replace(known, kwargs={**known.kwargs, **spec.kwargs}, max_episode_steps=spec.max_episode_steps)


# What an environment may import from: names joined by points or colons
PATH_OF_CODE = re.compile(r"[^\W\d]\w*(?:\s*[.:]+\s*[^\W\d]\w*)+")


def check_names_no_code(value: Any, known: EnvSpec, source: str) -> None:
    """
    Check that keywords from a file name no code of other packages.

    :param value: that a file gives to an environment: keywords, or options of a reset
    :param known: the registered specification; its own package may be named
    :param source: the file, for the message
    :raises NotEvaluable: if a text in it looks like a class or function of another package
    """
    parts = [*value, *value.values()] if isinstance(value, dict) else value if isinstance(value, list | tuple) else []
    for part in parts:
        check_names_no_code(part, known, source)
    entry = known.entry_point
    module = entry.partition(":")[0] if isinstance(entry, str) else getattr(entry, "__module__", "")
    own = module.partition(".")[0]
    found = PATH_OF_CODE.findall(value) if isinstance(value, str) else []
    strange = next((path for path in found if re.split(r"\W", path)[0] != own), None)
    if strange is not None:
        raise NotEvaluable(
            f"{source}: {known.id} is to get {strange!r}, which may be code that it imports. If you trust it, register the "
            "environment with this keyword yourself."
        )


def control_of(policy: Any) -> str | None:
    """
    Tell which of its policies a model with shared control acts with.

    :param policy: a model, or anything else that acts
    :return: "guided", "self" or "shared" (see ``CHACPolicy``), None without shared control
    """
    return getattr(getattr(policy, "policy", None), "control", None)


class SavedModel(NamedTuple):
    """A model on its way to another process. ``control`` is C-HAC's (``CHACPolicy``), which the archive does not hold."""

    algorithm: type[BaseAlgorithm]
    archive: bytes
    control: str | None = None

    def load(self, env: gym.Env) -> BaseAlgorithm:
        """
        Load the model on the CPU, fit for acting only.

        :param env: its spaces must be the model's; HER does not load without one
        """
        env_of_model = DummyVecEnv([lambda: env])
        model = self.algorithm.load(io.BytesIO(self.archive), env_of_model, device="cpu", custom_objects=NOT_FOR_ACTING)
        if self.control is not None:
            model.policy.control = self.control  # type: ignore[assignment]
        return model


class ModelDriver(ModelExpert):
    """
    A model that fits an environment, with what a display shows of it.

    :raises NotEvaluable: unless the spaces of the model and of the environment agree
    """

    def __init__(self, model: BaseAlgorithm, env: gym.Env, normalize: VecNormalize | None) -> None:
        try:
            wrapped = model._wrap_env(DummyVecEnv([lambda: env]), verbose=0, monitor_wrapper=False)  # transposes images
            check_for_correct_spaces(wrapped, model.observation_space, model.action_space)
        except ValueError as error:
            remedy = corridors_remedy(model.observation_space, env.observation_space)
            raise NotEvaluable(f"the model does not fit {env.unwrapped}: {error}.{remedy}") from None
        super().__init__(model, normalize)

    @property
    def hud(self) -> dict[str, Any]:
        """Stage, source of the last action and confidence, for a ``TakeoverDisplay``; empty without shared control."""
        policy: Any = self.model.policy  # type: ignore[attr-defined]
        control = getattr(policy, "control", None)
        if control is None:
            return {}
        choice, shown = policy.last_choice, dict[str, Any](stage=int(policy.stage))
        if policy.stage == 1:
            control = "guided"
        is_shared = control == "shared"
        if is_shared and choice is None:  # before the first step
            return shown
        self_drives = choice.self_drives.item() if is_shared else control == "self"
        shown["drives"] = "self-learning policy" if self_drives else "guided policy"
        if is_shared:
            shown["confidence"] = f"{choice.confidence.item():.2f}"
        return shown


class Task(NamedTuple):
    """Task of a process that runs episodes, see ``evaluate``."""

    policy: BaseAlgorithm | SavedModel | str | Callable[[Any], Any]
    env: str | EnvSpec | Callable[..., gym.Env]
    env_kwargs: dict[str, Any]
    normalize: VecNormalize | None = None
    seed: int = 0
    use_scenarios: bool = True
    record_paths: bool = False


class Runner:
    """
    Runner of the episodes of a task in this process. A context manager, which closes its environment.

    :param task: what to run
    :param render_mode: of the environment
    :raises NotEvaluable: if policy and environment do not fit
    """

    def __init__(self, task: Task, render_mode: str | None = None) -> None:
        self.task = task
        self.env = make_env(task.env, task.env_kwargs | ({"render_mode": render_mode} if render_mode else {}))
        try:
            self.driver = self._make_driver()
        except BaseException:
            self.env.close()
            raise

    def __enter__(self) -> "Runner":
        return self

    def __exit__(self, *_: object) -> None:
        self.env.close()

    def _make_driver(self) -> Callable[[Any], Any]:
        policy = self.task.policy
        if isinstance(policy, SavedModel):
            policy = policy.load(self.env)
        if isinstance(policy, BaseAlgorithm):
            return ModelDriver(policy, self.env, self.task.normalize)
        if not isinstance(policy, str):
            return policy
        try:
            return make_expert(policy, self.env)
        except (ValueError, KeyError) as error:
            raise NotEvaluable(f"expert {policy!r} is not available in {self.env.unwrapped}: {error}") from error

    def _act(self, observation: Any) -> Any:
        """
        Ask the driver for an action.

        :raises NotEvaluable: if an expert fails, or anybody returns what is no action
        """
        policy, space = self.task.policy, self.env.action_space
        name = f"expert {policy!r}" if isinstance(policy, str) else "policy"
        try:
            action = self.driver(observation)
        except Exception as error:
            if not isinstance(policy, str):
                raise
            raise NotEvaluable(f"{name} raised {type(error).__name__}: {error}") from error
        numbers = real_numbers(action)
        if isinstance(space, spaces.Box) and (numbers is None or numbers.shape != space.shape or not is_finite(numbers)):
            raise NotEvaluable(f"{name} must return finite numbers of shape {space.shape}, returned {action!r}.")
        if isinstance(space, spaces.Discrete) and (numbers is None or numbers.size != 1 or numbers.item() % 1):
            raise NotEvaluable(f"{name} must return a whole number, the space being {space}, returned {action!r}.")
        return action

    def seed(self, number: int) -> int:
        """Derive the seed of an episode from the task's seed and the number of the episode alone."""
        return int(np.random.SeedSequence([self.task.seed, number]).generate_state(1)[0])

    def reset(self, number: int) -> Any:
        """
        Begin an episode.

        :param number: scenario, or episode if the task has no scenarios
        :return: first observation
        """
        options = {"scenario": number} if self.task.use_scenarios else None
        observation, _ = self.env.reset(seed=self.seed(number), options=options)
        if hasattr(self.driver, "reset"):
            self.driver.reset(self.seed(number))
        return observation

    def episode(self, number: int, on_step: Callable[[], None] = lambda: None) -> tuple[dict[str, Any], DrivenPath | None]:
        """
        Run one episode.

        :param number: scenario, or episode if the task has no scenarios
        :param on_step: called after the reset and after each step
        :return: record and driven path, see ``Evaluation``
        :raises NotEvaluable: if the path is to be recorded, but the environment has no position; and for a reward, cost or
            route completion that is no finite number
        """
        observation = self.reset(number)
        info: dict[str, Any] = {}
        rewards, costs, positions, actions = [0.0], [0.0], [self._position()], []
        terminated = truncated = tells_cost = False
        on_step()
        while not (terminated or truncated):
            action = self._act(observation)
            actions.append(copy.deepcopy(action))  # the environment may change what it is given
            observation, reward, terminated, truncated, info = self.env.step(action)
            rewards.append(number_or_nan(reward))
            costs.append(0.0 if info.get("cost") is None else number_or_nan(info["cost"]))
            tells_cost |= info.get("cost") is not None
            positions.append(self._position())
            on_step()
        record = {
            "scenario" if self.task.use_scenarios else "episode": number,
            "seed": self.seed(number),
            "return": math.fsum(rewards),
            "steps": len(rewards) - 1,
            **({"cost": math.fsum(costs)} if tells_cost else {}),
            **({"success": success} if (success := happened_in(info, "is_success")) is not None else {}),
            **({} if info.get("route_completion") is None else {"route_completion": number_or_nan(info["route_completion"])}),
            "terminated": bool(terminated),
            "truncated": bool(truncated),
        }
        for key in ("return", "cost", "route_completion"):
            if not math.isfinite(record.get(key, 0.0)):
                raise NotEvaluable(
                    f"{key} of episode {number} of {self.env.unwrapped} is {record[key]}: mend the environment."
                )
        record |= {key: value for key, value in _scalars(info).items() if key not in {*record, "is_success"}}
        if not self.task.record_paths:
            return record, None
        return record, DrivenPath(np.array(positions), np.array(costs) > 0, np.array(actions))

    def _position(self) -> np.ndarray | None:
        if not self.task.record_paths:
            return None
        if not hasattr(self.env.unwrapped, "position"):
            raise NotEvaluable(f"env: {self.env.unwrapped} has no position, its paths cannot be recorded.")
        return np.array(self.env.unwrapped.position, dtype=float)


def _scalars(info: dict[str, Any]) -> dict[str, Any]:
    """
    Select the scalars of an info.

    :return: the numbers, truth values and texts in ``info``, as Python's own types, without NaN and infinity
    """
    values = {str(key): value.item() if isinstance(value, np.generic) else value for key, value in info.items()}
    return {
        key: value
        for key, value in values.items()
        if isinstance(value, int | str) or (isinstance(value, float) and math.isfinite(value))
    }
