"""The cockpit's window: the picture, the paper's indicators, the actions, and the keys."""

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pygame

from sb3_chac.cockpit.devices import Command, Joystick, Keyboard
from sb3_chac.cockpit.session import Display, Session, asks_for_help, indicators, who_drives
from sb3_chac.envs.driving.display import BLACK, EGO, HUMAN, ORANGE, PANEL, RED, TEXT

PICTURE = pygame.Rect(0, 0, 800, 600)
SIDE = pygame.Rect(800, 0, 320, 600)
STRIP = pygame.Rect(0, 600, 1120, 120)
SIZE = 1120, 720
FRAME_SECONDS = 0.033
DRAWING_SECONDS = 0.012  # that drawing may take: not begun right before a step, for events wait meanwhile
DIM, LINE, BAR = (140, 145, 155), (70, 76, 86), (42, 47, 56)
BARS = {"route": (138, 180, 255), "confidence": EGO, "risk": ORANGE}
COLOURS = {"person": HUMAN, "brake": RED, "novice": EGO}  # of who drives

COMMANDS = {
    pygame.K_p: Command.PAUSE,
    pygame.K_n: Command.SKIP,
    pygame.K_g: Command.SUCCESS,
    pygame.K_f: Command.FAILURE,
    pygame.K_q: Command.QUIT,
    pygame.K_c: Command.CORRIDORS,
    pygame.K_h: Command.HELP,
    pygame.K_k: Command.KEYBOARD,
}
KEYBOARD_HELP = (
    ("arrows, WASD", "drive: hold them. Pressing one takes over"),
    ("Space", "take over, hand back"),
)
JOYSTICK_HELP = (
    ("button, paddle", "take over, hand back (--device g29: drive while it is held)"),
    ("K", "drive with the keyboard from now on"),
)
HELP = (
    ("P", "pause, go on"),
    ("N", "next episode: skip this one"),
    ("G, F", "good or failed: end the episode, and say how it went"),
    ("Q", "quit, with a checkpoint to resume from"),
    ("C", "what the policy sees: how far ways ahead are free"),
    ("H", "this help"),
)


class Window:
    """
    Window of the cockpit. Events are handed on as they come, whatever is being drawn otherwise waits.

    :param title: of the window
    :raises RuntimeError: if no window can be opened
    """

    drive: Session

    def __init__(self, title: str) -> None:
        try:
            pygame.display.init()
            # SDL falls back to drivers that show nothing
            if pygame.display.get_driver() in ("dummy", "offscreen") and "SDL_VIDEODRIVER" not in os.environ:
                raise pygame.error("there is no display")
            self.screen = pygame.display.set_mode(SIZE)
        except pygame.error as error:
            raise RuntimeError(
                f"The cockpit's window could not be opened: {error}. Drive in a browser instead: --serve 8000."
            ) from error
        pygame.display.set_caption(title)
        pygame.font.init()
        pygame.event.set_blocked(pygame.MOUSEMOTION)
        self.font, self.small, self.large = (pygame.font.Font(None, size) for size in (27, 22, 36))
        self.help = False
        self.frames = 0
        self._drawn_at = 0.0
        self._picture: tuple[Any, pygame.Surface] | None = None

    def run(self, drive: Session, is_over: Callable[[], bool]) -> None:
        """
        Show a drive until it is over.

        :param drive: is shown
        :param is_over: asked after each frame
        """
        self.drive = drive
        while not is_over():
            now = time.monotonic()
            due = self._drawn_at + FRAME_SECONDS - now
            if due <= 0 and not 0 < self.drive.time_to_tick() < DRAWING_SECONDS:
                self._drawn_at = now
                self.draw()
                self.feel()
                events = pygame.event.get()  # now, for the next frame may be due already where drawing takes long
            else:
                events = [pygame.event.wait(max(1, int(1000 * due)) if due > 0 else 2), *pygame.event.get()]
            for event in events:
                self.handle(event)
        if isinstance(drive.person.device, Joystick):
            drive.person.device.feel(None)

    def feel(self) -> None:
        """Let a wheel with force feedback follow the novice, while it drives; who drives is not to fight with it."""
        device, display = self.drive.person.device, self.drive.display
        if isinstance(device, Joystick):
            now = self.drive.person.read()
            follows = now.connected and not now.takeover and not self.drive.paused and who_drives(display, True) == "novice"
            device.feel(display.proposed[0] if follows else None)

    def close(self) -> None:
        """Close the window."""
        pygame.display.quit()

    def handle(self, event: Any) -> None:
        """
        Take in an event of pygame.

        :param event: of pygame
        """
        command = self.drive.person.handle(event)
        if event.type == pygame.QUIT:
            command = Command.QUIT
        elif event.type == pygame.KEYDOWN:
            command = COMMANDS.get(event.key, command)
        self.drive.obey(command)
        match command:
            case Command.PAUSE:
                self.help = False
            case Command.HELP:
                self.help = not self.help
            case Command.KEYBOARD:
                if not isinstance(self.drive.person.device, Keyboard):
                    self.drive.person.hold(Keyboard())

    # What is drawn

    def draw(self) -> None:
        """Draw one frame."""
        drive, display = self.drive, self.drive.display
        self.screen.fill(PANEL)
        if display.picture is not None:
            self._draw_picture(display.picture)
        self._draw_side(display)
        self._draw_strip(display)
        if drive.notice:
            self._draw_message(drive.notice, ORANGE if drive.paused or drive.busy or drive.ended else RED)
        if self.help:
            self._draw_help()
        pygame.display.flip()
        self.frames += 1

    def _text(self, text: str, place: tuple[int, int], font: Any, colour: Any = TEXT, anchor: str = "topleft") -> pygame.Rect:
        rendered = font.render(text, True, colour)
        rect = rendered.get_rect(**{anchor: place})
        self.screen.blit(rendered, rect)
        return rect

    def _draw_picture(self, picture: np.ndarray) -> None:
        if self._picture is None or self._picture[0] is not picture:
            height, width = picture.shape[:2]
            surface = pygame.image.frombuffer(np.ascontiguousarray(picture[..., :3]).tobytes(), (width, height), "RGB")
            scale = min(PICTURE.width / width, PICTURE.height / height)
            if scale != 1:
                surface = pygame.transform.smoothscale(surface, (round(width * scale), round(height * scale)))
            self._picture = picture, surface
        surface = self._picture[1]
        self.screen.blit(surface, surface.get_rect(center=PICTURE.center))

    def _draw_side(self, display: Display) -> None:
        is_manned, lag = self.drive.person.read().connected, self.drive.lag
        driver = who_drives(display, is_manned)
        colour_of_driver = COLOURS[driver]
        pygame.draw.rect(self.screen, colour_of_driver, (SIDE.left, 0, 6, SIDE.height))
        y = 24
        for name, value in indicators(display, self.drive.totals, lag, is_manned):
            colour = TEXT
            if name == "takeover" and colour_of_driver != EGO:
                colour = colour_of_driver
            elif (name.startswith("updates") and lag) or (name == "risk" and asks_for_help(display, driver)):
                colour = ORANGE
            self._text(name, (SIDE.left + 24, y), self.font, DIM)
            self._text(value, (SIDE.right - 16, y), self.font, colour, "topright")
            y += 31
            share = {"confidence": display.novice.confidence, "risk": display.novice.risk, "route": display.route}.get(name)
            if share is not None:
                bar = pygame.Rect(SIDE.left + 24, y - 8, SIDE.width - 40, 10)
                pygame.draw.rect(self.screen, BAR, bar, border_radius=3)
                filled = bar.copy()
                filled.width = round(bar.width * share)
                pygame.draw.rect(self.screen, BARS[name], filled, border_radius=3)
                y += 13
        device = self.drive.person.device
        self._text(f"device: {device.name}", (SIDE.left + 24, SIDE.bottom - 56), self.small, DIM)
        self._text("H: help", (SIDE.left + 24, SIDE.bottom - 30), self.small, DIM)

    def _draw_strip(self, display: Display) -> None:
        pygame.draw.line(self.screen, LINE, STRIP.topleft, STRIP.topright)
        now = self.drive.person.read()
        driver = who_drives(display, now.connected)
        rows = (
            ("proposed", "by the novice", display.proposed, EGO),
            (
                "applied",
                {"person": "you drive", "brake": "the brake", "novice": "the novice's"}[driver],
                display.applied,
                COLOURS[driver],
            ),
            ("your input", self.drive.person.device.name, (now.steering, now.pedals), DIM),
        )
        for i, (name, who, (steering, pedals), colour) in enumerate(rows):
            y = STRIP.top + 12 + 36 * i
            self._text(name, (20, y), self.font)
            self._text(who, (130, y + 3), self.small, DIM)
            self._draw_bar(pygame.Rect(300, y, 330, 18), steering, colour, ("left", "right"))
            self._draw_bar(pygame.Rect(760, y, 220, 18), pedals, colour, ("brake", "throttle"))

    def _draw_bar(self, bar: pygame.Rect, value: float, colour: Any, ends: tuple[str, str]) -> None:
        pygame.draw.rect(self.screen, BAR, bar, border_radius=3)
        end = bar.centerx + round(min(max(value, -1.0), 1.0) * bar.width / 2)
        pygame.draw.rect(self.screen, colour, (min(bar.centerx, end), bar.top, abs(end - bar.centerx), bar.height))
        pygame.draw.line(self.screen, TEXT, (bar.centerx, bar.top - 2), (bar.centerx, bar.bottom + 1))
        # In the half that is free
        place, anchor = ((bar.left + 5, bar.centery), "midleft") if value >= 0 else ((bar.right - 5, bar.centery), "midright")
        self._text(f"{abs(value):.0%}", place, self.small, TEXT, anchor)
        self._text(ends[0], (bar.left - 8, bar.centery), self.small, DIM, "midright")
        self._text(ends[1], (bar.right + 8, bar.centery), self.small, DIM, "midleft")

    def _draw_message(self, message: str, colour: Any) -> None:
        rendered = self.font.render(message, True, BLACK)
        rect = rendered.get_rect(midtop=(PICTURE.centerx, 56))
        pygame.draw.rect(self.screen, colour, rect.inflate(28, 18), border_radius=5)
        self.screen.blit(rendered, rect)

    def _draw_help(self) -> None:
        lines = (*(KEYBOARD_HELP if isinstance(self.drive.person.device, Keyboard) else JOYSTICK_HELP), *HELP)
        box = pygame.Surface((560, 40 + 32 * len(lines)), pygame.SRCALPHA)
        box.fill((*PANEL, 225))
        rect = box.get_rect(center=PICTURE.center)
        self.screen.blit(box, rect)
        for i, (key, meaning) in enumerate(lines):
            y = rect.top + 22 + 32 * i
            self._text(key, (rect.left + 24, y), self.font, HUMAN)
            self._text(meaning, (rect.left + 190, y), self.font)
