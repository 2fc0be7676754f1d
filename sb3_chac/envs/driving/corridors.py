"""Corridors: how far the ways ahead are free, computed from a lidar scan and a route that are in the observation already."""

import numpy as np
from gymnasium import spaces

FAR = 40.0  # [m] farther hits count as none
# [1/m] of circular arcs from the ego's position, tangent to its heading
CURVATURES = np.array([-0.2, -0.14, -0.09, -0.06, -0.04, -0.025, -0.012, 0, 0.012, 0.025, 0.04, 0.06, 0.09, 0.14, 0.2])
ARC_HALF_WIDTHS = np.array([1.2, 1.9])  # [m]
# Strips along the route
LATERALS = np.linspace(-3.0, 3.0, 9)  # [m] offsets of their middles from that of the route
STRIP_HALF_WIDTHS = np.array([0.6, 1.2])  # [m]
N_ARCS, N_STRIPS = len(ARC_HALF_WIDTHS) * len(CURVATURES), len(STRIP_HALF_WIDTHS) * len(LATERALS)
N_CORRIDORS = N_ARCS + N_STRIPS
N_VIEW = 2 * N_CORRIDORS  # what an observation holds of them
FASTEST = 1.5  # [m] change of a free distance within a step that is told from greater ones
STRIPS_BEGIN = 0.5  # [m] along the route, nearer hits are beside the ego
ROUTE_SPACING = 1.0  # [m] between the points of a route


class Corridors:
    """
    Closeness of the nearest lidar hit in arcs (where would this steering lead?) and in strips along the route.

    All coordinates are the ego's: x ahead, y to the side towards which the rays are numbered. Only hits ahead (x > 0) count.

    :param rays: number of lidar rays, in equal steps around the vehicle, ray 0 straight ahead
    :param reach: [m] of the rays
    """

    def __init__(self, rays: int, reach: float) -> None:
        angles = np.arange(rays) * 2 * np.pi / rays
        self.reach = reach
        self.ahead = np.flatnonzero(np.cos(angles) > 1e-9)
        self.cos, self.sin = np.cos(angles[self.ahead]), np.sin(angles[self.ahead])
        # A point is |k| (x^2 + y^2) / 2 - sign(k) y from an arc of curvature k, up to terms of second order, which are
        # in the bounds: -w + |k| w^2 / 2 and w + |k| w^2 / 2 are where the distance is exactly w
        self.bend = np.abs(CURVATURES)[:, None]
        self.side = np.where(CURVATURES < 0, -1.0, 1.0)[:, None]
        self.arc_centers = (self.bend * ARC_HALF_WIDTHS**2 / 2).T[:, :, None]
        self.arc_half_widths = ARC_HALF_WIDTHS[:, None, None]

    def __call__(self, closeness: np.ndarray, route: np.ndarray, headings: np.ndarray) -> np.ndarray:
        """
        Compute all corridors.

        :param closeness: of the lidar's hits, 0 (nothing within reach) to 1 (touching), shape (rays,)
        :param route: [m] points of the route, one per metre, the first beside the ego, shape (n, 2)
        :param headings: [rad] of the route there, shape (n,)
        :return: closeness of the nearest hit, 1 - distance / ``FAR``, shape (N_CORRIDORS,): arcs of both half-widths, then
            strips of both half-widths; 0 if there is none within ``FAR``
        """
        closeness = closeness[self.ahead]
        hit = np.flatnonzero(closeness > 1e-4)
        free = np.full(N_CORRIDORS, FAR)
        if len(hit):
            distances = (1.0 - closeness[hit]) * self.reach
            x, y = distances * self.cos[hit], distances * self.sin[hit]
            free[:N_ARCS] = self._arcs(np.maximum(x, 1e-6), y).ravel()
            free[N_ARCS:] = self._strips(x, y, route, headings).ravel()
        return 1.0 - np.minimum(free, FAR) / FAR

    def _arcs(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """
        Measure along the arcs.

        :return: [m] to the nearest hit along each arc, at least ``FAR`` if there is none, shape (widths, curvatures)
        """
        inwards = self.side * y
        offset = self.bend * ((x * x + y * y) / 2) - inwards
        cotangent = (1.0 - self.bend * inwards) / x  # of the angle along the arc, times |k|: the nearest hit has the greatest
        inside = np.abs(offset - self.arc_centers) < self.arc_half_widths
        nearest = np.where(inside, cotangent, -np.inf).max(axis=2)
        bend = np.maximum(self.bend[:, 0], 1e-9)
        return np.where(nearest > -np.inf, np.arctan2(bend, nearest) / bend, FAR)

    @staticmethod
    def _strips(x: np.ndarray, y: np.ndarray, route: np.ndarray, headings: np.ndarray) -> np.ndarray:
        """
        Project the hits on the nearest points of the route.

        :return: [m] to the nearest hit along each strip, at least ``FAR`` if there is none, shape (widths, laterals)
        """
        nearest = (x[:, None] * route[:, 0] + y[:, None] * route[:, 1] - (route * route).sum(axis=1) / 2).argmax(axis=1)
        cos, sin = np.cos(headings)[nearest], np.sin(headings)[nearest]
        dx, dy = x - route[nearest, 0], y - route[nearest, 1]
        along = nearest * ROUTE_SPACING + dx * cos + dy * sin
        along = np.where(along > STRIPS_BEGIN, along, FAR)
        inside = np.abs(dy * cos - dx * sin - LATERALS[:, None]) < STRIP_HALF_WIDTHS[:, None, None]
        return np.where(inside, along, FAR).min(axis=2)


class CorridorView:
    """
    Corridors, and how their free distances changed since the observation before: what stands comes nearer as fast as the ego
    drives, what drives along does not. Without the change a policy takes a lane for blocked in which all go on at its speed,
    stays in the other one, and runs into what stands there.

    :param rays: see ``Corridors``
    :param reach: [m], alike
    """

    def __init__(self, rays: int, reach: float) -> None:
        self.corridors = Corridors(rays, reach)
        self.reset()

    def reset(self) -> None:
        """Forget the observation before."""
        self.last: np.ndarray | None = None

    def __call__(self, closeness: np.ndarray, route: np.ndarray, headings: np.ndarray) -> np.ndarray:
        """
        Look at the next observation. The parameters are those of ``Corridors``.

        :return: all corridors, then the change of each free distance in units of ``FASTEST``, within [-1, 1], negative where
            something comes nearer, 0 in a first observation; shape (N_VIEW,)
        """
        here = self.corridors(closeness, route, headings)
        last, self.last = here if self.last is None else self.last, here
        return np.concatenate([here, np.clip((last - here) * (FAR / FASTEST), -1.0, 1.0)])


def corridors_remedy(trained_on: spaces.Space | None, given: spaces.Space | None) -> str:
    """
    Say what to do if two observation spaces differ by the corridors alone.

    :param trained_on: of a model or a dataset
    :param given: of the environment
    :return: a sentence, with a blank before it; empty if something else is the matter
    """
    sizes = [space.shape[0] if isinstance(space, spaces.Box) and len(space.shape) == 1 else 0 for space in (trained_on, given)]
    if abs(sizes[0] - sizes[1]) != N_VIEW:
        return ""
    flag = sizes[0] > sizes[1]
    return (
        f" {max(sizes)} numbers are with corridors, {min(sizes)} without: make the environment with corridors={flag} (on the "
        f"command line: --env-kwargs corridors:{flag})."
    )
