"""Addresses at which the cockpit is served."""

import ipaddress
import socket
from contextlib import suppress
from typing import NamedTuple

from sb3_chac.deploy.address import is_port


class Address(NamedTuple):
    """Host and port at which the cockpit is served."""

    host: str
    port: int

    @property
    def is_loopback(self) -> bool:
        """Tell whether only this machine can reach it."""
        return self.host == "localhost" or (is_number(self.host) and ipaddress.ip_address(self.host).is_loopback)

    def from_elsewhere(self) -> "Address":
        """
        The address as other machines use it.

        :return: itself, but with this machine's address in its network in place of "all addresses"
        """
        if not (is_number(self.host) and ipaddress.ip_address(self.host).is_unspecified):
            return self
        own, anywhere = ("::1", "2001:db8::1") if ":" in self.host else ("127.0.0.1", "192.0.2.1")
        with (
            suppress(OSError),
            socket.socket(socket.AF_INET6 if ":" in self.host else socket.AF_INET, socket.SOCK_DGRAM) as out,
        ):
            out.connect((anywhere, 9))  # sends nothing, but chooses the way there
            own = out.getsockname()[0]
        return Address(own, self.port)

    def url(self, token: str, scheme: str = "http") -> str:
        """
        Build the address of the page.

        :param token: of who opens it
        :param scheme: "http" or "https"
        """
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{scheme}://{host}:{self.port}/?token={token}"


def parse_address(text: str) -> Address:
    """
    Parse the address to serve on.

    :param text: HOST:PORT or PORT (then on loopback)
    :raises ValueError: if it is neither
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") or "127.0.0.1"
    if not is_port(port):
        raise ValueError(f"--serve must be PORT or HOST:PORT, for example 127.0.0.1:8000, got {text!r}.")
    return Address(host, int(port))


def is_number(host: str) -> bool:
    """
    Tell IP addresses from names.

    :return: whether it is an IP address, not a name
    """
    with suppress(ValueError):
        ipaddress.ip_address(host)
        return True
    return False
