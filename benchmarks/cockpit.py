"""The cockpit's figures: how soon what the person does is driven, and how steadily the drive goes, with training beside it.

    python benchmarks/cockpit.py drive --minutes 10          # C-HAC on SafeDrive-v0, through both stages
    python benchmarks/cockpit.py drive --env MetaDriveSafety-v0
    python benchmarks/cockpit.py browser --minutes 3         # the same in a Chromium, served on loopback
    python benchmarks/cockpit.py start --times 5            # how long until the first picture of 'sb3-chac drive'
    python benchmarks/cockpit.py report
    python benchmarks/cockpit.py pictures                    # of the guide; of the page too if there is a Chromium

An emulated person presses and lets go keys at random moments, takes over and hands back. All else is what ``sb3-chac drive``
does, with SDL's dummy display. Two CSVs in benchmarks/results/cockpit/ get a row per event and per step of the environment:
<env>-events.csv, from the event in SDL's queue to the moment at which the environment begins the first step that is driven
with it; <env>-steps.csv, the moments of the steps, the gradient steps that were owed, what the car waited for, and the
window's frames. browser.csv gets a row per measured time: "round trip" of a message from the page and back; "action", from a
key to the moment at which the environment begins the first step that is driven with it; "shown", from a key to the page
showing that the driving end has it; and "applied", until the page shows that it was driven; "touch action", "touch shown" and
"touch applied" are the same from a thumb that touches the throttle on the screen; "picture", between two pictures on the page.
start.csv gets the seconds from the command to its address and to its first picture.
It wants a machine with two cores that does nothing else; the load average is in the rows.
"""

import asyncio
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import lab
import numpy as np
import pygame
import torch as th

from sb3_chac.cli import drive as command
from sb3_chac.cockpit.address import Address
from sb3_chac.cockpit.devices import Device, Keyboard
from sb3_chac.cockpit.devices.browser import Browser
from sb3_chac.cockpit.devices.emulator import DeviceEmulator
from sb3_chac.cockpit.experiment import CockpitRun
from sb3_chac.cockpit.window import Window

RESULTS = Path(__file__).parent / "results" / "cockpit"
PICTURES = Path(command.__file__).parent / "cockpit" / "images"
KEYS = (pygame.K_LEFT, pygame.K_RIGHT, pygame.K_UP, pygame.K_DOWN, pygame.K_SPACE)
OLD = {"chac": ("--env-kwargs", "corridors:False")}  # without which this agent was trained
MISSED = 1000.0  # [ms] after which a step was not driven with a key, but with the next one
PERIOD = 0.1  # [s] of a step, as the environments say
VERSIONS = lab.versions("sb3_chac", "torch", "numpy", "pygame-ce", "stable-baselines3")


class Person(threading.Thread):
    """
    Presses keys at random moments.

    :param seed: of the moments
    """

    def __init__(self, seed: int) -> None:
        super().__init__(daemon=True)
        self.rng = random.Random(seed)
        self.emulator = DeviceEmulator()
        self.events: list[float] = []  # [s] time.monotonic()
        self.stopped = threading.Event()

    def run(self) -> None:
        while not self.stopped.wait(self.rng.uniform(0.3, 0.9)):
            key = self.rng.choice(KEYS)
            for action in (self.emulator.press, self.emulator.release):
                self.events.append(time.monotonic())
                action(key)
                if self.stopped.wait(self.rng.uniform(0.25, 0.6)):  # more than a step: each event is seen by itself
                    break


def make_run(env: str, folder: str, device: Device, *arguments: str) -> CockpitRun:
    """
    :param env: id
    :param folder: for everything that is written
    :param device: that the person holds
    :param arguments: more of the command line
    """
    os.environ["MINARI_DATASETS_PATH"] = folder
    own = ["--env", env, "--seed", "1", "--log-folder", folder, "--go", *arguments]
    args = command.make_parser().parse_args(own)
    command.check_arguments(args)
    sys.argv[1:] = ["drive", *own]
    th.set_num_threads(1)
    return CockpitRun(args, device)


def measure(env: str, minutes: float) -> None:
    """
    :param env: id
    :param minutes: of driving
    """
    steps: list[dict[str, Any]] = []
    switch = int(60 * minutes / PERIOD * 0.4)
    with tempfile.TemporaryDirectory() as folder:
        window = Window("benchmark")
        run = make_run(env, folder, Keyboard(), "-params", f"switch_after:{switch}")
        person = Person(seed=0)

        def watch() -> None:
            while run.cockpit is None and not run.is_over:
                time.sleep(0.01)
            assert run.cockpit is not None
            vehicle = run.cockpit.env
            step = vehicle.step

            def timed(action: np.ndarray) -> Any:
                drive = run.drive
                now, heard = time.monotonic(), drive.person.input.time
                steps.append(
                    {
                        "time": now,
                        "heard": heard,
                        "lag": drive.lag,
                        "stage": drive.display.novice.stage,
                        "frames": window.frames,
                    }
                )
                return step(action)

            vehicle.step = timed  # type: ignore[method-assign]
            run.drive.go_on()
            person.start()
            time.sleep(60 * minutes)
            person.stopped.set()
            run.drive.quit()

        run.thread.start()
        threading.Thread(target=watch, daemon=True).start()
        window.run(run.drive, lambda: run.is_over)
        run.thread.join()
        window.close()
        if run.error is not None:
            raise run.error
    write(env, steps, person.events)


# In the page: a ping and its answer; and when what is pressed is shown
PING = """() => new Promise((resolve) => {
  const begun = performance.now();
  socket.addEventListener("message", ({ data }) => {
    if (typeof data === "string" && JSON.parse(data).pong === 0) resolve(performance.now() - begun);
  });
  send({ ping: 0 });
})"""
WATCH = """() => {
  window.seen = { shown: [], applied: [], "touch shown": [], "touch applied": [], picture: [] };
  window.presses = [];  // how, and when [ms since 1970]
  const begun = {};
  let by = "";
  const begin = (how) => (event) => {
    if (event.repeat || event.code === "Space") return;
    by = how;
    begun.shown = begun.applied = performance.now();
    window.presses.push([how, performance.timeOrigin + event.timeStamp]);
  };
  const drawn = draw;
  let last = null;
  window.draw = (blob) => {
    const now = performance.now();
    if (last !== null) window.seen.picture.push(now - last);
    last = now;
    return drawn(blob);
  };
  addEventListener("keydown", begin(""), true);
  addEventListener("pointerdown", begin("touch "), true);
  for (const [kind, row] of [["shown", "input"], ["applied", "applied"]]) {
    new MutationObserver(() => {
      if (begun[kind]) window.seen[by + kind].push(performance.now() - begun[kind]);
      begun[kind] = null;
    }).observe(byId(row).querySelectorAll(".bar div")[1], { attributes: true });
  }
}"""


def measure_browser(env: str, minutes: float) -> None:
    """
    :param env: id
    :param minutes: of driving
    """
    from sb3_chac.cockpit.server import Server

    device = Browser()
    rows: list[dict[str, Any]] = []
    steps: list[tuple[float, bool]] = []  # [s] since 1970 when each began, and whether it was driven with the throttle

    def drive_in_chromium() -> None:
        from playwright.sync_api import sync_playwright

        while run.cockpit is None and not run.is_over:
            time.sleep(0.01)
        assert run.cockpit is not None
        vehicle = run.cockpit.env
        step = vehicle.step

        def timed(action: np.ndarray) -> Any:
            now = run.drive.person.input
            steps.append((time.time(), now.takeover and now.pedals > 0))
            return step(action)

        vehicle.step = timed  # type: ignore[method-assign]
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium(), args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1200, "height": 780}, has_touch=True)
            page.goto(server.access.address.url(server.access.driver_token))
            page.wait_for_selector("text=You are at the wheel")
            page.keyboard.press("KeyP")
            fingers = page.context.new_cdp_session(page)
            end = time.monotonic() + 60 * minutes
            rng = random.Random(0)
            page.evaluate(WATCH)
            while time.monotonic() < end:
                if run.drive.paused:  # a busy machine has made the page fall silent
                    page.keyboard.press("KeyP")
                    time.sleep(0.5)
                rows.extend({"kind": "round trip", "ms": page.evaluate(PING)} for _ in range(5))
                page.keyboard.down("ArrowUp")  # takes over, too, where an episode has begun
                time.sleep(rng.uniform(0.3, 0.4))
                page.keyboard.up("ArrowUp")
                time.sleep(rng.uniform(0.6, 0.7))  # it is back in the middle
                page.keyboard.press("Space")
                time.sleep(rng.uniform(0.3, 0.4))
                pedals = page.locator("#pedals").bounding_box()
                assert pedals is not None
                throttle = {"x": pedals["x"] + pedals["width"] / 2, "y": pedals["y"] + pedals["height"] / 10}
                fingers.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [throttle]})
                time.sleep(rng.uniform(0.3, 0.4))
                fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
                time.sleep(rng.uniform(1.2, 1.3))  # handed back
            rows.extend({"kind": kind, "ms": value} for kind, values in page.evaluate("seen").items() for value in values)
            for how, pressed in page.evaluate("presses"):
                action = next((1000 * began - pressed for began, has_it in steps if has_it and 1000 * began > pressed), None)
                if action is not None and action < MISSED:
                    rows.append({"kind": f"{how}action", "ms": action})
            facts = {"load": round(os.getloadavg()[1], 2), "cores": os.cpu_count()}
            versions = {"versions": f"{VERSIONS} chromium={browser.version}"}
            rows[:] = [row | {"ms": round(row["ms"], 2)} | facts | versions for row in rows]
            browser.close()

    with tempfile.TemporaryDirectory() as folder:
        run = make_run(env, folder, device)
        server = Server(run.drive, device, Address("127.0.0.1", 0))
        visit(run, server, drive_in_chromium)
    lab.write(RESULTS / "browser.csv", rows)
    report()


def write(env: str, steps: list[dict[str, Any]], events: list[float]) -> None:
    """
    :param steps: a row each
    :param events: moments
    """
    first = steps[0]["time"]
    facts = {"load": round(os.getloadavg()[2], 2), "cores": os.cpu_count(), "versions": VERSIONS}
    heard = np.array([step["heard"] for step in steps])
    rows = []
    for event in events:
        index = int(np.searchsorted(heard, event))  # the first step that knew of it
        if event > first and index < len(steps):
            rows.append(
                {"event": round(event - first, 5), "latency_ms": round(1000 * (steps[index]["time"] - event), 2)} | facts
            )
    for step in steps:
        step["time"] = round(step["time"] - first, 5)
        del step["heard"]
    lab.write(RESULTS / f"{env}-events.csv", rows)
    lab.write(RESULTS / f"{env}-steps.csv", [step | facts for step in steps])
    report()


def report() -> None:
    """Prints the figures of the CSVs."""
    if (RESULTS / "start.csv").exists():
        rows = lab.read(RESULTS / "start.csv")
        for until in ("address", "picture"):
            seconds = np.array([float(row["seconds"]) for row in rows if row["until"] == until])
            what = f"start [s]: {until} after {np.median(seconds):.1f} (least {seconds.min():.1f}, most {seconds.max():.1f})"
            print(f"{what}, of {len(seconds)}, load average {rows[0]['load']}")
    if (RESULTS / "browser.csv").exists():
        report_browser()
    for file in sorted(RESULTS.glob("*-events.csv")):
        env = file.name.removesuffix("-events.csv")
        events, steps = (lab.read(RESULTS / f"{env}-{kind}.csv") for kind in ("events", "steps"))
        latency = np.array([float(row["latency_ms"]) for row in events])
        times = np.array([float(row["time"]) for row in steps])
        lag, frames = (np.array([int(row[name]) for row in steps]) for name in ("lag", "frames"))
        intervals, seconds = 1000 * np.diff(times), times[-1]
        tens = np.histogram(times, np.arange(0, seconds, 10))[0] / 10
        print(f"{env}: {seconds / 60:.1f} minutes, {len(steps)} steps, load average {events[0]['load']}")
        p50, p99 = np.percentile(latency, (50, 99))
        print(f"  input to action [ms]: median {p50:.0f}, p99 {p99:.1f}, most {latency.max():.1f}, of {len(latency)} events")
        mean, fastest = (len(times) - 1) / seconds, 10 / (times[10:] - times[:-10]).min()
        print(f"  rate [1/s]: {mean:.2f}, least in 10 s {tens.min():.1f}, most over 10 steps {fastest:.2f}")
        p99 = np.percentile(intervals, 99)
        print(f"  between steps [ms]: least {intervals.min():.2f}, p99 {p99:.1f}, most {intervals.max():.0f}")
        print(f"  window: {(frames[-1] - frames[0]) / seconds:.1f} frames per second")
        print(f"  gradient steps owed: median {np.median(lag):.0f}, most {lag.max()}, at the end {lag[-1]}")


def report_browser() -> None:
    rows = lab.read(RESULTS / "browser.csv")
    print(f"Chromium on loopback, load average {rows[0]['load']}")
    for kind in ("round trip", "action", "shown", "applied", "touch action", "touch shown", "touch applied", "picture"):
        times = np.array([float(row["ms"]) for row in rows if row["kind"] == kind])
        if len(times) == 0:
            continue
        p50, p99 = np.percentile(times, (50, 99))
        print(f"  {kind} [ms]: median {p50:.1f}, p99 {p99:.1f}, most {times.max():.1f}, of {len(times)}")


def measure_start(times: int) -> None:
    """
    :param times: how often the command is begun
    """
    rows = []
    command_line = [sys.executable, "-m", "sb3_chac", "drive", "--serve", "0", "--seed", "1"]
    for _ in range(times):
        with tempfile.TemporaryDirectory() as folder:
            begun = time.monotonic()
            environment = {**os.environ, "MINARI_DATASETS_PATH": folder}
            process = subprocess.Popen(
                [*command_line, "-f", folder], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
            )
            assert process.stdout is not None
            address = next(found[1] for line in process.stdout if (found := re.match(r"Drive at +(\S+)", line)))
            rows.append({"until": "address", "seconds": round(time.monotonic() - begun, 2)})
            asyncio.run(first_picture(address))
            rows.append({"until": "picture", "seconds": round(time.monotonic() - begun, 2)})
            process.terminate()
            process.wait()
    facts = {"load": round(os.getloadavg()[1], 2), "cores": os.cpu_count(), "versions": VERSIONS}
    lab.write(RESULTS / "start.csv", [row | facts for row in rows])
    report()


async def first_picture(address: str) -> None:
    """
    :param address: of the page
    """
    import aiohttp

    origin, _, query = address.partition("/?")
    async with aiohttp.ClientSession() as session, session.ws_connect(f"{origin}/ws?{query}", origin=origin) as channel:
        while (await channel.receive()).type is not aiohttp.WSMsgType.BINARY:
            pass


def pictures() -> None:
    """Writes those of the operator's guide: trained agents drive, the person takes over."""
    for name, algo, keys in (("takeover", "dpvp", [pygame.K_DOWN, pygame.K_RIGHT]), ("stage-2", "chac", [])):
        agent = Path(__file__).parent / "agents" / f"{algo}-SafeDrive-v0.zip"
        with tempfile.TemporaryDirectory() as folder:
            window = Window("picture")
            run = make_run(
                "SafeDrive-v0", folder, Keyboard(), "--algo", algo, "--trained-agent", str(agent), *OLD.get(algo, ())
            )

            def is_over(run: CockpitRun = run, window: Window = window, keys: list[int] = keys, name: str = name) -> bool:
                display = run.drive.display
                while keys and display.number >= 60:
                    DeviceEmulator().press(keys.pop())
                if display.number >= 64 and (display.takeover or display.novice.self_drives) and not run.drive.ended:
                    window.draw()
                    pygame.image.save(window.screen, PICTURES / f"{name}.png")
                    run.drive.quit()
                return run.is_over

            run.drive.go_on()
            window.help = False
            run.thread.start()
            window.run(run.drive, is_over)
            run.thread.join()
            window.close()
            if run.error is not None:
                raise run.error
    if chromium() is not None:
        pictures_of_the_page()


def visit(run: CockpitRun, server: Any, visitor: Callable[[], None]) -> None:
    """
    :param run: that is driven
    :param server: of its page
    :param visitor: opens the page and drives, in a thread of its own; then the drive ends
    """

    async def serve() -> None:
        async with server.listening():
            run.thread.start()
            try:
                await asyncio.to_thread(visitor)
            finally:
                run.drive.quit()
            while not run.is_over:
                await asyncio.sleep(0.1)

    asyncio.run(serve())
    if run.error is not None:
        raise run.error


def chromium() -> str | None:
    """
    :return: path of the browser
    """
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def pictures_of_the_page() -> None:
    """A trained agent drives, the person takes over: on a screen with a key, on a phone with a thumb."""
    from sb3_chac.cockpit.server import Server

    device = Browser()

    def take_pictures() -> None:
        from playwright.sync_api import sync_playwright

        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium(), args=["--no-sandbox"])
            for name, width, height, touch in (("browser", 1280, 800, False), ("phone", 844, 390, True)):
                page = browser.new_page(viewport={"width": width, "height": height}, has_touch=touch)
                page.goto(server.access.address.url(server.access.driver_token))
                page.wait_for_selector("text=You are at the wheel")
                begun = run.drive.display.number
                while run.drive.display.number < begun + 40:
                    if run.drive.paused:  # at first, and whenever a busy machine makes the page fall silent
                        page.keyboard.press("KeyP")
                        time.sleep(0.5)
                    time.sleep(0.05)
                if touch:
                    pad = page.locator("#pedals").bounding_box()
                    assert pad is not None
                    place = {"x": pad["x"] + pad["width"] / 2, "y": pad["y"] + 0.8 * pad["height"]}
                    thumb = page.context.new_cdp_session(page)
                    thumb.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [place]})
                else:
                    page.keyboard.down("ArrowDown")
                page.wait_for_selector("text=YOU DRIVE")
                page.screenshot(path=PICTURES / f"{name}.png")
                page.keyboard.press("Space")
                page.close()
            browser.close()

    with tempfile.TemporaryDirectory() as folder:
        agent = Path(__file__).parent / "agents" / "dpvp-SafeDrive-v0.zip"
        run = make_run("SafeDrive-v0", folder, device, "--algo", "dpvp", "--trained-agent", str(agent))
        server = Server(run.drive, device, Address("127.0.0.1", 0))
        visit(run, server, take_pictures)


if __name__ == "__main__":
    parser = lab.make_parser(__doc__, ["drive", "browser", "start", "report", "pictures"])
    parser.add_argument("--env", default="SafeDrive-v0", metavar="ID")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--times", type=int, default=5)
    arguments = parser.parse_args()
    if arguments.command == "drive":
        measure(arguments.env, arguments.minutes)
    elif arguments.command == "browser":
        measure_browser(arguments.env, arguments.minutes)
    elif arguments.command == "start":
        measure_start(arguments.times)
    else:
        {"report": report, "pictures": pictures}[arguments.command]()
