"""A scripted driver for SafeDrive: the human's stand-in. It knows the map, and where those whom it sees want to go."""

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sb3_chac.common.checks import check_integer, check_range
from sb3_chac.envs.safedrive.geometry import SPACING, boxes_overlap, half_extents, wrap_angle
from sb3_chac.envs.safedrive.map import HALF_WIDTH, LANE_WIDTH, LANES
from sb3_chac.envs.safedrive.traffic import DRIVING
from sb3_chac.envs.safedrive.vehicle import MAX_ACCELERATION, MAX_SPEED, MAX_STEERING, STEERING_RATE

if TYPE_CHECKING:
    from sb3_chac.envs.safedrive.env import SafeDriveEnv

SIGHT = 55.0  # [m]
EARLY, EARLY_COST = 40.0, 8.0  # [m] ahead of something in its lane, from which on it prefers the other one, and how much
LANE_CHANGE_COST = 2.5
INDIFFERENCE = 0.3  # differences in cost that do not matter: plans are mixed, so that similar situations get similar actions
LATERAL_ACCELERATION = 2.5  # [m/s2] in curves
GENTLE_SLOPE, STEEP_SLOPE, LATERAL_SPEED = 0.12, 0.28, 1.6  # [m per m], [m/s] of a lane change, steep if it has to be
TARGETS = np.array(LANES)  # [m] the driver keeps to one lane or the other
ACCELERATIONS = np.array([-4.0, -2.5, -1.2, 0.0, 1.2, 2.5])  # [m/s2]
TIMES = 0.3 * np.arange(1, 13)  # [s] of the prediction
FEARED = 0.125 * np.arange(1, 21)  # [s] of the prediction of what the novice does
COUNTER_STEERING = 5.0  # [m/s2] with which a vehicle is straightened out
PATIENCE, BOXED_IN_FOR = 3.0, 8.0  # [s]
DAWDLING = 0.4  # of the speed that the road allows
IMPERFECTIONS = {
    "scripted": dict(reaction_delay=3, action_noise=0.1),
    "scripted-careful": dict(reaction_delay=3, action_noise=0.1, desired_speed=8.0),
    "scripted-ideal": dict(reaction_delay=0, action_noise=0.0),
}


class Others(NamedTuple):
    """Predicted boxes around the ego: n objects at m times."""

    positions: np.ndarray  # (n, m, 2)
    headings: np.ndarray  # (n, m)
    lengths: np.ndarray  # (n, 1)
    widths: np.ndarray  # (n, 1)
    moves: np.ndarray  # (n,) whether it is a vehicle of the traffic
    ahead: np.ndarray  # (n,) [m] along the ego's route, inf for who goes another way
    laterals: np.ndarray  # (n,) [m] to the right of the route


class ScriptedDriver:
    """
    Samples plans (one of two lanes, one of six accelerations), compares where each would lead within 3.6 s with where
    everybody whom the lidar sees will be if they go on as they do, and follows the best by pure pursuit (Coulter 1992). It
    keeps no plan from one step to the next, and plans about as good as the best are mixed: similar situations get similar
    actions, which is what makes it fit to be imitated. Call ``reset`` when an episode begins.

    :param env: the environment in which it drives
    :param reaction_delay: [steps of 0.1 s] it sees the others as they were that long ago
    :param action_noise: standard deviation of the noise on both actions (first-order autoregressive, 0.8 from step to step)
    :param desired_speed: [m/s]
    :raises ValueError: for an argument out of its range
    """

    def __init__(
        self, env: "SafeDriveEnv", reaction_delay: int = 3, action_noise: float = 0.1, desired_speed: float = 10.0
    ) -> None:
        check_integer("reaction_delay", reaction_delay, low=0)
        check_range("action_noise", action_noise, low=0.0, high=1.0)
        check_range("desired_speed", desired_speed, low=0.0, exclusive_low=True)
        self.env, self.reaction_delay, self.action_noise, self.desired_speed = env, reaction_delay, action_noise, desired_speed
        self.rng = np.random.default_rng()
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
        self.dawdled = 0.0  # [s] in which the ego stands or crawls although the driver would speed up

    def __call__(self, observation: np.ndarray | None = None) -> np.ndarray:
        """
        :param observation: not used, the driver looks at the environment itself
        :return: steering and acceleration, shape (2,), in [-1, 1]
        """
        self.seen.append(self._look(TIMES))
        target, slope, acceleration, cap = self._plan(self.seen[0])
        ego = self.env.ego
        self.boxed_in = self.boxed_in + 0.1 if ego.speed < 0.3 else max(0.0, self.boxed_in - 0.05)
        self.dawdled = self.dawdled + 0.1 if ego.speed < DAWDLING * cap and acceleration > 0 else 0.0
        if acceleration > 0:
            acceleration = min(acceleration, 1.5 * (cap - ego.speed))
        elif ego.speed < 1.0:
            target = self.env.lateral  # who waits does not turn the wheel
        action = np.array([self._steering(target, slope), acceleration / MAX_ACCELERATION])
        self.noise = 0.8 * self.noise + 0.6 * self.rng.normal(0.0, 1.0, 2)
        return np.clip(action + self.action_noise * self.noise, -1.0, 1.0).astype(np.float32)

    def time_to_trouble(self, observation: np.ndarray | None, action: np.ndarray) -> float:
        """
        What a human beside the novice fears: that the vehicle leaves the road, if the steering is held for 0.6 s and follows
        the road from then on; that it comes too close to something to brake in time, if the acceleration is held; that it
        stands or crawls although it could go.

        :param observation: not used
        :param action: steering and acceleration, shape (2,), in [-1, 1]
        :return: [s] until it is too late, up to 2.5; inf if nothing threatens
        """
        if self.dawdled > PATIENCE:
            return 0.0
        env, ego = self.env, self.env.ego
        states = self._roll_out(float(action[0]) * MAX_STEERING, float(action[1]) * MAX_ACCELERATION)
        s, lateral, error, speed = states.T
        off_road = (np.abs(lateral) > HALF_WIDTH - 0.3) | (np.abs(error) > 0.9)
        time = np.inf
        if off_road.any():  # too late once there is no time left to straighten out
            first = int(np.argmax(off_road))
            straighten = 0.2 + abs(error[first]) * speed[first] / COUNTER_STEERING
            time = max(0.0, FEARED[first] - straighten)
        others = self._look(FEARED)
        if len(others.ahead):
            positions, headings = env.traffic.poses(np.zeros(len(s), dtype=int), s, lateral)
            size = ego.LENGTH + 0.6, ego.WIDTH + 0.4
            hit = boxes_overlap(
                positions, headings + error, *size, others.positions, others.headings, others.lengths, others.widths
            ).any(axis=0)  # fmt: skip
            if hit.any():
                first = int(np.argmax(hit))
                time = min(time, max(0.0, FEARED[first] - speed[first] / (2 * MAX_ACCELERATION)))
        return float(time)

    def _roll_out(self, wanted: float, acceleration: float) -> np.ndarray:
        """
        The ego along its route if ``wanted`` [rad] is steered for 0.6 s, and then what the road asks for.

        :param acceleration: [m/s2], held
        :return: s [m], lateral [m], heading error [rad] and speed [m/s] at the times ``FEARED``, shape (len(FEARED), 4)
        """
        env, ego = self.env, self.env.ego
        s, lateral, error, speed, steering = env.s, env.lateral, env.heading_error, ego.speed, ego.steering
        states = []
        for i in range(1, len(FEARED) + 1):
            curvature = float(env.map.route[min(int(s / SPACING), len(env.map.route) - 1), 3])
            if i * FEARED[0] > 0.6:
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
        """
        :param times: [s] from now, shape (m,)
        """
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
        :param positions: shape (n, 2)
        :return: [m] how far ahead of the ego along its route, inf for who does not go along, and how far to the right of the
            route; shapes (n,)
        """
        first = max(int(self.env.s / SPACING), 0)
        route = self.env.map.route[first : first + int(SIGHT / SPACING) : 2]
        d = positions[:, None] - route[:, :2]
        nearest = np.argmin(d[..., 0] ** 2 + d[..., 1] ** 2, axis=1)
        point, d = route[nearest], d[np.arange(len(positions)), nearest]
        lateral = d[:, 1] * np.cos(point[:, 2]) - d[:, 0] * np.sin(point[:, 2])
        along = (np.abs(wrap_angle(headings - point[:, 2])) < 0.6) & (np.abs(lateral) < HALF_WIDTH)
        return np.where(along & (nearest > 0), nearest * 2 * SPACING, np.inf), lateral

    def _speed_cap(self) -> float:
        """[m/s] with which the ego can take the curves ahead after comfortable braking, and less if it heads off the road"""
        env = self.env
        ahead = np.arange(0.0, 30.0, 2 * SPACING)
        curvature = np.abs(env.map.route[np.minimum(((env.s + ahead) / SPACING).astype(int), len(env.map.route) - 1), 3])
        squares = LATERAL_ACCELERATION / np.maximum(curvature, 1e-3) + 2 * 1.5 * np.maximum(ahead - 2.0, 0.0)
        return float(min(self.desired_speed, np.sqrt(squares.min()))) / (1 + 4 * max(abs(env.heading_error) - 0.3, 0.0))

    def _plan(self, others: Others) -> tuple[float, float, float, float]:
        """
        :return: lateral target [m], slope of the way there, acceleration [m/s2] and the speed [m/s] that the road allows
        """
        env, ego = self.env, self.env.ego
        cap = self._speed_cap()
        # Plans: s of shape (acceleration, time), lateral of (target, acceleration, time)
        speeds = np.clip(ego.speed + ACCELERATIONS[:, None] * TIMES, 0.0, max(cap, ego.speed))
        before = np.concatenate([np.full((len(ACCELERATIONS), 1), ego.speed), speeds[:, :-1]], axis=1)
        way = np.cumsum((before + speeds) / 2, axis=1) * TIMES[0]
        gaps = np.array([others.ahead[np.abs(others.laterals - target) < 2.0].min(initial=EARLY) for target in TARGETS])
        steepest = STEEP_SLOPE + 0.25 * max(0.0, 1.0 - ego.speed / 4.0)  # who is slow can turn more sharply
        slope = float(np.clip(LANE_WIDTH / max(gaps[int(env.lateral > 0)] - 13.0, 1.0), GENTLE_SLOPE, steepest))
        to_go = TARGETS - env.lateral
        moved = np.minimum(np.abs(to_go)[:, None, None], np.minimum(slope * way, LATERAL_SPEED * TIMES))
        lateral = env.lateral + np.sign(to_go)[:, None, None] * moved
        route = np.zeros(lateral.shape, dtype=int)
        positions, headings = env.traffic.poses(route, np.broadcast_to(env.s + way, lateral.shape), lateral)
        changing = np.abs(lateral - TARGETS[:, None, None]) > 0.05
        headings = headings + np.sign(to_go)[:, None, None] * changing * min(slope, LATERAL_SPEED / max(ego.speed, 4.0))

        cost = -way[:, -1] + 0.15 * np.abs(ACCELERATIONS) + 4.0 * np.maximum(speeds[:, -1] - cap, 0.0)
        # Who has begun to change lanes goes on
        here = LANES[int(env.lateral + 10.0 * np.sin(env.heading_error) > 0)]
        cost = cost + LANE_CHANGE_COST * (TARGETS != here)[:, None] + self._collision_cost(others, positions, headings)
        # See to it early to be in a free lane
        cost += EARLY_COST * np.maximum(1 - gaps / EARLY, 0.0)[:, None]
        weight = np.exp((cost.min() - cost) / INDIFFERENCE)
        weight /= weight.sum()
        return float((weight * TARGETS[:, None]).sum()), slope, float((weight * ACCELERATIONS).sum()), cap

    def _collision_cost(self, others: Others, positions: np.ndarray, headings: np.ndarray) -> np.ndarray:
        """
        :param positions: of the plans, shape (target, acceleration, time, 2)
        :return: shape (target, acceleration)
        """
        if len(others.ahead) == 0:
            return np.zeros(positions.shape[:2])
        ego = self.env.ego
        axes = (slice(None), None, None)  # objects first, then the plans, then time
        d = positions - others.positions[axes]
        cos, sin = np.cos(headings), np.sin(headings)
        along, across = d[..., 0] * cos + d[..., 1] * sin, d[..., 1] * cos - d[..., 0] * sin
        angle = others.headings[axes] - headings
        half_length, half_width = half_extents(others.lengths[axes], others.widths[axes], angle)
        gap_along = np.abs(along) - ego.LENGTH / 2 - half_length
        gap_across = np.abs(across) - ego.WIDTH / 2 - half_width
        moves = others.moves[:, None, None, None]
        hit = (gap_along < 0.8 + 0.15 * TIMES) & (gap_across < 0.4)
        behind = along > ego.LENGTH / 2 + half_length
        stays = (np.abs(TARGETS - self.env.lateral) < 2.0)[:, None, None]
        hit &= ~(behind & moves & (np.abs(angle) < 0.3) & stays)  # who follows keeps the distance
        if self.boxed_in > BOXED_IN_FOR:  # nothing else helps: push through
            hit &= moves
        first = np.where(hit.any(axis=-1), TIMES[np.argmax(hit, axis=-1)], np.inf)
        collision = (60.0 / (0.3 + first)).sum(axis=0)
        close = np.where((gap_along < 0.0) & (gap_across < 1.0), 1.0 - np.maximum(gap_across, 0.0), 0.0)
        collision += 8.0 * close.max(axis=-1).sum(axis=0)
        # Before something that stands in the way, keep the room to swing out
        room = np.where((gap_across < 0.3) & ~behind, np.maximum(7.0 - gap_along, 0.0), 0.0)
        return collision + 1.5 * (self.boxed_in < BOXED_IN_FOR) * room.max(axis=-1).sum(axis=0)

    def _steering(self, target: float, slope: float) -> float:
        """Pure pursuit of a lateral target [m], approached with a slope; in [-1, 1]"""
        env, ego = self.env, self.env.ego
        look = float(np.clip(0.9 * ego.speed, 5.0, 10.0))
        lateral = env.lateral + float(np.clip(target - env.lateral, -slope * look, slope * look))
        point, _ = env.traffic.poses(np.array(0), np.array(env.s + look), np.array(lateral))
        d = point - ego.position
        sine = np.sin(np.arctan2(d[1], d[0]) - ego.heading)
        slip = np.arcsin(np.clip(ego.LENGTH * sine / max(np.hypot(*d), 1.0), -0.9, 0.9))
        return float(np.clip(np.arctan(2 * np.tan(slip)) / MAX_STEERING, -1.0, 1.0))
