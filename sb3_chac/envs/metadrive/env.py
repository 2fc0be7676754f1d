"""MetaDriveSafety-v0: the simulator of the paper's experiments behind the interface of SafeDrive."""

from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_chac.common.arguments import checked
from sb3_chac.common.checks import check_driving_action, check_integer, check_range
from sb3_chac.common.contract import Guidance
from sb3_chac.envs.driving.corridors import N_CORRIDORS, N_VIEW, CorridorView
from sb3_chac.envs.driving.display import Display
from sb3_chac.envs.driving.env import CONTACT_MEMORY, DrivingEnv
from sb3_chac.envs.driving.guidance import guide
from sb3_chac.envs.metadrive.drivers import DRIVERS
from sb3_chac.envs.metadrive.observation import (
    LIDAR_REACH,
    N_LIDAR,
    N_OBSERVATION,
    OFFSET,
    SCALE,
    STRIPS,
    route_ahead,
)
from sb3_chac.envs.metadrive.route import Route
from sb3_chac.envs.metadrive.simulator import check_installed, is_headless, make_simulator, prepare, release

MAX_SCENARIO = 1_000_000
# MetaDrive's, which are lost if any of them is changed
SPAWN = {
    "use_special_color": True,
    "spawn_lane_index": (">", ">>", 0),
}
FULL_BRAKE = 1.5  # [m/s] that braking with all its might takes off the speed in a step, at least


class Preset(NamedTuple):
    """A published protocol. Both: maps of three blocks, accidents in four of five, collisions do not end the episode."""

    num_scenarios: int
    traffic_density: float
    max_speed: float  # [km/h]
    horizon: int  # [steps]


PRESETS = {
    "chac": Preset(num_scenarios=20, traffic_density=0.08, max_speed=35.0, horizon=2000),
    "pvp": Preset(num_scenarios=50, traffic_density=0.06, max_speed=80.0, horizon=1500),
}


class MetaDriveSafetyEnv(DrivingEnv):
    """
    MetaDrive's SafeMetaDriveEnv: drive through seeded maps of three blocks among traffic, cones, warning triangles, barriers
    and broken-down vehicles; ten decisions per second. One environment per process (see ``EngineInUse``).

    **Actions**, shape (2,), in [-1, 1]: steering (1 is 40 degrees of the front wheels to the left) and throttle or brake.

    **Observations**, shape (355,): MetaDrive's 259 numbers, each as (MetaDrive's - mean) / standard deviation (see
    ``envs.metadrive.observation``: about -1 to 1), rays as closeness, then the corridors. Of MetaDrive's, all in [0, 1]:

    ======= ==============================================================================================
    0, 1    distance to the left and to the right edge of the road, d / 18 m
    2       heading against the road's, to the right, (1 + sin(angle)) / 2
    3       speed, (v + 1 km/h) / (v_max + 1 km/h)
    4       steering; hardly moves, (action / 60 + 1) / 2
    5, 6    last action, (a + 1) / 2
    7       size of the yaw rate, per rad/s, 1 at most
    8       offset from the middle of the lane, to the right, (d / 2.25 m + 1) / 2
    9-13    checkpoint at the end of the road: how far ahead and to the left, each (d / 50 m + 1) / 2, at most 50 m away;
            radius of the road's leftmost lane, r / (60 m + width of the road), 0 if it is straight; way it bends, 0 left,
            0.5 straight, 1 right; angle by which it bends, (angle / 135 degrees + 1) / 2
    14-18   checkpoint at the end of the next road, alike; the same once more on the last road
    19-258  240 lidar rays, anticlockwise from straight ahead, as closeness: 0 free up to 50 m, 1 touching
    259-306 corridors, computed from the numbers above: closeness of the nearest ray's hit, 1 - d / 40 m, 0 if there is none
    307-354 change of the free distance of each of these 48 since the observation before, d / 1.5 m, negative where
            something comes nearer
    ======= ==============================================================================================

    Corridors 259-273 are along circular arcs of the curvatures -0.2 to 0.2 per metre, positive to the left (``CURVATURES`` of
    ``envs.driving.corridors``), 1.2 m to either side, and 274-288 the same, 1.9 m; 289-297 are along the route, in strips 4,
    3, 2, 1 m to the right of the middle of the road, on it, and as much to its left, 0.6 m to either side, and 298-306 the
    same, 1.2 m. The route is rebuilt from numbers 0 to 2 and 9 to 18 (``route_ahead``) and straight beyond them.

    With ``raw_observations`` they are MetaDrive's 259 as they are, rays as distances (1 is free), from which learning is far
    slower.

    **Reward**: MetaDrive's: metres along the lane + 0.1 v / v_max, but on a step in contact with something -5 in its place, on
    arrival +10, off the road or the route -5.

    **Cost** (``info["cost"]``): 1 per collision, counted when a contact begins. ``info["contact_cost"]`` is MetaDrive's own: 1
    on each step in contact with something, and for leaving the road.

    **Ends** (terminated): at the destination, off the road or off the route. Truncated after ``horizon`` steps, and when a
    contact has lasted for ``contact_limit`` steps: the ego cannot reverse and others do not make way, so that it may press
    against a vehicle to the horizon, at -5 a step. Neither MetaDrive nor the published protocols end that (None).

    **Info**: as SafeDrive's (``cost``, ``collision``, ``contact``, ``out_of_road``, ``arrive_dest``, ``is_success``,
    ``route_completion``, ``speed`` [m/s], ``episode_cost``, ``scenario``), and ``contact_cost``.

    ``reset(options={"scenario": k})`` drives map k; otherwise the map is drawn from ``start_scenario``,
    ``start_scenario`` + 1, ...

    In MetaDrive 0.4.3 a vehicle that brakes at a standstill creeps backwards; here the brake takes no more speed off than
    there is.

    :param preset: "chac" (the paper's) or "pvp" (that of PVP's authors): ``PRESETS``; the arguments below override it
    :param start_scenario: the first of the maps (by custom, training begins with 100, testing with 1000)
    :param num_scenarios: number of maps
    :param traffic_density: vehicles per 10 m of lane
    :param max_speed: [km/h] of the ego
    :param horizon: [steps of 0.1 s] after which an episode is truncated
    :param contact_limit: [steps of 0.1 s] that a contact may last until the episode is truncated, None for ever; shorter
        breaks than 10 steps do not interrupt it
    :param raw_observations: give MetaDrive's own 259 numbers as they are, without corridors
    :param corridors: whether the observation ends with the corridors
    :param headless: go without MetaDrive's assets, None to let the environment variable SB3_CHAC_METADRIVE_HEADLESS decide
    :param render_mode: "rgb_array", "human" or None: seen from above
    :raises ValueError: for an argument out of its range
    :raises DependencyNotInstalled: without MetaDrive
    :raises MissingAssets: see there
    :raises EngineInUse: for a second environment in this process
    """

    metadata: ClassVar[dict[str, Any]] = {**DrivingEnv.metadata, "steers_left": True}  # type: ignore[misc]
    action_names = ("steering", "throttle")

    @checked
    def __init__(
        self,
        preset: str = "chac",
        start_scenario: int = 100,
        num_scenarios: int | None = None,
        traffic_density: float | None = None,
        max_speed: float | None = None,
        horizon: int | None = None,
        contact_limit: int | None = 100,
        raw_observations: bool = False,
        corridors: bool = True,
        headless: bool | None = None,
        render_mode: str | None = None,
    ) -> None:
        if preset not in PRESETS:
            raise ValueError(f"preset must be one of {sorted(PRESETS)}, got {preset!r}.")
        given: dict[str, Any] = dict(
            num_scenarios=num_scenarios, traffic_density=traffic_density, max_speed=max_speed, horizon=horizon
        )
        settings = PRESETS[preset]._replace(**{name: value for name, value in given.items() if value is not None})
        check_integer("start_scenario", start_scenario, low=0)
        check_integer("num_scenarios", settings.num_scenarios, low=1)
        check_range("start_scenario + num_scenarios", start_scenario + settings.num_scenarios, high=MAX_SCENARIO)
        check_range("traffic_density", settings.traffic_density, low=0.0, high=1.0)
        check_range("max_speed", settings.max_speed, low=1.0, high=200.0)
        check_integer("horizon", settings.horizon, low=1)
        if contact_limit is not None:
            check_integer("contact_limit", contact_limit, low=1)
        self._set_up(start_scenario, settings.num_scenarios, render_mode)
        check_installed()
        prepare(is_headless(headless))
        self.horizon, self.contact_limit = int(settings.horizon), contact_limit
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.raw_observations = bool(raw_observations)
        self._corridors = CorridorView(N_LIDAR, LIDAR_REACH, STRIPS) if corridors and not raw_observations else None
        bounds = self._scaled(np.zeros(N_OBSERVATION)), self._scaled(np.ones(N_OBSERVATION))
        low, high = np.minimum(*bounds), np.maximum(*bounds)
        if self._corridors is not None:
            low = np.concatenate([low, np.zeros(N_CORRIDORS), -np.ones(N_VIEW - N_CORRIDORS)])
            high = np.concatenate([high, np.ones(N_VIEW)])
        self.observation_space = spaces.Box(low.astype(np.float32), high.astype(np.float32))
        self.simulator = make_simulator(
            self,
            dict(
                start_seed=0,
                num_scenarios=MAX_SCENARIO,
                map=3,
                traffic_density=float(settings.traffic_density),
                accident_prob=0.8,
                out_of_route_done=True,
                horizon=self.horizon,
                force_destroy=True,  # vehicles that are used again keep something, and episodes would depend on those before
                agent_configs={"default_agent": {**SPAWN, "max_speed_km_h": float(settings.max_speed)}},
            ),
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        Begin an episode.

        :param options: {"scenario": k} to drive map k
        :raises ValueError: if k is not an integer from 0 to 999,999
        """
        self._begin_episode(seed, options)
        observation, info = self.simulator.reset(seed=self.scenario)
        self._contact_began: int | None = None  # the step, of a contact that lasts
        info = self._info(info)
        if self._corridors is not None:
            self._corridors.reset()
        if self.render_mode == "human":
            self.render()
        return self._observed(observation), info

    def _check_scenario(self, name: str, value: Any) -> None:
        check_integer(name, value, low=0)
        check_range(name, value, high=MAX_SCENARIO - 1)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        check_driving_action(action)
        steering, throttle = np.clip(np.asarray(action, dtype=float), -1.0, 1.0)
        throttle = max(throttle, -max(self.forward_speed, 0.0) / FULL_BRAKE)
        observation, reward, terminated, truncated, info = self.simulator.step([steering, throttle])
        self.steps += 1
        self._count_collisions(info)
        truncated = bool(truncated) or (not terminated and self._contact_lasts_too_long())
        info = self._info(info)
        if self.render_mode == "human":
            self.render()
        return self._observed(observation), float(reward), bool(terminated), truncated, info

    def _count_collisions(self, info: dict[str, Any]) -> None:
        """
        Count the collisions that begin in this step.

        :param info: MetaDrive's
        """
        self.collisions = 0
        for name in self._touching(bool(info["crash_vehicle"]), bool(info["crash_object"])):
            self._touch(name)

    def _contact_lasts_too_long(self) -> bool:
        last = max(self._touched.values(), default=-CONTACT_MEMORY)
        if self.steps - last >= CONTACT_MEMORY:
            self._contact_began = None
        elif self._contact_began is None:
            self._contact_began = self.steps
        limit, began = self.contact_limit, self._contact_began
        return limit is not None and began is not None and last - began + 1 >= limit

    def _touching(self, vehicles: bool, objects: bool) -> set[str]:
        """
        Name the objects that touch the ego.

        :param vehicles: whether a vehicle touched the ego in this step
        :param objects: whether an object did
        :return: names of what did: what still does, or else the nearest of its kind within 15 m, or else its kind (MetaDrive
            removes a vehicle in the step that pushes it off its lane)
        """
        if not (vehicles or objects):
            return set()
        from metadrive.component.static_object.traffic_object import TrafficObject
        from metadrive.component.vehicle.base_vehicle import BaseVehicle

        engine, ego = self.simulator.engine, self.ego
        names = set()
        for kind, touched in ((BaseVehicle, vehicles), (TrafficObject, objects)):
            if touched:
                things = {
                    thing.name: thing
                    for thing in engine.get_objects().values()
                    if isinstance(thing, kind) and thing is not ego
                }
                distances = {name: np.hypot(*(np.array(thing.position) - ego.position)) for name, thing in things.items()}
                near = [name for name, distance in distances.items() if distance < 15.0]
                touching = {name for name in near if self._touches(things[name])}
                names |= touching or {min(near, key=distances.__getitem__, default=kind.__name__)}
        return names

    def _touches(self, thing: Any) -> bool:
        world = self.simulator.engine.physics_world.dynamic_world
        return world.contactTestPair(self.ego.chassis.node(), thing.body).getNumContacts() > 0

    def _info(self, info: dict[str, Any]) -> dict[str, Any]:
        """
        Build the info.

        :param info: MetaDrive's
        """
        self.last_info = self._driving_info(
            contact=bool(info["crash_vehicle"] or info["crash_object"]),
            out_of_road=bool(info["out_of_road"] and not info["arrive_dest"]),
            arrived=bool(info["arrive_dest"]),
            route_completion=1.0 if info["arrive_dest"] else float(np.clip(info["route_completion"], 0.0, 1.0)),
            speed=float(self.ego.speed),
        ) | {"contact_cost": float(info["cost"])}
        return dict(self.last_info)

    def _observed(self, observation: np.ndarray) -> np.ndarray:
        scaled = self._scaled(observation)
        if self._corridors is None:
            return scaled
        corridors = self._corridors(scaled[-N_LIDAR:], *route_ahead(scaled))
        return np.concatenate([scaled, corridors], dtype=np.float32)

    def _scaled(self, observation: np.ndarray) -> np.ndarray:
        clipped = np.clip(observation, 0.0, 1.0, dtype=np.float32)
        return clipped if self.raw_observations else (clipped - OFFSET) * SCALE

    @property
    def ego(self) -> Any:
        """MetaDrive's vehicle that the agent drives."""
        return self.simulator.agent

    @property
    def forward_speed(self) -> float:
        """[m/s], negative when going backwards."""
        return float(np.dot(self.ego.velocity, self.ego.heading))

    @property
    def position(self) -> np.ndarray:
        """[m] of the ego, shape (2,)."""
        return np.array(self.ego.position, dtype=float)

    def scripted_driver(self, name: str = "scripted") -> Any:
        """
        Make a driver by its name.

        :param name: "scripted" (with a human's imperfections), "scripted-ideal" (without), "idm" or "ppo" (MetaDrive's own)
        :return: a driver for this environment
        :raises ValueError: for another name
        """
        if name not in DRIVERS:
            raise ValueError(f"{name!r} is not a driver of MetaDriveSafety, choose from {sorted(DRIVERS)}.")
        return DRIVERS[name](self)

    # Pictures

    @property
    def guidance(self) -> Guidance:
        """Next junction, its distance, and the speed limit, which is the vehicle's top speed."""
        navigation = self.ego.navigation
        if self._route is None or not self._route.is_of(navigation):
            self._route = Route(navigation)
        s, _, _ = self._route.locate(self.position, *self._route.now(navigation))
        return guide(self._route.junctions, s, float(self._route.starts[-1]), float(self.ego.max_speed_km_h) / 3.6)

    _route: Route | None = None

    def _make_viewer(self) -> Display:
        from sb3_chac.envs.metadrive.render import Viewer

        return Viewer(self)

    def plot_map(self, axes: Any) -> None:
        """
        Draw the map of the current scenario.

        :param axes: of matplotlib, where the map of the current scenario is drawn, in metres
        """
        from sb3_chac.envs.metadrive.roads import plot_map

        plot_map(self, axes)

    def close(self) -> None:
        """Close the viewer and MetaDrive's engine."""
        super().close()
        release(self)
