"""Description of SafeDrive's observation, part by part."""

from typing import Any

from sb3_chac.envs.driving.corridors import N_VIEW
from sb3_chac.envs.driving.layout import placed
from sb3_chac.envs.safedrive.navigation import N_EGO, N_STATE
from sb3_chac.envs.safedrive.vehicle import MAX_SPEED


def layout(rays: int, corridors: bool) -> list[dict[str, Any]]:
    """
    Describe the numbers of an observation.

    :param rays: of the lidar
    :param corridors: whether they follow
    :return: of an observation, see ``SafeDriveEnv.observation_layout``; t is tanh
    """
    parts = [
        ("left_edge", 1, "m", "distance d to the left edge of the carriageway, d / 4 - 1"),
        ("right_edge", 1, "m", "distance d to the right edge of the carriageway, d / 4 - 1"),
        ("heading_error", 1, "rad", "heading against the route, t(angle / 0.15)"),
        ("speed", 1, "m/s", f"2 v / {MAX_SPEED:g} - 1"),
        ("steering_angle", 1, "rad", "angle of the front wheels, positive to the right, t(angle / 0.15)"),
        ("last_action", 2, "1", "last action"),
        ("yaw_rate", 1, "rad/s", "positive to the right, t(rate / 0.3)"),
        ("lane_offset", 1, "m", "offset from the middle of the nearest lane, to the right, t(d / 0.5)"),
        ("checkpoints", N_STATE - N_EGO, "rad", "8, 16, 26, 38, 50 m ahead: bearing t(angle / 0.4), heading t(angle / 0.6)"),
        ("lidar", rays, "m", "closeness 1 - d / 50, clockwise from straight ahead"),
    ]
    if corridors:
        parts += [
            ("corridors", N_VIEW // 2, "m", "closeness 1 - d / 40 in arcs, then in strips along the route"),
            ("corridor_changes", N_VIEW // 2, "m", "change of each free distance since the observation before, d / 1.5"),
        ]
    return placed(parts)
