"""The browser cockpit: a drive on loopback, good and bad viewers, a real browser."""

import asyncio
import json
import os
import re
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import threading
from contextlib import asynccontextmanager, contextmanager, suppress
from types import SimpleNamespace

import aiohttp
import numpy as np
import pytest
from cockpit_toys import Car, cockpit
from shell import FOREVER, wait_until

from sb3_chac.__main__ import main
from sb3_chac.cockpit import access
from sb3_chac.cockpit import server as server_module
from sb3_chac.cockpit.access import MOST_CONNECTIONS, MOST_REQUESTS
from sb3_chac.cockpit.address import Address, parse_address
from sb3_chac.cockpit.devices.browser import STALE, BadMessage, Browser, Held, Wish, parse
from sb3_chac.cockpit.server import MOST_MESSAGES, MOST_VIEWERS, Server, tls_context
from sb3_chac.cockpit.session import SessionEnded
from sb3_chac.cockpit.wrapper import STANDS

NOVICE = np.array([0.25, 0.0], np.float32)
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


class Served:
    """
    A drive of a ``Car`` at 50 steps per second, and its server, in threads of their own.

    The clock by which its driver falls silent is no wall clock: it goes on with what the driver says, see ``tick``.
    """

    def __init__(self, folder, tls=None):
        self.now = 0.0
        self.device = Browser(lambda: self.now)
        self.env, self.drive, self.car = cockpit(folder, self.device, Car(length=10**6), rate=50.0)
        self.server = Server(self.drive, self.device, Address("127.0.0.1", 0), tls, clock=lambda: self.now)
        self.is_served = threading.Event()
        self.threads = [threading.Thread(target=self.run), threading.Thread(target=lambda: asyncio.run(self.serve()))]
        for thread in self.threads:
            thread.start()
        assert self.is_served.wait(FOREVER)
        self.origin = f"{self.server.access.scheme}://127.0.0.1:{self.server.access.address.port}"

    def run(self):
        self.env.env.arm()
        try:
            while True:
                self.env.reset(seed=1)
                while not any(self.env.step(NOVICE)[2:4]):
                    pass
        except SessionEnded:
            pass

    async def serve(self):
        self.loop = asyncio.get_running_loop()
        async with self.server.listening():
            self.is_served.set()
            while not self.drive.ended:
                await asyncio.sleep(0.01)

    def stop(self):
        self.drive.quit()
        for thread in self.threads:
            thread.join(FOREVER)
            assert not thread.is_alive()

    def tick(self):
        """The clock goes on, but waits for what is still on its way from the driver, however slow the machine is."""
        if self.now - self.device.heard_at < STALE / 3:
            self.now += 0.02

    @property
    def steps(self):
        return len(self.car.executed)

    @asynccontextmanager
    async def viewer(self, token=None, origin=None, path="/ws"):
        async with aiohttp.ClientSession() as session:
            token = self.server.access.driver_token if token is None else token
            headers = {"Origin": self.origin if origin is None else origin}
            async with session.ws_connect(f"{self.origin}{path}?token={token}", headers=headers, max_msg_size=0) as channel:
                yield channel


@pytest.fixture
def served(tmp_path, monkeypatch, request):
    """Nobody is dropped because the machine is slow, unless the parameter says after how many seconds."""
    monkeypatch.setattr(server_module, "HEARTBEAT", None)
    monkeypatch.setattr(access, "PATIENCE", getattr(request, "param", FOREVER))
    drive = Served(tmp_path)
    yield drive
    drive.stop()


class Driver:
    """
    Sits at the wheel of a drive: tells what it holds every 20 ms, as the page does, until it is silent.

    :param served: its clock goes on meanwhile
    """

    def __init__(self, channel, served=None):
        self.channel, self.served, self.keys, self.silent = channel, served, [], False

    async def tell(self):
        while not self.silent:
            await self.channel.send_json({"keys": self.keys, "gamepad": None})
            await asyncio.sleep(0.02)
            if self.served is not None:
                self.served.tick()


@asynccontextmanager
async def driving(served):
    async with served.viewer() as channel:
        driver = Driver(channel, served)
        task = asyncio.create_task(driver.tell())
        try:
            await until(lambda: served.drive.person.read().connected)
            await channel.send_json({"wish": "pause"})
            await until(lambda: not served.drive.paused)
            yield driver
        finally:
            task.cancel()


async def until(condition):
    await asyncio.to_thread(wait_until, condition)


async def goes_on(served):
    steps = served.steps
    await until(lambda: served.steps > steps + 3)


async def state_of(channel, wanted=lambda state: True):
    """The first state that is wanted."""
    while True:
        message = await asyncio.wait_for(channel.receive(), FOREVER)
        assert not channel.closed
        if message.type is aiohttp.WSMsgType.TEXT and wanted(state := json.loads(message.data)):
            return state


async def closed(channel):
    """The code with which it was closed."""
    while not channel.closed:
        await asyncio.wait_for(channel.receive(), FOREVER)
    return channel.close_code


# Messages and the device


def test_messages_of_the_page():
    assert parse('{"keys": ["left", "up"], "gamepad": [0, -0.5, 1]}') == Held(frozenset({"left", "up"}), (0, -0.5, 1))
    assert parse('{"wish": "takeover"}') == Wish("takeover") and parse('{"ping": 3}') == Wish("ping", 3)


BAD = [
    "",
    "{",
    "[" * 500,
    "7",
    "{}",
    '{"keys": ["left"]}',
    '{"keys": ["left"], "gamepad": null, "more": 1}',
    '{"keys": ["fly"], "gamepad": null}',
    '{"keys": [1], "gamepad": null}',
    '{"keys": "left", "gamepad": null}',
    '{"keys": ["up", "up", "up", "up", "up"], "gamepad": null}',
    '{"keys": [], "gamepad": [NaN, 0, 0]}',
    '{"keys": [], "gamepad": [Infinity, 0, 0]}',
    '{"keys": [], "gamepad": [2, 0, 0]}',
    '{"keys": [], "gamepad": [true, 0, 0]}',
    '{"keys": [], "gamepad": [0, 0]}',
    '{"keys": [], "gamepad": [1' + "0" * 500 + ", 0, 0]}",
    '{"ping": 1' + "0" * 500 + "}",
    '{"ping": 1' + "0" * 5000 + "}",
    '{"wish": "format"}',
    '{"wish": ["quit"]}',
    '{"ping": -1}',
    '{"ping": 1.5}',
    '{"ping": true}',
]


@pytest.mark.parametrize("text", BAD)
def test_other_messages_are_refused(text):
    with pytest.raises(BadMessage):
        parse(text)


def test_gamepad_drives_and_keys_come_first():
    now = 0.0
    device = Browser(lambda: now)
    device.sit_down()
    device.handle(Held(frozenset(), (1.0, 0.5, 0.0)))
    assert device.read().steering == 1 and 0.4 < device.read().pedals < 0.6 and not device.read().takeover
    device.handle(Held(frozenset(), (0.05, 0.5, 1.0)))
    assert device.read()[:2] == (0, -1)
    device.handle(Wish("takeover"))
    assert device.read().takeover
    device.handle(Held(frozenset({"left"}), (1.0, 0.0, 0.0)))
    now = 0.2
    assert device.read().steering < 0 and device.read().connected
    now = 0.31
    assert not device.read().connected


@pytest.mark.parametrize(
    "text, address", [("8000", ("127.0.0.1", 8000)), ("[::1]:1", ("::1", 1)), ("0.0.0.0:0", ("0.0.0.0", 0))]
)
def test_addresses(text, address):
    parsed = parse_address(text)
    assert parsed == address and parsed.is_loopback == (text != "0.0.0.0:0")


# Driving


def test_keys_drive_and_space_hands_back(served):
    async def play():
        async with driving(served) as driver:
            await goes_on(served)
            assert np.allclose(served.car.executed[-1], NOVICE)
            driver.keys = ["right", "up"]
            await until(lambda: np.allclose(served.car.executed[-1], [1, 1]))
            state = await state_of(driver.channel, lambda state: state["takeover"] and state["applied"] == [1, 1])
            assert state["role"] == "driver" and dict(state["indicators"])["takeover"] == "YOU DRIVE"
            driver.keys = []
            await driver.channel.send_json({"wish": "takeover"})
            await until(lambda: np.allclose(served.car.executed[-1], NOVICE))
            await driver.channel.send_json({"wish": "pause"})
            await until(lambda: served.drive.paused)

    asyncio.run(play())


def test_viewers_get_pictures(served):
    async def look():
        async with driving(served), served.viewer(served.server.access.spectator_token) as channel:
            while (message := await asyncio.wait_for(channel.receive(), FOREVER)).type is not aiohttp.WSMsgType.BINARY:
                pass
            assert message.data.startswith(b"\xff\xd8\xff")  # JPEG

    asyncio.run(look())


@pytest.mark.parametrize("loss", ["stale", "away", "closed"])
def test_a_lost_driver_in_a_takeover_brakes_and_pauses(served, loss):
    async def lose():
        async with driving(served) as driver:
            driver.keys = ["up"]
            await until(lambda: served.drive.display.takeover)
            driver.silent = True
            await asyncio.sleep(0.05)
            if loss == "away":
                await driver.channel.send_json({"wish": "away"})
            elif loss == "closed":
                await driver.channel.close()

            def is_lost():
                served.now += 0.02 * (loss == "stale")
                return served.drive.paused

            await until(is_lost)
            assert served.car.speed < STANDS and served.drive.message.startswith("Braked. Nobody is at the wheel")
            assert not served.drive.person.read().takeover
        async with driving(served):  # somebody else sits down, and P goes on
            await goes_on(served)

    asyncio.run(lose())


def test_a_lost_driver_pauses_the_novice(served):
    async def lose():
        async with driving(served):
            await goes_on(served)
        await until(lambda: served.drive.paused)
        assert np.allclose(served.car.executed, NOVICE)

    asyncio.run(lose())


# Who may do what


def test_spectators_and_second_drivers_only_watch(served):
    async def watch():
        async with driving(served):
            for token, role in (
                (served.server.access.spectator_token, "spectator"),
                (served.server.access.driver_token, "taken"),
            ):
                async with served.viewer(token) as channel:
                    assert (await state_of(channel))["role"] == role
                    for message in (
                        {"keys": ["right"], "gamepad": None},
                        {"wish": "wheel"},
                        {"wish": "hand_over"},
                        {"wish": "pause"},
                        {"wish": "quit"},
                    ):
                        await channel.send_json(message)
                    await channel.send_json({"ping": 5})
                    await state_of(channel, lambda answer: answer.get("pong") == 5)  # all of it was heard
                    assert len(served.server.asking) == (role == "taken")
                    await goes_on(served)
        assert np.allclose(served.car.executed, NOVICE)

    asyncio.run(watch())


def test_a_free_wheel_is_taken_by_asking(served):
    async def take():
        async with served.viewer() as first:
            assert (await state_of(first))["role"] == "driver"
            async with served.viewer() as second:
                assert (await state_of(second))["role"] == "taken"
                await first.close()
                await state_of(second, lambda state: state.get("role") == "free")
                await second.send_json({"wish": "wheel"})
                await state_of(second, lambda state: state.get("role") == "driver")

    asyncio.run(take())


@asynccontextmanager
async def asking(served):
    """Somebody at the wheel, and somebody else who has asked for it."""
    async with driving(served) as driver, served.viewer() as second:
        await second.send_json({"wish": "wheel"})
        await state_of(driver.channel, lambda state: state.get("is_asked"))
        assert (await state_of(second, lambda state: state.get("asking")))["role"] == "taken"
        yield driver, second


def test_the_driver_hands_the_wheel_over_to_who_has_asked_for_it(served):
    async def hand_over():
        async with asking(served) as (driver, second), served.viewer() as third:
            await third.send_json({"wish": "wheel"})
            driver.keys = ["up"]
            await until(lambda: served.drive.display.takeover)
            await driver.channel.send_json({"wish": "hand_over"})  # a takeover is not transferred
            await driver.channel.send_json({"ping": 6})
            await state_of(driver.channel, lambda answer: answer.get("pong") == 6)
            assert (await state_of(driver.channel))["role"] == "driver" and len(served.server.asking) == 2
            driver.keys = []
            await driver.channel.send_json({"wish": "takeover"})
            await until(lambda: not served.drive.display.takeover)
            await driver.channel.send_json({"wish": "hand_over"})
            heir = Driver(second, served)
            await state_of(second, lambda state: state.get("role") == "driver")
            telling = asyncio.create_task(heir.tell())
            steps = served.steps
            driver.keys = ["down"]  # is not listened to any more
            await goes_on(served)
            assert not served.drive.paused and np.allclose(served.car.executed[steps:], NOVICE)
            heir.keys = ["up"]
            await until(lambda: np.allclose(served.car.executed[-1], [0, 1]))
            state = await state_of(driver.channel, lambda state: state.get("role") == "taken" and state["takeover"])
            assert dict(state["indicators"])["takeover"] == "a person"
            assert (await state_of(second, lambda state: state.get("role") == "driver"))["is_asked"]  # by the third
            telling.cancel()

    asyncio.run(hand_over())


def test_a_next_driver_who_is_silent_pauses_the_novice(served):
    async def hand_over():
        async with asking(served) as (driver, second):
            await driver.channel.send_json({"wish": "hand_over"})
            await state_of(second, lambda state: state.get("role") == "driver")

            def is_lost():
                served.now += 0.02
                return served.drive.paused

            await until(is_lost)
            assert np.allclose(served.car.executed, NOVICE)

    asyncio.run(hand_over())


@pytest.mark.parametrize("how", ["takes it back", "leaves", "the driver leaves"])
def test_asking_for_the_wheel_ends(served, how):
    async def end():
        async with asking(served) as (driver, second):
            if how == "takes it back":
                await second.send_json({"wish": "wheel"})
            else:
                await (second if how == "leaves" else driver.channel).close()
            await until(lambda: not served.server.asking)
            if how == "the driver leaves":  # who has asked does not get it without a click
                await state_of(second, lambda state: state.get("role") == "free")
            else:
                await driver.channel.send_json({"wish": "hand_over"})
                assert (await state_of(driver.channel, lambda state: not state.get("is_asked", True)))["role"] == "driver"

    asyncio.run(end())


# Who is refused


async def status(served, path, headers=None):
    async with aiohttp.ClientSession() as session, session.get(served.origin + path, headers=headers) as response:
        return response.status, await response.text(), response.headers


def test_page_and_token(served):
    async def ask():
        token = served.server.access.driver_token
        code, page, headers = await status(served, f"/?token={token}")
        assert code == 200 and "cockpit.js" in page
        assert "default-src 'none'" in headers["Content-Security-Policy"] and headers["Referrer-Policy"] == "no-referrer"
        assert f"cockpit.js?token={token}" in page and f"cockpit.css?token={token}" in page
        for name in ("cockpit.js", "cockpit.css"):
            assert (await status(served, f"/{name}?token={token}"))[0] == 200
        paths = ("/", "/?token=", "/?token=x", f"/?token={token}x", "/?token=%ff", "/ws", "/ws?token=x", "/cockpit.js")
        for path in (*paths, "/cockpit.css"):
            code, text, _ = await status(served, path, {"Origin": served.origin})
            assert code == 403 and "access token is missing or wrong" in text
        assert (await status(served, "/../server.py"))[0] == 404
        for host in (
            "evil.example",
            "evil.example:80",
            "127.0.0.1.evil.example",
            "[",
            "]",
            "[::1",
            "a b",
            "1" * 500,
            ":" * 90,
        ):
            code, text, _ = await status(served, f"/?token={token}", {"Host": host})
            assert code == 403 and "host name is not served" in text
        async with driving(served):
            await goes_on(served)

    asyncio.run(ask())


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1", ""])
def test_other_origins(served, origin):
    async def connect():
        async with driving(served):
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                async with served.viewer(origin=origin):
                    pass
            assert refused.value.status == 403
            await goes_on(served)

    asyncio.run(connect())


@pytest.mark.parametrize(
    "text, code",
    [("x" * 2000, 1009), ("{", 1008), ('{"keys": [], "gamepad": [NaN, 0, 0]}', 1008), (b"{}", 1008)],
)
def test_bad_messages_end_the_connection_and_not_the_drive(served, text, code):
    async def say():
        async with driving(served):
            async with served.viewer() as channel:
                await (channel.send_bytes(text) if isinstance(text, bytes) else channel.send_str(text))
                assert await closed(channel) == code
            await goes_on(served)

    asyncio.run(say())


@pytest.mark.parametrize("frame", ["message", "ping", "pong"])
def test_a_flood_of_messages(served, frame):
    async def flood():
        async with driving(served) as driver:
            driver.silent = True  # the clock stands still: it is a flood however slow the machine is
            async with served.viewer() as channel:
                send = {"message": lambda: channel.send_json({"ping": 1}), "ping": channel.ping, "pong": channel.pong}[frame]
                with suppress(ConnectionError):
                    for _ in range(MOST_MESSAGES + 20):
                        await send()
                assert await closed(channel) == 1008
            await goes_on(served)

    asyncio.run(flood())


def test_a_flood_of_requests_without_a_token(served):
    async def flood():
        async with driving(served) as driver:
            driver.silent = True
            codes = [(await status(served, "/?token=x"))[0] for _ in range(MOST_REQUESTS + 5)]
            assert codes[0] == 403 and codes[-1] == 429
            await goes_on(served)

    asyncio.run(flood())


def test_who_is_refused_or_dropped_is_logged_without_a_token(served, caplog):
    async def come():
        token = served.server.access.driver_token
        assert (await status(served, f"/?token={token}x"))[0] == 403
        async with driving(served), served.viewer() as channel:
            await channel.send_str("{")
            await closed(channel)
            await until(lambda: "dropped the viewer at 127.0.0.1: no JSON" in caplog.text)
        assert "refused '/'" in caplog.text and token not in caplog.text

    asyncio.run(come())


def test_too_many_viewers(served):
    async def crowd():
        async with driving(served):
            async with aiohttp.ClientSession() as session:
                url = f"{served.origin}/ws?token={served.server.access.spectator_token}"
                headers = {"Origin": served.origin}
                channels = [await session.ws_connect(url, headers=headers) for _ in range(MOST_VIEWERS - 1)]
                with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                    await session.ws_connect(url, headers=headers)
                assert refused.value.status == 503
                await goes_on(served)
                await channels[0].close()
                await until(lambda: len(served.server.viewers) < MOST_VIEWERS)
                await session.ws_connect(url, headers=headers)

    asyncio.run(crowd())


@pytest.mark.parametrize("served", [1.0], indirect=True)
def test_a_flood_of_connections(served, monkeypatch):
    # Seconds without a question are those of its clock, so that the driver is let in however slow the machine is
    monkeypatch.setattr(access, "time", SimpleNamespace(monotonic=lambda: served.now))

    async def flood():
        async with driving(served):
            address = ("127.0.0.1", served.server.access.address.port)

            def connect_often():  # not in the thread in which the driver tells what it holds
                return [socket.create_connection(address, timeout=FOREVER) for _ in range(3 * MOST_CONNECTIONS)]

            sockets = await asyncio.to_thread(connect_often)
            await goes_on(served)
            # Those that ask for nothing are closed, and others come in again
            while True:
                try:
                    assert (await status(served, "/cockpit.js"))[0] == 403
                    break
                except aiohttp.ClientError:
                    await asyncio.sleep(0.1)
            for connection in sockets:
                connection.close()
            await goes_on(served)

    asyncio.run(flood())


# The command and the browser


@contextmanager
def command(folder, *arguments):
    env = os.environ | {"MINARI_DATASETS_PATH": str(folder / "minari"), "OMP_NUM_THREADS": "1"}
    own = ["drive", "--algo", "pvp", "--seed", "1", "--serve", "127.0.0.1:0", *arguments]
    process = subprocess.Popen(
        [sys.executable, "-m", "sb3_chac", *own], cwd=folder, env=env, stdout=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


async def driven_until(channel, wanted):
    """Goes on whenever it is paused: on a busy machine the driver falls silent for longer than a device may."""
    patience = 0  # states until the wish is repeated
    while True:
        state = await state_of(channel, lambda state: "role" in state)
        state["total steps"] = int(dict(state["indicators"])["total step"])
        if wanted(state):
            return
        patience = max(patience - 1, 0) if state["paused"] else 0
        if state["paused"] and not patience:
            await channel.send_json({"wish": "pause"})
            patience = 40


def test_drive_in_a_browser_and_sigterm_saves(tmp_path):
    async def play(url):
        page, token = re.fullmatch(r"(.*)/\?token=(.*)", url).groups()
        async with aiohttp.ClientSession() as session:
            async with session.ws_connect(f"{page}/ws?token={token}", headers={"Origin": page}) as channel:
                driver = Driver(channel)
                task = asyncio.create_task(driver.tell())
                await driven_until(channel, lambda state: state["total steps"] > 0)
                driver.keys = ["up"]
                await driven_until(channel, lambda state: state["applied"] == [0, 1])
                process.send_signal(signal.SIGTERM)
                await closed(channel)
                task.cancel()

    with command(tmp_path, "--rate", "50") as process:
        url = process.stdout.readline().split()[-1]
        assert "Watch at" in process.stdout.readline()
        asyncio.run(play(url))
        printed = process.stdout.read()
        assert process.wait(FOREVER) == 0
    assert re.search("in [1-9][0-9]* takeovers", printed) and "sb3-chac drive --resume logs/pvp/SafeDrive-v0_1" in printed
    assert list((tmp_path / "logs/pvp/SafeDrive-v0_1/checkpoints").glob("*/replay_buffer.pkl"))


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--serve", "here"], "--serve must be PORT or HOST:PORT"),
        (["--serve", "8000", "--device", "wheel"], "leave out --device"),
        (["--serve", "203.0.113.1:8000"], "203.0.113.1:8000 cannot be served .*: give an address of this machine"),
        (["--serve", "nohost.invalid:8000"], "--serve: nohost.invalid:8000 cannot be served .*: give another address"),
        (["--serve", "x" * 300 + ":8000"], "cannot be served .*: mend the name"),
    ],
)
def test_wrong_arguments_get_one_message(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SB3_CHAC_TRACEBACK", raising=False)
    monkeypatch.setattr("sys.argv", ["sb3-chac", "drive", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2 and re.search(message, capsys.readouterr().err)


def test_an_encrypted_cockpit(tmp_path):
    certificate, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    make = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost"]
    subprocess.run([*make, "-out", certificate, "-keyout", key], check=True, capture_output=True)
    served = Served(tmp_path, tls_context(certificate, key))

    async def look():
        trusted = ssl.create_default_context(cafile=certificate)
        trusted.check_hostname = False
        async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(ssl=trusted)) as session:
            page = served.server.access.url(served.server.access.spectator_token)
            async with session.get(page) as response:
                assert response.status == 200 and "wss://" in response.headers["Content-Security-Policy"]
            address = page.replace("/?", "/ws?")
            async with session.ws_connect(address, headers={"Origin": served.origin}, max_msg_size=0) as channel:
                assert (await state_of(channel))["role"] == "spectator"

    try:
        assert served.origin.startswith("https://")
        asyncio.run(look())
    finally:
        served.stop()


@pytest.mark.parametrize("content", ["", "no certificate"])
def test_a_certificate_that_cannot_be_used(tmp_path, content):
    (tmp_path / "cert.pem").write_text(content)
    with pytest.raises(ValueError, match="--tls-cert"):
        tls_context(tmp_path / "cert.pem", None)


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_in_chromium(served):
    from playwright.sync_api import sync_playwright

    complaints = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"], timeout=1000 * FOREVER)
        page = browser.new_page()
        page.set_default_timeout(1000 * FOREVER)
        page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))

        def shows(element, text):
            wait_until(lambda: page.inner_text(f"#{element}") == text)

        page.goto(served.server.access.url(served.server.access.driver_token))
        shows("role", "You are at the wheel")
        page.keyboard.press("KeyP")
        shows("takeover-value", "no")
        wait_until(lambda: served.steps > 3)
        assert np.allclose(served.car.executed, NOVICE)

        throttle = "document.querySelectorAll('#applied .bar div')[1].style.width"
        page.keyboard.down("ArrowUp")
        wait_until(lambda: served.tick() or np.allclose(served.car.executed[-1], [0, 1]))
        shows("takeover-value", "YOU DRIVE")
        wait_until(lambda: page.evaluate(throttle) == "50%")
        page.keyboard.up("ArrowUp")
        page.click('button:has-text("Hand back")')
        shows("takeover-value", "no")
        wait_until(lambda: np.allclose(served.car.executed[-1], NOVICE))
        assert page.evaluate("document.getElementById('picture').width") == 8  # of the car's picture

        page.keyboard.down("ArrowUp")
        wait_until(lambda: served.drive.display.takeover)
        page.close()  # in a takeover
        wait_until(lambda: served.drive.paused)
        assert served.car.speed < STANDS
        browser.close()
    assert complaints == []
