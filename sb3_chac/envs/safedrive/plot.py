"""The map of a scenario as a matplotlib plot."""

from typing import TYPE_CHECKING

from sb3_chac.envs.driving.geometry import SPACING
from sb3_chac.envs.safedrive.geometry import Pose
from sb3_chac.envs.safedrive.map import Map
from sb3_chac.envs.safedrive.roads import areas

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GREYS = {"asphalt": "0.85", "route": "0.72", "grass": "white", "trees": "white"}
MARKERS = {"cone": ("^", "tab:orange"), "triangle": ("v", "tab:red"), "parked": ("s", "0.3")}


def plot_map(road_map: Map, axes: "Axes") -> None:
    """
    Draw a map: all roads grey, the ego's carriageway darker; cones (orange, upwards), warning triangles (red, downwards) and
    parked vehicles (squares); the start (dot) and the destination (star). Axes in metres, y downwards: right turns turn right.

    :param axes: where to draw
    """
    from matplotlib.collections import PolyCollection

    painted = [area for area in areas(road_map, road_map.finish) if area.kind in GREYS]
    colours = [GREYS[area.kind] for area in painted]
    axes.add_collection(
        PolyCollection([area.points for area in painted], facecolors=colours, edgecolors=colours, linewidths=0.2, zorder=1)
    )
    for kind, (marker, colour) in MARKERS.items():
        places = [_on_route(road_map, o.s, o.lateral) for o in road_map.obstacles if o.kind == kind]
        if places:
            axes.plot(*zip(*places, strict=True), marker=marker, color=colour, linestyle="", markersize=3, zorder=2)
    axes.plot(*_on_route(road_map, 0.0, 0.0), marker="o", color="black", markersize=5, zorder=2)
    axes.plot(*_on_route(road_map, road_map.finish, 0.0), marker="*", color="black", markersize=9, zorder=2)
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    if not axes.yaxis_inverted():
        axes.invert_yaxis()
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def _on_route(road_map: Map, s: float, lateral: float) -> tuple[float, float]:
    """
    Convert coordinates of the route.

    :param s: [m] along the route
    :param lateral: [m] to the right of it
    """
    pose = Pose(*road_map.route[int(s / SPACING), :3]).shifted(s % SPACING, lateral)
    return pose.x, pose.y
