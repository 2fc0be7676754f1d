"""SafeDrive as a picture: seen from above, the route upwards. Needs no display unless a window is asked for."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from sb3_chac.envs.driving.corridors import CURVATURES, FAR, LATERALS, N_ARCS
from sb3_chac.envs.driving.display import (
    ASPHALT,
    BLACK,
    FINE,
    GRASS,
    LINE,
    PARKED,
    ROUTE,
    TRAFFIC,
    Area,
    Display,
    turned,
)  # fmt: skip
from sb3_chac.envs.driving.geometry import SPACING
from sb3_chac.envs.safedrive.roads import areas
from sb3_chac.envs.safedrive.traffic import CRASHED

if TYPE_CHECKING:
    from sb3_chac.envs.safedrive.env import SafeDriveEnv

UP = -5.0, 15.0  # [m] before the ego on the route, places of which the second is above the first
WAY = 100.0  # [m] of the route ahead, farther than any picture shows
ARROWS, ARROW_SPACING = 9, 10.0  # number, [m] on the route

COLOURS = {
    "grass": GRASS, "trees": (104, 134, 88), "kerb": (214, 212, 204), "asphalt": ASPHALT, "route": ROUTE, "line": LINE,
    "black": BLACK,
}  # fmt: skip
WRECK, HAZARD = (225, 50, 45), (255, 180, 0)
FREE = (90, 190, 255)  # of corridors that are free
ARROW, RAY, ECHO = (140, 176, 158), (190, 225, 140), (250, 255, 80)


class Viewer(Display):
    """
    View of SafeDrive from above.

    :param env: the environment to show
    """

    env: "SafeDriveEnv"

    def _paint(self) -> None:
        env = self.env
        self._look_along_route()
        self._paint_map(env.map, self._areas)
        self._paint_arrows()
        obstacles = []
        for (kind, index), position, heading in zip(env.box_ids, env.box_positions, env.box_headings, strict=True):
            if kind == "car":
                self._paint_vehicle(position, heading, WRECK if env.traffic.state[index] == CRASHED else TRAFFIC)
            elif env.map.obstacles[index].kind == "parked":
                self._paint_parked(position, heading)
            else:
                obstacles.append((env.map.obstacles[index].kind, position))
        if env.show_corridors:
            self._paint_corridors()
        if env.show_lidar:
            self._paint_lidar()
        self._paint_vehicle(env.ego.position, env.ego.heading, self._ego_colour, env.ego.steering)
        for kind, position in obstacles:
            self._paint_sign(kind, self._to_canvas(position))
        self._finish(env._info())

    def _look_along_route(self) -> None:
        """The direction of the route upwards: steadier than the ego's own heading."""
        x, y = self._on_route(self.env.s + UP[1]) - self._on_route(self.env.s + UP[0])
        env = self.env
        way = env.map.route[self._index(env.s) : self._index(env.s + WAY) : int(1 / SPACING), :2]
        self._look(env.ego.position, float(np.arctan2(y, x)), env.ego.speed, np.vstack([env.ego.position, way]))

    def _on_route(self, s: float) -> np.ndarray:
        """
        Find a point of the route.

        :param s: [m] along the route; beyond its end it goes on straight
        :return: [m], shape (2,)
        """
        x, y, heading, _ = self.env.map.route[self._index(s)]
        rest = s - self._index(s) * SPACING
        return np.array([x + rest * np.cos(heading), y + rest * np.sin(heading)])

    def _index(self, s: float) -> int:
        """Return the index of the point of the route that is nearest to ``s`` [m]."""
        return int(np.clip(s / SPACING, 0, len(self.env.map.route) - 1))

    def _areas(self) -> Iterable[Area]:
        for area in areas(self.env.map, self.env.map.finish):
            yield COLOURS[area.kind], area.points

    def _paint_arrows(self) -> None:
        """Along the route ahead."""
        shape = np.array([(1.0, 0.0), (-1.0, -3.2), (-2.0, -3.2), (0.0, 0.0), (-2.0, 3.2), (-1.0, 3.2)])
        env = self.env
        for s in (np.ceil(env.s / ARROW_SPACING) + np.arange(1, ARROWS)) * ARROW_SPACING:
            if s < env.map.finish - 2.0:
                heading = env.map.route[int(s / SPACING), 2]
                self._polygon(ARROW, self._on_route(s) + shape @ turned(heading))

    def _paint_lidar(self) -> None:
        env, draw = self.env, self.pygame.draw
        distances = env.scan()[0]
        angles = env.ego.heading + np.arange(env.lidar.rays) * 2 * np.pi / env.lidar.rays
        hits = env.ego.position + distances[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        start = self._to_canvas(env.ego.position)
        for end, distance in zip(self._to_canvas(hits), distances, strict=True):
            draw.line(self.canvas, RAY, start, end)
            if distance < env.lidar.reach:
                draw.circle(self.canvas, ECHO, end, 2.5 * FINE)

    def _paint_corridors(self) -> None:
        """The narrow strips along the route and the narrow arcs of the ego, as far as each is free."""
        env = self.env
        if env.corridors is None:
            return
        free = FAR * (1 - env.corridors)
        for offset, reach in zip(LATERALS, free[N_ARCS : N_ARCS + len(LATERALS)], strict=True):
            s = np.linspace(env.s, env.s + reach, 20)
            x, y, heading = np.array([(*self._on_route(a), env.map.route[self._index(a), 2]) for a in s]).T
            self._paint_way(np.stack([x - offset * np.sin(heading), y + offset * np.cos(heading)], axis=1), reach)
        for curvature, reach in zip(CURVATURES, free[: len(CURVATURES)], strict=True):
            angles = np.linspace(0, min(reach * abs(curvature), np.pi), 20)
            if curvature == 0:
                points = np.stack([np.linspace(0, reach, 20), np.zeros(20)], axis=1)
            else:
                points = np.stack([np.sin(angles) / abs(curvature), (1 - np.cos(angles)) / curvature], axis=1)
            self._paint_way(env.ego.position + points @ turned(env.ego.heading), reach)

    def _paint_way(self, points: np.ndarray, reach: float) -> None:
        """
        Paint one corridor.

        :param points: [m] on it, shape (n, 2)
        :param reach: [m] as far as it is free
        """
        share = reach / FAR
        colour = tuple(int(near + share * (free - near)) for near, free in zip(WRECK, FREE, strict=True))
        self.pygame.draw.lines(self.canvas, colour, False, self._to_canvas(points).tolist(), 2 * FINE)

    def _paint_parked(self, position: np.ndarray, heading: float) -> None:
        """Paint a parked vehicle, with hazard lights."""
        self._paint_vehicle(position, heading, PARKED)
        if self.env.steps // 4 % 2 == 0:
            corners = np.array([(2.3, 0.9), (2.3, -0.9), (-2.3, 0.9), (-2.3, -0.9)]) @ turned(heading)
            for corner in self._to_canvas(position + corners):
                self.pygame.draw.circle(self.canvas, HAZARD, corner, 2.5 * FINE)
