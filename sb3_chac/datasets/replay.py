"""Replay of recorded episodes in their environment."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from sb3_chac.common.checks import is_finite
from sb3_chac.common.minari_datasets import DatasetError
from sb3_chac.evaluation.episodes import Runner, Task, check_names_no_code, registered_spec

if TYPE_CHECKING:
    from minari import MinariDataset


class Replay(Runner):
    """
    Replay of the actions of an episode. A context manager, which closes its environment.

    :param dataset: holds the episode
    :param number: of the episode
    :param render_mode: of the environment
    :raises DatasetError: if there is no such episode, or neither its environment nor its seed is known
    :raises NotEvaluable: if the environment cannot be made, see ``registered_spec``
    """

    def __init__(self, dataset: "MinariDataset", number: int, render_mode: str | None = None) -> None:
        if not 0 <= number < dataset.total_episodes:
            raise DatasetError(f"{dataset.id}: there is no episode {number}, they are 0 to {dataset.total_episodes - 1}.")
        spec = dataset.env_spec
        if spec is None:
            raise DatasetError(f"{dataset.id} does not say how its environment is made: it cannot be driven again.")
        (self.metadata,) = dataset.storage.get_episode_metadata([number])
        if self.metadata.get("seed") is None:
            raise DatasetError(f"{dataset.id} does not hold the seed of episode {number}: it cannot be driven again.")
        self.recorded = dataset[number]
        if not (is_finite(self.recorded.actions) and is_finite(self.recorded.rewards)):
            raise DatasetError(f"{dataset.id}: actions or rewards of episode {number} are NaN or infinite.")
        self.observations: list[np.ndarray] = []
        self.rewards: list[float] = []
        spec = registered_spec(spec, f"dataset {dataset.id}")
        check_names_no_code(self.metadata.get("options"), spec, f"dataset {dataset.id}")
        super().__init__(Task(lambda observation: None, spec, {}), render_mode)

    def __enter__(self) -> "Replay":
        return self

    def episode(self, number: int, on_step: Callable[[], None] = lambda: None) -> tuple[dict[str, Any], None]:
        """
        Repeat the recorded actions.

        :param number: of the episode
        :param on_step: called after the reset and after each step
        :return: number, return and steps; see ``report`` for how they differ from those recorded
        """
        observation, _ = self.env.reset(seed=self.metadata["seed"], options=self.metadata.get("options"))
        self.observations, self.rewards = [observation], []
        on_step()
        is_discrete = isinstance(self.env.action_space, spaces.Discrete)
        for action in self.recorded.actions:
            observation, reward, terminated, truncated, _ = self.env.step(int(action) if is_discrete else action)
            self.observations.append(observation)
            self.rewards.append(float(reward))
            on_step()
            if terminated or truncated:
                break
        return {"episode": number, "return": math.fsum(self.rewards), "steps": len(self.rewards)}, None

    def report(self) -> str:
        """Tell in words how the replay differs from the recording."""
        steps, recorded_steps = len(self.rewards), len(self.recorded.rewards)
        total, recorded_total = math.fsum(self.rewards), math.fsum(self.recorded.rewards)
        gaps = [  # as far as both go
            float(np.max(np.abs(np.asarray(now, float) - then), initial=0.0))
            for now, then in zip(self.observations, self.recorded.observations, strict=False)
        ]
        differing = np.flatnonzero(gaps)
        lines = [
            f"episode {self.recorded.id}: recorded {recorded_steps} steps, return {recorded_total:.6g}; "
            f"replayed {steps} steps, return {total:.6g}",
            f"  the returns differ by {abs(total - recorded_total):.3g}, the observations by {max(gaps):.3g} at most",
        ]
        if len(differing):
            lines.append(f"  the first difference is after step {differing[0]}")
        return "\n".join(lines)
