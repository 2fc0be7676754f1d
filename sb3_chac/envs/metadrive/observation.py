"""MetaDrive's observation: how it is scaled, and the route that is rebuilt from it."""

import math

import numpy as np

from sb3_chac.envs.driving.corridors import FAR, LATERALS, ROUTE_SPACING, route_along

N_EGO, N_CHECKPOINT, N_LIDAR = 9, 5, 240  # of the ego, of each of two checkpoints, rays
N_OBSERVATION = N_EGO + 2 * N_CHECKPOINT + N_LIDAR
# Of MetaDrive's first 19 observations, the others are lidar: means and standard deviations where novice and human drive
# (benchmarks/metadrive_safety.py observations). The fifth, the steering, hardly moves in MetaDrive 0.4.3: it is left small
MEANS = [0.3, 0.3, 0.5, 0.75, 0.5, 0.5, 0.64, 0.28, 0.5, 0.71, 0.49, 0.17, 0.5, 0.6, 0.87, 0.49, 0.12, 0.48, 0.58]
STDS = [0.15, 0.17, 0.1, 0.2, 0.1, 0.12, 0.16, 0.2, 0.17, 0.15, 0.1, 0.28, 0.29, 0.15, 0.12, 0.2, 0.23, 0.26, 0.13]
# (MetaDrive's - OFFSET) * SCALE is what the agent sees; rays become closeness
OFFSET = np.array([*MEANS, *[1.0] * N_LIDAR], dtype=np.float32)
SCALE = np.array([*[1 / std for std in STDS], *[-1.0] * N_LIDAR], dtype=np.float32)
# In MetaDrive's units
LIDAR_REACH, CHECKPOINT_REACH = 50.0, 50.0  # [m]
WIDEST_ROAD, LANE_WIDTH = 18.0, 3.5  # [m]
WIDEST_BEND, LONGEST_BEND = 60.0, math.radians(135.0)  # [m] radius, to which the width of the road is added, and [rad]
STRIPS = LATERALS * (4.0 / 3.0)  # [m]: three lanes of 3.5 m less the width of a car
ROUTE = np.arange(0.0, FAR + ROUTE_SPACING / 2, ROUTE_SPACING)  # [m] where the route is rebuilt


def route_ahead(observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Rebuild the middle of the route from a scaled observation: two roads, each straight or an arc, and straight on.

    Width, offset and heading of the first road are observed at the ego, its end is the first checkpoint; the second road
    goes on from there to the second one. How they bend is observed, too.

    :param observation: shape (259,) or longer
    :return: [m] points every metre from beside the ego to 40 m ahead, in the ego's frame, x ahead and y to the left, shape
        (41, 2), and [rad] the route's headings there, shape (41,)
    """
    values = (observation[: len(MEANS)] / SCALE[: len(MEANS)] + OFFSET[: len(MEANS)]).astype(float).tolist()
    left, right = values[0] * WIDEST_ROAD, values[1] * WIDEST_ROAD
    lateral, width = (left - right) / 2, left + right
    (x, y), curvature, _ = _road(values[N_EGO : N_EGO + N_CHECKPOINT], width)
    (next_x, next_y), next_curvature, angle = _road(values[N_EGO + N_CHECKPOINT :], width)
    distance = math.hypot(x, y)
    seen = distance < CHECKPOINT_REACH - 0.01
    heading = math.asin(min(max(2 * values[2] - 1, -1.0), 1.0))
    if not curvature and x > 5.0:  # the observed heading is against the rightmost lane, which leaves the road at a ramp
        far = math.atan2(y, x)
        near = far - math.asin(min(max(lateral / distance, -1.0), 1.0))
        heading = near if seen else min(max(heading, min(near, far)), max(near, far))
    cos, sin = math.cos(heading), math.sin(heading)
    start = -sin * lateral, cos * lateral
    along, across = (x - start[0]) * cos + (y - start[1]) * sin, (y - start[1]) * cos - (x - start[0]) * sin
    if curvature and seen:
        length = math.atan2(along * abs(curvature), 1 - across * curvature) / abs(curvature)
    else:
        length = along if seen else FAR
    next_length = math.hypot(next_x - x, next_y - y)  # 0 on the last road, which is both roads
    if next_length > 0.01 and next_curvature:
        next_length = angle / abs(next_curvature)
    elif math.hypot(next_x, next_y) > CHECKPOINT_REACH - 0.01:
        next_length = FAR
    headings = heading + curvature * np.minimum(ROUTE, length) + next_curvature * np.clip(ROUTE - length, 0.0, next_length)
    return route_along(*start, headings), headings


def _road(values: list[float], width: float) -> tuple[tuple[float, float], float, float]:
    """
    Rebuild a road from the observation of its end.

    :param values: of a checkpoint, as MetaDrive gives them, each in [0, 1]
    :param width: [m] of the road
    :return: position [m] of the checkpoint, curvature [1/m] of the middle of the road that ends there, positive to the left,
        0 if it is straight, and angle [rad] by which it bends
    """
    position = (2 * values[0] - 1) * CHECKPOINT_REACH, (2 * values[1] - 1) * CHECKPOINT_REACH
    radius = values[2] * (WIDEST_BEND + width)  # of the leftmost lane
    if radius < 0.5:
        return position, 0.0, 0.0
    turn = 1.0 if values[3] < 0.5 else -1.0
    return position, turn / (radius + turn * (width - LANE_WIDTH) / 2), (2 * values[4] - 1) * LONGEST_BEND
