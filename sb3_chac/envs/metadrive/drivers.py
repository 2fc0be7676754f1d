"""Drivers of MetaDriveSafety-v0: the scripted driver, and MetaDrive's own two."""

from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_chac.envs.metadrive.driver import ScriptedDriver

if TYPE_CHECKING:
    from sb3_chac.envs.metadrive.env import MetaDriveSafetyEnv


class MetaDrivesDriver:
    """
    A driver that comes with MetaDrive. Trouble is predicted as by the scripted driver.

    :param env: the environment in which it drives
    """

    def __init__(self, env: "MetaDriveSafetyEnv") -> None:
        self.env = env
        self.watcher = ScriptedDriver(env, reaction_delay=0, action_noise=0.0)
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        self.policy: Any = None
        self.watcher.reset(seed)

    def __call__(self, observation: np.ndarray | None = None) -> np.ndarray:
        """
        Drive one step.

        :return: steering and throttle, shape (2,), in [-1, 1]
        """
        self.watcher(observation)  # it has to see whether the ego dawdles
        return np.clip(self.act(), -1.0, 1.0).astype(np.float32)

    def act(self) -> Any:
        """
        Ask MetaDrive's policy.

        :return: steering and throttle, of any range
        """
        raise NotImplementedError

    def time_to_trouble(self, observation: np.ndarray | None, action: np.ndarray) -> float:
        """See ``ScriptedDriver.time_to_trouble``."""
        return self.watcher.time_to_trouble(observation, action)


class IDMDriver(MetaDrivesDriver):
    """The intelligent driver model with lane changes by MOBIL, as MetaDrive's traffic has it."""

    def act(self) -> Any:
        if self.policy is None:
            from metadrive.policy.idm_policy import IDMPolicy

            self.policy = IDMPolicy(self.env.ego, self.env.scenario)
        return self.policy.act()


class PPODriver(MetaDrivesDriver):
    """A network trained with PPO, of which MetaDrive has the weights; it acts deterministically."""

    def act(self) -> Any:
        from metadrive.examples.ppo_expert.numpy_expert import expert

        return expert(self.env.ego, deterministic=True)


# Name -> environment -> driver
DRIVERS: dict[str, Any] = {
    "scripted": lambda env: ScriptedDriver(env, reaction_delay=3, action_noise=0.1),
    "scripted-ideal": lambda env: ScriptedDriver(env, reaction_delay=0, action_noise=0.0),
    "idm": IDMDriver,
    "ppo": PPODriver,
}
