"""The scene of a scenario: its map, its traffic, its obstacles, and where the ego starts."""

from typing import NamedTuple

import numpy as np

from sb3_chac.envs.safedrive.map import LANES, OBSTACLE_SIZES, Map
from sb3_chac.envs.safedrive.traffic import Traffic


class Scene(NamedTuple):
    """Map, traffic, obstacles and starting lane of a scenario."""

    map: Map
    traffic: Traffic
    lane: float  # [m] offset of the lane in which the ego starts
    obstacle_positions: np.ndarray
    obstacle_headings: np.ndarray
    obstacle_sizes: np.ndarray  # length and width


def make_scene(scenario: int, blocks: int | str, obstacle_density: float, traffic_density: float) -> Scene:
    """
    Make the scene of a scenario; what it stands for depends on nothing else.

    :param scenario: any integer
    :param blocks: see ``SafeDriveEnv``
    :param obstacle_density: see ``SafeDriveEnv``
    :param traffic_density: see ``SafeDriveEnv``
    """
    road_map = Map(scenario, blocks, obstacle_density)
    rng = np.random.default_rng([abs(scenario), int(scenario < 0), 1])
    lane = float(rng.choice(LANES))
    traffic = Traffic(road_map, traffic_density, rng)
    obstacles = road_map.obstacles
    s, lateral = np.array([(o.s, o.lateral) for o in obstacles]).reshape(-1, 2).T
    positions, headings = traffic.poses(np.zeros(len(s), dtype=int), s, lateral)
    sizes = np.array([OBSTACLE_SIZES[o.kind] for o in obstacles]).reshape(-1, 2)
    return Scene(road_map, traffic, lane, positions, headings, sizes)
