"""A person's devices without the devices: what SDL would report, for tests and measurements."""

from typing import Any

import pygame


class EmulatedJoystick:
    """
    Stand-in for the device that ``Joystick`` opens.

    :param instance_id: number under which its events come
    :param name: that it gives itself
    """

    def __init__(self, instance_id: int = 0, name: str = "Emulated wheel") -> None:
        self.instance_id, self.name = instance_id, name

    def get_instance_id(self) -> int:
        return self.instance_id

    def get_name(self) -> str:
        return self.name


class DeviceEmulator:
    """
    Source of the events of a keyboard and of joysticks. By default they go into pygame's queue, from where the cockpit's
    window takes them.

    :param post: takes an event
    """

    def __init__(self, post: Any = pygame.event.post) -> None:
        self.post = post
        self.joystick = EmulatedJoystick()

    def press(self, key: int) -> None:
        """
        Press a key and hold it.

        :param key: pygame.K_...
        """
        self._post(pygame.KEYDOWN, key=key)

    def release(self, key: int) -> None:
        """
        Let go of a key.

        :param key: pygame.K_...
        """
        self._post(pygame.KEYUP, key=key)

    def tap(self, key: int) -> None:
        """
        Press a key and let go of it.

        :param key: pygame.K_...
        """
        self.press(key)
        self.release(key)

    def lose_focus(self) -> None:
        """Another window is in front."""
        self._post(pygame.WINDOWFOCUSLOST)

    def gain_focus(self) -> None:
        """Bring the window to the front again."""
        self._post(pygame.WINDOWFOCUSGAINED)

    def open_joystick(self, device_index: int) -> EmulatedJoystick:
        """Open the joystick, for ``Joystick(..., open_joystick=emulator.open_joystick)``."""
        return self.joystick

    def plug(self) -> None:
        """Plug in a joystick; it is another one than before."""
        self.joystick = EmulatedJoystick(self.joystick.instance_id + 1, self.joystick.name)
        self._post(pygame.JOYDEVICEADDED, device_index=0)

    def unplug(self) -> None:
        """Pull the joystick out."""
        self._post(pygame.JOYDEVICEREMOVED, instance_id=self.joystick.instance_id)

    def axis(self, axis: int, value: float) -> None:
        """
        Move an axis.

        :param axis: number
        :param value: -1 to 1, raw
        """
        self._post(pygame.JOYAXISMOTION, instance_id=self.joystick.instance_id, axis=axis, value=value)

    def button(self, button: int) -> None:
        """
        Press a button and let go of it.

        :param button: number, is pressed and let go
        """
        self.hold_button(button)
        self.release_button(button)

    def hold_button(self, button: int) -> None:
        """
        Press a button and hold it.

        :param button: number
        """
        self._post(pygame.JOYBUTTONDOWN, instance_id=self.joystick.instance_id, button=button)

    def release_button(self, button: int) -> None:
        """
        Let go of a button.

        :param button: number
        """
        self._post(pygame.JOYBUTTONUP, instance_id=self.joystick.instance_id, button=button)

    def _post(self, kind: int, **values: Any) -> None:
        self.post(pygame.event.Event(kind, **values))
