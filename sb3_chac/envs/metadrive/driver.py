"""Scripted driver for MetaDrive, which stands in for the human. It knows the map and the destinations of the traffic."""

from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_chac.common.checks import check_range
from sb3_chac.envs.driving.geometry import SPACING, half_extents, wrap_angle
from sb3_chac.envs.driving.planner import FEARED, HELD_FOR, SIGHT, Others, PlanningDriver
from sb3_chac.envs.metadrive.route import Path, Route

if TYPE_CHECKING:
    from sb3_chac.envs.metadrive.env import MetaDriveSafetyEnv

WHEELBASE, REAR_AXLE = 2.47, 1.42  # [m] of the ego; how far its rear axle is behind its centre
STEP = 0.02  # [s] of the physics, in each of which the brake takes its share off the speed
TRAFFIC_SPEED, TRAFFIC_ACCELERATION, TRAFFIC_BRAKING = 8.4, 1.5, 1.5  # [m/s], [m/s2] in what it may do
USUAL_SPEED = 10.0  # [m/s] unless the preset allows less


class ScriptedDriver(PlanningDriver):
    """
    Scripted driver for MetaDriveSafety-v0: a ``PlanningDriver`` with seven accelerations and the lanes of the road, which sees
    everybody within 55 m.

    :param env: the environment in which it drives
    :param reaction_delay: see ``PlanningDriver``
    :param action_noise: see ``PlanningDriver``
    :param desired_speed: [m/s], None for 0.9 of what the ego can do, but 10 at most
    :raises ValueError: for an argument out of its range
    """

    RIGHT = -1.0
    ACCELERATIONS = np.array([-6.0, -4.0, -2.5, -1.2, 0.0, 1.2, 2.5])
    EARLY, PREVIEW, CAUTION = 45.0, 40.0, 8.0
    BRAKING, IMPACT = 9.0, (45.0, 9.0)
    PATIENCE, FORGETTING = 1.5, 0.1

    def __init__(
        self,
        env: "MetaDriveSafetyEnv",
        reaction_delay: int = 3,
        action_noise: float = 0.1,
        desired_speed: float | None = None,
    ) -> None:
        if desired_speed is not None:
            check_range("desired_speed", desired_speed, low=0.0, exclusive_low=True)
        self.env, self.desired_speed = env, desired_speed
        self._route: Route | None = None
        super().__init__(reaction_delay, action_noise)

    def reset(self, seed: int | None = None) -> None:
        super().reset(seed)
        self._paths: dict[Any, Path] = {}  # of the traffic

    # The ego

    def _locate(self) -> None:
        ego = self.env.ego
        navigation = ego.navigation
        if self._route is None or not self._route.is_of(navigation):
            self._route, self._paths = Route(navigation), {}
            self.seen.clear()
        self.route = self._route
        self.targets, self.lane_width = self.route.targets, self.route.lane_width
        self.position, self.heading = self.env.position, float(ego.heading_theta)
        self.speed = max(self.env.forward_speed, 0.0)
        self.s, self.lateral, self.index = self.route.locate(self.position, *self.route.now(navigation))
        self.error = float(wrap_angle(self.heading - self.route.heading[self.index]))  # [rad], positive to the left
        self.length, self.width = float(ego.LENGTH), float(ego.WIDTH)
        self.max_steering = float(np.radians(ego.max_steering))
        self.engine = 4 * float(ego.config["max_engine_force"]) / ego.MASS  # [m/s2]
        self.brake = 4 * float(ego.config["max_brake_force"]) / ego.MASS / STEP  # [m/s2], as long as the tyres hold
        usual = min(0.9 * float(ego.max_speed_km_h) / 3.6, USUAL_SPEED)
        self.wanted_speed = usual if self.desired_speed is None else self.desired_speed

    def _pedal(self, acceleration: float) -> float:
        return acceleration / (self.engine if acceleration > 0 else self.brake)

    def _acceleration(self, pedal: float) -> float:
        return pedal * self.engine if pedal > 0 else max(pedal * self.brake, -self.BRAKING)

    def _poses(self, s: np.ndarray, lateral: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.route.poses(s, lateral)

    def _curvature(self, s: np.ndarray) -> np.ndarray:
        curvature = self.route.curvature[self.route.index(s)]
        return curvature / (1 + curvature * self.lateral).clip(0.3)

    def _edges(self, s: np.ndarray) -> tuple[np.ndarray | float, np.ndarray | float]:
        return self.route.left, self.route.right[self.route.index(s)]

    def _impatience(self) -> float:
        return 0.5 if self.env.last_info["contact"] else 0.1  # in contact there is little to wait for

    def _roll_out(self, steering: float, acceleration: float) -> np.ndarray:
        s, lateral, error, speed, route = self.s, self.lateral, self.error, self.speed, self.route
        top = float(self.env.ego.max_speed_km_h) / 3.6
        states = []
        for time in FEARED:
            curvature = float(route.curvature[route.index(s)])
            yaw_rate = speed * np.tan(steering) / WHEELBASE
            if time > HELD_FOR:
                yaw_rate = speed * np.clip(curvature - 0.2 * error, -0.3, 0.3)
            error += (yaw_rate - curvature * speed) * FEARED[0]
            lateral -= speed * np.sin(error) * FEARED[0]
            s += speed * np.cos(error) * FEARED[0]
            speed = min(max(speed + acceleration * FEARED[0], 0.0), top)
            states.append((s, lateral, error, speed))
        return np.array(states)

    def _steering(self, target: float, slope: float) -> float:
        look = float(np.clip(0.3 * self.speed, 2.5, 8.0))
        slope += max(np.sign(target - self.lateral) * self.error, 0.0)  # all the more if it heads the other way
        lateral = self.lateral + float(np.clip(target - self.lateral, -slope * look, slope * look))
        point, _ = self.route.poses(np.array(self.s + look), lateral)
        d = point - self.position + REAR_AXLE * np.array([np.cos(self.heading), np.sin(self.heading)])
        sine = np.sin(np.arctan2(d[1], d[0]) - self.heading)
        return float(np.clip(np.arctan(2 * WHEELBASE * sine / max(np.hypot(*d), 1.0)) / self.max_steering, -1.0, 1.0))

    # The others

    def _look(self, times: np.ndarray) -> Others:
        from metadrive.component.static_object.traffic_object import TrafficObject
        from metadrive.component.vehicle.base_vehicle import BaseVehicle

        rows: list[tuple] = []
        for thing in self.env.simulator.engine.get_objects().values():
            if thing is self.env.ego or not isinstance(thing, BaseVehicle | TrafficObject):
                continue
            position = np.array(thing.position, dtype=float)[:2]
            if max(abs(position - self.position)) > SIGHT:
                continue
            heading = float(thing.heading_theta)
            if isinstance(thing, BaseVehicle):
                for positions, headings, moves in self._futures(thing, position, heading, times):
                    rows.append((positions, headings, thing.LENGTH, thing.WIDTH, moves, position, heading))
            else:
                # A barrier lies across its lane
                size = (2 * thing.RADIUS,) * 2 if hasattr(thing, "RADIUS") else (thing.WIDTH, thing.LENGTH)
                positions, headings = np.tile(position, (len(times), 1)), np.full(len(times), heading)
                rows.append((positions, headings, *size, False, position, heading))
        if not rows:
            none = np.zeros(0)
            return Others(np.zeros((0, len(times), 2)), np.zeros((0, len(times))), *(none[:, None],) * 2, none > 0, none, none)
        positions, headings, lengths, widths, moves, here, now = map(np.array, zip(*rows, strict=True))
        return Others(positions, headings, lengths[:, None], widths[:, None], moves, *self._along_route(here, now))

    def _futures(self, car: Any, position: np.ndarray, heading: float, times: np.ndarray) -> list[tuple]:
        """
        Predict a vehicle of the traffic, which may speed up or brake.

        :param position: [m], shape (2,)
        :param heading: [rad]
        :param times: [s] from now, shape (m,)
        :return: positions, headings and whether it drives, for each of the ways in which it may go on
        """
        speed = float(car.speed)
        if speed < 0.3 and car.throttle_brake < 0.05:
            return [(np.tile(position, (len(times), 1)), np.full(len(times), heading), False)]
        path, start = self._path(car, position)
        s, lateral, index = path.locate(position, start - 15.0, start + 15.0)
        error = wrap_angle(heading - path.heading[index])
        futures = []
        for acceleration, top in ((TRAFFIC_ACCELERATION, max(TRAFFIC_SPEED, speed)), (-TRAFFIC_BRAKING, speed)):
            speeds = np.clip(speed + acceleration * times, 0.4 * speed, top)
            way = np.cumsum(np.diff(times, prepend=0.0) * (np.concatenate([[speed], speeds[:-1]]) + speeds) / 2)
            positions, headings = path.poses(s + way, lateral * np.exp(-way / 10.0))
            futures.append((positions, headings + error * np.exp(-way / 4.0), True))
        return futures

    def _path(self, car: Any, position: np.ndarray) -> tuple[Path, float]:
        """
        Find the way of a vehicle.

        :return: the path that the car takes from the lane that it is in or moves to, and where on it the car is about [m]
        """
        policy = self.env.simulator.engine.get_policy(car.name)
        lane = getattr(policy, "routing_target_lane", None) or car.lane
        checkpoints = car.navigation.checkpoints if car.navigation else []
        key = (lane.index, tuple(checkpoints))
        if key not in self._paths:
            self._paths[key] = Path(self._lanes_from(lane, checkpoints))
        return self._paths[key], float(lane.local_coordinates(position)[0])

    def _lanes_from(self, lane: Any, checkpoints: list) -> list[Any]:
        """Chain the lanes from one to the last checkpoint, each time the one that begins nearest."""
        graph = self.route.map.road_network.graph
        lanes = [lane]
        if lane.index[1] in checkpoints[:-1]:
            first = checkpoints.index(lane.index[1])
            for start, end in zip(checkpoints[first:-1], checkpoints[first + 1 :], strict=True):
                end_point = np.array(lanes[-1].end)
                lanes.append(min(graph[start][end], key=lambda lane: float(np.hypot(*(np.array(lane.start) - end_point)))))
        return lanes

    def _along_route(self, positions: np.ndarray, headings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Place objects on the ego's route.

        :param positions: shape (n, 2)
        :param headings: shape (n,)
        :return: [m] how far ahead of the ego along its route, inf for those that do not go along, and how far to the right of
            the route; shapes (n,)
        """
        route = self.route
        window = slice(self.index, self.index + int(SIGHT / SPACING), 2)
        x, y, way = route.x[window], route.y[window], route.heading[window]
        dx, dy = positions[:, :1] - x, positions[:, 1:] - y
        nearest = np.argmin(dx**2 + dy**2, axis=1)
        n, heading = np.arange(len(positions)), way[nearest]
        lateral = dx[n, nearest] * np.sin(heading) - dy[n, nearest] * np.cos(heading)
        right = route.right[window][nearest]
        along = (np.abs(wrap_angle(headings - heading)) < 0.6) & (lateral > route.left) & (lateral < right)
        return np.where(along & (nearest > 0), nearest * 2 * SPACING, np.inf), lateral

    def _is_left_out(self, others: Others) -> np.ndarray:
        return self._beside(others)  # every plan begins with them

    def _beside(self, others: Others) -> np.ndarray:
        """
        Tell which of the others stand and touch the ego, or nearly so, but not in front, or are being passed.

        Only in the plans does the tail swing out into them.

        :return: shape (n,)
        """
        d, angle = others.positions[:, 0] - self.position, others.headings[:, 0] - self.heading
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        along, across = d[:, 0] * cos + d[:, 1] * sin, d[:, 1] * cos - d[:, 0] * sin
        half_length, half_width = half_extents(others.lengths[:, 0], others.widths[:, 0], angle)
        gap_along = np.abs(along) - self.length / 2 - half_length
        gap_across = np.abs(across) - self.width / 2 - half_width
        in_front = (along > 0.0) & (gap_across < 0.0)
        reach = np.where(along > 0.0, 0.4, 1.0)
        return ~others.moves & (gap_along < 0.8) & (gap_across < reach) & ~in_front
