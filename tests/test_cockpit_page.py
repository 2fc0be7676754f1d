"""The page of the browser cockpit in a Chromium: on phones and large screens, with thumbs, and what it says of who drives."""

import itertools
import os
import re
from contextlib import contextmanager
from dataclasses import replace
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from cockpit_toys import Car, cockpit
from shell import FOREVER, wait_until
from test_cockpit_browser import CHROMIUM, NOVICE, Served

from sb3_chac.cockpit import access
from sb3_chac.cockpit import server as server_module
from sb3_chac.cockpit.address import Address
from sb3_chac.cockpit.devices.browser import MOMENT, BadMessage, Browser, Held, Wish, parse
from sb3_chac.cockpit.meter import CALM, LEAST, GuidanceMeter, Lesson, LessonMeter
from sb3_chac.cockpit.session import Display, Novice, Totals, asks_for_help, indicators, who_drives
from sb3_chac.cockpit.wrapper import STANDS
from sb3_chac.common.contract import Guidance, TakeoverDisplay

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
# Whether there is a touch screen, sizes
SIZES = [(True, [(390, 844), (844, 390)]), (False, [(800, 600), (1280, 800), (1920, 1080)])]
MORE_SIZES = [
    (True, [(360, 640), (640, 360), (1024, 768), (768, 1024)]),
    (False, [(360, 640), (640, 360), (390, 844), (844, 390), (2560, 1440)]),
]
LOOKED_AT = os.environ.get("SB3_CHAC_SCREENSHOTS")  # a folder, for those who want to look


# The device: thumbs


def device_at(now=0.0):
    clock = [now]
    device = Browser(lambda: clock[0])
    device.sit_down()
    return device, clock


def hold(device, touch=None, keys=()):
    device.handle(Held(frozenset(keys), None, touch))


def test_messages_with_a_touch():
    assert parse('{"keys": [], "gamepad": null, "touch": [-0.5, 1]}') == Held(frozenset(), None, (-0.5, 1.0))
    assert parse('{"keys": [], "gamepad": null, "touch": null}') == parse('{"keys": [], "gamepad": null}')
    for touch in ("[0]", "[0, 2]", "[0, NaN]", "[true, 0]", "7", '"left"'):
        with pytest.raises(BadMessage, match="touch"):
            parse(f'{{"keys": [], "gamepad": null, "touch": {touch}}}')


def test_touching_takes_over_and_letting_go_hands_back_after_a_moment():
    device, clock = device_at()
    hold(device)
    assert not device.read().takeover
    hold(device, (-0.5, 0.25))
    assert device.read()[:3] == (-0.5, 0.25, True)
    hold(device)
    assert device.read()[:3] == (0, 0, True)
    clock[0] = 0.9 * MOMENT
    assert device.read().takeover
    hold(device, (0.1, 0.0))  # the thumb is back in time
    clock[0] = 3 * MOMENT
    hold(device, (0.1, 0.0))
    assert device.read().takeover
    hold(device)
    clock[0] = 4 * MOMENT
    hold(device)
    assert not device.read().takeover


@pytest.mark.parametrize("by", ["wish", "key"])
def test_a_takeover_that_began_otherwise_is_not_handed_back_by_letting_go(by):
    device, clock = device_at()
    if by == "wish":
        device.handle(Wish("takeover"))
    else:
        hold(device, keys=["up"])
    hold(device, (0.5, 0.0))
    hold(device)
    clock[0] = 2 * MOMENT
    hold(device)
    assert device.read().takeover
    device.handle(Wish("takeover"))
    assert not device.read().takeover


def test_a_touch_that_becomes_a_key_or_is_handed_back_by_a_wish():
    device, clock = device_at()
    hold(device, (0.5, 0.0))
    hold(device, None, ["left"])  # goes on with the keyboard
    clock[0] = 2 * MOMENT
    hold(device, None, ["left"])
    assert device.read().takeover
    device.hand_back()
    hold(device, (0.5, 0.0))
    device.handle(Wish("takeover"))  # the button, while the other thumb steers
    assert not device.read().takeover
    device.go_away()
    assert device.read()[:2] == (0, 0)


# The way there for a phone


@pytest.mark.parametrize("host, scheme", [("0.0.0.0", "http"), ("::", "https"), ("192.0.2.7", "http")])
def test_the_printed_address_can_be_used_elsewhere(host, scheme):
    url = Address(host, 8000).from_elsewhere().url("abc", scheme)
    parts = urlsplit(url)
    assert not ip_address(parts.hostname).is_unspecified and (parts.scheme, parts.port) == (scheme, 8000)
    if host == "192.0.2.7":
        assert parts.hostname == host
    lines = server_module.qr_code(url).splitlines()
    assert len(lines) > 15 and len({len(re.sub("\x1b[^m]*m", "", line)) for line in lines if line.strip()}) == 1


# Who drives


@pytest.mark.parametrize(
    "display, is_manned, watches, driver, takeover, self_learning",
    [
        (Display(), True, False, "novice", "no", "in use"),
        (Display(takeover=True), True, False, "person", "YOU DRIVE", "no"),
        (Display(takeover=True), True, True, "person", "a person", "no"),
        (Display(takeover=True), False, False, "brake", "nobody", "no"),
        (Display(brakes=True), False, True, "brake", "nobody", "no"),
        (Display(), False, False, "novice", "no", "in use"),
    ],
)
def test_what_is_said_of_who_drives(display, is_manned, watches, driver, takeover, self_learning):
    display = replace(display, novice=Novice("2", True, 0.9))
    said = dict(indicators(display, Totals(), 0, is_manned, watches))
    assert who_drives(display, is_manned) == driver
    assert (said["takeover"], said["self-learning"], said["confidence"]) == (takeover, self_learning, "0.90")


def test_nobody_is_said_to_drive_while_the_car_brakes_by_itself(tmp_path):
    device, clock = device_at()
    hold(device)
    env, drive, car = cockpit(tmp_path, device)
    env.env.arm()
    env.reset()
    hold(device, (0.0, 1.0))
    env.step(NOVICE)
    assert who_drives(drive.display, True) == "person"
    shown, show = [], drive.show

    def watch(**changes):
        show(**changes)
        shown.append(drive.display)

    drive.show, drive.wait_for_tick = watch, lambda: None
    clock[0] = 9.0  # nothing was heard for long
    assert env.step(NOVICE)[4]["unattended"] and car.speed < STANDS
    assert {who_drives(display, False) for display in shown[:-1]} == {"brake"}
    assert who_drives(shown[-1], False) == "novice" and not any(display.takeover for display in shown)


def test_collisions_are_counted_once(tmp_path):
    class Bumping(Car):
        def step(self, action):
            *step, info = super().step(action)
            return *step, info | {"crashed": self.steps in (2, 3, 4, 6)}

    device, _ = device_at()
    hold(device)
    env, drive, _ = cockpit(tmp_path, device, Bumping())
    env.reset()
    assert [env.step(NOVICE) and drive.totals.collisions for _ in range(7)] == [0, 1, 1, 1, 1, 2, 2]


@pytest.mark.parametrize(
    "guidance, speed, following",
    [
        (Guidance(), "36 km/h", "-"),
        (Guidance("left", 41.6, 15.0), "36/54 km/h", "left 42 m"),
        (Guidance("2nd exit", 0.0), "36 km/h", "2nd exit now"),
    ],
)
def test_what_is_said_of_the_way_ahead(guidance, speed, following):
    said = dict(indicators(Display(speed=10.0, guidance=guidance), Totals(), 0))
    assert (said["speed"], said["next"]) == (speed, following)


@pytest.mark.parametrize("corridors", [None, False, True])
def test_the_corridors_are_shown_and_hidden_where_there_are_any(tmp_path, corridors):
    class Painted(Car, TakeoverDisplay):
        show_corridors = corridors
        guidance = Guidance("right", 7.0)

    device, _ = device_at()
    hold(device)
    env, drive, car = cockpit(tmp_path, device, Painted())
    env.reset()
    shown = []
    for _ in range(3):
        shown.append(car.show_corridors)
        drive.obey(device.handle(Wish("corridors")))
        hold(device)
        env.step(NOVICE)
    other = None if corridors is None else not corridors
    assert shown == [corridors, other, corridors] and drive.display.guidance == Guidance("right", 7.0)


# The guidance meter


def test_risk_is_the_share_of_higher_values_and_help_is_asked_for_until_it_is_calm():
    meter = GuidanceMeter(threshold=0.9)
    assert [meter.tell(float(value)) for value in range(LEAST)] == [None] * LEAST and not meter.asks
    assert meter.tell(None) is None
    assert meter.tell(-1.0) == 1.0 and meter.asks
    for step in range(CALM):
        assert meter.asks
        assert meter.tell(1000.0 + step) == 0.0
    assert not meter.asks
    assert meter.tell(LEAST / 2 - 0.5) == pytest.approx(0.5, abs=0.15)


def test_without_a_threshold_nobody_is_asked():
    meter = GuidanceMeter()
    for value in range(2 * LEAST):
        meter.tell(-float(value))
    assert meter.tell(-1e9) == 1.0 and not meter.asks


def test_a_lesson_is_the_change_since_the_takeover_began_and_counts_states_like_it():
    meter = LessonMeter((0.5, -0.25))
    assert str(meter.tell((0.5, -0.25), None)) == "+0.00, 0 alike"
    meter.tell((0.6, -0.3), -0.25)
    meter.tell((0.6, -0.3), -0.2)
    assert meter.tell((0.75, -0.5), None) == (0.25, -0.25, 1)
    assert str(meter.tell((0.75, -0.5), -0.9)) == "+0.50, 2 alike"


def test_memory_ends():
    meter = GuidanceMeter(memory=LEAST)
    for value in [1.0] * LEAST + [-1.0] * LEAST:
        meter.tell(value)
    assert meter.tell(-0.5) == 0.0


def test_a_person_who_drives_is_not_asked():
    display = Display(novice=Novice("1", risk=0.97, asks=True))
    assert dict(indicators(display, Totals(), 0))["risk"] == "HELP 97%" and asks_for_help(display, "novice")
    assert dict(indicators(replace(display, takeover=True), Totals(), 0))["risk"] == "97%"


# The page

CHECK = """() => {
  const problems = [];
  const parts = [...document.querySelectorAll("#view, #who, .cell, .row, main button, .pad, #notice")];
  const seen = parts.filter((part) => part.checkVisibility() && part.getBoundingClientRect().width);
  const box = (part) => part.getBoundingClientRect();
  const name = (part) => part.id || part.textContent.trim();
  for (const part of seen) {
    const { left, top, right, bottom } = box(part);
    const isInside = left >= -1 && top >= -1 && right <= innerWidth + 1 && bottom <= innerHeight + 1;
    if (!isInside) problems.push(`${name(part)} leaves the view`);
    if (part.scrollWidth > part.clientWidth + 1 && part.clientWidth) problems.push(`${name(part)} is cut off`);
  }
  for (const [i, a] of seen.entries()) for (const b of seen.slice(i + 1)) {
    const [one, other] = [box(a), box(b)];
    const width = Math.min(one.right, other.right) - Math.max(one.left, other.left);
    const height = Math.min(one.bottom, other.bottom) - Math.max(one.top, other.top);
    if (width > 1 && height > 1 && !a.contains(b)) problems.push(`${name(a)} and ${name(b)} overlap`);
  }
  const still = [document.scrollingElement, ...document.querySelectorAll("#panel, dialog[open]")];
  for (const part of still) {
    if (part.scrollHeight > part.clientHeight + 1) problems.push(`${part.id || "page"} scrolls`);
  }
  for (const dialog of document.querySelectorAll("dialog[open]")) {
    const { left, top, right, bottom } = box(dialog);
    if (left < 0 || top < 0 || right > innerWidth || bottom > innerHeight) problems.push(`${dialog.id} leaves the view`);
  }
  const view = box(document.getElementById("view"));
  if (view.width * view.height < 0.2 * innerWidth * innerHeight) problems.push("the picture is small");
  for (const button of document.querySelectorAll("main button, .pad")) {
    const { width, height } = box(button);
    if (button.checkVisibility() && (width < 44 || height < 44)) problems.push(`${name(button)} is too small to touch`);
  }
  return problems;
}"""


@pytest.fixture
def served(tmp_path, monkeypatch):
    monkeypatch.setattr(server_module, "HEARTBEAT", None)
    monkeypatch.setattr(access, "PATIENCE", FOREVER)
    monkeypatch.setattr(server_module, "MOST_MESSAGES", 10**9)  # within a second of its clock, which may stand still
    drive = Served(tmp_path)
    yield drive
    drive.stop()


@contextmanager
def chromium():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"], timeout=1000 * FOREVER)
        yield browser
        browser.close()


@contextmanager
def opened(browser, served, **context):
    """A page whose driver is at the wheel; there must be no complaint of it."""
    complaints = []
    opened = browser.new_context(**context)
    opened.set_default_timeout(1000 * FOREVER)
    page = opened.new_page()
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(served.server.access.url(served.server.access.driver_token))
    shows(page, "role", "You are at the wheel")
    yield page
    opened.close()
    assert complaints == []


def shows(page, element, text):
    wait_until(lambda: page.inner_text(f"#{element}") == text, pause=0.05)


@needs_chromium
@pytest.mark.parametrize("all_sizes", [SIZES, pytest.param(MORE_SIZES, marks=pytest.mark.slow)], ids=["few", "more"])
def test_nothing_overlaps_or_leaves_the_view_in_any_size(served, all_sizes):
    """With the longest values. Help and options fit as well, and are closed at first."""
    novice = Novice("2: self-learning", True, 0.97, 1.0, True, Lesson(12.0, -12.0, 999))
    numbers = {"total_steps": 1_234_567, "human_steps": 1_234_567, "seconds": 123_456.0, "cost": 1234.5, "collisions": 3}
    served.drive.lag = 123_456
    with chromium() as browser:
        for touch, sizes in all_sizes:
            context = {
                "has_touch": touch,
                "is_mobile": touch,
                "viewport": dict(zip(("width", "height"), sizes[0], strict=True)),
            }
            with opened(browser, served, **context) as page:
                served.server.asking = [served.server.viewers[0]]  # somebody asks for the wheel
                guidance = Guidance("straight", 199.0, 33.3)
                served.drive.show(novice=novice, speed=33.3, route=1.0, guidance=guidance)
                served.drive.count(episode=12_345, **numbers)
                shows(page, "total-step-value", "1234567")
                shows(page, "wheel", "Somebody asks for the wheel: hand over")
                for width, height in sizes:
                    page.set_viewport_size({"width": width, "height": height})
                    wait_until(lambda: page.evaluate("[innerWidth, innerHeight]") == [width, height], pause=0.02)  # noqa: B023
                    name = f"{width}x{height}{'-touch' if touch else ''}"
                    assert page.locator("#steering").is_visible() == touch and not page.locator("dialog").first.is_visible()
                    assert page.evaluate(CHECK) == [], name
                    if LOOKED_AT:
                        page.screenshot(path=Path(LOOKED_AT) / f"{name}.png")
                    for button, dialog in (("Help", "help"), ("Options", "options")):
                        page.click(f"button:has-text('{button}')")
                        assert page.locator(f"#{dialog}").is_visible()
                        assert page.evaluate(CHECK) == [], f"{dialog} in {name}"
                        if LOOKED_AT:
                            page.screenshot(path=Path(LOOKED_AT) / f"{name}-{dialog}.png")
                        page.click(f"#{dialog} button")


def touch(session, *points):
    """:param points: (x, y) of the thumbs that are on the screen from now on"""
    before = getattr(touch, "count", 0)
    kind = "touchStart" if len(points) > before else "touchEnd" if len(points) < before else "touchMove"
    touch.count = len(points)
    numbered = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
    session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": numbered})


@needs_chromium
def test_two_thumbs_drive_and_a_collision_is_felt(served):
    with chromium() as browser, opened(browser, served, viewport={"width": 844, "height": 390}, has_touch=True) as page:
        page.evaluate("navigator.vibrate = (pattern) => { window.vibrated = pattern; }")
        page.click("button:has-text('Begin')")
        wait_until(lambda: served.steps > 3)
        session = page.context.new_cdp_session(page)
        boxes = {name: page.locator(f"#{name}").bounding_box() for name in ("steering", "pedals")}
        middle = {name: (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2) for name, box in boxes.items()}
        steer, pedals = middle["steering"], middle["pedals"]

        def executes(steering, throttle):
            wait_until(lambda: served.tick() or np.allclose(served.car.executed[-1], [steering, throttle], atol=0.02))

        touch(session, steer)  # in the dead zone: takes over and holds the wheel straight
        executes(0, 0)
        shows(page, "takeover-value", "YOU DRIVE")
        brake = (pedals[0], boxes["pedals"]["y"] + boxes["pedals"]["height"] - 1)
        touch(session, steer, brake)
        executes(0, -1)
        touch(session, (steer[0] - 100, steer[1]), brake)
        executes(-1, -1)
        throttle = (pedals[0], boxes["pedals"]["y"] + 1)
        touch(session, (steer[0] - 100, steer[1]), throttle)
        executes(-1, 1)
        touch(session)
        executes(0, 0)  # the person still drives
        shows(page, "takeover-value", "YOU DRIVE")
        released = served.now
        wait_until(lambda: served.tick() or np.allclose(served.car.executed[-1], NOVICE))
        assert 0.5 * MOMENT < served.now - released
        shows(page, "takeover-value", "no")

        page.click("button:has-text('Pause')")
        wait_until(lambda: served.drive.paused)
        seen = "window.flashes = 0; new MutationObserver(() => { window.flashes++; }).observe(view, {attributes: true});"
        page.evaluate(f"() => {{ const view = document.getElementById('view'); {seen} }}")
        served.drive.count(collisions=served.drive.totals.collisions + 1)
        wait_until(lambda: page.evaluate("window.vibrated === 200 && window.flashes >= 2"))  # it came and went


@needs_chromium
def test_the_wheel_is_handed_over_between_two_pages(served):
    size = {"width": 800, "height": 600}
    with chromium() as browser, opened(browser, served, viewport=size) as first:
        second = browser.new_page(viewport=size)
        second.goto(served.server.access.url(served.server.access.driver_token))
        shows(second, "role", "Somebody else is at the wheel: you watch")
        shows(first, "watching", "1 watch")
        second.click("text=Ask for the wheel")
        first.click("text=Somebody asks for the wheel: hand over")
        shows(second, "role", "You are at the wheel")
        shows(first, "wheel", "Ask for the wheel")
        assert not second.locator("#wheel").is_visible()


@needs_chromium
def test_the_keyboard_reaches_everything_and_space_stays_with_the_button(served):
    with chromium() as browser, opened(browser, served, viewport={"width": 1280, "height": 800}) as page:
        reached = []
        for _ in range(6):
            page.keyboard.press("Tab")
            reached.append(page.evaluate("document.activeElement.textContent"))
        assert reached == ["Take over", "Begin", "Next", "Quit", "Help", "Options"]
        page.keyboard.press("Space")
        assert page.locator("#options").is_visible()
        page.keyboard.press("Escape")
        assert not page.locator("#options").is_visible() and not served.drive.person.read().takeover
        page.click("#picture")
        page.keyboard.press("Space")
        wait_until(lambda: served.drive.person.read().takeover)
        press = "const quit = document.querySelector('[data-wish=quit]'); quit.click();"
        assert page.evaluate(f"() => {{ {press} return quit.textContent; }}") == "Sure?"
        page.evaluate("send({ wish: 'takeover' })")
        wait_until(lambda: not served.drive.person.read().takeover)  # all before was heard
        assert not served.drive.ended  # once by mistake is not enough
        page.evaluate(f"() => {{ {press} quit.click(); }}")
        wait_until(lambda: served.drive.ended)


@needs_chromium
def test_the_person_says_how_the_episode_ended(served):
    records = []
    served.env.recorder.on_episode = records.append
    served.drive.corridors = False
    with chromium() as browser, opened(browser, served, viewport={"width": 844, "height": 390}) as page:
        page.click("button:has-text('Begin')")
        page.keyboard.press("KeyG")
        wait_until(lambda: served.tick() or (records and records[-1].verdict is True))
        page.click("button:has-text('Options')")
        page.click("text=show what the policy sees")
        wait_until(lambda: served.tick() or served.drive.corridors)
        page.click("text=Episode: failed")
        wait_until(lambda: served.tick() or records[-1].verdict is False)
        assert not page.locator("#options").is_visible()


@needs_chromium
@pytest.mark.slow
def test_axe_finds_nothing_to_complain_of(served):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    served.drive.show(novice=Novice("2", True, 0.97), speed=3.0)
    with chromium() as browser:
        for width, height, touch in ((1280, 800, False), (390, 844, True)):
            with opened(browser, served, viewport={"width": width, "height": height}, has_touch=touch) as page:
                shows(page, "confidence-value", "0.97")
                for dialog in (None, "help", "options"):
                    if dialog is not None:
                        page.click(f"[data-opens={dialog}]")
                    found = axe.run(page).response["violations"]
                    assert [(rule["id"], node["html"]) for rule in found for node in rule["nodes"]] == []
                    if dialog is not None:
                        page.click(f"#{dialog} button")


def luminance(colour):
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_contrasts_of_wcag_aa():
    css = (Path(server_module.STATIC) / "cockpit.css").read_text()
    colours = dict(pair.strip().split(": ") for pair in css.split(":root {")[1].split("}")[0].split(";") if "#" in pair)
    for text, ground in itertools.product(("dim", "text", "novice", "human", "warn", "lost"), ("panel", "bar")):
        light, dark = sorted((luminance(colours[f"--{name}"]) for name in (text, ground)), reverse=True)
        least = 3.0 if (text, ground) == ("lost", "bar") else 4.5  # large or no text
        assert (light + 0.05) / (dark + 0.05) >= least, (text, ground)
