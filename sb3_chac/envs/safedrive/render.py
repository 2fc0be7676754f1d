"""SafeDrive as a picture: seen from above, the route upwards. Needs no display unless a window is asked for."""

from typing import TYPE_CHECKING, Any

import numpy as np
from highway_env.vehicle.kinematics import Vehicle

from sb3_chac.envs.safedrive.env import ARRIVES_BEFORE_END, STEPS_PER_SECOND
from sb3_chac.envs.safedrive.geometry import SPACING
from sb3_chac.envs.safedrive.roads import areas
from sb3_chac.envs.safedrive.traffic import CRASHED

if TYPE_CHECKING:
    from sb3_chac.envs.safedrive.env import SafeDriveEnv

SIZE = 800, 600  # [px]
SCALE = 6.0  # [px/m]
EGO_AT = 0.5, 0.72  # where in the picture the ego is, of its width and height
FINE = 2  # painted that many times larger and then shrunk, for smooth edges
UP = -5.0, 15.0  # [m] before the ego on the route, places of which the second is above the first
ARROWS, ARROW_SPACING = 7, 10.0  # number, [m] on the route
FLASH_STEPS = 4  # that a collision shows

COLOURS = {
    "grass": (133, 160, 112), "trees": (104, 134, 88), "kerb": (214, 212, 204), "asphalt": (92, 95, 101),
    "route": (112, 119, 134), "line": (244, 244, 240), "black": (20, 20, 20),
}  # fmt: skip
EGO, HUMAN, TRAFFIC, WRECK, PARKED = (60, 205, 75), (255, 205, 30), (70, 140, 235), (225, 50, 45), (150, 152, 155)
ORANGE, RED, WHITE, BLACK, HAZARD = (255, 120, 0), (215, 30, 30), (255, 255, 255), (25, 25, 25), (255, 180, 0)
ARROW, RAY, ECHO = (140, 176, 158), (190, 225, 140), (250, 255, 80)
HUD, TEXT, HUD_POSITION = (24, 27, 33), (235, 237, 240), (12, 12)


class Viewer:
    """
    Paints what the environment holds, and changes nothing of it: the same state gives the same picture.

    :param env: the environment to show
    """

    def __init__(self, env: "SafeDriveEnv") -> None:
        import pygame
        from highway_env.road.graphics import WorldSurface

        pygame.font.init()
        self.env, self.pygame = env, pygame
        size = SIZE[0] * FINE, SIZE[1] * FINE
        self.canvas = WorldSurface(size, 0, pygame.Surface(size, 0, 32))
        self.canvas.scaling, self.canvas.centering_position = SCALE * FINE, list(EGO_AT)
        self.canvas.move_display_window_to(np.zeros(2))  # the ego is the origin
        self.picture = pygame.Surface(SIZE, 0, 32)
        self.font, self.large_font = pygame.font.Font(None, 21), pygame.font.Font(None, 34)
        self.window: Any = None
        self.closed = False  # by the user
        self._painted_map: Any = None
        self._shown: tuple[int, int] | None = None

    # What the environment calls

    def frame(self) -> np.ndarray:
        """
        :return: the picture, shape (height, width, 3), uint8
        """
        self._paint()
        pixels = np.frombuffer(self.pygame.image.tobytes(self.picture, "RGB"), np.uint8)
        return pixels.reshape(SIZE[1], SIZE[0], 3).copy()

    def show(self) -> None:
        """
        Show the picture in a window, ten steps per second. Does nothing once the user has closed the window.

        :raises RuntimeError: if no window can be opened
        """
        if self.closed:
            return
        pygame = self.pygame
        if self.window is None:
            self._open_window()
        if pygame.event.get(pygame.QUIT):  # only these: a human's device may wait for the others
            self.closed = True
            self._close_window()
            return
        self._paint()
        self.window.blit(self.picture, (0, 0))
        pygame.display.flip()
        now = self.env.scenario, self.env.steps
        if now != self._shown:  # another picture of the same step takes no time
            self.clock.tick(STEPS_PER_SECOND)
        self._shown = now

    def close(self) -> None:
        self._close_window()

    def _open_window(self) -> None:
        pygame = self.pygame
        try:
            pygame.display.init()
            self.window = pygame.display.set_mode(SIZE)
        except pygame.error as error:
            raise RuntimeError(
                f"render_mode='human' needs a display, but no window could be opened ({error}). "
                "Use render_mode='rgb_array' instead."
            ) from error
        pygame.display.set_caption("SafeDrive-v0")
        pygame.event.set_blocked(pygame.MOUSEMOTION)  # nobody takes them, and a full queue loses others
        self.clock = pygame.time.Clock()

    def _close_window(self) -> None:
        if self.window is not None:
            self.window = None
            self.pygame.display.quit()

    # The picture

    def to_picture(self, points: np.ndarray) -> np.ndarray:
        """
        :param points: [m] on the map, shape (..., 2)
        :return: [px] where they are in the picture painted last, x and y, shape (..., 2)
        """
        return self._to_canvas(points) / FINE

    def _to_canvas(self, points: np.ndarray) -> np.ndarray:
        return (points - self.centre) @ self.rotation.T * (SCALE * FINE) + self.shift

    def _paint(self) -> None:
        env, canvas = self.env, self.canvas
        self._look_along_route()
        canvas.fill(COLOURS["grass"])
        self._paint_map()
        self._paint_arrows()
        flash = any(env.steps - step < FLASH_STEPS for step in env._touched.values())
        obstacles = []
        for (kind, index), position, heading in zip(env.box_ids, env.box_positions, env.box_headings, strict=True):
            if kind == "car":
                self._paint_vehicle(position, heading, WRECK if env.traffic.state[index] == CRASHED else TRAFFIC)
            elif env.map.obstacles[index].kind == "parked":
                self._paint_parked(position, heading)
            else:
                obstacles.append((env.map.obstacles[index].kind, position))
        if env.show_lidar:
            self._paint_lidar()
        human = bool(env.hud.get("takeover"))
        self._paint_vehicle(env.ego.position, env.ego.heading, HUMAN if human else EGO, env.ego.steering)
        for kind, position in obstacles:
            self._paint_sign(kind, self._to_canvas(position))
        if flash:
            self._paint_flash()
        self.pygame.transform.smoothscale(canvas, SIZE, self.picture)
        self._paint_hud(human, flash)

    def _look_along_route(self) -> None:
        """The ego at its place, the direction of the route upwards: steadier than the ego's own heading."""
        env = self.env
        x, y = self._on_route(env.s + UP[1]) - self._on_route(env.s + UP[0])
        angle = -np.pi / 2 - np.arctan2(y, x)
        self.angle = float(angle)
        self.rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        self.centre = env.ego.position.copy()
        self.shift = np.array(EGO_AT) * self.canvas.get_size()

    def _on_route(self, s: float) -> np.ndarray:
        """
        :param s: [m] along the route; beyond its end it goes on straight
        :return: [m], shape (2,)
        """
        route = self.env.map.route
        x, y, heading, _ = route[int(np.clip(s / SPACING, 0, len(route) - 1))]
        rest = s - np.clip(int(s / SPACING), 0, len(route) - 1) * SPACING
        return np.array([x + rest * np.cos(heading), y + rest * np.sin(heading)])

    def _paint_map(self) -> None:
        if self._painted_map is not self.env.map:
            self._painted_map = self.env.map
            painted = areas(self.env.map, self.env.map.length - ARRIVES_BEFORE_END)
            self._colours = [COLOURS[area.kind] for area in painted]
            self._corners = np.concatenate([area.points for area in painted])
            self._ends = np.cumsum([len(area.points) for area in painted])
            middles = np.array([(area.points.max(axis=0) + area.points.min(axis=0)) / 2 for area in painted])
            sizes = np.array([np.linalg.norm(np.ptp(area.points, axis=0)) / 2 for area in painted])
            self._middles, self._sizes = middles, sizes
        middles, reach = self._to_canvas(self._middles), self._sizes * SCALE * FINE
        width, height = self.canvas.get_size()
        seen = (np.abs(middles[:, 0] - width / 2) < width / 2 + reach) & (
            np.abs(middles[:, 1] - height / 2) < height / 2 + reach
        )
        corners = self._to_canvas(self._corners).round().astype(int)
        for i in np.flatnonzero(seen):
            first = self._ends[i - 1] if i else 0
            self.pygame.draw.polygon(self.canvas, self._colours[i], corners[first : self._ends[i]].tolist())

    def _paint_arrows(self) -> None:
        """Along the route ahead."""
        shape = np.array([(1.0, 0.0), (-1.0, -3.2), (-2.0, -3.2), (0.0, 0.0), (-2.0, 3.2), (-1.0, 3.2)])
        env = self.env
        for s in (np.ceil(env.s / ARROW_SPACING) + np.arange(1, ARROWS)) * ARROW_SPACING:
            if s < env.map.length - ARRIVES_BEFORE_END - 2.0:
                heading = env.map.route[int(s / SPACING), 2]
                self._polygon(ARROW, self._on_route(s) + shape @ _turned(heading))

    def _polygon(self, colour: tuple[int, int, int], points: np.ndarray) -> None:
        self.pygame.draw.polygon(self.canvas, colour, self._to_canvas(points).tolist())

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

    def _paint_vehicle(
        self, position: np.ndarray, heading: float, colour: tuple[int, int, int], steering: float = 0.0
    ) -> None:
        from highway_env.vehicle.graphics import VehicleGraphics

        vehicle = Vehicle(None, self.rotation @ (position - self.centre), heading + self.angle)
        vehicle.color = colour
        vehicle.action["steering"] = steering
        VehicleGraphics.display(vehicle, self.canvas, offscreen=True, draw_roof=True)

    def _paint_parked(self, position: np.ndarray, heading: float) -> None:
        """With hazard lights."""
        self._paint_vehicle(position, heading, PARKED)
        if self.env.steps // 4 % 2 == 0:
            corners = np.array([(2.3, 0.9), (2.3, -0.9), (-2.3, 0.9), (-2.3, -0.9)]) @ _turned(heading)
            for corner in self._to_canvas(position + corners):
                self.pygame.draw.circle(self.canvas, HAZARD, corner, 2.5 * FINE)

    def _paint_sign(self, kind: str, at: np.ndarray) -> None:
        """Upright and larger than it is, to be seen."""
        draw = self.pygame.draw

        def polygon(colour: tuple[int, int, int], *points: tuple[float, float]) -> None:
            draw.polygon(self.canvas, colour, (at + FINE * np.array(points)).tolist())

        if kind == "cone":
            polygon(BLACK, (-8, 8), (8, 8), (8, 5), (2, -10), (-2, -10), (-8, 5))
            polygon(ORANGE, (-7, 7), (7, 7), (7, 5), (-7, 5))
            polygon(ORANGE, (-5, 5), (5, 5), (1.5, -9), (-1.5, -9))
            polygon(WHITE, (-3.8, 1), (3.8, 1), (2.6, -4), (-2.6, -4))
        else:
            polygon(WHITE, (-11, 8), (11, 8), (0, -12))
            polygon(RED, (-9.5, 7), (9.5, 7), (0, -10.5))
            polygon(WHITE, (-4.5, 4), (4.5, 4), (0, -4.5))

    def _paint_flash(self) -> None:
        """A red frame, and a ring around the ego."""
        draw, canvas = self.pygame.draw, self.canvas
        draw.rect(canvas, RED, canvas.get_rect(), 10 * FINE)
        draw.circle(canvas, RED, self._to_canvas(self.centre), 26 * FINE, 4 * FINE)

    def _paint_hud(self, human: bool, flash: bool) -> None:
        env = self.env
        info = env._info()
        rows = {
            "speed": f"{3.6 * env.ego.speed:.0f} km/h",
            "route": f"{info['route_completion']:.0%}",
            "cost": f"{env.episode_cost}",
        }
        rows["time"] = f"{env.steps / STEPS_PER_SECOND:.1f} s"
        rows |= {str(name): _text(value) for name, value in env.hud.items()}
        lines = [(self.font.render(name, True, TEXT), self.font.render(value, True, TEXT)) for name, value in rows.items()]
        name_width = max(name.get_width() for name, _ in lines)
        width = name_width + max(value.get_width() for _, value in lines) + 44
        line_height = self.font.get_linesize() + 3
        box = self.pygame.Surface((width, 16 + line_height * len(lines)), self.pygame.SRCALPHA, 32)
        box.fill((*HUD, 215))
        self.pygame.draw.rect(box, HUMAN if human else EGO, (0, 0, 6, box.get_height()))
        for i, (name, value) in enumerate(lines):
            box.blit(name, (18, 9 + i * line_height))
            box.blit(value, (width - 12 - value.get_width(), 9 + i * line_height))
        self.picture.blit(box, HUD_POSITION)
        state = "collision" if flash else "arrived" if env.arrived else "off the road" if env.out_of_road else ""
        state = state or ("human drives" if human else "")
        if state:
            colour = EGO if env.arrived and not flash else HUMAN if state == "human drives" else RED
            text = self.large_font.render(state, True, BLACK if colour == HUMAN else WHITE)
            place = text.get_rect(midtop=(SIZE[0] // 2, 20))
            self.pygame.draw.rect(self.picture, colour, place.inflate(24, 12), border_radius=4)
            self.picture.blit(text, place)


def _turned(heading: float) -> np.ndarray:
    """What turns rows (ahead, right) into rows (x, y)."""
    return np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])


def _text(value: Any) -> str:
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    return f"{value:.2f}" if isinstance(value, float | np.floating) else str(value)
