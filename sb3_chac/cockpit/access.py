"""Access to the cockpit's server: access tokens, host names, origins, and limits for everybody."""

import asyncio
import hmac
import logging
import re
import secrets
import socket
import ssl
import time
from collections.abc import Awaitable, Callable
from typing import Any

from aiohttp import web

from sb3_chac.cockpit.address import Address, is_number
from sb3_chac.cockpit.devices import Clock

logger = logging.getLogger(__name__)

MOST_REQUESTS = 100  # of an address in a second
MOST_REMARKS = 10  # in the log in a second
MOST_CONNECTIONS = 64
PATIENCE = 10.0  # [s] with a connection that asks for nothing
HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[0-9a-zA-Z._-]+)(:[0-9]{1,5})?")
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "X-Frame-Options": "DENY",
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src blob:; connect-src 'self' {socket}://{host}; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)


class Counter:
    """
    Count of what one viewer, or one address, asks for: too much if it is more than ``most`` within a second.

    :param most: number of requests or messages
    :param clock: [s]
    """

    def __init__(self, most: int, clock: Clock) -> None:
        self.most, self.clock = most, clock
        self._second, self._count = 0.0, 0

    def is_flooded(self) -> bool:
        """Count one more, and tell whether that is too many."""
        now = self.clock()
        if now - self._second > 1:
            self._second, self._count = now, 0
        self._count += 1
        return self._count > self.most


class Access:
    """
    Gatekeeper of the server.

    There are two access tokens, one for who may drive and one for who may watch. Nobody gets anything without one, on loopback
    neither, for others may use the machine. Requests under other host names (DNS rebinding) and WebSockets of other origins
    are refused. Limits hold for those without a token, too. Who is refused or dropped is told to the log, without tokens.

    :param address: where it is served; the port is set once it is known
    :param tls: certificate and key, None to encrypt nothing
    :param clock: [s], by which requests are counted
    """

    def __init__(self, address: Address, tls: ssl.SSLContext | None, clock: Clock) -> None:
        self.address, self.tls, self.clock = address, tls, clock
        self.patience = PATIENCE
        self.driver_token, self.spectator_token = secrets.token_urlsafe(24), secrets.token_urlsafe(24)
        self._remarks = Counter(MOST_REMARKS, clock)
        self._requests: dict[str | None, Counter] = {}  # by address
        self._useful: set[Any] = set()  # connections that have asked for something

    @web.middleware
    async def guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Answer a request, unless it is refused, with the headers that hold for every answer."""
        self._useful.add(request.protocol)
        try:
            self._check_request(request)
            response = await handler(request)
        except web.HTTPException as refusal:
            refusal.headers.update(HEADERS)
            self.remark(f"refused {request.path!r:.40} to {request.remote}: {refusal.status} {refusal.text}")
            raise
        if not response.prepared:
            policy = POLICY.format(host=request.host, socket="wss" if self.tls else "ws")
            response.headers.update({**HEADERS, "Content-Security-Policy": policy})
        return response

    def _check_request(self, request: web.Request) -> None:
        """
        Check what holds for everybody, whether there is a token or not.

        :raises HTTPException: for too many requests of an address, and for another host name
        """
        if len(self._requests) > MOST_CONNECTIONS:
            self._requests.clear()
        if self._requests.setdefault(request.remote, Counter(MOST_REQUESTS, self.clock)).is_flooded():
            raise web.HTTPTooManyRequests(text="Too many requests: wait a second.")
        found = HOST.fullmatch(request.host)
        host = found[1].strip("[]").lower() if found else ""
        own = {"localhost", self.address.host.lower(), socket.gethostname().lower()}
        if not (host in own or is_number(host)):
            raise web.HTTPForbidden(text="This host name is not served. Use the address that was printed.")

    def remark(self, text: str) -> None:
        """
        Log a remark, without any token.

        :param text: for the log, without a token
        """
        if not self._remarks.is_flooded():
            logger.warning("cockpit: %s", text)

    @property
    def scheme(self) -> str:
        """Scheme of the page's address."""
        return "https" if self.tls else "http"

    def url(self, token: str) -> str:
        """
        Build the address of the page.

        :param token: one of the two
        """
        return self.address.from_elsewhere().url(token, self.scheme)

    def may_drive(self, request: web.Request) -> bool:
        """
        Tell whether a request may drive or only watch.

        :raises HTTPForbidden: if it may not even watch
        """
        token = request.query.get("token", "").encode()
        if hmac.compare_digest(token, self.driver_token.encode()):
            return True
        if hmac.compare_digest(token, self.spectator_token.encode()):
            return False
        raise web.HTTPForbidden(text="The access token is missing or wrong. Use the address that was printed.")

    def check_origin(self, request: web.Request) -> None:
        """
        Check where a WebSocket was opened.

        :raises HTTPForbidden: unless it was on the cockpit's own page
        """
        if request.headers.get("Origin") != f"{self.scheme}://{request.host}":
            raise web.HTTPForbidden(text="Only the cockpit's own page may connect.")

    def admit(self, http: web.Server) -> asyncio.Protocol:
        """
        Answer a new connection.

        :param http: that serves it, unless it is one too many
        """
        return http() if len(http.connections) < MOST_CONNECTIONS else _Refusal()

    async def sweep(self, http: web.Server) -> None:
        """Close connections that ask for nothing, so that they do not keep others out."""
        seen: dict[Any, float] = {}
        while True:
            await asyncio.sleep(self.patience / 4)
            now, connections = time.monotonic(), set(http.connections)
            self._useful &= connections
            seen = {connection: seen.get(connection, now) for connection in connections - self._useful}
            for connection, since in seen.items():
                if now - since > self.patience:
                    connection.force_close()


class _Refusal(asyncio.Protocol):
    """A connection too many."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()
