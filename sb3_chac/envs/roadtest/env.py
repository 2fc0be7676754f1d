"""RoadTest-v0: a rehearsal of the paper's road test, two fixed routes on SafeDrive's roads, with people who cross them."""

import math
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_chac.common.checks import check_integer, check_range
from sb3_chac.envs.driving.geometry import SPACING, boxes_overlap
from sb3_chac.envs.driving.guidance import WAYS as COMMANDS
from sb3_chac.envs.driving.layout import placed
from sb3_chac.envs.driving.planner import Others
from sb3_chac.envs.safedrive.driver import IMPERFECTIONS, ScriptedDriver
from sb3_chac.envs.safedrive.env import SafeDriveEnv
from sb3_chac.envs.safedrive.geometry import Pose
from sb3_chac.envs.safedrive.map import HALF_WIDTH, length
from sb3_chac.envs.safedrive.scene import Scene
from sb3_chac.envs.safedrive.vehicle import MAX_SPEED

ROUTES = {1: "SXCTSO", 2: "CTSXCO"}  # blocks of the routes, which are the scenarios
COMMAND_AHEAD = 40.0  # [m] before a junction from where on the command tells the way through it
CHECKPOINTS = np.arange(2.0, 61.0, 2.0)  # [m] ahead on the route, 30
N_CHECKPOINTS = len(CHECKPOINTS)
REACH = 60.0  # [m] that checkpoints are scaled by
N_OWN = 3  # speed, offset, heading

KERB = HALF_WIDTH + 1.2  # [m] beside the middle of the carriageway, where people wait
PLACES_EVERY = 25.0  # [m] at most between the places where somebody may cross
TRIGGER = 25.0, 45.0  # [m] ahead of the vehicle when somebody begins to cross


class Kind(NamedTuple):
    """Kind of those who cross."""

    name: str
    length: float  # [m]
    width: float
    speed: float  # [m/s]


KINDS = (Kind("pedestrian", 0.6, 0.6, 1.4), Kind("bicycle", 1.8, 0.6, 3.5))


class Crossing(NamedTuple):
    """People at the side of the route, one entry each."""

    s: np.ndarray  # [m] along the route
    side: np.ndarray  # from which they come: 1 right, -1 left
    kind: np.ndarray  # index of KINDS
    trigger: np.ndarray  # [m] ahead of the vehicle when they begin
    walked: np.ndarray  # [m]
    walks: np.ndarray  # whether they have begun
    there: np.ndarray  # whether they have neither arrived nor been hit


class RoadTestEnv(SafeDriveEnv):
    """
    Rehearsal of the paper's road test on two fixed routes.

    Route 1 is for training, route 2 for testing. Roads, traffic, obstacles, actions, reward, cost and ends are SafeDrive's.
    What differs:

    **Observations**, shape (306,), in [-1, 1], those of the paper's vehicle:

    ======= ==============================================================================================
    0       speed, 2 v / v_max - 1
    1       offset from the middle of the carriageway, to the right, d / 4 m
    2       heading against the route, tanh(angle / 0.15)
    3-5     driving command for the next junction within 40 m: left, straight, right (one is 1, the others 0)
    6-65    30 checkpoints on the middle of the route, 2, 4, ..., 60 m ahead: metres ahead and to the right of the
            vehicle, each divided by 60
    66-305  240 distances, clockwise from straight ahead, as closeness: 0 free up to 50 m, 1 touching
    ======= ==============================================================================================

    **Crossings**: pedestrians and bicycles wait at the kerb and cross the carriageway as the vehicle comes, at places and
    times that the episode's seed draws. Touching one costs 1, as any collision; the vehicle stops.

    :param route: 1 or 2; ``reset(options={"scenario": k})`` chooses, too
    :param crossing_density: share of the places (every 25 m of road that is no junction) where somebody crosses, 0 to 1
    :param kwargs: of ``SafeDriveEnv``, but for blocks, corridors, start_scenario and num_scenarios
    :raises ValueError: for an argument out of its range
    """

    _people: Crossing

    def __init__(self, route: int = 1, crossing_density: float = 0.3, **kwargs: Any) -> None:
        self._check_route("route", route)
        check_range("crossing_density", crossing_density, low=0, high=1)
        super().__init__(start_scenario=route, num_scenarios=1, blocks=ROUTES[route], corridors=False, **kwargs)
        self.crossing_density = crossing_density
        n = N_OWN + len(COMMANDS) + 2 * N_CHECKPOINTS + self.lidar.rays
        self.observation_space = spaces.Box(-1.0, 1.0, (n,), np.float32)

    @staticmethod
    def _check_route(name: str, route: Any) -> None:
        check_integer(name, route, low=1)
        if route not in ROUTES:
            raise ValueError(f"{name} must be one of the routes {', '.join(map(str, ROUTES))}, got {route!r}.")

    @property
    def observation_layout(self) -> list[dict[str, Any]]:
        """Name, first element, element after the last, unit and meaning of each part of an observation."""
        parts = [
            ("speed", 1, "m/s", f"2 v / {MAX_SPEED:g} - 1"),
            ("offset", 1, "m", "offset from the middle of the carriageway, to the right, d / 4"),
            ("heading_error", 1, "rad", "heading against the route, tanh(angle / 0.15)"),
            ("command", len(COMMANDS), "1", "left, straight or right at the next junction within 40 m"),
            ("checkpoints", 2 * N_CHECKPOINTS, "m", "2, 4, ..., 60 m ahead: ahead and to the right of the vehicle, d / 60"),
            ("lidar", self.lidar.rays, "m", "closeness 1 - d / 50, clockwise from straight ahead"),
        ]
        return placed(parts)

    def _scene(self, scenario: int) -> Scene:
        self._check_route("options['scenario']", scenario)
        self.blocks = ROUTES[scenario]
        scene = super()._scene(scenario)
        self._people = self._place_people(scene)
        return scene

    def _place_people(self, scene: Scene) -> Crossing:
        """Draw who crosses where, and when."""
        places, s = [], 0.0
        for block in scene.map.blocks:
            start, s = s, s + length(block.route)
            if block.kind in "-SC":
                places += [*np.arange(max(start + 6.0, 35.0), min(s - 4.0, scene.map.length - 20.0), PLACES_EVERY)]
        rng = self.np_random
        chosen = np.array(places)[rng.random(len(places)) < self.crossing_density]
        n = len(chosen)
        return Crossing(
            chosen, rng.choice([-1.0, 1.0], n), rng.integers(len(KINDS), size=n), rng.uniform(*TRIGGER, n),
            np.zeros(n), np.zeros(n, bool), np.ones(n, bool),
        )  # fmt: skip

    # Dynamics

    def _move(self, action: np.ndarray) -> np.ndarray:
        people = self._people
        people.walks[:] |= people.there & (people.s - self.s < people.trigger)
        speeds = np.array([kind.speed for kind in KINDS])[people.kind]
        people.walked[:] += people.walks * speeds / self.metadata["render_fps"]
        people.there[:] &= people.walked < 2 * KERB
        return super()._move(action)

    def people_at(self, seconds: np.ndarray) -> tuple[np.ndarray, ...]:
        """
        Predict where those are who have not arrived, if they go on as they do.

        :param seconds: from now, shape (m,)
        :return: positions [m], shape (n, m, 2), headings [rad], shape (n, m), lengths and widths [m], shape (n, 1)
        """
        people = self._people
        there = np.flatnonzero(people.there)
        kinds = people.kind[there]
        speeds = np.array([kind.speed for kind in KINDS])[kinds] * people.walks[there]
        walked = people.walked[there, None] + speeds[:, None] * seconds
        side = people.side[there, None]
        along = np.broadcast_to(people.s[there, None], walked.shape)
        positions, headings = self.traffic.poses(np.zeros(walked.shape, int), along, side * (KERB - walked))
        sizes = np.array([(kind.length, kind.width) for kind in KINDS])[kinds]
        return positions, headings - side * math.pi / 2, sizes[:, :1], sizes[:, 1:]

    def _collide(self, before: Pose) -> None:
        super()._collide(before)
        positions, headings, lengths, widths = self.people_at(np.zeros(1))
        ego = self.ego
        hits = boxes_overlap(
            ego.position, ego.heading, ego.LENGTH, ego.WIDTH, positions[:, 0], headings[:, 0], lengths[:, 0], widths[:, 0]
        )
        if hits.any():
            self.collisions += int(hits.sum())
            self.episode_cost += int(hits.sum())
            self.contact = True
            self._people.there[np.flatnonzero(self._people.there)[hits]] = False
            ego.position, ego.heading, ego.speed = np.array(before[:2]), before.heading, 0.0
            self._locate()

    # What the agent is told

    @property
    def command(self) -> str:
        """Command for the next junction: "left", "straight" or "right"."""
        ahead = (junction.way for junction in self.map.junctions if junction.start - COMMAND_AHEAD <= self.s < junction.end)
        return next(ahead, "straight")

    def scan(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Cast the lidar's rays.

        :return: [m] distances along the lidar's rays, people included, shape (240,), and indices of the other boxes that can
            be seen
        """
        positions, headings, lengths, widths = self.people_at(np.zeros(1))
        n = len(self.box_positions)
        distances, seen = self.lidar.scan(
            self.ego.position,
            self.ego.heading,
            np.concatenate([self.box_positions, positions[:, 0]]),
            np.concatenate([self.box_headings, headings[:, 0]]),
            np.concatenate([self.box_lengths, lengths[:, 0]]),
            np.concatenate([self.box_widths, widths[:, 0]]),
        )
        return distances, seen[seen < n]

    def _observe(self) -> np.ndarray:
        ego, route = self.ego, self.map.route
        distances, self.seen = self.scan()
        index = np.minimum(((self.s + CHECKPOINTS) / SPACING).astype(int), len(route) - 1)
        d = route[index, :2] - ego.position
        cos, sin = math.cos(ego.heading), math.sin(ego.heading)
        checkpoints = np.stack([d[:, 0] * cos + d[:, 1] * sin, d[:, 1] * cos - d[:, 0] * sin], axis=1) / REACH
        own = 2 * ego.speed / MAX_SPEED - 1, self.lateral / HALF_WIDTH, math.tanh(self.heading_error / 0.15)
        told = [float(command == self.command) for command in COMMANDS]
        observation = np.concatenate([own, told, checkpoints.ravel(), 1 - distances / self.lidar.reach])
        return np.clip(observation, -1.0, 1.0).astype(np.float32)

    def _info(self) -> dict[str, Any]:
        return {**super()._info(), "command": self.command}

    def scripted_driver(self, name: str = "scripted") -> ScriptedDriver:
        """
        Make a driver by its name.

        :param name: "scripted" (with a human's imperfections) or "scripted-ideal" (without)
        :return: a driver for this environment, who sees the people
        :raises ValueError: for another name
        """
        if name not in IMPERFECTIONS:
            raise ValueError(f"{name!r} is not a driver of RoadTest, choose from {sorted(IMPERFECTIONS)}.")
        return RoadTestDriver(self, **IMPERFECTIONS[name])  # type: ignore[arg-type]


class RoadTestDriver(ScriptedDriver):
    """SafeDrive's scripted driver, who predicts the people at the side of the road, too. The parameters are the same."""

    env: RoadTestEnv

    def _look(self, times: np.ndarray) -> Others:
        others = super()._look(times)
        positions, headings, lengths, widths = self.env.people_at(times)
        n = len(positions)
        return Others(
            np.concatenate([others.positions, positions]),
            np.concatenate([others.headings, headings]),
            np.concatenate([others.lengths, lengths]),
            np.concatenate([others.widths, widths]),
            np.concatenate([others.moves, np.ones(n, bool)]),  # nothing to push through
            np.concatenate([others.ahead, np.full(n, np.inf)]),
            np.concatenate([others.laterals, np.zeros(n)]),
        )
