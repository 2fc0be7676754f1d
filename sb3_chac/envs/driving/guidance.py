"""Guidance as of a navigation system: the next junction on the route, the way through it, and how far it is."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_chac.common.contract import Guidance
from sb3_chac.envs.driving.geometry import wrap_angle

WAYS = ("left", "straight", "right")
EXITS = {"right": "1st exit", "straight": "2nd exit", "left": "3rd exit"}  # of roundabouts with four arms


class Junction(NamedTuple):
    """Junction on a route."""

    start: float  # [m] along the route
    end: float
    way: str  # of WAYS
    is_roundabout: bool


def way_through(angle: float) -> str:
    """
    Name the way through a junction.

    :param angle: [rad] by which the heading changes in it, positive to the right
    :return: of WAYS
    """
    return WAYS[int(np.rint(np.clip(wrap_angle(angle) / (np.pi / 2), -1, 1))) + 1]


def guide(junctions: Sequence[Junction], s: float, finish: float, speed_limit: float) -> Guidance:
    """
    Tell the next junction, or the destination if there is none before it.

    :param junctions: of the route, in order
    :param s: [m] along the route
    :param finish: [m] along the route, where the destination is
    :param speed_limit: [m/s]
    """
    for junction in junctions:
        if s < junction.end:
            way = EXITS[junction.way] if junction.is_roundabout else junction.way
            return Guidance(way, max(junction.start - s, 0.0), speed_limit)
    return Guidance("goal", max(finish - s, 0.0), speed_limit)
