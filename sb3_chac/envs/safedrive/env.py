"""SafeDrive-v0: the driving task of the paper's benchmark, on highway-env."""

import math
from collections import OrderedDict
from typing import Any

import numpy as np
from gymnasium import spaces
from highway_env.road.road import Road

from sb3_chac.common.arguments import checked
from sb3_chac.common.checks import check_driving_action, check_integer, check_range
from sb3_chac.common.contract import Guidance
from sb3_chac.envs.driving.compiled import compiled
from sb3_chac.envs.driving.corridors import N_VIEW, CorridorView
from sb3_chac.envs.driving.display import STEPS_PER_SECOND, Display
from sb3_chac.envs.driving.env import DrivingEnv
from sb3_chac.envs.driving.geometry import boxes_overlap
from sb3_chac.envs.driving.guidance import guide
from sb3_chac.envs.safedrive.driver import IMPERFECTIONS, ScriptedDriver
from sb3_chac.envs.safedrive.geometry import Pose
from sb3_chac.envs.safedrive.layout import layout
from sb3_chac.envs.safedrive.lidar import Lidar
from sb3_chac.envs.safedrive.map import BLOCKS, HALF_WIDTH, LANES, Map
from sb3_chac.envs.safedrive.navigation import N_EGO, N_STATE, locate, navigation, route_ahead
from sb3_chac.envs.safedrive.scene import Scene, make_scene
from sb3_chac.envs.safedrive.traffic import CAR_LENGTH, CAR_WIDTH
from sb3_chac.envs.safedrive.vehicle import MAX_SPEED, Ego

SUBSTEPS = 2
PARKED_TOWED_AFTER = 50  # steps after a collision with a parked vehicle
SCENES_KEPT = 64


class SafeDriveEnv(DrivingEnv):
    """
    Drive a route through seeded maps of straights, curves, ramps, roundabouts, T-intersections and intersections, among
    traffic, cones, warning triangles and parked vehicles; ten decisions per second.

    **Actions**, shape (2,), in [-1, 1]: steering (1 is 0.6 rad of the front wheels to the right) and acceleration (1 is
    4 m/s2, -1 brakes as much; the vehicle does not drive backwards; top speed 15 m/s).

    **Observations**, shape (355,), in [-1, 1]; t(x) stands for tanh(x):

    ======= ==============================================================================================
    0       distance to the left edge of the carriageway, d / 4 m - 1
    1       distance to the right edge, alike
    2       heading against the route, t(angle / 0.15)
    3       speed, 2 v / v_max - 1
    4       angle of the front wheels, t(angle / 0.15)
    5, 6    last action
    7       yaw rate, t(rate / 0.3 per s)
    8       offset from the middle of the nearest lane, to the right, t(d / 0.5 m)
    9-18    checkpoints on the middle of the carriageway 8, 16, 26, 38 and 50 m ahead, each: bearing to the right,
            t(angle / 0.4), and heading of the route there, t(angle / 0.6), both against the ego's heading
    19-258  240 lidar rays, clockwise from straight ahead, as closeness: 0 free up to 50 m, 1 touching
    259-288 closeness, 1 - d / 40 m, of the nearest lidar hit within 1.2 m of 15 arcs that lead straight on with
            curvatures of -0.2, -0.14, -0.09, -0.06, -0.04, -0.025, -0.012, 0, 0.012, ..., 0.2 per m (to the right), then
            within 1.9 m of them
    289-306 closeness, alike, in 9 strips along the route, -3, -2.25, ..., 3 m to the right of its middle: within 0.6 m,
            then within 1.2 m
    307-354 change of the free distance of each of these 48 since the observation before, d / 1.5 m, negative where
            something comes nearer
    ======= ==============================================================================================

    The last 96, the corridors, are computed from the others and from those of the observation before
    (``sb3_chac.envs.driving.corridors``): which way is free, and who drives along, as an MLP hardly finds out from rays.
    ``corridors=False`` leaves them out.

    **Reward**: ``displacement_reward`` per metre of progress along the route, ``speed_reward`` v / v_max per step, less
    ``collision_penalty`` per collision, ``arrival_reward`` at the destination, less ``out_of_road_penalty`` off the
    carriageway (Section V of the paper).

    **Cost** (``info["cost"]``): 1 per collision, counted when a contact begins. Collisions do not end the episode: cones and
    triangles fall over; vehicles stop and are towed away after 5 s, and the ego stops if it ran into one.

    **Ends** (terminated): at the destination, and when the middle of the vehicle leaves the carriageway. Truncated after
    ``horizon`` steps.

    **Info**: ``cost``, ``collision`` (one began), ``contact`` (touching something), ``out_of_road``, ``arrive_dest``,
    ``is_success``, ``route_completion`` (0 to 1), ``speed`` [m/s], ``episode_cost``, ``scenario``.

    ``reset(options={"scenario": k})`` drives map k, any integer; otherwise the map is drawn from ``start_scenario``,
    ``start_scenario`` + 1, ...

    :param start_scenario: the first of the maps (by custom, 100-119 are for training, 1000-1049 for testing)
    :param num_scenarios: number of maps
    :param traffic_density: of moving vehicles, 0 (none) to 3; 1 is about one per 60 m of the route, two at each junction
        and ramp, and one per 100 m that comes the other way
    :param obstacle_density: 0 (none) to 1: share of the places for obstacles that have some
    :param blocks: how many blocks a map has (1 to 12), or their letters in order: S straight, C curve, R ramp,
        O roundabout, T T-intersection, X intersection
    :param horizon: [steps of 0.1 s] after which an episode is truncated
    :param displacement_reward: c_disp, per metre
    :param speed_reward: c_speed, per step at top speed
    :param collision_penalty: R_collision, subtracted per collision
    :param arrival_reward: R_term at the destination
    :param out_of_road_penalty: R_term off the road, subtracted
    :param corridors: whether the observation ends with the corridors
    :param render_mode: "rgb_array", "human" or None
    :param show_lidar: whether pictures show the lidar's rays
    :param show_corridors: whether pictures show how far the corridors are free: blue where 40 m, red where something is near
    :raises ValueError: for an argument out of its range
    """

    action_names = ("steering", "acceleration")

    @checked
    def __init__(
        self,
        start_scenario: int = 100,
        num_scenarios: int = 20,
        traffic_density: float = 0.6,
        obstacle_density: float = 0.25,
        blocks: int | str = 4,
        horizon: int = 1000,
        displacement_reward: float = 1.0,
        speed_reward: float = 0.1,
        collision_penalty: float = 5.0,
        arrival_reward: float = 10.0,
        out_of_road_penalty: float = 5.0,
        corridors: bool = True,
        render_mode: str | None = None,
        show_lidar: bool = False,
        show_corridors: bool = False,
    ) -> None:
        check_integer("start_scenario", start_scenario, low=-(2**62))
        check_integer("num_scenarios", num_scenarios, low=1)
        check_range("traffic_density", traffic_density, low=0, high=3)
        check_range("obstacle_density", obstacle_density, low=0, high=1)
        check_integer("horizon", horizon, low=1)
        if isinstance(blocks, str):
            if not 1 <= len(blocks) <= 12 or set(blocks) - set(BLOCKS):
                raise ValueError(f"blocks must be 1 to 12 letters out of {BLOCKS!r}, or a number of blocks, got {blocks!r}.")
        else:
            check_integer("blocks", blocks, low=1)
            check_range("blocks", blocks, low=1, high=12)
        coefficients = dict(
            displacement_reward=displacement_reward, speed_reward=speed_reward, collision_penalty=collision_penalty,
            arrival_reward=arrival_reward, out_of_road_penalty=out_of_road_penalty,
        )  # fmt: skip
        for name, value in coefficients.items():
            check_range(name, value, low=0.0)
        self._set_up(start_scenario, num_scenarios, render_mode)
        self.traffic_density, self.obstacle_density = traffic_density, obstacle_density
        self.blocks = blocks if isinstance(blocks, str) else int(blocks)
        self.horizon = int(horizon)
        self.displacement_reward, self.speed_reward, self.collision_penalty = (
            displacement_reward,
            speed_reward,
            collision_penalty,
        )
        self.arrival_reward, self.out_of_road_penalty = arrival_reward, out_of_road_penalty
        if show_corridors and not corridors:
            raise ValueError("show_corridors: there are none with corridors=False, leave out one of the two.")
        self.show_lidar, self.show_corridors = show_lidar, show_corridors if corridors else None

        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.lidar = Lidar()
        self._corridors = CorridorView(self.lidar.rays, self.lidar.reach) if corridors else None
        self._n_observation = N_STATE + self.lidar.rays + N_VIEW * corridors
        self.observation_space = spaces.Box(-1.0, 1.0, (self._n_observation,), np.float32)
        self._scenes: OrderedDict[int, Scene] = OrderedDict()

    # Scenes

    def _scene(self, scenario: int) -> Scene:
        """Return the scene of a scenario, made when it is first needed."""
        if scenario in self._scenes:
            self._scenes.move_to_end(scenario)
            return self._scenes[scenario]
        self._scenes[scenario] = make_scene(scenario, self.blocks, self.obstacle_density, self.traffic_density)
        if len(self._scenes) > SCENES_KEPT:
            self._scenes.popitem(last=False)
        return self._scenes[scenario]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        Begin an episode.

        :param options: {"scenario": k} to drive map k
        :raises ValueError: if k is not an integer
        """
        self._begin_episode(seed, options)
        self.scene = self._scene(self.scenario)
        self.map, self.traffic = self.scene.map, self.scene.traffic
        self.traffic.reset()
        self.s, self.lateral = 5.0, self.scene.lane
        self.ego = Ego(self.map.start.shifted(self.s, self.lateral))
        self.heading_error = 0.0
        self.last_action = np.zeros(2)
        self.contact, self.arrived, self.out_of_road = False, False, False
        self._tow: dict[int, int] = {}  # parked vehicle that was hit -> step at which it is gone
        self._find_boxes()
        if self._corridors is not None:
            self._corridors.reset()
        if self.render_mode == "human":
            self.render()
        return self._observe(), self._info()

    @property
    def observation_layout(self) -> list[dict[str, Any]]:
        """Name, first element, element after the last, unit and meaning of each part of an observation."""
        return layout(self.lidar.rays, corridors=self._corridors is not None)

    # Dynamics

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        ego = self.ego
        check_driving_action(action)
        action = np.minimum(np.maximum(np.asarray(action, dtype=float), -1.0), 1.0)
        before = Pose(ego.position[0], ego.position[1], ego.heading)
        action = self._move(action)
        previous_s = self.s
        self._locate()
        self.traffic.step(1 / STEPS_PER_SECOND, self.s, self.lateral, ego.speed, ego.position, ego.heading)
        self.steps += 1
        self.last_action = action
        for obstacle in [o for o, when in self._tow.items() if self.steps >= when]:
            self._tow.pop(obstacle)
            self.traffic.remove_obstacle(obstacle)
        self._find_boxes()
        self._collide(before)

        self.arrived = self.s >= self.map.finish
        self.out_of_road = abs(self.lateral) > HALF_WIDTH and not self.arrived
        reward = self.displacement_reward * (self.s - previous_s) + self.speed_reward * ego.speed / MAX_SPEED
        reward += self.arrival_reward * self.arrived - self.out_of_road_penalty * self.out_of_road
        reward -= self.collision_penalty * self.collisions
        if self.render_mode == "human":
            self.render()
        terminated = self.arrived or self.out_of_road
        return self._observe(), float(reward), terminated, self.steps >= self.horizon, self._info()

    def _move(self, action: np.ndarray) -> np.ndarray:
        """
        Move the ego for one step.

        :return: the action that was executed
        """
        self.ego.control(action[0], action[1])
        for _ in range(SUBSTEPS):
            self.ego.step(1 / (STEPS_PER_SECOND * SUBSTEPS))
        return action

    def _locate(self) -> None:
        """Find where the ego is on the route, close to where it was (the route may pass near itself)."""
        self.s, self.lateral, self.heading_error = locate(self.map.route, self.s, self.ego.position, self.ego.heading)

    def _find_boxes(self) -> None:
        """Collect everything that can be hit or seen: first the cars of the traffic that are there, then the obstacles."""
        traffic, scene = self.traffic, self.scene
        obstacles = scene.obstacle_positions, scene.obstacle_headings, scene.obstacle_sizes, traffic.obstacle_there
        self.box_positions, self.box_headings, self.box_lengths, self.box_widths = _boxes(
            traffic.positions, traffic.headings, *obstacles
        )

    @property
    def box_ids(self) -> list[tuple[str, int]]:
        """Kind ("car" or "obstacle") and index of each box."""
        obstacles = np.flatnonzero(self.traffic.obstacle_there)
        return [("car", int(i)) for i in self.traffic.visible] + [("obstacle", int(i)) for i in obstacles]

    def _collide(self, before: Pose) -> None:
        """
        Count the contacts that begin, and let them have their effect.

        :param before: pose of the ego before this step
        """
        ego = self.ego
        self.collisions, self.contact = 0, False
        d = self.box_positions - ego.position
        near = np.flatnonzero(d[:, 0] ** 2 + d[:, 1] ** 2 < (ego.LENGTH + CAR_LENGTH) ** 2)
        if len(near) == 0:
            return
        size = ego.LENGTH, ego.WIDTH
        boxes = self.box_positions[near], self.box_headings[near], self.box_lengths[near], self.box_widths[near]
        hits = near[boxes_overlap(ego.position, ego.heading, *size, *boxes)]
        box_ids = self.box_ids if len(hits) else []
        for i in hits:
            kind, index = box_ids[i]
            self._touch((kind, index))
            self.contact = True
            if kind == "obstacle" and self.map.obstacles[index].kind != "parked":
                self.traffic.remove_obstacle(index)
                continue
            if kind == "car":
                self.traffic.crash(index)
            else:
                self._tow.setdefault(index, self.steps + PARKED_TOWED_AFTER)
            if d[i] @ ego.direction > 0:  # the ego ran into it
                ego.position, ego.heading, ego.speed = np.array(before[:2]), before.heading, 0.0
        if len(hits):
            self._locate()
            self._find_boxes()

    # What the agent is told

    @property
    def corridors(self) -> np.ndarray | None:
        """Closeness of the nearest hit in each corridor of the last observation, see ``Corridors``; None without corridors."""
        return None if self._corridors is None else self._corridors.last

    def _observe(self) -> np.ndarray:
        ego = self.ego
        distances, self.seen = self.scan()
        observation = np.empty(self._n_observation, np.float32)
        off_lane = self.lateral - LANES[int(self.lateral > 0)]
        to_edge = min(max(self.lateral / HALF_WIDTH, -1.0), 1.0)
        observation[:N_EGO] = (
            to_edge, -to_edge, math.tanh(self.heading_error / 0.15),
            2 * ego.speed / MAX_SPEED - 1, math.tanh(ego.steering / 0.15), *self.last_action,
            math.tanh(ego.yaw_rate / 0.3), math.tanh(off_lane / 0.5),
        )  # fmt: skip
        observation[N_EGO:N_STATE] = navigation(self.map.route, self.s, ego.position, ego.heading)
        lidar = observation[N_STATE : N_STATE + self.lidar.rays]
        lidar[:] = 1 - distances / self.lidar.reach
        if self._corridors is not None:
            observation[N_STATE + self.lidar.rays :] = self._corridors(lidar, *route_ahead(observation))
        return observation

    def scan(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Cast the lidar's rays.

        :return: [m] distances along the lidar's rays, shape (240,), and indices of the boxes that can be seen
        """
        return self.lidar.scan(
            self.ego.position, self.ego.heading, self.box_positions, self.box_headings, self.box_lengths, self.box_widths
        )

    def _info(self) -> dict[str, Any]:
        return self._driving_info(
            contact=self.contact,
            out_of_road=self.out_of_road,
            arrived=self.arrived,
            route_completion=float(min(max(self.s / self.map.finish, 0.0), 1.0)),
            speed=self.ego.speed,
        )

    def scripted_driver(self, name: str = "scripted") -> ScriptedDriver:
        """
        Make a driver by its name.

        :param name: "scripted" (with a human's imperfections) or "scripted-ideal" (without)
        :return: a driver for this environment
        :raises ValueError: for another name
        """
        if name not in IMPERFECTIONS:
            raise ValueError(f"{name!r} is not a driver of SafeDrive, choose from {sorted(IMPERFECTIONS)}.")
        return ScriptedDriver(self, **IMPERFECTIONS[name])  # type: ignore[arg-type]

    @property
    def position(self) -> np.ndarray:
        """[m] of the ego, shape (2,)."""
        return self.ego.position.copy()

    # Pictures

    @property
    def guidance(self) -> Guidance:
        """Next junction, its distance, and the speed limit, which is the vehicle's top speed."""
        return guide(self.map.junctions, self.s, self.map.finish, MAX_SPEED)

    def _make_viewer(self) -> Display:
        from sb3_chac.envs.safedrive.render import Viewer

        return Viewer(self)

    def plot_map(self, axes: Any) -> None:
        """
        Draw the map of the current scenario.

        :param axes: of matplotlib, where the map of the current scenario is drawn, in metres, y downwards
        """
        from sb3_chac.envs.safedrive.plot import plot_map

        plot_map(self.map, axes)

    @property
    def road(self) -> Road:
        """highway-env's road of the current map: the lanes, without vehicles."""
        if self._road is None or self._road[0] is not self.map:
            from sb3_chac.envs.safedrive.roads import road_network

            self._road = self.map, Road(road_network(self.map))
        return self._road[1]

    _road: tuple[Map, Road] | None = None


@compiled
def _boxes(car_positions, car_headings, positions, headings, sizes, there):
    """
    Collect everything that can be hit or seen.

    :param positions: of the obstacles, shape (n, 2), with their headings, sizes (length, width) and whether they are there
    :return: positions, headings, lengths and widths of the cars, then of the obstacles that are there
    """
    n_cars, obstacles = len(car_headings), np.flatnonzero(there)
    boxes = np.empty((n_cars + len(obstacles), 2))
    boxes[:n_cars], boxes[n_cars:] = car_positions, positions[obstacles]
    lengths, widths = np.full(len(boxes), CAR_LENGTH), np.full(len(boxes), CAR_WIDTH)
    lengths[n_cars:], widths[n_cars:] = sizes[obstacles, 0], sizes[obstacles, 1]
    return boxes, np.concatenate((car_headings, headings[obstacles])), lengths, widths
