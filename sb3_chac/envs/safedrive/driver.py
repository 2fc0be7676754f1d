"""Scripted driver for SafeDrive, which stands in for the human. It knows the map, and where the traffic that it sees goes."""

from typing import TYPE_CHECKING

import numpy as np

from sb3_chac.common.checks import check_range
from sb3_chac.envs.driving.geometry import SPACING, wrap_angle
from sb3_chac.envs.driving.planner import FEARED, HELD_FOR, SIGHT, Others, PlanningDriver
from sb3_chac.envs.safedrive.map import HALF_WIDTH, LANE_WIDTH, LANES
from sb3_chac.envs.safedrive.traffic import DRIVING
from sb3_chac.envs.safedrive.vehicle import MAX_ACCELERATION, MAX_SPEED, MAX_STEERING, STEERING_RATE

if TYPE_CHECKING:
    from sb3_chac.envs.safedrive.env import SafeDriveEnv

IMPERFECTIONS = {
    "scripted": dict(reaction_delay=3, action_noise=0.1),
    "scripted-ideal": dict(reaction_delay=0, action_noise=0.0),
}


class ScriptedDriver(PlanningDriver):
    """
    Scripted driver for SafeDrive-v0: a ``PlanningDriver`` with six accelerations and two lanes, whose eyes are the lidar.

    :param env: the environment in which it drives
    :param reaction_delay: see ``PlanningDriver``
    :param action_noise: see ``PlanningDriver``
    :param desired_speed: [m/s]
    :raises ValueError: for an argument out of its range
    """

    RIGHT = 1.0
    ACCELERATIONS = np.array([-4.0, -2.5, -1.2, 0.0, 1.2, 2.5])
    EARLY, PREVIEW, CAUTION = 40.0, 30.0, 4.0
    BRAKING, IMPACT = MAX_ACCELERATION, (60.0, 0.0)
    PATIENCE, FORGETTING = 3.0, np.inf
    targets, lane_width, max_steering = np.array(LANES), LANE_WIDTH, MAX_STEERING

    def __init__(
        self, env: "SafeDriveEnv", reaction_delay: int = 3, action_noise: float = 0.1, desired_speed: float = 10.0
    ) -> None:
        check_range("desired_speed", desired_speed, low=0.0, exclusive_low=True)
        self.env, self.wanted_speed = env, desired_speed
        super().__init__(reaction_delay, action_noise)

    def _locate(self) -> None:
        env, ego = self.env, self.env.ego
        self.s, self.lateral, self.error, self.speed = env.s, env.lateral, env.heading_error, ego.speed
        self.length, self.width = ego.LENGTH, ego.WIDTH

    def _poses(self, s: np.ndarray, lateral: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.env.traffic.poses(np.zeros(s.shape, dtype=int), s, lateral)

    def _curvature(self, s: np.ndarray) -> np.ndarray:
        route = self.env.map.route
        return route[np.minimum((s / SPACING).astype(int), len(route) - 1), 3]

    def _edges(self, s: np.ndarray) -> tuple[np.ndarray | float, np.ndarray | float]:
        return -HALF_WIDTH, HALF_WIDTH

    def _pedal(self, acceleration: float) -> float:
        return acceleration / MAX_ACCELERATION

    def _acceleration(self, pedal: float) -> float:
        return pedal * MAX_ACCELERATION

    def _roll_out(self, steering: float, acceleration: float) -> np.ndarray:
        env, ego, wanted = self.env, self.env.ego, steering
        s, lateral, error, speed, steering = env.s, env.lateral, env.heading_error, ego.speed, ego.steering
        states = []
        for i in range(1, len(FEARED) + 1):
            curvature = float(env.map.route[min(int(s / SPACING), len(env.map.route) - 1), 3])
            if i * FEARED[0] > HELD_FOR:
                wanted = np.arctan(2 * np.tan(np.arcsin(np.clip(ego.LENGTH / 2 * (curvature - 0.1 * error), -0.9, 0.9))))
            change = STEERING_RATE * FEARED[0]
            steering += min(max(wanted - steering, -change), change)
            slip = ego.slip_at(steering, speed)
            error += (speed * np.sin(slip) / (ego.LENGTH / 2) - curvature * speed) * FEARED[0]
            lateral += speed * np.sin(error + slip) * FEARED[0]
            s += speed * np.cos(error + slip) * FEARED[0]
            speed = min(max(speed + acceleration * FEARED[0], 0.0), MAX_SPEED)
            states.append((s, lateral, error, speed))
        return np.array(states)

    def _look(self, times: np.ndarray) -> Others:
        env, traffic = self.env, self.env.traffic
        near = env.seen
        n_cars = int((near < len(traffic.visible)).sum())
        cars = traffic.visible[near[:n_cars]]
        speed = np.where(traffic.state[cars] == DRIVING, traffic.speed[cars], 0.0)
        lateral = 0.4 * traffic.lateral[cars] + 0.6 * traffic.target[cars]
        ways = traffic.s[cars, None] + speed[:, None] * times
        positions, headings = traffic.poses(traffic.path[cars, None], ways, lateral[:, None])
        static = near[n_cars:]
        positions = np.concatenate([positions, np.repeat(env.box_positions[static, None], len(times), axis=1)])
        headings = np.concatenate([headings, np.repeat(env.box_headings[static, None], len(times), axis=1)])
        ahead, laterals = self._along_route(env.box_positions[near], env.box_headings[near])
        lengths, widths = env.box_lengths[near, None], env.box_widths[near, None]
        return Others(positions, headings, lengths, widths, np.arange(len(near)) < n_cars, ahead, laterals)

    def _along_route(self, positions: np.ndarray, headings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Place objects on the ego's route.

        :param positions: shape (n, 2)
        :param headings: shape (n,)
        :return: [m] how far ahead of the ego along its route, inf for those that do not go along, and how far to the right of
            the route; shapes (n,)
        """
        first = max(int(self.env.s / SPACING), 0)
        route = self.env.map.route[first : first + int(SIGHT / SPACING) : 2]
        d = positions[:, None] - route[:, :2]
        nearest = np.argmin(d[..., 0] ** 2 + d[..., 1] ** 2, axis=1)
        point, d = route[nearest], d[np.arange(len(positions)), nearest]
        lateral = d[:, 1] * np.cos(point[:, 2]) - d[:, 0] * np.sin(point[:, 2])
        along = (np.abs(wrap_angle(headings - point[:, 2])) < 0.6) & (np.abs(lateral) < HALF_WIDTH)
        return np.where(along & (nearest > 0), nearest * 2 * SPACING, np.inf), lateral

    def _steering(self, target: float, slope: float) -> float:
        env, ego = self.env, self.env.ego
        look = float(np.clip(0.9 * ego.speed, 5.0, 10.0))
        lateral = env.lateral + float(np.clip(target - env.lateral, -slope * look, slope * look))
        point, _ = env.traffic.poses(np.array(0), np.array(env.s + look), np.array(lateral))
        d = point - ego.position
        sine = np.sin(np.arctan2(d[1], d[0]) - ego.heading)
        slip = np.arcsin(np.clip(ego.LENGTH * sine / max(np.hypot(*d), 1.0), -0.9, 0.9))
        return float(np.clip(np.arctan(2 * np.tan(slip)) / MAX_STEERING, -1.0, 1.0))
