"""Force feedback: a spring that turns the wheel to where the novice steers, by SDL's haptic devices."""

import ctypes
from typing import Any

from sb3_chac.cockpit.devices.base import DeviceError

# SDL_haptic.h
INIT_HAPTIC, SPRING, CARTESIAN, FOR_EVER = 0x1000, 1 << 7, 1, 2**32 - 1
MOST_RAW, MOST_FORCE = 2**15 - 1, 2**16 - 1
AXES = 3


class Direction(ctypes.Structure):
    """SDL_HapticDirection."""

    _fields_ = (("type", ctypes.c_uint8), ("dir", ctypes.c_int32 * AXES))


class Condition(ctypes.Structure):
    """SDL_HapticCondition."""

    _fields_ = (
        ("type", ctypes.c_uint16),
        ("direction", Direction),
        ("length", ctypes.c_uint32),
        *((name, ctypes.c_uint16) for name in ("delay", "button", "interval")),
        *((name, ctypes.c_uint16 * AXES) for name in ("right_sat", "left_sat")),
        *((name, ctypes.c_int16 * AXES) for name in ("right_coeff", "left_coeff")),
        ("deadband", ctypes.c_uint16 * AXES),
        ("center", ctypes.c_int16 * AXES),
    )


class Effect(ctypes.Union):
    """SDL_HapticEffect, as far as it is used."""

    _fields_ = (("condition", Condition), ("others", ctypes.c_uint8 * 128))


def sdl() -> Any:
    """
    Find the SDL that pygame has loaded: devices are known to this one only.

    :raises DeviceError: if it cannot be reached
    """
    import pygame

    try:
        library = ctypes.CDLL(pygame.base.__file__)  # what it is linked to is searched, too
        for name in ("SDL_JoystickFromInstanceID", "SDL_HapticOpenFromJoystick"):
            getattr(library, name).restype = ctypes.c_void_p
        library.SDL_GetError.restype = ctypes.c_char_p
        library.SDL_HapticQuery.restype = ctypes.c_uint32
    except (OSError, AttributeError) as error:
        raise DeviceError(f"--force-feedback: pygame's SDL has no force feedback here ({error}): leave it out.") from error
    library.SDL_InitSubSystem(INIT_HAPTIC)
    return library


class Spring:
    """
    Spring of a steering wheel. It is slack until it is pulled, and whenever it is let go.

    :param strength: share of the force that the wheel has, above 0 and at most 1
    :param library: SDL, pygame's if None
    """

    def __init__(self, strength: float, library: Any = None) -> None:
        self.strength = strength
        self.sdl = library if library is not None else sdl()
        self._haptic: Any = None
        self._effect: int | None = None
        self._centre: int | None = None  # raw, to where it pulls

    def attach(self, joystick: Any) -> None:
        """
        Use a device that was plugged in.

        :param joystick: pygame's, open
        :raises DeviceError: if it offers no spring
        """
        self.detach()
        opened = self.sdl.SDL_JoystickFromInstanceID(joystick.get_instance_id())
        haptic = self.sdl.SDL_HapticOpenFromJoystick(ctypes.c_void_p(opened)) if opened else None
        if not haptic or not self.sdl.SDL_HapticQuery(ctypes.c_void_p(haptic)) & SPRING:
            if haptic:
                self.sdl.SDL_HapticClose(ctypes.c_void_p(haptic))
            raise DeviceError(
                f"--force-feedback: {joystick.get_name()} or its driver offers no spring: leave it out, or use another driver."
            )
        self._haptic = ctypes.c_void_p(haptic)

    def detach(self) -> None:
        """The device is gone, or another one comes."""
        if self._haptic is not None:
            self.sdl.SDL_HapticClose(self._haptic)  # destroys its effects
        self._haptic = self._effect = self._centre = None

    def pull(self, centre: float) -> None:
        """
        Pull the wheel to a place.

        :param centre: raw value of the axis there, -1 to 1
        """
        raw = round(min(max(centre, -1.0), 1.0) * MOST_RAW)
        if self._haptic is None or raw == self._centre:
            return
        self._centre = raw
        effect = Effect()
        condition = effect.condition
        condition.type, condition.length = SPRING, FOR_EVER
        condition.direction.type, condition.direction.dir[0] = CARTESIAN, 1
        for side in ("right", "left"):
            getattr(condition, f"{side}_sat")[0] = round(self.strength * MOST_FORCE)
            getattr(condition, f"{side}_coeff")[0] = round(self.strength * MOST_RAW)
        condition.center[0] = raw
        if self._effect is None:
            made = self.sdl.SDL_HapticNewEffect(self._haptic, ctypes.byref(effect))
            if made < 0:
                self.detach()
                return
            self._effect = made
        else:
            self.sdl.SDL_HapticUpdateEffect(self._haptic, self._effect, ctypes.byref(effect))
        self.sdl.SDL_HapticRunEffect(self._haptic, self._effect, 1)

    def let_go(self) -> None:
        """Let the wheel be free."""
        if self._effect is not None and self._centre is not None:
            self.sdl.SDL_HapticStopEffect(self._haptic, self._effect)
        self._centre = None
