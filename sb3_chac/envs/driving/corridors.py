"""Corridors: how far the ways ahead are free, computed from a lidar scan and a route that are in the observation already."""

import numpy as np
from gymnasium import spaces

from sb3_chac.envs.driving.compiled import compiled

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
    :param laterals: [m] offsets of the strips' middles from that of the route, shape (9,)
    """

    def __init__(self, rays: int, reach: float, laterals: np.ndarray = LATERALS) -> None:
        angles = np.arange(rays) * 2 * np.pi / rays
        self.reach, self.laterals = reach, laterals
        self.ahead = np.flatnonzero(np.cos(angles) > 1e-9)
        self.cos, self.sin = np.cos(angles[self.ahead]), np.sin(angles[self.ahead])

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
            free[:N_ARCS] = _arcs(np.maximum(x, 1e-6), y).ravel()
            free[N_ARCS:] = _strips(x, y, route, headings, self.laterals).ravel()
        return 1.0 - np.minimum(free, FAR) / FAR


@compiled
def _arcs(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """
    Measure along the arcs.

    A point is |k| (x^2 + y^2) / 2 - sign(k) y from an arc of curvature k, up to terms of second order, which are in the
    bounds: -w + |k| w^2 / 2 and w + |k| w^2 / 2 are where the distance is exactly w.

    :param x: [m] of the hits ahead, greater than 0; with y, shape (hits,)
    :return: [m] to the nearest hit along each arc, at least ``FAR`` if there is none, shape (widths, curvatures)
    """
    free = np.full((len(ARC_HALF_WIDTHS), len(CURVATURES)), FAR)
    nearest = np.empty(len(ARC_HALF_WIDTHS))
    for arc in range(len(CURVATURES)):
        bend, side = abs(CURVATURES[arc]), -1.0 if CURVATURES[arc] < 0 else 1.0
        nearest[:] = -np.inf
        for hit in range(len(x)):
            inwards = side * y[hit]
            offset = bend * ((x[hit] * x[hit] + y[hit] * y[hit]) / 2) - inwards
            cotangent = (1.0 - bend * inwards) / x[hit]  # of the angle along the arc, times |k|: greatest at the nearest hit
            for width in range(len(ARC_HALF_WIDTHS)):
                half_width = ARC_HALF_WIDTHS[width]
                if abs(offset - bend * half_width**2 / 2) < half_width:
                    nearest[width] = max(nearest[width], cotangent)
        for width in range(len(ARC_HALF_WIDTHS)):
            if nearest[width] > -np.inf:
                free[width, arc] = np.arctan2(max(bend, 1e-9), nearest[width]) / max(bend, 1e-9)
    return free


@compiled
def _strips(x: np.ndarray, y: np.ndarray, route: np.ndarray, headings: np.ndarray, laterals: np.ndarray) -> np.ndarray:
    """
    Project the hits on the nearest points of the route.

    :param laterals: [m] offsets of the strips' middles from the route
    :return: [m] to the nearest hit along each strip, at least ``FAR`` if there is none, shape (widths, laterals)
    """
    free = np.full((len(STRIP_HALF_WIDTHS), len(laterals)), FAR)
    half_squares = (route[:, 0] * route[:, 0] + route[:, 1] * route[:, 1]) / 2
    for hit in range(len(x)):
        nearest = np.argmax(x[hit] * route[:, 0] + y[hit] * route[:, 1] - half_squares)
        cos, sin = np.cos(headings[nearest]), np.sin(headings[nearest])
        dx, dy = x[hit] - route[nearest, 0], y[hit] - route[nearest, 1]
        along, across = nearest * ROUTE_SPACING + dx * cos + dy * sin, dy * cos - dx * sin
        if along > STRIPS_BEGIN:
            for width in range(len(STRIP_HALF_WIDTHS)):
                for strip in range(len(laterals)):
                    if abs(across - laterals[strip]) < STRIP_HALF_WIDTHS[width]:
                        free[width, strip] = min(free[width, strip], along)
    return free


@compiled
def route_along(x: float, y: float, headings: np.ndarray) -> np.ndarray:
    """
    Integrate the headings of a route.

    :param x: [m] of its first point, with ``y``
    :param headings: [rad] at its points, which are ``ROUTE_SPACING`` apart, shape (n,)
    :return: [m] its points, shape (n, 2)
    """
    cos, sin = np.cos(headings), np.sin(headings)
    route = np.empty((len(headings), 2))
    route[0, 0], route[0, 1] = x, y
    for i in range(1, len(headings)):
        route[i, 0] = route[i - 1, 0] + (cos[i] + cos[i - 1]) * (ROUTE_SPACING / 2)
        route[i, 1] = route[i - 1, 1] + (sin[i] + sin[i - 1]) * (ROUTE_SPACING / 2)
    return route


class CorridorView:
    """
    Corridors, and how their free distances changed since the observation before: what stands comes nearer as fast as the ego
    drives, what drives along does not. Without the change a policy takes a lane for blocked in which all go on at its speed,
    stays in the other one, and runs into what stands there.

    The parameters are those of ``Corridors``.
    """

    def __init__(self, rays: int, reach: float, laterals: np.ndarray = LATERALS) -> None:
        self.corridors = Corridors(rays, reach, laterals)
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
