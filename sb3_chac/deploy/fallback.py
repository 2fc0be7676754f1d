"""Steering while braking: along the route of the last observation, by dead reckoning."""

import math

import numpy as np

from sb3_chac.deploy.metadata import Metadata

SPACING = 1.0  # [m] between the points of the route
KNOTS = np.array([0.0, 8.0, 16.0, 26.0, 38.0, 50.0])  # [m] where an observation tells headings of the route
HEADING_SCALES = np.array([-0.15, *[0.6] * 5])  # [rad]
ROUTE = np.arange(0.0, KNOTS[-1] + SPACING / 2, SPACING)
HALF_WIDTH, TOP_SPEED = 4.0, 15.0  # [m], [m/s] in the units of the observation


class RouteFallback:
    """
    Pure pursuit of the route in SafeDrive-v0's observations, at the lateral offset that the vehicle has.

    Between observations the pose is integrated with a kinematic bicycle model and the actions that were executed.

    :param half_length: [m] half of the distance between the axles, as the bicycle model has it
    :param max_steering: [rad] of the front wheels at steering 1
    :param max_acceleration: [m/s2] at acceleration 1
    """

    def __init__(self, half_length: float = 2.5, max_steering: float = 0.6, max_acceleration: float = 4.0) -> None:
        self.half_length, self.max_steering, self.max_acceleration = half_length, max_steering, max_acceleration
        self.route: np.ndarray | None = None

    @classmethod
    def of(cls, metadata: Metadata) -> "RouteFallback | None":
        """Return one if the policy's observations begin as SafeDrive's do, else None."""
        names = [part["name"] for part in metadata.layout]
        is_ours = names[:4] == ["left_edge", "right_edge", "heading_error", "speed"] and "checkpoints" in names
        return cls() if is_ours and metadata.action_names == ["steering", "acceleration"] else None

    def observe(self, observation: np.ndarray) -> None:
        """
        Begin anew from an observation that passed its checks.

        :param observation: shape (19,) or longer
        """
        values = np.asarray(observation, float)
        tanhs = np.clip([values[2], *values[10:19:2]], -0.999999, 0.999999)
        headings = np.interp(ROUTE, KNOTS, np.arctanh(tanhs) * HEADING_SCALES)
        lateral = float(values[0]) * HALF_WIDTH
        steps = SPACING / 2 * np.stack([np.cos(headings), np.sin(headings)], axis=1)
        # Parallel to the middle, at the offset of the vehicle, which is at the origin: x ahead, y to the right
        self.route = np.concatenate([np.zeros((1, 2)), np.cumsum(steps[1:] + steps[:-1], axis=0)])
        if abs(lateral) > HALF_WIDTH / 2:  # not nearer to the edge than the middle of a lane
            shift = math.copysign(HALF_WIDTH / 2, lateral) - lateral
            self.route += shift * np.array([-math.sin(headings[0]), math.cos(headings[0])])
        self.x = self.y = self.heading = 0.0
        self.speed = (float(values[3]) + 1) / 2 * TOP_SPEED

    def advance(self, action: np.ndarray | tuple[float, ...], dt: float) -> None:
        """
        Move on by an action.

        :param action: steering and acceleration, as executed
        :param dt: [s] how long
        """
        if self.route is None or not dt > 0:
            return
        slip = math.atan(0.5 * math.tan(action[0] * self.max_steering))
        self.x += self.speed * math.cos(self.heading + slip) * dt
        self.y += self.speed * math.sin(self.heading + slip) * dt
        self.heading += self.speed * math.sin(slip) / self.half_length * dt
        self.speed = min(max(self.speed + action[1] * self.max_acceleration * dt, 0.0), TOP_SPEED)

    def __call__(self) -> tuple[float, float] | None:
        """
        Steer and brake.

        :return: action, None before the first observation
        """
        if self.route is None:
            return None
        ahead = max(4.0, 0.6 * self.speed)
        dx, dy = self.route[:, 0] - self.x, self.route[:, 1] - self.y
        distance = np.hypot(dx, dy)
        nearest = int(distance.argmin())
        beyond = np.flatnonzero(distance[nearest:] >= ahead)
        target = nearest + int(beyond[0]) if len(beyond) else len(self.route) - 1
        right = dy[target] * math.cos(self.heading) - dx[target] * math.sin(self.heading)
        curvature = 2 * right / max(distance[target], 1.0) ** 2
        slip = math.asin(min(max(curvature * self.half_length, -0.9), 0.9))
        steering = math.atan(2 * math.tan(slip)) / self.max_steering
        return min(max(steering, -1.0), 1.0), -1.0
