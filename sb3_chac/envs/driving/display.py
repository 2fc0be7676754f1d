"""Base of the pictures of our environments: their size, the window, and the panel with what happens."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from highway_env.vehicle.kinematics import Vehicle

Colour = tuple[int, int, int]
Area = tuple[Colour, np.ndarray]  # of the map, corners [m] of shape (n, 2)

SIZE = 800, 600  # [px]
SCALES = 10.0, 6.0  # [px/m] when the ego stands, and at the speed FAST
EGO_AT = 0.74, 0.87  # where in the picture the ego is, of its height, likewise
ASIDE = 0.3  # of the picture's width, by which the ego is beside its middle at most
FAST = 15.0  # [m/s]
FINE = 2  # painted that many times larger and then shrunk, for smooth edges
STEPS_PER_SECOND = 10
FLASH_STEPS = 4  # that a collision shows
EGO, HUMAN, TRAFFIC, PARKED = (60, 205, 75), (255, 205, 30), (70, 140, 235), (150, 152, 155)
ORANGE, RED, WHITE, BLACK = (255, 120, 0), (215, 30, 30), (255, 255, 255), (25, 25, 25)
GRASS, ASPHALT, ROUTE, LINE = (133, 160, 112), (92, 95, 101), (112, 119, 134), (244, 244, 240)
PANEL, TEXT, PANEL_POSITION = (24, 27, 33), (235, 237, 240), (12, 12)


class Display:
    """
    Painter of an environment. It changes nothing of what it paints: the same state gives the same picture. Needs no display
    unless a window is asked for.

    :param env: the environment to show, with ``hud`` (name -> value), ``scenario`` and ``steps``
    """

    def __init__(self, env: Any) -> None:
        import pygame
        from highway_env.road.graphics import WorldSurface

        pygame.font.init()
        self.env, self.pygame = env, pygame
        size = SIZE[0] * FINE, SIZE[1] * FINE
        self.canvas = WorldSurface(size, 0, pygame.Surface(size, 0, 32))
        self.picture = pygame.Surface(SIZE, 0, 32)
        self.font, self.large_font = pygame.font.Font(None, 21), pygame.font.Font(None, 34)
        self.window: Any = None
        self.closed = False  # by the user
        self._painted_map: Any = None
        self._shown: tuple[int, int] | None = None

    def _paint(self) -> None:
        """Paint the present state on ``self.canvas``, and finish with ``_finish``."""
        raise NotImplementedError

    def frame(self) -> np.ndarray:
        """
        Paint the current state.

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
            self.close()
            return
        self._paint()
        self.window.blit(self.picture, (0, 0))
        pygame.display.flip()
        now = self.env.scenario, self.env.steps
        if now != self._shown:  # another picture of the same step takes no time
            self.clock.tick(STEPS_PER_SECOND)
        self._shown = now

    def close(self) -> None:
        """Close the window, if there is one."""
        if self.window is not None:
            self.window = None
            self.pygame.display.quit()

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
        pygame.display.set_caption(self.env.spec.id if self.env.spec else type(self.env).__name__)
        pygame.event.set_blocked(pygame.MOUSEMOTION)  # nobody takes them, and a full queue loses others
        self.clock = pygame.time.Clock()

    # What is painted: the methods below work on the canvas, which is larger than the picture

    def _look(self, position: np.ndarray, heading: float, speed: float, way: np.ndarray | None = None) -> None:
        """
        Set the view. The faster the ego is, the farther it looks ahead; the way ahead is in the middle of the picture.

        :param position: [m] of the ego on the map, y downwards, shape (2,)
        :param heading: [rad] that is to be upwards, clockwise from the x axis
        :param speed: [m/s] of the ego
        :param way: [m] points of its way from itself on, one every metre, as far as it is known, shape (n, 2)
        """
        share = min(abs(speed) / FAST, 1.0)
        self.scale, down = (slow + share * (fast - slow) for slow, fast in (SCALES, EGO_AT))
        self.angle = -np.pi / 2 - heading
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        self.rotation = np.array([[cos, -sin], [sin, cos]])
        self.centre = np.array(position, dtype=float)
        across = 0.5
        if way is not None:
            ahead = ((way[: int(down * SIZE[1] / self.scale)] - self.centre) @ self.rotation.T)[:, 0]
            across -= float(np.clip((ahead.min() + ahead.max()) / 2 * self.scale / SIZE[0], -ASIDE, ASIDE))
        self.shift = np.array([across, down]) * self.canvas.get_size()
        # For highway-env's graphics, the ego is the origin
        self.canvas.scaling, self.canvas.centering_position = self.scale * FINE, [across, down]
        self.canvas.move_display_window_to(np.zeros(2))

    @property
    def _ego_colour(self) -> Colour:
        return HUMAN if self.env.hud.get("takeover") else EGO

    def to_picture(self, points: np.ndarray) -> np.ndarray:
        """
        Convert positions to pixels.

        :param points: [m] on the map, shape (..., 2)
        :return: [px] where they are in the picture painted last, x and y, shape (..., 2)
        """
        return self._to_canvas(points) / FINE

    def _to_canvas(self, points: np.ndarray) -> np.ndarray:
        return (points - self.centre) @ self.rotation.T * (self.scale * FINE) + self.shift

    def _polygon(self, colour: Colour, points: np.ndarray) -> None:
        self.pygame.draw.polygon(self.canvas, colour, self._to_canvas(points).tolist())

    def _paint_map(self, road_map: Any, areas: Callable[[], Iterable[Area]]) -> None:
        """
        Paint the areas of the map.

        :param road_map: nothing but another one has other areas
        :param areas: painted one upon the other
        """
        if self._painted_map is not road_map:
            self._painted_map = road_map
            self._colours, corners = zip(*areas(), strict=True)
            self._corners = np.concatenate(corners)
            self._ends = np.cumsum([len(points) for points in corners])
            self._middles = np.array([(points.max(axis=0) + points.min(axis=0)) / 2 for points in corners])
            self._sizes = np.array([np.linalg.norm(np.ptp(points, axis=0)) / 2 for points in corners])
        self.canvas.fill(GRASS)
        middles, reach = self._to_canvas(self._middles), self._sizes * self.scale * FINE
        width, height = self.canvas.get_size()
        seen = (np.abs(middles[:, 0] - width / 2) < width / 2 + reach) & (
            np.abs(middles[:, 1] - height / 2) < height / 2 + reach
        )
        pixels = self._to_canvas(self._corners).round().astype(int)
        for i in np.flatnonzero(seen):
            first = self._ends[i - 1] if i else 0
            self.pygame.draw.polygon(self.canvas, self._colours[i], pixels[first : self._ends[i]].tolist())

    def _paint_vehicle(
        self,
        position: np.ndarray,
        heading: float,
        colour: Colour,
        steering: float = 0.0,
        size: tuple[float, float] = (Vehicle.LENGTH, Vehicle.WIDTH),
    ) -> None:
        from highway_env.vehicle.graphics import VehicleGraphics

        vehicle = Vehicle(None, self.rotation @ (position - self.centre), heading + self.angle)
        vehicle.LENGTH, vehicle.WIDTH = size
        vehicle.color = colour
        vehicle.action["steering"] = steering
        VehicleGraphics.display(vehicle, self.canvas, offscreen=True, draw_roof=True)

    def _paint_sign(self, kind: str, at: np.ndarray) -> None:
        """Upright and larger than it is, to be seen."""
        draw = self.pygame.draw

        def polygon(colour: Colour, *points: tuple[float, float]) -> None:
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

    def _finish(self, info: dict[str, Any]) -> None:
        """
        Add signs of a collision and the panel.

        :param info: of the last step
        """
        flash = any(self.env.steps - step < FLASH_STEPS for step in self.env._touched.values())
        if flash:
            self._paint_flash()
        self.pygame.transform.smoothscale(self.canvas, SIZE, self.picture)
        self._paint_panel(info, flash)

    def _paint_panel(self, info: dict[str, Any], flash: bool) -> None:
        """
        The numbers in the corner, unless they are shown elsewhere, and above in the middle what is the matter.

        :param info: of the last step
        :param flash: whether a collision is to be seen
        """
        human = bool(self.env.hud.get("takeover"))
        if getattr(self.env, "panel", True):
            self._paint_numbers(info, human)
        state = "collision" if flash else "arrived" if info["arrive_dest"] else "off the road" if info["out_of_road"] else ""
        state = state or ("human drives" if human and getattr(self.env, "panel", True) else "")
        if state:
            colour = EGO if state == "arrived" else HUMAN if state == "human drives" else RED
            text = self.large_font.render(state, True, BLACK if colour == HUMAN else WHITE)
            place = text.get_rect(midtop=(SIZE[0] // 2, 20))
            self.pygame.draw.rect(self.picture, colour, place.inflate(24, 12), border_radius=4)
            self.picture.blit(text, place)

    def _paint_numbers(self, info: dict[str, Any], human: bool) -> None:
        """
        Paint the numbers in the corner.

        :param info: of the last step
        :param human: whether a person drives
        """
        rows = {
            "speed": f"{3.6 * info['speed']:.0f} km/h",
            "route": f"{info['route_completion']:.0%}",
            "next": str(self.env.guidance),
            "cost": f"{info['episode_cost']:g}",
            "time": f"{self.env.steps / STEPS_PER_SECOND:.1f} s",
        }
        rows |= {str(name): _text(value) for name, value in self.env.hud.items()}
        lines = [(self.font.render(name, True, TEXT), self.font.render(value, True, TEXT)) for name, value in rows.items()]
        name_width = max(name.get_width() for name, _ in lines)
        width = name_width + max(value.get_width() for _, value in lines) + 44
        line_height = self.font.get_linesize() + 3
        box = self.pygame.Surface((width, 16 + line_height * len(lines)), self.pygame.SRCALPHA, 32)
        box.fill((*PANEL, 215))
        self.pygame.draw.rect(box, HUMAN if human else EGO, (0, 0, 6, box.get_height()))
        for i, (name, value) in enumerate(lines):
            box.blit(name, (18, 9 + i * line_height))
            box.blit(value, (width - 12 - value.get_width(), 9 + i * line_height))
        self.picture.blit(box, PANEL_POSITION)


def _text(value: Any) -> str:
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    return f"{value:.2f}" if isinstance(value, float | np.floating) else str(value)


def turned(heading: float) -> np.ndarray:
    """Return the rotation matrix that turns rows (ahead, right) into rows (x, y)."""
    return np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
