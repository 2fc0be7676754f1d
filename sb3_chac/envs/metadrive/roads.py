"""Lane and marking polygons of a MetaDrive map."""

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from sb3_chac.envs.metadrive.env import MetaDriveSafetyEnv

SAMPLING = 1  # [m] between two points of a line
LINE_WIDTH, DASH, DASHES_EVERY = 0.2, 3, 8  # [m]
OBJECTS = {"TrafficCone": "cone", "TrafficWarning": "triangle", "TrafficBarrier": "barrier"}  # MetaDrive's class -> kind
MARKERS = {"cone": ("^", "tab:orange"), "triangle": ("v", "tab:red"), "barrier": ("_", "tab:red"), "broken down": ("s", "0.3")}


class Patch(NamedTuple):
    """A piece of the map. kind: "lane", "route" (a lane that the ego may take), "line" or "yellow line"."""

    kind: str
    points: np.ndarray  # [m] corners, shape (n, 2)


class Thing(NamedTuple):
    """Something on the map that can be hit. kind: "vehicle", "broken down", "cone", "triangle" or "barrier"."""

    kind: str
    position: np.ndarray  # [m] shape (2,)
    heading: float  # [rad] anticlockwise
    length: float  # [m]
    width: float  # [m]


def patches(env: "MetaDriveSafetyEnv") -> Iterator[Patch]:
    """The map of the current scenario, to be painted one upon the other."""
    checkpoints = env.ego.navigation.checkpoints
    route = set(itertools.pairwise(checkpoints))
    graph = env.simulator.current_map.road_network.graph
    roads = [(start, end, lanes) for start, ends in graph.items() for end, lanes in ends.items()]
    for start, end, lanes in sorted(roads, key=lambda road: road[:2] in route):
        for lane in lanes:
            yield Patch("route" if (start, end) in route else "lane", np.array(lane.polygon)[:, :2])
    for feature in env.simulator.current_map.get_map_features(SAMPLING).values():
        if "LINE" in feature["type"]:
            kind = "yellow line" if "YELLOW" in feature["type"] else "line"
            points = np.array(feature["polyline"])[:, :2]
            step = DASHES_EVERY if "BROKEN" in feature["type"] else len(points)
            for first in range(0, len(points) - 1, step):
                yield Patch(kind, _ribbon(points[first : first + (DASH + 1 if "BROKEN" in feature["type"] else step)]))


def things(env: "MetaDriveSafetyEnv") -> Iterator[Thing]:
    """Everything on the road but the ego."""
    for thing in env.simulator.engine.get_objects().values():
        kind = OBJECTS.get(type(thing).__name__)
        if kind is None and hasattr(thing, "break_down"):
            kind = "broken down" if thing.break_down else "vehicle"
        if kind is not None and thing is not env.ego:
            yield Thing(kind, np.array(thing.position), float(thing.heading_theta), thing.LENGTH, thing.WIDTH)


def _ribbon(points: np.ndarray) -> np.ndarray:
    """
    Widen a line to a painted one.

    :param points: [m] of a line, shape (n, 2), n >= 2
    :return: [m] corners of the painted line, shape (2 n, 2)
    """
    along = np.gradient(points, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-6)
    across = LINE_WIDTH / 2 * np.stack([-along[:, 1], along[:, 0]], axis=1)
    return np.concatenate([points + across, (points - across)[::-1]])


def plot_map(env: "MetaDriveSafetyEnv", axes: "Axes") -> None:
    """
    Draw the map: all lanes grey, the route's darker; cones, warning triangles, barriers and broken-down vehicles; the start
    (dot) and the destination (star). Axes in metres.

    :param axes: where to draw
    """
    from matplotlib.collections import PolyCollection

    greys = {"lane": "0.88", "route": "0.75", "line": "white", "yellow line": "tab:olive"}
    painted = list(patches(env))
    colours = [greys[patch.kind] for patch in painted]
    corners: Any = [patch.points for patch in painted]
    axes.add_collection(PolyCollection(corners, facecolors=colours, edgecolors=colours, linewidths=0.2, zorder=1))
    seen = list(things(env))
    for kind, (marker, colour) in MARKERS.items():
        places = [thing.position for thing in seen if thing.kind == kind]
        if places:
            axes.plot(*zip(*places, strict=True), marker=marker, color=colour, linestyle="", markersize=3, zorder=2)
    axes.plot(*env.position, marker="o", color="black", markersize=5, zorder=2)
    axes.plot(*destination(env), marker="*", color="black", markersize=9, zorder=2)
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def destination(env: "MetaDriveSafetyEnv") -> np.ndarray:
    """
    Find the end of the route.

    :return: [m] middle of the lane at the end of the route, shape (2,)
    """
    lane = env.ego.navigation.final_lane
    return np.array(lane.position(lane.length - 5.0, 0.0))[:2]
