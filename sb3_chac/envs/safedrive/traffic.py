"""
Traffic on rails: every car has a path of its own, a place on it and a speed.

Cars follow whoever is in their way (intelligent driver model, Treiber et al. 2000), let pass who comes first where paths
cross or merge, and pull over to the other lane before an obstacle. The loops over cars are compiled (functions at the end).
"""

import numpy as np

from sb3_chac.envs.driving.compiled import compiled
from sb3_chac.envs.driving.geometry import SPACING, boxes_overlap
from sb3_chac.envs.safedrive.geometry import sample
from sb3_chac.envs.safedrive.map import LANES, OBSTACLE_SIZES, Map

CAR_LENGTH, CAR_WIDTH = 5.0, 2.0  # [m]
HIDDEN, DRIVING, CRASHED, GONE = range(4)  # states of a car

MAX_ACCELERATION, COMFORTABLE_BRAKING, MAX_BRAKING = 3.0, 4.0, 6.0  # [m/s2]
MIN_GAP, TIME_GAP = 3.0, 1.0  # [m], [s]
SPEEDS = 8.0, 11.0  # [m/s] between which cars want to drive
LANE_CHANGE_SPEED = 2.0  # [m/s] sideways
AHEAD = 2.0 + 2.0 * np.arange(12)  # [m] before the bumper, where a car looks for others on its path
SOON = 0.35 * np.arange(1, 9)  # [s] at which it compares where everybody will be
PATIENCE, TOWED_AFTER = 6.0, 15.0  # [s] of standing, after which a car stops yielding, and after which it is taken away
CRASHED_FOR = 5.0  # [s] that a car stands after a collision before it is taken away
DECISION_STEPS = 2  # steps between two decisions of the traffic


class Traffic:
    """
    Traffic on a map.

    :param road_map: the map
    :param density: 1 is about one car per 60 m of the route, two at each junction and ramp, and one per 100 m the other way
    :param rng: draws who drives where
    """

    def __init__(self, road_map: Map, density: float, rng: np.random.Generator) -> None:
        self.map = road_map
        self.tables = [road_map.route]  # of the ego first, then one for every path in use
        table_of: dict[int, int] = {0: 0}
        cars = []
        for index, s, lane, trigger in self._draw(density, rng):
            if index not in table_of:
                table_of[index] = len(self.tables)
                path = road_map.paths[index]
                self.tables.append(sample(path.start, path.segments))
            cars.append((table_of[index], s, lane, rng.uniform(*SPEEDS), trigger))
        columns = np.array(cars, dtype=float).reshape(-1, 5).T
        self.initial = (columns[0].astype(int), *columns[1:])
        points = np.concatenate(self.tables)
        self.points = np.column_stack([points, np.cos(points[:, 2]), np.sin(points[:, 2])])
        sizes = np.array([len(table) for table in self.tables])
        self.first, self.last = np.cumsum(sizes) - sizes, sizes - 1
        self._tables = self.points, self.first, self.last
        obstacles = [(o.s, o.lateral, OBSTACLE_SIZES[o.kind][0] / 2) for o in road_map.obstacles]
        self.obstacle_s, self.obstacle_lateral, self.obstacle_half = np.array(obstacles).reshape(-1, 3).T
        in_use = [road_map.paths[index] for index in table_of]
        self.shared_from, self.shared_to = np.array([path.shared for path in in_use]).T
        self.ahead_of_route = np.array([path.ahead_of_route for path in in_use])

    def _draw(self, density: float, rng: np.random.Generator) -> list[tuple[int, float, float, float]]:
        """Path, place on it [m], lane [m] and the place of the ego on the route [m] from which on the car is there."""
        paths, cars = self.map.paths, []
        for s in np.arange(35.0, self.map.length, 50.0):
            if rng.random() < 0.8 * density:
                place = s + rng.uniform(0, 30)
                cars.append((0, place, rng.choice(LANES), place - 60.0))
        meets = {path.block_start for path in paths[2:]}
        for block_start in sorted(meets):
            ways = [i for i, path in enumerate(paths) if i > 1 and path.block_start == block_start]
            for _ in range(rng.poisson(2.0 * density)):
                index = int(rng.choice(ways))
                path = paths[index]
                place = max(path.meets - rng.uniform(15.0, 50.0), 0.0)
                trigger = place - 60.0 if path.kind == "leaves" else block_start - rng.uniform(15.0, 50.0)
                cars.append((index, place, rng.choice(path.lanes), trigger))
        whole = sum(segment.length for segment in paths[1].segments)
        for s in np.arange(0.0, self.map.length, 60.0):
            if rng.random() < 0.6 * density:  # meets the ego about where it will be by then
                cars.append((1, max(whole - s - 90.0 - rng.uniform(0, 30), 0.0), rng.choice(LANES), s))
        return cars

    def reset(self) -> None:
        self.path, self.s, self.lateral, self.desired_speed, self.trigger = (column.copy() for column in self.initial)
        self.target = self.lateral.copy()
        self.speed = self.desired_speed.copy()
        self.acceleration = np.zeros_like(self.speed)
        self.state = np.zeros(len(self.s), dtype=int)
        self.standing = np.zeros_like(self.speed)  # [s]
        self.crashed_for = np.zeros_like(self.speed)  # [s]
        self.obstacle_there = np.ones(len(self.obstacle_s), dtype=bool)
        self.steps, self.towed = 0, 0
        self.update_visible()

    def poses(self, path: np.ndarray, s: np.ndarray, lateral: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """
        Beyond either end, paths go on straight.

        :param path: index of the path, 0 for the ego's route
        :param s: [m] along it
        :param lateral: [m] to the right of it; all broadcast to one shape
        :return: positions, shape (..., 2), and headings, shape (...)
        """
        path, s, lateral = np.broadcast_arrays(path, s, lateral)
        positions, headings = _poses(*self._tables, path.ravel(), s.ravel(), lateral.ravel())
        return positions.reshape(*s.shape, 2), headings.reshape(s.shape)

    def update_visible(self) -> None:
        """Update what can be seen of the cars: ``visible`` (indices), ``positions`` and ``headings``."""
        self.visible, self.positions, self.headings = _visible(*self._tables, self.path, self.s, self.lateral, self.state)

    def crash(self, car: int) -> None:
        """The car stands where it is, and is towed away after some seconds."""
        self.state[car], self.speed[car] = CRASHED, 0.0

    def remove_obstacle(self, obstacle: int) -> None:
        """Remove an obstacle: it has fallen over, or was towed away."""
        self.obstacle_there[obstacle] = False

    def step(
        self, dt: float, ego_s: float, ego_lateral: float, ego_speed: float, ego_position: np.ndarray, ego_heading: float
    ) -> None:
        """
        Move all cars by one step.

        :param dt: [s]
        :param ego_s: [m] along the route
        :param ego_lateral: [m] to the right of it
        :param ego_speed: [m/s]
        :param ego_position: [m], shape (2,)
        :param ego_heading: [rad]
        """
        self._appear(ego_s, ego_position)
        cars = self.visible
        if len(cars) == 0:
            self.update_visible()
            return
        # Of the cars, then of the ego
        path, s = np.concatenate([self.path[cars], [0]]), np.concatenate([self.s[cars], [ego_s]])
        lateral, speed = np.concatenate([self.lateral[cars], [ego_lateral]]), np.concatenate([self.speed[cars], [ego_speed]])
        positions = np.concatenate([self.positions, ego_position[None]])
        headings = np.concatenate([self.headings, [ego_heading]])
        if self.steps % DECISION_STEPS == 0:
            shared = self.shared_from[path] - 12.0, self.shared_to[path], self.ahead_of_route[path]
            obstacles = self.obstacle_s, self.obstacle_lateral, self.obstacle_half, self.obstacle_there
            self.target[cars], gaps = _pull_over(self.target[cars], s, lateral, speed, shared, obstacles)
            waits = self.standing[cars] < PATIENCE
            self.acceleration[cars] = _decide(
                self._tables, path, s, lateral, speed, positions, headings, self.desired_speed[cars], waits, gaps
            )
        self.steps += 1

        driving = self.state[cars] == DRIVING
        moved = _move(s, lateral, speed, self.target[cars], self.acceleration[cars], driving, dt)
        for car in self._would_hit(path[:-1], moved[0], moved[1], positions, headings):
            moved[:, car] = s[car], lateral[car], 0.0
        self.s[cars], self.lateral[cars], self.speed[cars] = moved
        self.towed += _take_away(
            cars, self.path, self.last, self.s, self.speed, self.state, self.standing, self.crashed_for, dt
        )  # fmt: skip
        self.update_visible()

    def _appear(self, ego_s: float, ego_position: np.ndarray) -> None:
        """Let the cars appear whose time has come, unless there is somebody in their place."""
        waiting = np.flatnonzero((self.state == HIDDEN) & (self.trigger <= ego_s))
        if len(waiting) == 0:
            return
        places, _ = self.poses(self.path[waiting], self.s[waiting], self.lateral[waiting])
        for car, place in zip(waiting, places, strict=True):
            if self._stands_on_obstacle(int(car)):
                self.state[car] = GONE
                continue
            others = np.concatenate([self.positions, ego_position[None]])
            if np.min(np.sum((others - place) ** 2, axis=1)) > 15.0**2:
                self.state[car] = DRIVING
                self.update_visible()

    def _stands_on_obstacle(self, car: int) -> bool:
        path, s = self.path[car], self.s[car]
        if not self.shared_from[path] <= s <= self.shared_to[path]:
            return False
        beside = np.abs(self.obstacle_lateral - self.lateral[car]) < 2.5
        return bool((beside & (np.abs(self.obstacle_s - s - self.ahead_of_route[path]) < 12.0)).any())

    def _would_hit(self, path, s, lateral, positions, headings) -> np.ndarray:
        """
        Find the cars that must not move, as they would touch another one that they do not touch yet.

        :param positions: of the cars before their move, and of the ego
        """
        n = len(s)
        moved, moved_headings = _poses(*self._tables, path, s, lateral)
        after = np.concatenate([moved, positions[n:]])
        i, j = _near(after)
        if len(i) == 0:
            return i
        size = CAR_LENGTH, CAR_WIDTH
        touches = np.zeros(len(i), dtype=bool)
        for others, other_headings in ((after, np.append(moved_headings, headings[n:])), (positions, headings)):
            touches |= boxes_overlap(moved[i], moved_headings[i], *size, others[j], other_headings[j], *size)
        before = boxes_overlap(positions[i], headings[i], *size, positions[j], headings[j], *size)
        return np.unique(i[touches & ~before])


# Loops over cars. Where nothing else is said, arrays hold all n cars that can be seen and then the ego, shape (n + 1,)


@compiled
def _pose(points, first, last, path, s, lateral):
    """Position (x, y) and heading at a place, ``s`` along and ``lateral`` to the right of a path."""
    index = min(max(int(s / SPACING), 0), last[path])
    point = points[first[path] + index]
    cos, sin = point[4], point[5]
    rest = s - index * SPACING
    heading = point[2] + point[3] * min(rest, SPACING)
    return point[0] + rest * cos - lateral * sin, point[1] + rest * sin + lateral * cos, heading


@compiled
def _poses(points, first, last, path, s, lateral):
    positions, headings = np.empty((len(s), 2)), np.empty(len(s))
    for i in range(len(s)):
        positions[i, 0], positions[i, 1], headings[i] = _pose(points, first, last, path[i], s[i], lateral[i])
    return positions, headings


@compiled
def _visible(points, first, last, path, s, lateral, state):
    """
    Find the cars of the map that are there.

    :return: their indices, positions and headings
    """
    cars = np.flatnonzero((state == DRIVING) | (state == CRASHED))
    positions, headings = _poses(points, first, last, path[cars], s[cars], lateral[cars])
    return cars, positions, headings


@compiled
def _pull_over(target, s, lateral, speed, shared, obstacles):
    """
    Let cars on the ego's route pass obstacles in the other lane.

    :param target: [m] where the cars want to be, to the right of their path, shape (n,)
    :param shared: [m] from where to where everybody's path runs on the route, and how far the route is ahead of it
    :param obstacles: [m] along and beside the route and half of their lengths, and whether they are there
    :return: the new targets, and [m] from each car's bumper to an obstacle in its lane, shapes (n,)
    """
    start, end, ahead_of_route = shared
    obstacle_s, obstacle_lateral, obstacle_half, obstacle_there = obstacles
    gaps = np.full(len(target), np.inf)
    on_route = (s >= start) & (s <= end)
    s = s + ahead_of_route
    for car in range(len(target)):
        if not on_route[car]:
            continue
        other = -target[car]
        blocked = other_blocked = False
        for obstacle in range(len(obstacle_s)):
            ahead = obstacle_s[obstacle] - s[car]
            if not (obstacle_there[obstacle] and -6.0 < ahead < 35.0):
                continue
            blocked = blocked or abs(obstacle_lateral[obstacle] - target[car]) < 2.2
            other_blocked = other_blocked or abs(obstacle_lateral[obstacle] - other) < 2.2
            if ahead > 0 and abs(obstacle_lateral[obstacle] - lateral[car]) < 2.3:
                gaps[car] = min(gaps[car], ahead - CAR_LENGTH / 2 - obstacle_half[obstacle])
        if not blocked or other_blocked:
            continue
        beside = on_route & (np.abs(lateral - other) < 2.5)
        beside &= np.abs(s - s[car] + np.maximum(speed - speed[car], 0.0)) < 10.0
        beside[car] = False
        if not beside.any():
            target[car] = other
    return target, gaps


@compiled
def _decide(tables, path, s, lateral, speed, positions, headings, desired_speed, waits, obstacle_gaps):
    """
    Decide how fast each car would go, and where in its lane.

    :param tables: arguments of ``_pose``
    :param desired_speed: [m/s], shape (n,)
    :param waits: whether a car still lets others pass, shape (n,)
    :param obstacle_gaps: [m] from a car's bumper to an obstacle in its lane, shape (n,)
    :return: [m/s2], shape (n,)
    """
    points, first, last = tables
    everybody, n = len(s), len(desired_speed)
    cos, sin = np.cos(headings), np.sin(headings)
    future = np.empty((everybody, len(SOON), 2))
    for i in range(everybody):
        for k in range(len(SOON)):
            future[i, k, 0], future[i, k, 1], _ = _pose(points, first, last, path[i], s[i] + speed[i] * SOON[k], lateral[i])
    acceleration = np.empty(n)
    for i in range(n):
        leader, gap = _leader(i, tables, path, s, lateral, positions, cos, sin)
        v, their_speed = speed[i], max(speed[leader] * np.cos(headings[leader] - headings[i]), 0.0)
        if obstacle_gaps[i] < gap:
            gap, their_speed = obstacle_gaps[i], 0.0
        wanted = MIN_GAP + v * TIME_GAP + v * (v - their_speed) / (2 * np.sqrt(MAX_ACCELERATION * COMFORTABLE_BRAKING))
        free = 1 - (v / desired_speed[i]) ** 4
        acceleration[i] = MAX_ACCELERATION * (free - (max(wanted, 0.0) / max(gap, 0.3)) ** 2)
        if waits[i] and _yields(i, positions, headings, cos, sin, future):
            acceleration[i] = min(acceleration[i], -COMFORTABLE_BRAKING)
    return np.clip(acceleration, -MAX_BRAKING, MAX_ACCELERATION)


@compiled
def _leader(i, tables, path, s, lateral, positions, cos, sin):
    """
    Whose box covers a point of car i's path, and how far ahead.

    :return: index and [m]; 0 and inf if there is nobody
    """
    points, first, last = tables
    for ahead in AHEAD:
        x, y, _ = _pose(points, first, last, path[i], s[i] + CAR_LENGTH / 2 + ahead, lateral[i])
        for j in range(len(positions)):
            dx, dy = x - positions[j, 0], y - positions[j, 1]
            along, across = abs(dx * cos[j] + dy * sin[j]), abs(dy * cos[j] - dx * sin[j])
            if j != i and along < CAR_LENGTH / 2 + 0.8 and across < CAR_WIDTH / 2 + 1.2:
                return j, ahead - 1.0
    return 0, np.inf


@compiled
def _yields(i, positions, headings, cos, sin, future):
    """
    Tell whether to yield: of two that will be in the same place at the same time from different ways, the one farther ahead
    goes first.

    :param future: positions at the times ``SOON``, shape (n + 1, len(SOON), 2)
    :return: whether car i lets anybody go first
    """
    for j in range(len(positions)):
        angle = (headings[i] - headings[j] + np.pi) % (2 * np.pi) - np.pi
        dx, dy = positions[j, 0] - positions[i, 0], positions[j, 1] - positions[i, 1]
        if abs(angle) <= 0.25 or dx * cos[i] + dy * sin[i] <= -dx * cos[j] - dy * sin[j]:
            continue
        for k in range(len(SOON)):
            if (future[i, k, 0] - future[j, k, 0]) ** 2 + (future[i, k, 1] - future[j, k, 1]) ** 2 < 4.5**2:
                return True
    return False


@compiled
def _move(s, lateral, speed, target, acceleration, driving, dt):
    """
    Move the cars.

    :return: new s [m], lateral [m] and speed [m/s] of the cars, shape (3, n)
    """
    moved = np.empty((3, len(target)))
    for i in range(len(target)):
        new_speed = min(max(speed[i] + acceleration[i] * dt, 0.0), 15.0) if driving[i] else 0.0
        sideways = min(max(target[i] - lateral[i], -LANE_CHANGE_SPEED * dt), LANE_CHANGE_SPEED * dt)
        moved[0, i] = s[i] + new_speed * dt
        moved[1, i] = lateral[i] + sideways * (new_speed > 0.5)
        moved[2, i] = new_speed
    return moved


@compiled
def _near(positions):
    """
    Find pairs of vehicles that may touch.

    :param positions: of the cars, then of the ego
    :return: the cars, and all others so near to them that they may touch, two arrays of indices
    """
    pairs = [
        (i, j)
        for i in range(len(positions) - 1)
        for j in range(len(positions))
        if i != j
        and (positions[i, 0] - positions[j, 0]) ** 2 + (positions[i, 1] - positions[j, 1]) ** 2 < CAR_LENGTH**2 + CAR_WIDTH**2
    ]
    return np.array([pair[0] for pair in pairs], np.int64), np.array([pair[1] for pair in pairs], np.int64)


@compiled
def _take_away(cars, path, last, s, speed, state, standing, crashed_for, dt):
    """
    Remove who has arrived, has crashed or stands for too long; arrays hold all cars of the map, and are changed.

    :return: how many stood for too long
    """
    towed = 0
    for car in cars:
        standing[car] = standing[car] + dt if speed[car] < 0.3 else max(standing[car] - 2 * dt, 0.0)
        crashed = state[car] == CRASHED
        crashed_for[car] += dt * crashed
        stuck = standing[car] > TOWED_AFTER and not crashed
        towed += stuck
        if stuck or s[car] >= last[path[car]] * SPACING or crashed_for[car] > CRASHED_FOR:
            state[car] = GONE
    return towed
