"""MetaDrive as a picture from above, the ego's heading upwards. Needs neither its assets nor a display."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from sb3_chac.envs.driving.display import (
    ASPHALT,
    FINE,
    LINE,
    PARKED,
    RED,
    ROUTE,
    TRAFFIC,
    WHITE,
    Area,
    Display,
    turned,
)
from sb3_chac.envs.metadrive.roads import destination, patches, things

if TYPE_CHECKING:
    from sb3_chac.envs.metadrive.env import MetaDriveSafetyEnv

SIGHT = 120.0  # [m] around the ego in which things are painted
COLOURS = {"lane": ASPHALT, "route": ROUTE, "line": LINE, "yellow line": (230, 190, 60)}
DOWNWARDS = np.array([1.0, -1.0])  # MetaDrive's y axis points upwards


class Viewer(Display):
    """
    View of MetaDrive from above.

    :param env: the environment to show
    """

    env: "MetaDriveSafetyEnv"

    def _paint(self) -> None:
        env = self.env
        self._look(env.position * DOWNWARDS, -env.ego.heading_theta, env.last_info["speed"])
        self._paint_map((env.simulator.current_map, env.scenario), self._areas)
        self._paint_destination()
        signs = []
        for thing in things(env):
            position, heading = thing.position * DOWNWARDS, -thing.heading
            if np.hypot(*(position - self.centre)) > SIGHT:
                continue
            if thing.kind in ("vehicle", "broken down"):
                colour = TRAFFIC if thing.kind == "vehicle" else PARKED
                self._paint_vehicle(position, heading, colour, size=(thing.length, thing.width))
            elif thing.kind == "barrier":
                self._paint_barrier(position, heading, thing.length)
            else:
                signs.append((thing.kind, position))
        ego = env.ego
        steering = -ego.steering * np.radians(ego.max_steering)
        self._paint_vehicle(self.centre, -ego.heading_theta, self._ego_colour, steering, (ego.LENGTH, ego.WIDTH))
        for kind, position in signs:
            self._paint_sign(kind, self._to_canvas(position))
        self._finish(env.last_info)

    def _areas(self) -> Iterable[Area]:
        for patch in patches(self.env):
            yield COLOURS[patch.kind], patch.points * DOWNWARDS

    def _paint_destination(self) -> None:
        self.pygame.draw.circle(self.canvas, WHITE, self._to_canvas(destination(self.env) * DOWNWARDS), 12 * FINE, 3 * FINE)

    def _paint_barrier(self, position: np.ndarray, heading: float, length: float) -> None:
        """Red, with a white middle."""
        for part, colour in ((1.0, RED), (0.4, WHITE)):
            corners = np.array([(0.25, 1), (0.25, -1), (-0.25, -1), (-0.25, 1)]) * (1, part * length / 2)
            self._polygon(colour, position + corners @ turned(heading))
