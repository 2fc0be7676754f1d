"""The ego vehicle: highway-env's bicycle model, with a steering wheel that takes time and tyres that slip."""

import math

from highway_env.vehicle.kinematics import Vehicle

from sb3_chac.envs.safedrive.geometry import Pose

MAX_SPEED = 15.0  # [m/s]
MAX_STEERING = 0.6  # [rad] of the front wheels
MAX_ACCELERATION = 4.0  # [m/s2], braking alike
STEERING_RATE = 3.0  # [rad/s]
MAX_LATERAL_ACCELERATION = 7.0  # [m/s2]


class Ego(Vehicle):
    """
    Vehicle that the agent drives. It does not look for its lane on the map (the environment knows better), drives forward
    only, and goes on after a crash.

    :param pose: where it starts
    """

    MAX_SPEED = MAX_SPEED
    speed: float  # [m/s]

    def __init__(self, pose: Pose) -> None:
        super().__init__(None, pose[:2], pose.heading, speed=0.0)  # without a road
        self.steering = 0.0  # [rad] of the front wheels, as it is

    def control(self, steering: float, acceleration: float) -> None:
        """
        Set the controls.

        :param steering: in [-1, 1], positive to the right
        :param acceleration: in [-1, 1]
        """
        self.act({"steering": steering * MAX_STEERING, "acceleration": acceleration * MAX_ACCELERATION})

    def slip_at(self, steering: float, speed: float) -> float:
        """
        Compute the slip angle.

        :param steering: [rad]
        :param speed: [m/s]
        :return: [rad] between heading and velocity; it understeers where v^2 sin(slip) / (length / 2) would be above the limit
        """
        limit = math.asin(min(1.0, MAX_LATERAL_ACCELERATION * self.LENGTH / 2 / max(speed, 1.0) ** 2))
        return min(max(math.atan(0.5 * math.tan(steering)), -limit), limit)

    @property
    def slip(self) -> float:
        """[rad] angle between heading and motion."""
        return self.slip_at(self.steering, self.speed)

    @property
    def yaw_rate(self) -> float:
        """Yaw rate [rad/s], positive to the right."""
        return self.speed * math.sin(self.slip) / (self.LENGTH / 2)

    def step(self, dt: float) -> None:
        wanted = self.action["steering"]
        self.steering += min(max(wanted - self.steering, -STEERING_RATE * dt), STEERING_RATE * dt)
        self.action["steering"] = math.atan(2 * math.tan(self.slip))
        super().step(dt)
        self.action["steering"] = wanted

    def on_state_update(self) -> None:
        self.speed = min(max(self.speed, 0.0), MAX_SPEED)
