"""Lidar: distances to the nearest box along rays, for all boxes and rays at once."""

import numpy as np


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
        Slab method: a ray is inside a box while it is between both pairs of its parallel sides.

        :param position: of the lidar, shape (2,); ``heading`` is where ray 0 looks
        :param positions: centres of the boxes, shape (n, 2), with ``headings``, ``lengths`` and ``widths``, shape (n,)
        :return: [m] distances, ``reach`` where there is nothing, shape (rays,), and indices of the boxes that can be seen
        """
        d = position - positions
        near = np.flatnonzero(d[:, 0] ** 2 + d[:, 1] ** 2 < (self.reach + 3.0) ** 2)
        if len(near) == 0:
            return np.full(self.rays, self.reach), near
        d, headings, half_length, half_width = d[near], headings[near], lengths[near, None] / 2, widths[near, None] / 2
        # Origin and directions of the rays in the frame of each box: (n, 1) and (n, rays)
        cos, sin = np.cos(headings), np.sin(headings)
        x = (d[:, 0] * cos + d[:, 1] * sin)[:, None]
        y = (d[:, 1] * cos - d[:, 0] * sin)[:, None]
        cos, sin = np.cos(heading - headings)[:, None], np.sin(heading - headings)[:, None]
        along, across = cos * self.cos - sin * self.sin, sin * self.cos + cos * self.sin
        per_x = 1 / np.where(np.abs(along) < 1e-9, 1e-9, along)
        per_y = 1 / np.where(np.abs(across) < 1e-9, 1e-9, across)
        middle_x, middle_y = -x * per_x, -y * per_y
        reach_x, reach_y = half_length * np.abs(per_x), half_width * np.abs(per_y)
        enters = np.maximum(middle_x - reach_x, middle_y - reach_y)
        leaves = np.minimum(middle_x + reach_x, middle_y + reach_y)
        hits = (leaves >= enters) & (leaves > 0)
        distances = np.where(hits, np.maximum(enters, 0.0), np.inf)
        nearest = distances.min(axis=0, initial=self.reach)
        return nearest, near[(distances <= nearest).any(axis=1)]
