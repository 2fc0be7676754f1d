"""Position of the ego on its route, and the way ahead in its observation."""

import numpy as np

from sb3_chac.envs.driving.compiled import compiled
from sb3_chac.envs.driving.corridors import ROUTE_SPACING, route_along
from sb3_chac.envs.driving.geometry import SPACING
from sb3_chac.envs.safedrive.map import HALF_WIDTH

CHECKPOINTS = np.array([8.0, 16.0, 26.0, 38.0, 50.0])  # [m] ahead on the route
N_EGO, N_NAVIGATION = 9, 2 * len(CHECKPOINTS)
N_STATE = N_EGO + N_NAVIGATION  # numbers before the lidar
ROUTE = np.arange(0.0, CHECKPOINTS[-1] + ROUTE_SPACING / 2, ROUTE_SPACING)  # [m] where the route is rebuilt from them
# Where the observation tells headings of the route (beside the ego, at the checkpoints), and [rad] what they are scaled by
ROUTE_KNOTS = np.array([0.0, *CHECKPOINTS])  # [m]
ROUTE_HEADINGS = np.array([2, *range(N_EGO + 1, N_STATE, 2)])
ROUTE_HEADING_SCALES = np.array([-0.15] + [0.6] * len(CHECKPOINTS), np.float32)


@compiled
def locate(route: np.ndarray, s: float, position: np.ndarray, heading: float) -> tuple[float, float, float]:
    """
    Find where a vehicle is on the route, close to where it was (the route may pass near itself).

    :param s: [m] along the route, where it was
    :return: s [m], lateral [m] and the heading against that of the route [rad]
    """
    first = max(0, int(s / SPACING) - 16)
    dx, dy = position[0] - route[first : first + 40, 0], position[1] - route[first : first + 40, 1]
    nearest = np.argmin(dx**2 + dy**2)
    x, y, there, curvature = dx[nearest], dy[nearest], route[first + nearest, 2], route[first + nearest, 3]
    along = x * np.cos(there) + y * np.sin(there)
    lateral = y * np.cos(there) - x * np.sin(there)
    error = heading - there - curvature * along
    return (first + nearest) * SPACING + along, lateral, (error + np.pi) % (2 * np.pi) - np.pi


@compiled
def navigation(route: np.ndarray, s: float, position: np.ndarray, heading: float) -> np.ndarray:
    """
    Observe the checkpoints ahead.

    :param s: [m] along the route
    :param heading: [rad] of the ego
    :return: for each checkpoint its bearing and the heading of the route there, as they are observed, shape (N_NAVIGATION,)
    """
    told = np.empty(N_NAVIGATION)
    for i in range(len(CHECKPOINTS)):
        point = route[min(int((s + CHECKPOINTS[i]) / SPACING), len(route) - 1)]
        bearing = np.arctan2(point[1] - position[1], point[0] - position[0]) - heading
        told[2 * i] = np.tanh(((bearing + np.pi) % (2 * np.pi) - np.pi) / 0.4)
        told[2 * i + 1] = np.tanh(((point[2] - heading + np.pi) % (2 * np.pi) - np.pi) / 0.6)
    return told


def route_ahead(observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Rebuild the middle of the route from an observation: its direction at the ego and at the checkpoints, integrated.

    :param observation: shape (259,) or longer
    :return: [m] points every metre from beside the ego to 50 m ahead, in the ego's frame, shape (51, 2), and [rad] the
        route's headings there, shape (51,)
    """
    tanhs = np.minimum(np.maximum(observation[ROUTE_HEADINGS], -0.999999), 0.999999)
    headings = np.interp(ROUTE, ROUTE_KNOTS, np.arctanh(tanhs) * ROUTE_HEADING_SCALES)
    lateral = float(observation[0] * HALF_WIDTH)
    return route_along(np.sin(headings[0]) * lateral, -np.cos(headings[0]) * lateral, headings), headings
