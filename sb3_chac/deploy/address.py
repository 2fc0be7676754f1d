"""Addresses in arguments and on the command line: what one cannot be, or cannot be used for, is named with the remedy."""

import errno
import socket
from typing import Any

from sb3_chac.deploy.metadata import NotDeployable

REMEDIES = {
    errno.EADDRINUSE: "choose another port, or end the program that has this one",
    errno.EADDRNOTAVAIL: "give an address of this machine, or 0.0.0.0 for all that it has",
    errno.EACCES: "choose a port above 1023",
}


def parse_address(name: str, text: Any, low: int = 0) -> tuple[str, int]:
    """
    Parse an address.

    :param name: of the option or argument, for the message
    :param text: HOST:PORT
    :param low: least port; 0 is any that is free
    :return: host and port
    :raises NotDeployable: for anything else
    """
    host, _, port = str(text).rpartition(":")
    if not host or not is_port(port, low):
        raise NotDeployable(
            f"{name} must be HOST:PORT with a port from {low} to 65535, such as 127.0.0.1:5600, got {text!r:.80}."
        )
    return host, int(port)


def is_port(text: str, low: int = 0) -> bool:
    """
    Tell whether a text is the number of a port.

    :param text: the number
    :param low: least port
    """
    return text.isascii() and text.isdecimal() and len(text) <= 5 and low <= int(text) <= 65535


def resolve(name: str, host: str) -> str:
    """
    Look up the address of a host.

    :param name: of the option or argument, for the message
    :param host: its name, or its IPv4 address
    :return: its IPv4 address
    :raises NotDeployable: if it has none
    """
    try:
        return socket.gethostbyname(host)
    except (OSError, TypeError, ValueError) as error:  # the latter two for what can be no name
        reason = getattr(error, "strerror", None) or error
        raise NotDeployable(f"{name}: no host {host!r:.80} ({reason}): mend the name, or give its IPv4 address.") from error


def bound_socket(name: str, address: tuple[str, int]) -> socket.socket:
    """
    Listen to an address.

    :param name: of the option or argument, for the message
    :param address: host and port
    :return: UDP socket
    :raises NotDeployable: if there is no such host, or the address cannot be had
    """
    host, port = address
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.bind((resolve(name, host), port))
    except BaseException as error:
        sock.close()
        if isinstance(error, OSError):
            raise NotDeployable(f"{name}: cannot listen at {host}:{port} ({error.strerror}): {remedy(error)}.") from error
        raise
    return sock


def remedy(error: OSError) -> str:
    """
    Choose what helps against an error.

    :param error: of a socket that was to listen
    :return: what to do, in the imperative
    """
    return REMEDIES.get(error.errno or 0, "give another address")
