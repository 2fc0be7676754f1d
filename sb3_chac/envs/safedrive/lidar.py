"""Lidar: distances to the nearest box along rays, for all boxes and rays at once."""

import numpy as np

from sb3_chac.envs.driving.compiled import compiled


class Lidar:
    """
    Ray 0 looks ahead, the others follow clockwise as seen from above (to the right) in equal steps.

    :param rays: number of rays
    :param reach: [m] how far they see
    """

    def __init__(self, rays: int = 240, reach: float = 50.0) -> None:
        self.rays, self.reach = rays, reach
        angles = np.arange(rays) * 2 * np.pi / rays
        self.cos, self.sin = np.cos(angles), np.sin(angles)

    def scan(
        self,
        position: np.ndarray,
        heading: float,
        positions: np.ndarray,
        headings: np.ndarray,
        lengths: np.ndarray,
        widths: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Cast the rays by the slab method: a ray is inside a box while it is between both pairs of its parallel sides.

        :param position: of the lidar, shape (2,); ``heading`` is where ray 0 looks
        :param positions: centres of the boxes, shape (n, 2), with ``headings``, ``lengths`` and ``widths``, shape (n,)
        :return: [m] distances, ``reach`` where there is nothing, shape (rays,), and indices of the boxes that can be seen
        """
        return _scan(position, float(heading), positions, headings, lengths, widths, self.cos, self.sin, self.reach)


@compiled
def _scan(position, heading, positions, headings, lengths, widths, ray_cos, ray_sin, reach):
    nearest = np.full(len(ray_cos), reach)
    near = np.empty(len(positions), np.int64)
    distances = np.empty((len(positions), len(ray_cos)))  # of the boxes that are near
    n = 0
    for box in range(len(positions)):
        dx, dy = position[0] - positions[box, 0], position[1] - positions[box, 1]
        if dx * dx + dy * dy >= (reach + 3.0) ** 2:
            continue
        half_length, half_width = lengths[box] / 2, widths[box] / 2
        # Origin and directions of the rays in the frame of the box
        cos, sin = np.cos(headings[box]), np.sin(headings[box])
        x, y = dx * cos + dy * sin, dy * cos - dx * sin
        cos, sin = np.cos(heading - headings[box]), np.sin(heading - headings[box])
        for ray in range(len(ray_cos)):
            along, across = cos * ray_cos[ray] - sin * ray_sin[ray], sin * ray_cos[ray] + cos * ray_sin[ray]
            per_x = 1 / (along if abs(along) >= 1e-9 else 1e-9)
            per_y = 1 / (across if abs(across) >= 1e-9 else 1e-9)
            enters = max(-x * per_x - half_length * abs(per_x), -y * per_y - half_width * abs(per_y))
            leaves = min(-x * per_x + half_length * abs(per_x), -y * per_y + half_width * abs(per_y))
            distances[n, ray] = max(enters, 0.0) if leaves >= enters and leaves > 0 else np.inf
            nearest[ray] = min(nearest[ray], distances[n, ray])
        near[n] = box
        n += 1
    seen = np.array([(distances[i] <= nearest).any() for i in range(n)], np.bool_)
    return nearest, near[:n][seen]
