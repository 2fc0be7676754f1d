"""
Traffic on rails: every car has a path of its own, a place on it and a speed.

Cars follow whoever is in their way (intelligent driver model, Treiber et al. 2000), let pass who comes first where paths
cross or merge, and pull over to the other lane before an obstacle. All cars are advanced at once in numpy.
"""

import numpy as np

from sb3_chac.envs.safedrive.geometry import SPACING, boxes_overlap, sample, wrap_angle
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
        self.points = np.concatenate(self.tables)
        sizes = np.array([len(table) for table in self.tables])
        self.first, self.last = np.cumsum(sizes) - sizes, sizes - 1
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
        index = np.minimum(np.maximum((s / SPACING).astype(int), 0), self.last[path])
        point = self.points[self.first[path] + index]
        x, y, heading, curvature = point[..., 0], point[..., 1], point[..., 2], point[..., 3]
        rest = s - index * SPACING
        cos, sin = np.cos(heading), np.sin(heading)
        position = np.empty((*heading.shape, 2))
        position[..., 0] = x + rest * cos - lateral * sin
        position[..., 1] = y + rest * sin + lateral * cos
        return position, heading + curvature * np.minimum(rest, SPACING)

    def update_visible(self) -> None:
        """Where the cars are that one can see: ``visible`` (indices), ``positions`` and ``headings``."""
        self.visible = np.flatnonzero((self.state == DRIVING) | (self.state == CRASHED))
        self.positions, self.headings = self.poses(self.path[self.visible], self.s[self.visible], self.lateral[self.visible])

    def crash(self, car: int) -> None:
        """The car stands where it is, and is towed away after some seconds."""
        self.state[car], self.speed[car] = CRASHED, 0.0

    def remove_obstacle(self, obstacle: int) -> None:
        """It has fallen over, or was towed away."""
        self.obstacle_there[obstacle] = False

    def step(
        self, dt: float, ego_s: float, ego_lateral: float, ego_speed: float, ego_position: np.ndarray, ego_heading: float
    ) -> None:
        """
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
        path, s, lateral, speed = self.path[cars], self.s[cars], self.lateral[cars], self.speed[cars]
        positions = np.concatenate([self.positions, ego_position[None]])
        headings = np.append(self.headings, ego_heading)
        if self.steps % DECISION_STEPS == 0:
            everybody = np.append(path, 0), np.append(s, ego_s), np.append(lateral, ego_lateral), np.append(speed, ego_speed)
            gap = self._pull_over(cars, *everybody)
            self.acceleration[cars] = self._decide(cars, *everybody, positions, headings, gap)
        self.steps += 1

        driving = self.state[cars] == DRIVING
        new_speed = np.clip(speed + self.acceleration[cars] * dt, 0.0, 15.0) * driving
        new_s = s + new_speed * dt
        sideways = np.clip(self.target[cars] - lateral, -LANE_CHANGE_SPEED * dt, LANE_CHANGE_SPEED * dt)
        new_lateral = lateral + sideways * (new_speed > 0.5)
        blocked = self._would_hit(path, new_s, new_lateral, positions, headings)
        if blocked is not None:
            new_speed[blocked] = 0.0
            new_s[blocked], new_lateral[blocked] = s[blocked], lateral[blocked]
        self.speed[cars], self.s[cars], self.lateral[cars] = new_speed, new_s, new_lateral
        self._take_away(cars, dt)
        self.update_visible()

    def _appear(self, ego_s: float, ego_position: np.ndarray) -> None:
        """Cars whose time has come, unless there is somebody in their place."""
        for car in np.flatnonzero((self.state == HIDDEN) & (self.trigger <= ego_s)):
            if self._stands_on_obstacle(int(car)):
                self.state[car] = GONE
                continue
            position, _ = self.poses(self.path[car], self.s[car], self.lateral[car])
            others = np.concatenate([self.positions, ego_position[None]])
            if np.min(np.sum((others - position) ** 2, axis=1)) > 15.0**2:
                self.state[car] = DRIVING
                self.update_visible()

    def _stands_on_obstacle(self, car: int) -> bool:
        path, s = self.path[car], self.s[car]
        if not self.shared_from[path] <= s <= self.shared_to[path]:
            return False
        beside = np.abs(self.obstacle_lateral - self.lateral[car]) < 2.5
        return bool((beside & (np.abs(self.obstacle_s - s - self.ahead_of_route[path]) < 12.0)).any())

    def _pull_over(self, cars, path, s, lateral, speed) -> np.ndarray:
        """
        Cars on the ego's route pass obstacles in the other lane.

        :param path: of all cars, then of the ego (the other arguments likewise); shape (n_cars + 1,)

        :return: [m] from each car's bumper to an obstacle in its lane, shape (n_cars,)
        """
        gap = np.full(len(cars), np.inf)
        if not self.obstacle_there.any():
            return gap
        on_route = (s >= self.shared_from[path] - 12.0) & (s <= self.shared_to[path])
        s = s + self.ahead_of_route[path]
        for i in np.flatnonzero(on_route[:-1]):
            ahead = self.obstacle_s - s[i]
            near = self.obstacle_there & (ahead > -6.0) & (ahead < 35.0)
            blocking = near & (np.abs(self.obstacle_lateral - self.target[cars[i]]) < 2.2)
            if blocking.any():
                other = -self.target[cars[i]]
                beside = (
                    on_route & (np.abs(lateral - other) < 2.5) & (np.abs(s - s[i] + np.maximum(speed - speed[i], 0)) < 10.0)
                )
                beside[i] = False
                if not beside.any() and not (near & (np.abs(self.obstacle_lateral - other) < 2.2)).any():
                    self.target[cars[i]] = other
            in_way = near & (ahead > 0) & (np.abs(self.obstacle_lateral - lateral[i]) < 2.3)
            gap[i] = np.min(np.where(in_way, ahead - CAR_LENGTH / 2 - self.obstacle_half, np.inf))
        return gap

    def _decide(self, cars, path, s, lateral, speed, positions, headings, obstacle_gap) -> np.ndarray:
        """
        :param path: of all cars, then of the ego (the other arguments likewise); shape (n_cars + 1,)
        :return: [m/s2], shape (n_cars,)
        """
        n = len(cars)
        cos, sin = np.cos(headings), np.sin(headings)
        # Whose box covers a point of my path, and how far ahead: (n_cars, n_points, n_cars + 1)
        look = s[:n, None] + CAR_LENGTH / 2 + AHEAD
        mine, _ = self.poses(path[:n, None], look, lateral[:n, None])
        d = mine[:, :, None] - positions
        covered = np.abs(d[..., 0] * cos + d[..., 1] * sin) < CAR_LENGTH / 2 + 0.8
        covered &= np.abs(d[..., 1] * cos - d[..., 0] * sin) < CAR_WIDTH / 2 + 1.2
        own = np.arange(n)
        covered[own, :, own] = False
        gaps = np.where(covered, AHEAD[:, None], np.inf).min(axis=1)
        leader = np.argmin(gaps, axis=1)
        gap = gaps[own, leader] - 1.0
        their_speed = np.maximum(speed[leader] * np.cos(headings[leader] - headings[:n]), 0.0)
        their_speed = np.where(obstacle_gap < gap, 0.0, their_speed)
        gap = np.maximum(np.minimum(gap, obstacle_gap), 0.3)
        v = speed[:n]
        wanted = MIN_GAP + v * TIME_GAP + v * (v - their_speed) / (2 * np.sqrt(MAX_ACCELERATION * COMFORTABLE_BRAKING))
        free = 1 - (v / self.desired_speed[cars]) ** 4
        acceleration = MAX_ACCELERATION * (free - (np.maximum(wanted, 0.0) / gap) ** 2)

        # Who will be in the same place at the same time, coming from elsewhere: let go first who is farther ahead
        future, _ = self.poses(path[:, None], s[:, None] + speed[:, None] * SOON, lateral[:, None])
        distance2 = ((future[:n, None] - future) ** 2).sum(axis=-1).min(axis=-1)
        crossing = (distance2 < 4.5**2) & (np.abs(wrap_angle(headings[:n, None] - headings)) > 0.25)
        to = positions - positions[:, None]
        in_front = to[..., 0] * cos[:, None] + to[..., 1] * sin[:, None]
        yields = (crossing & (in_front > in_front.T)[:n]).any(axis=1) & (self.standing[cars] < PATIENCE)
        acceleration = np.where(yields, np.minimum(acceleration, -COMFORTABLE_BRAKING), acceleration)
        return np.clip(acceleration, -MAX_BRAKING, MAX_ACCELERATION)

    def _would_hit(self, path, s, lateral, positions, headings) -> np.ndarray | None:
        """
        :param positions: of the cars before their move, and of the ego
        :return: cars that must not move, as they would touch another one that they do not touch yet; None if none are near
        """
        n = len(s)
        moved, moved_headings = self.poses(path, s, lateral)
        after = np.concatenate([moved, positions[n:]])
        d = moved[:, None] - after
        near = d[..., 0] ** 2 + d[..., 1] ** 2 < CAR_LENGTH**2 + CAR_WIDTH**2
        near[np.arange(n), np.arange(n)] = False
        if not near.any():
            return None
        i, j = np.nonzero(near)
        size = CAR_LENGTH, CAR_WIDTH
        touches = np.zeros(len(i), dtype=bool)
        for others, other_headings in ((after, np.append(moved_headings, headings[n:])), (positions, headings)):
            touches |= boxes_overlap(moved[i], moved_headings[i], *size, others[j], other_headings[j], *size)
        before = boxes_overlap(positions[i], headings[i], *size, positions[j], headings[j], *size)
        return np.unique(i[touches & ~before])

    def _take_away(self, cars: np.ndarray, dt: float) -> None:
        standing = self.speed[cars] < 0.3
        self.standing[cars] = np.where(standing, self.standing[cars] + dt, np.maximum(self.standing[cars] - 2 * dt, 0.0))
        crashed = self.state[cars] == CRASHED
        self.crashed_for[cars] += dt * crashed
        stuck = (self.standing[cars] > TOWED_AFTER) & ~crashed
        self.towed += int(stuck.sum())
        arrived = self.s[cars] >= self.last[self.path[cars]] * SPACING
        self.state[cars[arrived | stuck | (self.crashed_for[cars] > CRASHED_FOR)]] = GONE
