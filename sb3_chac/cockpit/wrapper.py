"""The environment as it is driven in the cockpit: in real time, recorded, with pictures."""

from typing import Any

import gymnasium as gym
import numpy as np

from sb3_chac.cockpit.recording import CrashSafeRecorder
from sb3_chac.cockpit.session import Session, lost_message
from sb3_chac.common.checks import happened_in, number_in
from sb3_chac.common.contract import TakeoverDisplay
from sb3_chac.human.intervention import ControlState, InterventionWrapper

STANDS = 0.3  # [m/s]
MAX_BRAKING = 8.0  # [s]
BRAKING = 2.0  # [s] where no speed is told


class Cockpit(gym.Wrapper):
    """
    The outermost wrapper of an environment in which a person drives: each step waits for its moment, and is recorded and
    shown. An episode that is skipped ends as truncated.

    If the device is lost in a takeover, the vehicle is braked to a stand and the drive pauses; the episode is over then. What
    the brake did is nobody's decision: it is returned as one step whose info holds ``unattended``, is not recorded and is not
    to be learned from. If it is lost while the novice drives, the drive pauses.

    :param env: with the person as expert and rule
    :param drive: of this environment
    :param recorder: gets the episodes
    """

    env: InterventionWrapper

    def __init__(self, env: InterventionWrapper, drive: Session, recorder: CrashSafeRecorder) -> None:
        super().__init__(env)
        self.drive, self.recorder = drive, recorder
        self.steps = 0  # of the episode
        self._touched = False  # whether the vehicle touched something in the last step
        if isinstance(self.unwrapped, TakeoverDisplay):
            self.unwrapped.panel = False  # each number is shown once, beside the picture
            drive.corridors = self.unwrapped.show_corridors
        self._rng = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is None:  # each episode has one of its own: it can be driven again
            seed = int(self._rng.integers(2**31))
        else:
            self._rng = np.random.default_rng(seed)
        self.drive.person.hand_back()
        observation, info = self.env.reset(seed=seed, options=options)
        self.recorder.begin(observation, seed, options)
        self.steps = 0
        self._touched = False
        self.drive.count(episode=self.drive.totals.episode + 1)
        self._show(info, takeover=False)
        return observation, info

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        drive, person = self.drive, self.drive.person
        while True:
            drive.wait_for_tick()
            if person.look().connected:
                break
            if self.env.state is ControlState.TAKEOVER:
                return self._brake_to_a_stand()
            drive.pause(lost_message(person.device.name))
        proposed = np.array(action)  # the environment may change what it is given
        observation, reward, terminated, truncated, info = self.env.step(action)
        skips, verdict = drive.take_skip()
        truncated = truncated or (skips and not terminated)
        self.steps += 1
        self.recorder.add(proposed, observation, float(reward), terminated, truncated, info, verdict)
        drive.count(
            cost=drive.totals.cost + (number_in(info, "cost", 0) or 0.0),
            collisions=drive.totals.collisions + self._has_collided(info),
        )
        self._show(
            info,
            takeover=info["takeover"],
            proposed=person.as_input(proposed),
            applied=person.as_input(info["applied_action"]),
        )
        return observation, reward, terminated, truncated, info

    def _brake_to_a_stand(self) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        drive, person = self.drive, self.drive.person
        self.recorder.end()
        message = lost_message(person.device.name)
        drive.message = "Braking. " + message
        vehicle, brake = self.env.env, person.brake.astype(self.action_space.dtype)
        seconds, terminated, truncated = 0.0, False, False
        while True:
            observation, _, terminated, truncated, info = vehicle.step(brake)
            seconds += drive.period
            self._show(info, takeover=False, brakes=True, applied=person.as_input(brake))
            stands = info["speed"] < STANDS if "speed" in info else seconds >= BRAKING
            if terminated or truncated or stands or seconds >= MAX_BRAKING:
                break
            drive.wait_for_tick()
        person.hand_back()
        drive.show(brakes=False)
        drive.take_skip()
        drive.pause("Braked. " + message)
        drive.wait_for_tick()  # the vehicle is to be seen where it stands
        return observation, 0.0, False, True, {**info, "unattended": True}

    def _has_collided(self, info: dict[str, Any]) -> bool:
        """
        Tell whether a collision has begun. Environments report one by ``collision``, or by ``crashed`` while it lasts.

        :param info: of a step
        """
        before, self._touched = self._touched, bool(happened_in(info, "crashed"))
        collision = happened_in(info, "collision")
        return self._touched and not before if collision is None else collision

    def _show(self, info: dict[str, Any], takeover: bool, **changes: Any) -> None:
        if isinstance(self.unwrapped, TakeoverDisplay):
            self.unwrapped.hud = {"takeover": takeover}  # the rest is told beside the picture
            self.unwrapped.show_corridors = self.drive.corridors
            changes["guidance"] = self.unwrapped.guidance
        picture = self.env.env.render()
        if isinstance(picture, list):
            picture = picture[-1]
        changes |= {"picture": np.asarray(picture), "number": self.drive.display.number + 1}
        self.drive.show(takeover=takeover, speed=info.get("speed"), route=info.get("route_completion"), **changes)
