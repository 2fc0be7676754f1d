"""Sampling planner shared by the scripted drivers of both driving tasks, which stand in for the human."""

from abc import ABC, abstractmethod
from collections import deque
from typing import NamedTuple

import numpy as np

from sb3_chac.common.checks import check_integer, check_range
from sb3_chac.envs.driving.geometry import SPACING, boxes_overlap, half_extents

SIGHT = 55.0  # [m]
EARLY_COST = 8.0  # of something ahead in a lane, falling with its distance: prefer the other lanes early
LANE_CHANGE_COST = 2.5  # per lane
INDIFFERENCE = 0.3  # differences in cost that do not matter: plans are mixed, so that similar situations get similar actions
LATERAL_ACCELERATION = 2.5  # [m/s2] in curves
GENTLE_SLOPE, STEEP_SLOPE, LATERAL_SPEED = 0.12, 0.28, 1.6  # [m per m], [m/s] of a lane change, steep if it has to be
TIMES = 0.3 * np.arange(1, 13)  # [s] of the prediction
FEARED = 0.125 * np.arange(1, 21)  # [s] of the prediction of the novice's driving
COUNTER_STEERING = 5.0  # [m/s2] with which a vehicle is straightened out
BOXED_IN_FOR = 8.0  # [s]
DAWDLING = 0.4  # of the speed that the road allows
HELD_FOR = 0.6  # [s] that the novice's steering is held in the prediction


class Others(NamedTuple):
    """Predicted boxes around the ego: n objects at m times."""

    positions: np.ndarray  # (n, m, 2)
    headings: np.ndarray  # (n, m)
    lengths: np.ndarray  # (n, 1)
    widths: np.ndarray  # (n, 1)
    moves: np.ndarray  # (n,) whether it drives
    ahead: np.ndarray  # (n,) [m] along the ego's route, inf for those that go another way
    laterals: np.ndarray  # (n,) [m] to the right of the route


class PlanningDriver(ABC):
    """
    Sample plans, compare them with the predicted traffic, and follow the best by pure pursuit (Coulter 1992).

    A plan is a lane and an acceleration. Each is rolled out for 3.6 s and compared with where everybody in sight will be. No
    plan is kept from one step to the next, and plans about as good as the best are mixed: similar situations get similar
    actions, which makes the driver fit to be imitated. Call ``reset`` when an episode begins.

    A task derives from it and supplies the state of the ego (``_locate``), the others (``_look``), the geometry of the route
    and the pedals.

    :param reaction_delay: [steps of 0.1 s] it sees the others as they were that long ago
    :param action_noise: standard deviation of the noise on both actions (first-order autoregressive, 0.8 from step to step)
    :raises ValueError: for an argument out of its range
    """

    RIGHT: float  # sign of an angle to the right
    ACCELERATIONS: np.ndarray  # [m/s2] of the plans
    EARLY: float  # [m] ahead of something in its lane, from which on it prefers the other ones
    PREVIEW: float  # [m] how far ahead curves limit the speed
    CAUTION: float  # how much a heading off the road slows it down, per rad
    BRAKING: float  # [m/s2] at most
    IMPACT: tuple[float, float]  # cost of a collision, and per m/s
    PATIENCE: float  # [s] of dawdling until a human takes over
    FORGETTING: float  # [s] of dawdling that a step without it takes back

    # State of the ego, see ``_locate``
    s: float  # [m] along the route
    lateral: float  # [m] to the right of it
    error: float  # [rad] heading against the route
    speed: float  # [m/s]
    length: float  # [m]
    width: float  # [m]
    max_steering: float  # [rad]
    wanted_speed: float  # [m/s]
    targets: np.ndarray  # [m] laterals of the lanes
    lane_width: float  # [m]

    def __init__(self, reaction_delay: int, action_noise: float) -> None:
        check_integer("reaction_delay", reaction_delay, low=0)
        check_range("action_noise", action_noise, low=0.0, high=1.0)
        self.reaction_delay, self.action_noise = reaction_delay, action_noise
        self.rng = np.random.default_rng()
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """
        Forget the episode before.

        :param seed: of the noise, None to let it go on
        """
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.noise = np.zeros(2)
        self.seen: deque[Others] = deque(maxlen=self.reaction_delay + 1)
        self.boxed_in = 0.0  # [s] of standing
        self.dawdled = 0.0  # [s] in which the ego stood or crawled although the driver would have sped up

    def __call__(self, observation: np.ndarray | None = None) -> np.ndarray:
        """
        Drive one step.

        :param observation: not used, the driver looks at the environment itself
        :return: steering and pedal, shape (2,), in [-1, 1]
        """
        self._locate()
        self.seen.append(self._look(TIMES))
        target, slope, acceleration, cap = self._plan(self.seen[0])
        self.boxed_in = self.boxed_in + self._impatience() if self.speed < 0.3 else max(0.0, self.boxed_in - 0.05)
        if self.speed < DAWDLING * cap and acceleration > 0:
            self.dawdled = min(self.dawdled + 0.1, self.PATIENCE + 1.0)
        else:
            self.dawdled = max(self.dawdled - self.FORGETTING, 0.0)
        if acceleration > 0:
            acceleration = min(acceleration, 1.5 * (cap - self.speed))
        elif self.speed < 1.0:
            target = self.lateral  # keep the wheel straight while stopped
        action = np.array([self._steering(target, slope), self._pedal(acceleration)])
        self.noise = 0.8 * self.noise + 0.6 * self.rng.normal(0.0, 1.0, 2)
        return np.clip(action + self.action_noise * self.noise, -1.0, 1.0).astype(np.float32)

    def time_to_trouble(self, observation: np.ndarray | None, action: np.ndarray) -> float:
        """
        Predict the time until an action of the novice leads off the road or into a collision.

        The steering is held for 0.6 s and follows the road from then on, the acceleration is held. A vehicle that stands or
        crawls although it could go is in trouble at once.

        :param observation: not used
        :param action: steering and pedal, shape (2,), in [-1, 1]
        :return: [s] until it is too late to steer or brake, up to 2.5; inf without trouble ahead
        """
        if self.dawdled > self.PATIENCE:
            return 0.0
        self._locate()
        states = self._roll_out(float(action[0]) * self.max_steering, self._acceleration(float(action[1])))
        s, lateral, error, speed = states.T
        left, right = self._edges(s)
        off_road = (lateral > right - 0.3) | (lateral < left + 0.3) | (np.abs(error) > 0.9)
        time = np.inf
        if off_road.any():  # too late once there is no time left to straighten out
            first = int(np.argmax(off_road))
            straighten = 0.2 + abs(error[first]) * speed[first] / COUNTER_STEERING
            time = max(0.0, FEARED[first] - straighten)
        others = self._look(FEARED)
        if len(others.ahead):
            positions, headings = self._poses(s, lateral)
            size = self.length + 0.6, self.width + 0.4
            hit = boxes_overlap(
                positions, headings + error, *size, others.positions, others.headings, others.lengths, others.widths
            ).any(axis=0)  # fmt: skip
            if hit.any():
                first = int(np.argmax(hit))
                time = min(time, max(0.0, FEARED[first] - speed[first] / (2 * self.BRAKING)))
        return float(time)

    # Supplied by the task

    @abstractmethod
    def _locate(self) -> None:
        """Update the state of the ego and of its route."""

    @abstractmethod
    def _look(self, times: np.ndarray) -> Others:
        """
        Predict everybody in sight.

        :param times: [s] from now, shape (m,)
        """

    @abstractmethod
    def _poses(self, s: np.ndarray, lateral: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Convert coordinates of the route.

        :param s: [m] along the route
        :param lateral: [m] to the right of it, of the same shape
        :return: positions [m], shape (..., 2), and headings of the route [rad], shape (...)
        """

    @abstractmethod
    def _curvature(self, s: np.ndarray) -> np.ndarray:
        """
        Look up how the ego's way bends.

        :param s: [m] along the route
        :return: curvature [1/m] there, of either sign
        """

    @abstractmethod
    def _edges(self, s: np.ndarray) -> tuple[np.ndarray | float, np.ndarray | float]:
        """
        Look up the edges of the road.

        :param s: [m] along the route
        :return: laterals [m] of its left and its right edge
        """

    @abstractmethod
    def _roll_out(self, steering: float, acceleration: float) -> np.ndarray:
        """
        Predict the ego if the steering is held for ``HELD_FOR`` and then follows the road.

        :param steering: [rad]
        :param acceleration: [m/s2], held
        :return: s [m], lateral [m], heading error [rad] and speed [m/s] at the times ``FEARED``, shape (len(FEARED), 4)
        """

    @abstractmethod
    def _steering(self, target: float, slope: float) -> float:
        """
        Steer by pure pursuit.

        :param target: lateral [m]
        :param slope: of the way there
        :return: in [-1, 1]
        """

    @abstractmethod
    def _pedal(self, acceleration: float) -> float:
        """
        Convert an acceleration [m/s2] to the second action.

        :return: not clipped
        """

    @abstractmethod
    def _acceleration(self, pedal: float) -> float:
        """Convert the second action to an acceleration [m/s2]."""

    def _impatience(self) -> float:
        """[s] that a step of standing counts."""
        return 0.1

    def _is_left_out(self, others: Others) -> np.ndarray:
        """
        Tell which of the others no plan can avoid.

        :return: shape (n,)
        """
        return np.zeros(len(others.ahead), dtype=bool)

    # The plan

    def _speed_cap(self) -> float:
        """Limit the speed [m/s] to what the curves ahead allow after comfortable braking, and more if heading off the road."""
        ahead = np.arange(0.0, self.PREVIEW, 2 * SPACING)
        curvature = np.abs(self._curvature(self.s + ahead))
        squares = LATERAL_ACCELERATION / np.maximum(curvature, 1e-3) + 2 * 1.5 * np.maximum(ahead - 2.0, 0.0)
        return float(min(self.wanted_speed, np.sqrt(squares.min()))) / (1 + self.CAUTION * max(abs(self.error) - 0.3, 0.0))

    def _plan(self, others: Others) -> tuple[float, float, float, float]:
        """
        Compare the plans and mix the best.

        :return: lateral target [m], slope of the way there, acceleration [m/s2] and the speed [m/s] that the road allows
        """
        cap, targets, accelerations = self._speed_cap(), self.targets, self.ACCELERATIONS
        # Plans: s of shape (acceleration, time), lateral of (target, acceleration, time)
        speeds = np.clip(self.speed + accelerations[:, None] * TIMES, 0.0, max(cap, self.speed))
        before = np.concatenate([np.full((len(accelerations), 1), self.speed), speeds[:, :-1]], axis=1)
        way = np.cumsum((before + speeds) / 2, axis=1) * TIMES[0]
        gaps = np.array([others.ahead[np.abs(others.laterals - target) < 2.0].min(initial=self.EARLY) for target in targets])
        lane = int(np.argmin(np.abs(targets - self.lateral)))
        steepest = STEEP_SLOPE + 0.25 * max(0.0, 1.0 - self.speed / 4.0)  # a slow vehicle can turn more sharply
        slope = float(np.clip(self.lane_width / max(gaps[lane] - 13.0, 1.0), GENTLE_SLOPE, steepest))
        to_go = targets - self.lateral
        moved = np.minimum(np.abs(to_go)[:, None, None], np.minimum(slope * way, LATERAL_SPEED * TIMES))
        lateral = self.lateral + np.sign(to_go)[:, None, None] * moved
        positions, headings = self._poses(np.broadcast_to(self.s + way, lateral.shape), lateral)
        changing = np.abs(lateral - targets[:, None, None]) > 0.05
        turn = changing * min(slope, LATERAL_SPEED / max(self.speed, 4.0))
        headings = headings + self.RIGHT * np.sign(to_go)[:, None, None] * turn

        cost = -way[:, -1] + 0.15 * np.abs(accelerations) + 4.0 * np.maximum(speeds[:, -1] - cap, 0.0)
        # Penalise aborting a lane change: the lane is the one that the ego is heading for
        here = np.argmin(np.abs(targets - (self.lateral + self.RIGHT * 10.0 * np.sin(self.error))))
        cost = cost + LANE_CHANGE_COST * np.abs(np.arange(len(targets)) - here)[:, None]
        cost = cost + self._collision_cost(others, positions, headings, speeds)
        # Get into a free lane early
        cost += EARLY_COST * np.maximum(1 - gaps / self.EARLY, 0.0)[:, None]
        weight = np.exp((cost.min() - cost) / INDIFFERENCE)
        weight /= weight.sum()
        return float((weight * targets[:, None]).sum()), slope, float((weight * accelerations).sum()), cap

    def _collision_cost(self, others: Others, positions: np.ndarray, headings: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """
        Add up the collisions of each plan, and how close it comes to one.

        :param positions: of the plans, shape (target, acceleration, time, 2)
        :param headings: of the plans, shape (target, acceleration, time)
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
        stays = (np.abs(self.targets - self.lateral) < 2.0)[:, None, None]
        hit &= ~(behind & moves & (np.abs(angle) < 0.3) & stays)  # a follower keeps the distance
        hit &= ~self._is_left_out(others)[:, None, None, None]
        if self.boxed_in > BOXED_IN_FOR:  # nothing else helps: push through
            hit &= moves
        first = np.argmax(hit, axis=-1)
        impact = self.IMPACT[0] + self.IMPACT[1] * speeds[np.arange(len(speeds)), first]
        collision = np.where(hit.any(axis=-1), impact / (0.3 + TIMES[first]), 0.0).sum(axis=0)
        close = np.where((gap_along < 0.0) & (gap_across < 1.0), 1.0 - np.maximum(gap_across, 0.0), 0.0)
        collision += 8.0 * close.max(axis=-1).sum(axis=0)
        # Before an obstacle in the way, keep the room to swing out
        room = np.where((gap_across < 0.3) & ~behind, np.maximum(7.0 - gap_along, 0.0), 0.0)
        return collision + 1.5 * (self.boxed_in < BOXED_IN_FOR) * room.max(axis=-1).sum(axis=0)
