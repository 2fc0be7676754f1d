"""
Notices what moves the training environments besides the algorithm: an evaluation in them, in a callback or between two calls
of ``learn``. What the algorithm saw last is not where they are then.
"""

import functools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize

from sb3_chac.common.checks import check_finite


class CountedCalls:
    """
    A method of an environment, which counts its calls, whoever makes them. That of a copy counts for itself.

    :param method: bound
    """

    def __init__(self, method: Callable[..., Any]) -> None:
        functools.update_wrapper(self, method)
        self.method, self.calls = method, 0

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.calls += 1
        return self.method(*args, **kwargs)


def count_calls(env: VecEnv) -> list[CountedCalls]:
    """
    Count from now on what moves environments: those of this process themselves, as one may hold on to them, else their
    ``VecEnv``.

    :return: the counting methods
    """
    base: Any = env.unwrapped
    movers = [(one.unwrapped, ("step", "reset")) for one in getattr(base, "envs", []) if isinstance(one, gym.Env)]
    counting = []
    for owner, names in movers or [(base, ("step_async", "reset"))]:
        for name in names:
            own = vars(owner)  # not setattr(), which some environments hand on to what they wrap
            if not isinstance(own.get(name), CountedCalls):
                own[name] = CountedCalls(getattr(owner, name))
            counting.append(own[name])
    return counting


class OwnSteps(BaseCallback):
    """
    The first of the callbacks, which notes how the algorithm's own step has left its environments.

    :param env: the training environments
    """

    def __init__(self, env: VecEnv) -> None:
        super().__init__()
        self.env = env
        self.counting = count_calls(env)
        self.note()

    def note(self) -> None:
        """Note that the algorithm has seen where its environments are."""
        self.noted = [method.calls for method in self.counting]
        self.originals: list[tuple[VecNormalize, Any, Any]] = []
        env = self.env
        while isinstance(env, VecEnvWrapper):
            if isinstance(env, VecNormalize) and hasattr(env, "old_obs"):
                self.originals.append((env, env.old_obs, env.old_reward))
            env = env.venv

    def _on_step(self) -> bool:
        self.note()
        return True

    @property
    def others_moved(self) -> bool:
        """Tell whether somebody else has moved the environments since."""
        return self.noted != [method.calls for method in self.counting]

    def restore_originals(self) -> None:
        """Let each ``VecNormalize`` know again what it got in the algorithm's own step, which is yet to be stored."""
        for env, old_obs, old_reward in self.originals:
            env.old_obs, env.old_reward = old_obs, old_reward


class NoticesOthers(BaseAlgorithm):
    """Base of the algorithms that begin new episodes when somebody else has moved their training environments."""

    _own_steps: OwnSteps | None = None

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        assert self.env is not None
        self._own_steps = OwnSteps(self.env)
        callbacks = callback if isinstance(callback, list) else [callback]
        objects = [one if isinstance(one, BaseCallback) else ConvertCallback(one) for one in callbacks]
        return super()._init_callback([self._own_steps, *objects], progress_bar)

    @property
    def others_moved(self) -> bool:
        """Tell whether somebody else has moved the environments since the algorithm's last step or reset."""
        return self._own_steps is not None and self._own_steps.env is self.env and self._own_steps.others_moved

    def _forget_episodes(self) -> None:
        """Called when new episodes are about to begin, before those under way are over."""

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if self.others_moved:
            self._last_obs = None
        if reset_num_timesteps or self._last_obs is None:  # the environments are about to be reset
            self._forget_episodes()
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    def _begin_episodes(self) -> Any:
        """
        Begin new episodes in all environments.

        :return: their first observations
        """
        assert self.env is not None and self._own_steps is not None
        self._forget_episodes()
        observations = self.env.reset()
        check_finite("observation", observations, self.num_timesteps)  # type: ignore[arg-type]
        self._own_steps.note()
        return observations

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        """Called after the callbacks of each step, before it is stored."""
        if self.others_moved:
            self._own_steps.restore_originals()  # type: ignore[union-attr]
        super()._update_info_buffer(infos, dones)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_own_steps"]
