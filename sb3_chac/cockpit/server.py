"""The cockpit for a browser: the page, the pictures and what the driver does, over one WebSocket per viewer.

Who may connect: only who has the access token of this drive, from a page that this server has sent. See ``Server``.
"""

import asyncio
import hmac
import io
import secrets
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from PIL import Image

try:
    from aiohttp import WSCloseCode, WSMsgType, web
except ImportError as error:
    raise RuntimeError('--serve needs aiohttp: pip install "sb3-chac[cockpit]".') from error

from sb3_chac.cockpit.browser import Address, BadMessage, Browser, Held, Wish, is_number, parse
from sb3_chac.cockpit.session import Drive, indicators

STATIC = Path(__file__).parent / "static"
FILES = {"/": "index.html", "/cockpit.js": "cockpit.js", "/cockpit.css": "cockpit.css"}
MOST_BYTES = 1024  # of a message
MOST_MESSAGES = 200  # of a viewer in a second
MOST_VIEWERS = 16
MOST_CONNECTIONS = 64
PATIENCE = 10.0  # [s] with a connection that asks for nothing
LOOK, TELL = 0.01, 0.05  # [s] between two looks for a new picture, and between two messages to a viewer at most
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "X-Frame-Options": "DENY",
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src blob:; connect-src 'self' ws://{host}; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)


class Viewer:
    """
    One page that is open.

    :param may_drive: whether it may take the wheel
    """

    def __init__(self, socket: web.WebSocketResponse, may_drive: bool) -> None:
        self.socket, self.may_drive = socket, may_drive
        self.news = asyncio.Event()
        self.shown = -1  # number of the newest picture it was sent
        self._second, self._messages = 0.0, 0

    def is_flooding(self) -> bool:
        """To be called once per message."""
        now = time.monotonic()
        if now - self._second > 1:
            self._second, self._messages = now, 0
        self._messages += 1
        return self._messages > MOST_MESSAGES


class Server:
    """
    Serves the cockpit of a drive.

    There are two access tokens, one for who may drive and one for who may watch. Nobody gets anything without one, on loopback
    neither, for others may use the machine. Requests under other host names (DNS rebinding) and WebSockets of other origins
    are refused, as are messages that the page does not send. One viewer sits at the wheel; it becomes free when that one
    leaves, and is taken by a click then, not by itself.

    :param drive: with ``device`` at its wheel
    :param device: of the driver
    :param address: port 0 for any that is free
    """

    def __init__(self, drive: Drive, device: Browser, address: Address) -> None:
        self.drive, self.device, self.address = drive, device, address
        self.driver_token, self.spectator_token = secrets.token_urlsafe(24), secrets.token_urlsafe(24)
        self.viewers: list[Viewer] = []
        self.driver: Viewer | None = None
        self._picture: tuple[int, bytes] = (-1, b"")
        self._news = asyncio.Event()
        self._useful: set[Any] = set()  # connections that have asked for something

    @asynccontextmanager
    async def listening(self) -> AsyncIterator[None]:
        """
        Serves inside the block.

        :raises OSError: if the address cannot be had
        """
        app = web.Application(middlewares=[self._guard])
        app.add_routes([web.get(path, self._file) for path in FILES] + [web.get("/ws", self._websocket)])
        runner = web.AppRunner(app, access_log=None, keepalive_timeout=PATIENCE, shutdown_timeout=1.0)
        await runner.setup()
        http = runner.server
        assert http is not None

        def connect() -> asyncio.Protocol:
            return http() if len(http.connections) < MOST_CONNECTIONS else _Refusal()

        loop = asyncio.get_running_loop()
        try:
            listener = await loop.create_server(connect, self.address.host, self.address.port, backlog=MOST_CONNECTIONS)
        except OSError as error:
            await runner.cleanup()
            reason = error.strerror or str(error)
            raise OSError(f"--serve: {self.address.host}:{self.address.port} cannot be served: {reason}.") from error
        self.address = Address(self.address.host, listener.sockets[0].getsockname()[1])
        tasks = [asyncio.create_task(self._publish()), asyncio.create_task(self._sweep(http))]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            listener.close()
            for viewer in list(self.viewers):
                with suppress(ConnectionError, asyncio.TimeoutError):
                    await asyncio.wait_for(viewer.socket.close(code=WSCloseCode.GOING_AWAY, message=b"The drive is over"), 1)
            await runner.cleanup()

    # Who may come in

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        self._useful.add(request.protocol)
        host = urlsplit(f"//{request.host}").hostname or ""
        own = {"localhost", self.address.host, socket.gethostname().lower()}
        if not (host in own or is_number(host)):
            raise web.HTTPForbidden(text="This host name is not served. Use the address that was printed.")
        try:
            response = await handler(request)
        except web.HTTPException as refusal:
            refusal.headers.update(HEADERS)
            raise
        if not response.prepared:
            response.headers.update({**HEADERS, "Content-Security-Policy": POLICY.format(host=request.host)})
        return response

    def _may_drive(self, request: web.Request) -> bool:
        """
        :raises HTTPForbidden: if it may not even watch
        """
        token = request.query.get("token", "").encode()
        if hmac.compare_digest(token, self.driver_token.encode()):
            return True
        if hmac.compare_digest(token, self.spectator_token.encode()):
            return False
        raise web.HTTPForbidden(text="The access token is missing or wrong. Use the address that was printed.")

    async def _file(self, request: web.Request) -> web.StreamResponse:
        if request.path == "/":
            self._may_drive(request)
        return web.FileResponse(STATIC / FILES[request.path])

    async def _websocket(self, request: web.Request) -> web.StreamResponse:
        if request.headers.get("Origin") != f"http://{request.host}":
            raise web.HTTPForbidden(text="Only the cockpit's own page may connect.")
        may_drive = self._may_drive(request)
        if len(self.viewers) >= MOST_VIEWERS:
            raise web.HTTPServiceUnavailable(text=f"There are {MOST_VIEWERS} viewers already.")
        channel = web.WebSocketResponse(max_msg_size=MOST_BYTES, heartbeat=5.0, compress=False, timeout=1.0)
        viewer = Viewer(channel, may_drive)
        self.viewers.append(viewer)
        telling = None
        try:
            await channel.prepare(request)
            self._sit_down(viewer)
            telling = asyncio.create_task(self._tell(viewer))
            await self._listen(viewer)
        finally:
            if telling is not None:
                telling.cancel()
            self.viewers.remove(viewer)
            if self.driver is viewer:
                self.driver = None
                with self.drive.person.lock:
                    self.device.leave()
        return channel

    def _sit_down(self, viewer: Viewer) -> None:
        """Nobody gets the wheel of a takeover that another one has begun: first it brakes."""
        if viewer.may_drive and self.driver is None and not self.drive.person.read().takeover:
            self.driver = viewer
            with self.drive.person.lock:
                self.device.sit_down()

    # What they say

    async def _listen(self, viewer: Viewer) -> None:
        async for message in viewer.socket:
            try:
                if viewer.is_flooding():
                    raise BadMessage("too many messages")
                if message.type is not WSMsgType.TEXT:
                    raise BadMessage("not text")
                await self._obey(viewer, parse(message.data))
            except BadMessage as error:
                await viewer.socket.close(code=WSCloseCode.POLICY_VIOLATION, message=str(error).encode())
                return

    async def _obey(self, viewer: Viewer, message: Held | Wish) -> None:
        if isinstance(message, Wish) and message.name == "ping":
            await viewer.socket.send_json({"pong": message.number})
        elif isinstance(message, Wish) and message.name == "wheel":
            self._sit_down(viewer)
        elif viewer is self.driver:
            self.drive.obey(self.drive.person.handle(message))
        self._news.set()

    # What they are told

    async def _publish(self) -> None:
        """Wakes the viewers when there is something new, and every ``TELL`` anyway."""
        told = time.monotonic()
        while True:
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._news.wait(), LOOK)
            display = self.drive.display
            is_new = display.number != self._picture[0] and bool(self.viewers)
            if is_new and display.picture is not None:
                self._picture = display.number, await asyncio.to_thread(as_jpeg, display.picture)
            if is_new or self._news.is_set() or time.monotonic() - told > TELL:
                self._news.clear()
                told = time.monotonic()
                for viewer in self.viewers:
                    viewer.news.set()

    async def _tell(self, viewer: Viewer) -> None:
        """Sends the newest state and picture, as fast as the viewer takes them: who is slow gets fewer."""
        with suppress(ConnectionError):
            while not viewer.socket.closed:
                await viewer.news.wait()
                viewer.news.clear()
                await viewer.socket.send_json(self.state(viewer))
                number, picture = self._picture
                if number != viewer.shown and picture:
                    viewer.shown = number
                    await viewer.socket.send_bytes(picture)

    def state(self, viewer: Viewer) -> dict[str, Any]:
        """
        :return: what the page shows besides the picture
        """
        drive, display, now = self.drive, self.drive.display, self.drive.person.read()
        if viewer is self.driver:
            role = "driver"
        elif not viewer.may_drive:
            role = "spectator"
        else:
            role = "free" if self.driver is None else "taken"
        return {
            "role": role,
            "notice": drive.notice,
            "waits": bool(drive.paused or drive.busy or drive.ended),
            "takeover": display.takeover,
            "wants": now.takeover,
            "indicators": indicators(display, drive.lag),
            "confidence": display.novice.confidence,
            "proposed": display.proposed,
            "applied": display.applied,
            "input": (now.steering, now.pedals),
        }

    async def _sweep(self, http: web.Server) -> None:
        """Closes connections that ask for nothing, so that they do not keep others out."""
        seen: dict[Any, float] = {}
        while True:
            await asyncio.sleep(PATIENCE / 4)
            now, connections = time.monotonic(), set(http.connections)
            self._useful &= connections
            seen = {connection: seen.get(connection, now) for connection in connections - self._useful}
            for connection, since in seen.items():
                if now - since > PATIENCE:
                    connection.force_close()


class _Refusal(asyncio.Protocol):
    """A connection too many."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()


def as_jpeg(picture: np.ndarray) -> bytes:
    """
    :param picture: shape (height, width, 3), uint8
    """
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture[..., :3])).save(file, "JPEG", quality=80)
    return file.getvalue()


async def serve(
    drive: Drive, device: Browser, address: Address, begin: Callable[[], None], is_over: Callable[[], bool]
) -> None:
    """
    Serves the cockpit until the drive is over. SIGINT and SIGTERM end it as the person's quit does.

    :param drive: with ``device`` at its wheel
    :param device: of the driver
    :param address: where
    :param begin: called as soon as it is served
    :param is_over: asked from then on
    :raises OSError: if the address cannot be had
    """
    server = Server(drive, device, address)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, drive.quit)
    async with server.listening():
        if not server.address.is_loopback:
            print(
                f"Warning: {address.host} can be reached from other machines, and nothing is encrypted. Safer: --serve "
                f"127.0.0.1:{server.address.port}, and on your machine ssh -L {server.address.port}:127.0.0.1:"
                f"{server.address.port} HERE.",
                file=sys.stderr,
            )
        print(f"Drive at  {server.address.url(server.driver_token)}")
        print(f"Watch at  {server.address.url(server.spectator_token)}", flush=True)
        begin()
        while not is_over():
            await asyncio.sleep(0.1)
