"""Base of both driving tasks."""

from abc import abstractmethod
from collections.abc import Hashable
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from sb3_chac.common.checks import check_integer
from sb3_chac.common.contract import TakeoverDisplay
from sb3_chac.envs.driving.display import STEPS_PER_SECOND, Display

CONTACT_MEMORY = 10  # steps without contact after which touching the same object is a new collision


class DrivingEnv(gym.Env, TakeoverDisplay):
    """
    Base class for driving tasks: choice of the scenario, counting of collisions, entries of ``info``, and pictures.

    A task calls ``_set_up`` in its constructor and ``_begin_episode`` in ``reset``, notes contacts with ``_touch`` after
    setting ``collisions`` to 0 in each step, and builds its ``info`` with ``_driving_info``.
    """

    # steers_left: whether the first action is positive to the left
    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array", "human"],
        "render_fps": STEPS_PER_SECOND,
        "steers_left": False,
    }
    # For the runtime on a vehicle (sb3_chac.deploy.metadata)
    brake_action: ClassVar[tuple[float | None, ...]] = (None, -1.0)  # keeps the steering
    coast_action: ClassVar[tuple[float | None, ...]] = (None, 0.0)

    _viewer: Display | None = None

    def _set_up(self, start_scenario: int, num_scenarios: int, render_mode: str | None) -> None:
        """
        Store what both tasks have in common; call it in the constructor.

        :param start_scenario: the first of the maps
        :param num_scenarios: number of maps
        :param render_mode: "rgb_array", "human" or None
        :raises ValueError: for another render mode
        """
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}.")
        self.start_scenario, self.num_scenarios = int(start_scenario), int(num_scenarios)
        self.render_mode = render_mode
        self.hud: dict[str, Any] = {}  # shown by wrappers beside the speed

    def _begin_episode(self, seed: int | None, options: dict[str, Any] | None) -> None:
        """
        Seed the random numbers, choose the scenario and clear the counts.

        :param seed: see ``gym.Env.reset``
        :param options: {"scenario": k} to drive map k
        :raises ValueError: if k is not a scenario
        """
        gym.Env.reset(self, seed=seed)
        if options and "scenario" in options:
            self._check_scenario("options['scenario']", options["scenario"])
            self.scenario = int(options["scenario"])
        else:
            self.scenario = self.start_scenario + int(self.np_random.integers(self.num_scenarios))
        self.steps, self.episode_cost, self.collisions = 0, 0, 0
        self._touched: dict[Hashable, int] = {}  # object -> step of the last contact

    def _check_scenario(self, name: str, value: Any) -> None:
        """
        Check the number of a scenario.

        :param name: of the argument
        :raises ValueError: if it is none
        """
        check_integer(name, value, low=-(2**62))

    def _touch(self, thing: Hashable) -> None:
        """
        Note that the ego touches something in this step, and count a collision if the contact has just begun.

        :param thing: what names it
        """
        begins = self.steps - self._touched.get(thing, -CONTACT_MEMORY) >= CONTACT_MEMORY
        self.collisions += begins
        self.episode_cost += begins
        self._touched[thing] = self.steps

    def _driving_info(
        self, *, contact: bool, out_of_road: bool, arrived: bool, route_completion: float, speed: float
    ) -> dict[str, Any]:
        """
        Build the entries of ``info`` that both tasks have.

        :param contact: whether the ego touches something
        :param out_of_road: whether it left the road
        :param arrived: whether it is at the destination
        :param route_completion: within [0, 1]
        :param speed: [m/s]
        """
        return {
            "cost": float(self.collisions),
            "collision": self.collisions > 0,
            "contact": contact,
            "out_of_road": out_of_road,
            "arrive_dest": arrived,
            "is_success": arrived,
            "route_completion": route_completion,
            "speed": speed,
            "episode_cost": float(self.episode_cost),
            "scenario": self.scenario,
        }

    @property
    @abstractmethod
    def position(self) -> np.ndarray:
        """[m] of the ego, shape (2,)."""

    # Pictures

    @abstractmethod
    def _make_viewer(self) -> Display:
        """Return what draws this environment."""

    def render(self) -> np.ndarray | None:
        """
        Draw the current state.

        :return: the picture, shape (600, 800, 3), uint8, with render_mode "rgb_array", else None
        :raises ResetNeeded: before the first reset
        :raises RuntimeError: if render_mode is "human" and there is no display
        """
        if self.render_mode is None:
            gym.logger.warn("render() does nothing without a render_mode, for example render_mode='rgb_array'.")
            return None
        if not hasattr(self, "steps"):
            raise gym.error.ResetNeeded("Call reset() before render().")
        if self._viewer is None:
            self._viewer = self._make_viewer()
        if self.render_mode == "rgb_array":
            return self._viewer.frame()
        self._viewer.show()
        return None

    def close(self) -> None:
        """Close the viewer."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
