"""A scripted driver for MetaDrive: the human's stand-in. It knows the map, and where those whom it sees want to go."""

from collections import deque
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sb3_chac.common.checks import check_integer, check_range
from sb3_chac.envs.safedrive.geometry import boxes_overlap, half_extents, wrap_angle

if TYPE_CHECKING:
    from sb3_chac.envs.metadrive.env import MetaDriveSafetyEnv

SPACING = 0.5  # [m] between the points of a sampled path
RUN_OUT = 60.0  # [m] by which paths go straight on beyond their ends
SIGHT = 55.0  # [m]
EARLY, EARLY_COST = 45.0, 8.0  # [m] ahead of something in its lane, from which on it prefers the other ones, and how much
LANE_CHANGE_COST = 2.5  # per lane
INDIFFERENCE = 0.3  # differences in cost that do not matter: plans are mixed, so that similar situations get similar actions
LATERAL_ACCELERATION = 2.5  # [m/s2] in curves
GENTLE_SLOPE, STEEP_SLOPE, LATERAL_SPEED = 0.12, 0.28, 1.6  # [m per m], [m/s] of a lane change, steep if it has to be
ACCELERATIONS = np.array([-6.0, -4.0, -2.5, -1.2, 0.0, 1.2, 2.5])  # [m/s2]
TIMES = 0.3 * np.arange(1, 13)  # [s] of the prediction
FEARED = 0.125 * np.arange(1, 21)  # [s] of the prediction of what the novice does
WHEELBASE, REAR_AXLE = 2.47, 1.42  # [m] of the ego; how far its rear axle is behind its centre
STEP = 0.02  # [s] of the physics, in each of which the brake takes its share off the speed
MAX_BRAKING = 9.0  # [m/s2]
TRAFFIC_SPEED, TRAFFIC_ACCELERATION, TRAFFIC_BRAKING = 8.4, 1.5, 1.5  # [m/s], [m/s2] in what it may do
COUNTER_STEERING = 5.0  # [m/s2] with which a vehicle is straightened out
PATIENCE, BOXED_IN_FOR = 1.5, 8.0  # [s]
DAWDLING = 0.4  # of the speed that the road allows
USUAL_SPEED = 10.0  # [m/s] unless the preset allows less


class Path:
    """
    The middle of a chain of lanes, sampled; laterals are to the right of it.

    :param lanes: MetaDrive's
    """

    def __init__(self, lanes: list[Any]) -> None:
        points, starts = [], [0.0]
        for lane in lanes:
            n = max(1, int(np.ceil(lane.length / SPACING)))
            at = np.arange(n) * (lane.length / n)
            points += [(*lane.position(s, 0.0)[:2], lane.heading_theta_at(s), starts[-1] + s) for s in at]
            starts.append(starts[-1] + lane.length)
        x, y, heading, s = np.array(points).T
        heading = np.unwrap(heading)
        beyond = np.arange(0.0, RUN_OUT, SPACING)
        end, way = lanes[-1].position(lanes[-1].length, 0.0), heading[-1]
        self.starts = np.array(starts)  # [m] of the lanes, and the end of the last
        self.s = np.concatenate([s, self.starts[-1] + beyond])
        self.x = np.concatenate([x, end[0] + np.cos(way) * beyond])
        self.y = np.concatenate([y, end[1] + np.sin(way) * beyond])
        self.heading = np.concatenate([heading, np.full(len(beyond), way)])
        bend = np.gradient(self.heading, self.s)
        self.curvature = np.convolve(np.pad(bend, 4, "edge"), np.ones(9) / 9, "valid")  # [1/m], positive to the left

    def index(self, s: Any) -> Any:
        return np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 1)

    def poses(self, s: np.ndarray, lateral: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """
        :return: positions [m], shape (..., 2), and headings [rad]
        """
        i = self.index(s)
        along, heading = s - self.s[i], self.heading[i]
        cos, sin = np.cos(heading), np.sin(heading)
        x, y = self.x[i] + along * cos + lateral * sin, self.y[i] + along * sin - lateral * cos
        return np.stack([x, y], axis=-1), heading

    def locate(self, position: np.ndarray, low: float, high: float) -> tuple[float, float, int]:
        """
        :param low: [m] where along the path to look, up to ``high`` [m]
        :return: s [m] and lateral [m] of the nearest point, and its index
        """
        first, last = self.index(low), self.index(high) + 1
        dx, dy = position[0] - self.x[first:last], position[1] - self.y[first:last]
        i = int(np.argmin(dx**2 + dy**2))
        cos, sin = np.cos(self.heading[first + i]), np.sin(self.heading[first + i])
        return float(self.s[first + i] + dx[i] * cos + dy[i] * sin), float(dx[i] * sin - dy[i] * cos), first + i


class Route(Path):
    """
    Where MetaDrive's navigation leads the ego: along the leftmost lanes of the roads between its checkpoints.

    :param navigation: MetaDrive's
    """

    def __init__(self, navigation: Any) -> None:
        self.map, self.checkpoints = navigation.map, list(navigation.checkpoints)
        graph = self.map.road_network.graph
        roads = [graph[start][end] for start, end in zip(self.checkpoints[:-1], self.checkpoints[1:], strict=True)]
        super().__init__([road[0] for road in roads])
        self.lane_width = float(roads[0][0].width)
        lanes = np.ones(len(self.s))  # side by side, without those that begin later or have ended
        for road, start, end in zip(roads, self.starts[:-1], self.starts[1:], strict=True):
            for k, lane in enumerate(road[1:], start=1):
                begin, finish = 0.0, end - start  # circular lanes are there from end to end
                if not hasattr(lane, "angle"):
                    begin, left = road[0].local_coordinates(lane.start)
                    finish, right = road[0].local_coordinates(lane.end)
                    if max(abs(left - k * self.lane_width), abs(right - k * self.lane_width)) > 0.5:
                        continue  # it comes from elsewhere
                there = (self.s > start + begin - 0.1) & (self.s < min(start + finish, end))
                lanes[there & (lanes == k)] = k + 1
        lanes[self.s >= self.starts[-1]] = len(roads[-1])
        self.left, self.right = -self.lane_width / 2, (lanes - 0.5) * self.lane_width  # [m] its edges
        self.targets = self.lane_width * np.arange(min(len(road) for road in roads))  # [m] middles of the lanes all along it
        self.targets = np.clip(self.targets, self.left + 2.05, self.targets[-1] + self.lane_width / 2 - 2.05)

    def is_of(self, navigation: Any) -> bool:
        return self.map is navigation.map and self.checkpoints == navigation.checkpoints


class Others(NamedTuple):
    """Predicted boxes around the ego: n objects at m times."""

    positions: np.ndarray  # (n, m, 2)
    headings: np.ndarray  # (n, m)
    lengths: np.ndarray  # (n, 1)
    widths: np.ndarray  # (n, 1)
    moves: np.ndarray  # (n,) whether it drives
    ahead: np.ndarray  # (n,) [m] along the ego's route, inf for who goes another way
    laterals: np.ndarray  # (n,) [m] to the right of the route


class ScriptedDriver:
    """
    Samples plans (one of the lanes, one of seven accelerations), compares where each would lead within 3.6 s with where
    everybody within 55 m will be, and follows the best by pure pursuit (Coulter 1992). It keeps no plan from one step to the
    next, and plans about as good as the best are mixed: similar situations get similar actions, which is what makes it fit to
    be imitated. Call ``reset`` when an episode begins.

    :param env: the environment in which it drives
    :param reaction_delay: [steps of 0.1 s] it sees the others as they were that long ago
    :param action_noise: standard deviation of the noise on both actions (first-order autoregressive, 0.8 from step to step)
    :param desired_speed: [m/s], None for 0.9 of what the ego can do, but 10 at most
    :raises ValueError: for an argument out of its range
    """

    def __init__(
        self,
        env: "MetaDriveSafetyEnv",
        reaction_delay: int = 3,
        action_noise: float = 0.1,
        desired_speed: float | None = None,
    ) -> None:
        check_integer("reaction_delay", reaction_delay, low=0)
        check_range("action_noise", action_noise, low=0.0, high=1.0)
        if desired_speed is not None:
            check_range("desired_speed", desired_speed, low=0.0, exclusive_low=True)
        self.env, self.reaction_delay, self.action_noise, self.desired_speed = env, reaction_delay, action_noise, desired_speed
        self.rng = np.random.default_rng()
        self._route: Route | None = None
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """
        :param seed: of the noise, None to let it go on
        """
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.noise = np.zeros(2)
        self.seen: deque[Others] = deque(maxlen=self.reaction_delay + 1)
        self.boxed_in = 0.0  # [s] of standing
        self.dawdled = 0.0  # [s] in which the ego stood or crawled although the driver would have sped up
        self._paths: dict[Any, Path] = {}  # of the traffic

    def __call__(self, observation: np.ndarray | None = None) -> np.ndarray:
        """
        :param observation: not used, the driver looks at the environment itself
        :return: steering and throttle, shape (2,), in [-1, 1]
        """
        self._locate()
        self.seen.append(self._look(TIMES))
        target, slope, acceleration, cap = self._plan(self.seen[0])
        waited = 0.5 if self.env.last_info["contact"] else 0.1  # who touches already has little to wait for
        self.boxed_in = self.boxed_in + waited if self.speed < 0.3 else max(0.0, self.boxed_in - 0.05)
        if self.speed < DAWDLING * cap and acceleration > 0:
            self.dawdled = min(self.dawdled + 0.1, PATIENCE + 1.0)
        else:
            self.dawdled = max(self.dawdled - 0.1, 0.0)
        if acceleration > 0:
            acceleration = min(acceleration, 1.5 * (cap - self.speed))
        elif self.speed < 1.0:
            target = self.lateral  # who waits does not turn the wheel
        action = np.array([self._steering(target, slope), self._throttle(acceleration)])
        self.noise = 0.8 * self.noise + 0.6 * self.rng.normal(0.0, 1.0, 2)
        return np.clip(action + self.action_noise * self.noise, -1.0, 1.0).astype(np.float32)

    def time_to_trouble(self, observation: np.ndarray | None, action: np.ndarray) -> float:
        """
        What a human beside the novice fears: that the vehicle leaves the road, if the steering is held for 0.6 s and follows
        the road from then on; that it comes too close to something to brake in time, if the acceleration is held; that it
        stands or crawls although it could go.

        :param observation: not used
        :param action: steering and throttle, shape (2,), in [-1, 1]
        :return: [s] until it is too late, up to 2.5; inf if nothing threatens
        """
        if self.dawdled > PATIENCE:
            return 0.0
        self._locate()
        s, lateral, error, speed = self._roll_out(float(action[0]) * self.max_steering, self._acceleration(float(action[1]))).T
        right = self.route.right[self.route.index(s)]
        off_road = (lateral > right - 0.3) | (lateral < self.route.left + 0.3) | (np.abs(error) > 0.9)
        time = np.inf
        if off_road.any():  # too late once there is no time left to straighten out
            first = int(np.argmax(off_road))
            straighten = 0.2 + abs(error[first]) * speed[first] / COUNTER_STEERING
            time = max(0.0, FEARED[first] - straighten)
        others = self._look(FEARED)
        if len(others.ahead):
            positions, headings = self.route.poses(s, lateral)
            size = self.length + 0.6, self.width + 0.4
            hit = boxes_overlap(
                positions, headings + error, *size, others.positions, others.headings, others.lengths, others.widths
            ).any(axis=0)  # fmt: skip
            if hit.any():
                first = int(np.argmax(hit))
                time = min(time, max(0.0, FEARED[first] - speed[first] / (2 * MAX_BRAKING)))
        return float(time)

    # The ego

    def _locate(self) -> None:
        """Where the ego is on its route, and what it can do."""
        ego = self.env.ego
        navigation = ego.navigation
        if self._route is None or not self._route.is_of(navigation):
            self._route, self._paths = Route(navigation), {}
            self.seen.clear()
        self.route = self._route
        self.position, self.heading = self.env.position, float(ego.heading_theta)
        self.speed = max(self.env.forward_speed, 0.0)
        k = min(max(int(navigation._target_checkpoints_index[0]), 0), len(self.route.starts) - 2)
        low, high = self.route.starts[k] - 10.0, self.route.starts[k + 1] + 20.0
        self.s, self.lateral, self.index = self.route.locate(self.position, low, high)
        self.error = float(wrap_angle(self.heading - self.route.heading[self.index]))  # [rad], positive to the left
        self.length, self.width = float(ego.LENGTH), float(ego.WIDTH)
        self.max_steering = float(np.radians(ego.max_steering))
        self.engine = 4 * float(ego.config["max_engine_force"]) / ego.MASS  # [m/s2]
        self.brake = 4 * float(ego.config["max_brake_force"]) / ego.MASS / STEP  # [m/s2], as long as the tyres hold
        usual = min(0.9 * float(ego.max_speed_km_h) / 3.6, USUAL_SPEED)
        self.wanted_speed = usual if self.desired_speed is None else self.desired_speed

    def _throttle(self, acceleration: float) -> float:
        return acceleration / (self.engine if acceleration > 0 else self.brake)

    def _acceleration(self, throttle: float) -> float:
        return throttle * self.engine if throttle > 0 else max(throttle * self.brake, -MAX_BRAKING)

    def _roll_out(self, steering: float, acceleration: float) -> np.ndarray:
        """
        The ego along its route if ``steering`` [rad] is held for 0.6 s, and then what the road asks for.

        :param acceleration: [m/s2], held
        :return: s [m], lateral [m], heading error [rad] and speed [m/s] at the times ``FEARED``, shape (len(FEARED), 4)
        """
        s, lateral, error, speed, route = self.s, self.lateral, self.error, self.speed, self.route
        top = float(self.env.ego.max_speed_km_h) / 3.6
        states = []
        for time in FEARED:
            curvature = float(route.curvature[route.index(s)])
            yaw_rate = speed * np.tan(steering) / WHEELBASE
            if time > 0.6:
                yaw_rate = speed * np.clip(curvature - 0.2 * error, -0.3, 0.3)
            error += (yaw_rate - curvature * speed) * FEARED[0]
            lateral -= speed * np.sin(error) * FEARED[0]
            s += speed * np.cos(error) * FEARED[0]
            speed = min(max(speed + acceleration * FEARED[0], 0.0), top)
            states.append((s, lateral, error, speed))
        return np.array(states)

    def _speed_cap(self) -> float:
        """[m/s] with which the ego can take the curves ahead after comfortable braking, and less if it heads off the road"""
        ahead = np.arange(0.0, 40.0, 2 * SPACING)
        curvature = self.route.curvature[self.route.index(self.s + ahead)]
        curvature = np.abs(curvature / (1 + curvature * self.lateral).clip(0.3))
        squares = LATERAL_ACCELERATION / np.maximum(curvature, 1e-3) + 2 * 1.5 * np.maximum(ahead - 2.0, 0.0)
        return float(min(self.wanted_speed, np.sqrt(squares.min()))) / (1 + 8 * max(abs(self.error) - 0.3, 0.0))

    def _steering(self, target: float, slope: float) -> float:
        """Pure pursuit of a lateral target [m], approached with a slope; in [-1, 1]"""
        look = float(np.clip(0.3 * self.speed, 2.5, 8.0))
        slope += max(np.sign(target - self.lateral) * self.error, 0.0)  # all the more if it heads the other way
        lateral = self.lateral + float(np.clip(target - self.lateral, -slope * look, slope * look))
        point, _ = self.route.poses(np.array(self.s + look), lateral)
        d = point - self.position + REAR_AXLE * np.array([np.cos(self.heading), np.sin(self.heading)])
        sine = np.sin(np.arctan2(d[1], d[0]) - self.heading)
        return float(np.clip(np.arctan(2 * WHEELBASE * sine / max(np.hypot(*d), 1.0)) / self.max_steering, -1.0, 1.0))

    # The others

    def _look(self, times: np.ndarray) -> Others:
        """
        :param times: [s] from now, shape (m,)
        """
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
        :return: positions, headings and whether it drives, for each of the ways in which a vehicle may go on
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
        :param positions: shape (n, 2)
        :return: [m] how far ahead of the ego along its route, inf for who does not go along, and how far to the right of the
            route; shapes (n,)
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

    # The plan

    def _plan(self, others: Others) -> tuple[float, float, float, float]:
        """
        :return: lateral target [m], slope of the way there, acceleration [m/s2] and the speed [m/s] that the road allows
        """
        route, cap = self.route, self._speed_cap()
        targets = route.targets
        # Plans: s of shape (acceleration, time), lateral of (target, acceleration, time)
        speeds = np.clip(self.speed + ACCELERATIONS[:, None] * TIMES, 0.0, max(cap, self.speed))
        before = np.concatenate([np.full((len(ACCELERATIONS), 1), self.speed), speeds[:, :-1]], axis=1)
        way = np.cumsum((before + speeds) / 2, axis=1) * TIMES[0]
        gaps = np.array([others.ahead[np.abs(others.laterals - target) < 2.0].min(initial=EARLY) for target in targets])
        lane = int(np.argmin(np.abs(targets - self.lateral)))
        steepest = STEEP_SLOPE + 0.25 * max(0.0, 1.0 - self.speed / 4.0)  # who is slow can turn more sharply
        slope = float(np.clip(route.lane_width / max(gaps[lane] - 13.0, 1.0), GENTLE_SLOPE, steepest))
        to_go = targets - self.lateral
        moved = np.minimum(np.abs(to_go)[:, None, None], np.minimum(slope * way, LATERAL_SPEED * TIMES))
        lateral = self.lateral + np.sign(to_go)[:, None, None] * moved
        s = np.broadcast_to(self.s + way, lateral.shape)
        positions, headings = route.poses(s, lateral)
        changing = np.abs(lateral - targets[:, None, None]) > 0.05
        headings = headings - np.sign(to_go)[:, None, None] * changing * min(slope, LATERAL_SPEED / max(self.speed, 4.0))

        cost = -way[:, -1] + 0.15 * np.abs(ACCELERATIONS) + 4.0 * np.maximum(speeds[:, -1] - cap, 0.0)
        # Who has begun to change lanes goes on
        here = np.argmin(np.abs(targets - (self.lateral - 10.0 * np.sin(self.error))))
        cost = cost + LANE_CHANGE_COST * np.abs(np.arange(len(targets)) - here)[:, None]
        cost = cost + self._collision_cost(others, positions, headings, speeds)
        # See to it early to be in a free lane
        cost += EARLY_COST * np.maximum(1 - gaps / EARLY, 0.0)[:, None]
        weight = np.exp((cost.min() - cost) / INDIFFERENCE)
        weight /= weight.sum()
        return float((weight * targets[:, None]).sum()), slope, float((weight * ACCELERATIONS).sum()), cap

    def _collision_cost(self, others: Others, positions: np.ndarray, headings: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """
        :param positions: of the plans, shape (target, acceleration, time, 2)
        :param speeds: [m/s], shape (acceleration, time)
        :return: shape (target, acceleration)
        """
        if len(others.ahead) == 0:
            return np.zeros(positions.shape[:2])
        axes = (slice(None), None, None)  # objects first, then the plans, then time
        d = positions - others.positions[axes]
        cos, sin = np.cos(headings), np.sin(headings)
        along, across = d[..., 0] * cos + d[..., 1] * sin, d[..., 1] * cos - d[..., 0] * sin
        angle = others.headings[axes] - headings
        half_length, half_width = half_extents(others.lengths[axes], others.widths[axes], angle)
        gap_along = np.abs(along) - self.length / 2 - half_length
        gap_across = np.abs(across) - self.width / 2 - half_width
        moves = others.moves[:, None, None, None]
        hit = (gap_along < 0.8 + 0.15 * TIMES) & (gap_across < 0.4)
        behind = along > self.length / 2 + half_length
        stays = (np.abs(self.route.targets - self.lateral) < 2.0)[:, None, None]
        hit &= ~(behind & moves & (np.abs(angle) < 0.3) & stays)  # who follows keeps the distance
        hit &= ~self._beside(others)[:, None, None, None]  # every plan begins with that
        if self.boxed_in > BOXED_IN_FOR:  # nothing else helps: push through
            hit &= moves
        first = np.argmax(hit, axis=-1)
        impact = 45.0 + 9.0 * speeds[np.arange(len(speeds)), first]
        collision = np.where(hit.any(axis=-1), impact / (0.3 + TIMES[first]), 0.0).sum(axis=0)
        close = np.where((gap_along < 0.0) & (gap_across < 1.0), 1.0 - np.maximum(gap_across, 0.0), 0.0)
        collision += 8.0 * close.max(axis=-1).sum(axis=0)
        # Before something that stands in the way, keep the room to swing out
        room = np.where((gap_across < 0.3) & ~behind, np.maximum(7.0 - gap_along, 0.0), 0.0)
        return collision + 1.5 * (self.boxed_in < BOXED_IN_FOR) * room.max(axis=-1).sum(axis=0)

    def _beside(self, others: Others) -> np.ndarray:
        """
        :return: whether it stands and touches the ego, or nearly so, but not in front, or is being passed: the tail that plans
            swing out into it is only theirs. Shape (n,)
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
