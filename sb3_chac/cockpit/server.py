"""
The cockpit for a browser: the page, the pictures and what the driver does, over one WebSocket per viewer.

Who may connect: only who has the access token of this drive, from a page that this server has sent. See ``Access``.
"""

import asyncio
import io
import signal
import ssl
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

try:
    import segno
    from aiohttp import WSCloseCode, WSMsgType, web
except ImportError as error:
    raise RuntimeError('--serve needs aiohttp and segno: pip install "aiohttp>=3.10" segno.') from error

from sb3_chac.cockpit.access import MOST_CONNECTIONS, Access, Counter
from sb3_chac.cockpit.address import Address
from sb3_chac.cockpit.devices import Clock
from sb3_chac.cockpit.devices.browser import BadMessage, Browser, Held, Wish, parse
from sb3_chac.cockpit.forms import Answer, Form
from sb3_chac.cockpit.session import Session, SessionEnded, asks_for_help, indicators, who_drives
from sb3_chac.deploy.address import remedy

STATIC = Path(__file__).parent / "static"
FILES = {"/": "index.html", "/cockpit.js": "cockpit.js", "/cockpit.css": "cockpit.css"}
MOST_BYTES = 1024  # of a message
MOST_MESSAGES = 200  # of a viewer in a second, control frames included
MOST_VIEWERS = 16
MOST_BYTES_OF_ANSWER = 2**16
HEARTBEAT = 5.0  # [s] between two questions whether a viewer is still there
LOOK, TELL = 0.01, 0.05  # [s] between two looks for a new picture, and between two messages to a viewer at most


class Viewer:
    """
    One page that is open.

    :param may_drive: whether it may take the wheel
    :param remote: its address
    """

    def __init__(self, socket: web.WebSocketResponse, may_drive: bool, remote: str | None) -> None:
        self.socket, self.may_drive, self.remote = socket, may_drive, remote
        self.news = asyncio.Event()
        self.shown = -1  # number of the newest picture it was sent


class Server:
    """
    Server of the cockpit of a drive.

    Who may come in, ``Access`` decides; messages that the page does not send are refused. One viewer sits at the wheel; it
    becomes free when that one leaves, and is taken by a click then, not by itself. Others who may drive can ask for it, and
    the driver hands it over to the one who has asked first.

    :param drive: with ``device`` at its wheel
    :param device: of the driver
    :param address: port 0 for any that is free
    :param tls: certificate and key, None to encrypt nothing
    :param clock: [s], by which requests and messages are counted
    """

    def __init__(
        self,
        drive: Session,
        device: Browser,
        address: Address,
        tls: ssl.SSLContext | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        self.drive, self.device, self.clock = drive, device, clock
        self.access = Access(address, tls, clock)
        self.viewers: list[Viewer] = []
        self.driver: Viewer | None = None
        self.asking: list[Viewer] = []  # who asks the driver for the wheel, the first one first
        self.form: Form | None = None  # that the driver is asked to fill in
        self.form_number = 0
        self._answer: asyncio.Future[Answer]
        self.has_quit = False
        self.farewell = "The drive is over"
        self._picture: tuple[int, bytes] = (-1, b"")
        self._news = asyncio.Event()

    @asynccontextmanager
    async def listening(self) -> AsyncIterator[None]:
        """
        Serve inside the block.

        :raises OSError: if the address cannot be had
        """
        access = self.access
        app = web.Application(middlewares=[access.guard], client_max_size=MOST_BYTES_OF_ANSWER)
        app.add_routes([web.get(path, self._file) for path in FILES] + [web.get("/ws", self._websocket)])
        app.add_routes([web.get("/form", self._show_form), web.post("/form", self._take_answer)])
        runner = web.AppRunner(app, access_log=None, keepalive_timeout=access.patience, shutdown_timeout=1.0)
        await runner.setup()
        http, loop = runner.server, asyncio.get_running_loop()
        assert http is not None
        try:
            listener = await loop.create_server(
                lambda: access.admit(http), access.address.host, access.address.port, backlog=MOST_CONNECTIONS, ssl=access.tls
            )
        except (OSError, UnicodeError) as error:  # the latter for what can be no name
            await runner.cleanup()
            host, port = access.address
            reason, help_ = str(error), "mend the name"
            if isinstance(error, OSError):
                reason, help_ = error.strerror or reason, remedy(error)
            raise OSError(f"--serve: {host:.80}:{port} cannot be served ({reason}): {help_}.") from error
        access.address = Address(access.address.host, listener.sockets[0].getsockname()[1])
        tasks = [asyncio.create_task(self._publish()), asyncio.create_task(access.sweep(http))]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            listener.close()
            for viewer in list(self.viewers):
                with suppress(ConnectionError, asyncio.TimeoutError):
                    await asyncio.wait_for(viewer.socket.close(code=WSCloseCode.GOING_AWAY, message=self.farewell.encode()), 1)
            await runner.cleanup()

    async def _file(self, request: web.Request) -> web.StreamResponse:
        self.access.may_drive(request)
        if request.path != "/":
            return web.FileResponse(STATIC / FILES[request.path])
        page = (STATIC / FILES["/"]).read_text()
        for name in ("cockpit.css", "cockpit.js"):  # they are not served without the token either
            page = page.replace(f'"{name}"', f'"{name}?token={request.query["token"]}"')
        return web.Response(text=page, content_type="text/html")

    async def _websocket(self, request: web.Request) -> web.StreamResponse:
        self.access.check_origin(request)
        may_drive = self.access.may_drive(request)
        if len(self.viewers) >= MOST_VIEWERS:
            raise web.HTTPServiceUnavailable(text=f"There are {MOST_VIEWERS} viewers already.")
        # Without autoping, control frames come as messages and are counted
        channel = web.WebSocketResponse(
            max_msg_size=MOST_BYTES, heartbeat=HEARTBEAT, compress=False, timeout=1.0, autoping=False
        )
        viewer = Viewer(channel, may_drive, request.remote)
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
            if viewer in self.asking:
                self.asking.remove(viewer)
            if channel.close_code == WSCloseCode.ABNORMAL_CLOSURE:
                self.access.remark(f"lost the viewer at {viewer.remote}")
            if self.driver is viewer:
                self.driver = None
                self.asking.clear()
                with self.drive.person.lock:
                    self.device.leave()
        return channel

    # What they are asked

    async def ask(self, form: Form) -> Answer:
        """
        Ask the driver to fill in a form.

        :param form: is shown until it is answered
        :raises SessionEnded: if the server is to end
        """
        if self.has_quit:
            raise SessionEnded
        self._answer = asyncio.get_running_loop().create_future()
        self.form, self.form_number = form, self.form_number + 1
        try:
            return await self._answer
        finally:
            self.form = None
            self._news.set()

    def quit(self) -> None:
        """End the drive and what is asked."""
        self.has_quit = True
        self.drive.quit()
        if self.form is not None and not self._answer.done():
            self._answer.set_exception(SessionEnded())

    def _asked_form(self, request: web.Request) -> Form:
        """
        Return the form, to who may drive.

        :raises HTTPException: for others, and if none is asked
        """
        if not self.access.may_drive(request):
            raise web.HTTPForbidden(text="Who watches is not asked.")
        if self.form is None or self._answer.done():
            raise web.HTTPNotFound(text="Nothing is asked now.")
        return self.form

    async def _show_form(self, request: web.Request) -> web.StreamResponse:
        form = self._asked_form(request)
        return web.json_response({"number": self.form_number, **asdict(form)})

    async def _take_answer(self, request: web.Request) -> web.StreamResponse:
        self.access.check_origin(request)
        text = await request.text()
        form = self._asked_form(request)
        try:
            answer = form.parse(text, self.form_number)
        except BadMessage as error:
            raise web.HTTPBadRequest(text=str(error)) from error
        self._answer.set_result(answer)
        return web.Response(text="")

    def _sit_down(self, viewer: Viewer) -> None:
        """Take the wheel if it is free. A takeover in progress is never transferred: the vehicle brakes first."""
        if viewer.may_drive and self.driver is None and not self.drive.person.read().takeover:
            self.driver = viewer
            with self.drive.person.lock:
                self.device.sit_down()

    def _ask_for_wheel(self, viewer: Viewer) -> None:
        """Take the wheel if it is free, else ask the driver for it, or ask no longer."""
        if self.driver is None:
            self._sit_down(viewer)
        elif viewer in self.asking:
            self.asking.remove(viewer)
        elif viewer.may_drive and viewer is not self.driver:
            self.asking.append(viewer)

    def _hand_over(self) -> None:
        """Give the wheel to who has asked first, while the novice drives or in a pause: no takeover is ever transferred."""
        with self.drive.person.lock:
            if self.asking and not self.device.takeover:
                self.driver = self.asking.pop(0)
                self.device.change_driver()

    # What they say

    async def _listen(self, viewer: Viewer) -> None:
        counter = Counter(MOST_MESSAGES, self.clock)
        async for message in viewer.socket:
            try:
                if counter.is_flooded():
                    raise BadMessage("too many messages")
                if message.type is WSMsgType.PING:
                    await viewer.socket.pong(message.data)
                    continue
                if message.type is WSMsgType.PONG:
                    continue
                if message.type is not WSMsgType.TEXT:
                    raise BadMessage("not text")
                await self._obey(viewer, parse(message.data))
            except BadMessage as error:
                self.access.remark(f"dropped the viewer at {viewer.remote}: {error}")
                await viewer.socket.close(code=WSCloseCode.POLICY_VIOLATION, message=str(error).encode())
                return

    async def _obey(self, viewer: Viewer, message: Held | Wish) -> None:
        if isinstance(message, Wish) and message.name == "ping":
            await viewer.socket.send_json({"pong": message.number})
        elif isinstance(message, Wish) and message.name == "wheel":
            self._ask_for_wheel(viewer)
        elif viewer is self.driver and isinstance(message, Wish) and message.name == "hand_over":
            self._hand_over()
        elif viewer is self.driver:
            self.drive.obey(self.drive.person.handle(message))
        self._news.set()

    # What they are told

    async def _publish(self) -> None:
        """Wake the viewers when there is something new, and every ``TELL`` anyway."""
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
        """Send the newest state and picture, as fast as the viewer takes them: who is slow gets fewer."""
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
        """Collect what the page shows besides the picture."""
        drive, display, now = self.drive, self.drive.display, self.drive.person.read()
        driver = who_drives(display, now.connected)
        if viewer is self.driver:
            role = "driver"
        elif not viewer.may_drive:
            role = "spectator"
        else:
            role = "free" if self.driver is None else "taken"
        return {
            "role": role,
            "watching": len(self.viewers) - (self.driver is not None),
            "asking": viewer in self.asking,
            "is_asked": role == "driver" and bool(self.asking),
            "form": self.form_number if self.form is not None and role == "driver" else None,
            "may_take_over": drive.person.may_take_over,
            "notice": drive.notice,
            "waits": bool(drive.paused or drive.busy or drive.ended),
            "paused": drive.paused,
            "driver": driver,
            "takeover": driver == "person",
            "collisions": drive.totals.collisions,
            "wants": now.takeover,
            "indicators": indicators(display, drive.totals, drive.lag, now.connected, role != "driver"),
            "confidence": display.novice.confidence,
            "risk": display.novice.risk,
            "route": display.route,
            "corridors": drive.corridors,
            "asks": asks_for_help(display, driver),
            "proposed": display.proposed,
            "applied": display.applied,
            "input": (now.steering, now.pedals),
        }


def as_jpeg(picture: np.ndarray) -> bytes:
    """
    Compress a picture.

    :param picture: shape (height, width, 3), uint8
    """
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture[..., :3])).save(file, "JPEG", quality=80)
    return file.getvalue()


def qr_code(text: str) -> str:
    """
    Draw a QR code.

    :param text: what a phone's camera is to read
    :return: lines for a terminal
    """
    lines = io.StringIO()
    segno.make(text, micro=False).terminal(lines, compact=True)
    return lines.getvalue()


def tls_context(certificate: Path, key: Path | None) -> ssl.SSLContext:
    """
    Load a certificate.

    :param certificate: PEM
    :param key: PEM, None if it is in the same file
    :raises ValueError: if they cannot be used
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, key, password=lambda: b"")
    except (OSError, ValueError) as error:  # of SSL, too
        raise ValueError(f"--tls-cert {certificate}, --tls-key {key}: cannot be used ({error}).") from error
    return context


async def serve(server: Server, conduct: Callable[[], Awaitable[None]]) -> None:
    """
    Serve the cockpit until what it is for is over. SIGINT and SIGTERM end it as the person's quit does.

    :param server: not listening yet
    :param conduct: what it is for, runs as soon as it is served
    :raises OSError: if the address cannot be had
    """
    access, address = server.access, server.access.address
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, server.quit)
    async with server.listening():
        if not access.address.is_loopback and access.tls is None:
            print(
                f"Warning: {address.host} can be reached from other machines, and nothing is encrypted. Safer: --tls-cert, or "
                f"--serve 127.0.0.1:{access.address.port}, and on your machine ssh -L {access.address.port}:127.0.0.1:"
                f"{access.address.port} HERE.",
                file=sys.stderr,
            )
        print(f"Drive at  {access.url(access.driver_token)}")
        print(f"Watch at  {access.url(access.spectator_token)}", flush=True)
        if not access.address.is_loopback and sys.stdout.isatty():
            print("Drive with a phone in this network:\n" + qr_code(access.url(access.driver_token)), flush=True)
        await conduct()
