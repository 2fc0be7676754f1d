"""Studies: protocol, orders, what is stored, the summary; a scripted participant with the real command; the page."""

import asyncio
import csv
import json
import os
import re
import signal
import subprocess
import sys
from collections import Counter
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import aiohttp
import pytest
import yaml
from shell import FOREVER, wait_until
from test_cockpit_browser import Driver, state_of, status
from test_cockpit_page import LOOKED_AT, chromium, needs_chromium, opened, served  # noqa: F401

import sb3_chac
from sb3_chac.__main__ import main
from sb3_chac.cli.drive import prepare
from sb3_chac.cockpit import forms
from sb3_chac.cockpit.devices.browser import BadMessage
from sb3_chac.cockpit.recording import EpisodeRecord
from sb3_chac.cockpit.session import SessionEnded
from sb3_chac.cockpit.study import SUMMARY, Condition, Participant, Protocol, StudyError, read_protocol, summarise, table

EXAMPLE = Path(__file__).parents[1] / "examples" / "study" / "protocol.yaml"
GUIDE = Path(sb3_chac.__file__).parent / "cockpit" / "README.md"
SHORT = {"episodes": 2, "algo": "pvp", "env_kwargs": {"horizon": 30, "blocks": 1}, "rate": 20}
RECORD = EpisodeRecord(100, 10, 2, 1.5, 0.5, True, 50.0, 10.0, None, True)
SCALES = {scale.name: 5 * i for i, scale in enumerate(forms.TLX)}


def write(folder, **changes):
    """Write a protocol with two short conditions."""
    folder.mkdir(exist_ok=True)
    data = {"title": "T", "consent": "consent.txt", "conditions": {"a": SHORT, "b": SHORT}} | changes
    (folder / "protocol.yaml").write_text(yaml.safe_dump({key: value for key, value in data.items() if value is not None}))
    (folder / "consent.txt").write_text("Do you agree?")
    return folder / "protocol.yaml"


def protocol(size=3, **changes):
    return Protocol("T", "c", {name: Condition(1) for name in "abcdefgh"[:size]}, **changes)


# The protocol


def test_the_example(tmp_path, monkeypatch):
    example = read_protocol(EXAMPLE)
    assert f"```yaml\n{EXAMPLE.read_text()}```" in GUIDE.read_text()
    assert list(example.practice) == ["first-drive"] and list(example.conditions) == ["with-meter", "without-meter"]
    arguments = example.conditions["without-meter"].drive_arguments(tmp_path, example.folder, "x-v0", 7)
    monkeypatch.setattr(sys, "argv", ["sb3-chac"])
    drive = prepare(arguments)
    assert drive.no_meter and not drive.no_takeover and drive.query is None and drive.seed == 7
    assert drive.env_kwargs == {"start_scenario": 100, "num_scenarios": 20}


BAD = [
    ({"nonsense": 1}, "'nonsense' is unknown, choose from title, consent, conditions"),
    ({"title": None}, "'title' is missing"),
    ({"title": 7}, "title must be text"),
    ({"order": "latin"}, "order must be one of counterbalanced, random, fixed"),
    ({"seed": -1}, "seed must be"),
    ({"questions": [1]}, "questions must be"),
    ({"questions": ["a", "a"]}, "another one"),
    ({"conditions": {}}, "conditions must map names"),
    ({"conditions": {"a b": SHORT}}, "'a b' cannot be a name"),
    ({"conditions": {"a": {"episodes": 1, "fly": 1}}}, "a: 'fly' is unknown"),
    ({"conditions": {"a": {}}}, "'episodes' is missing"),
    ({"conditions": {"a": {"episodes": 0}}}, "episodes must be a number of at least 1"),
    ({"conditions": {"a": {"episodes": 1, "meter": 1}}}, "meter must be true or false"),
    ({"conditions": {"a": {"episodes": 1, "scenarios": "1:2"}}}, r"scenarios must be \[first, number\]"),
    ({"practice": {"a": SHORT}}, "a names a condition and a practice drive"),
    ({"consent": "nowhere.txt"}, "consent: .*nowhere.txt cannot be read"),
]


@pytest.mark.parametrize("changes, message", BAD, ids=[message[:30] for _, message in BAD])
def test_bad_protocols(tmp_path, changes, message):
    with pytest.raises(StudyError, match=message):
        read_protocol(write(tmp_path, **changes))


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5])
def test_counterbalanced_orders(size):
    """Each condition is as often at each place, and as often after each other one."""
    count = size * (2 if size % 2 else 1)
    orders = [protocol(size, seed=3).order_for(participant) for participant in range(1, count + 1)]
    places = Counter((place, name) for order in orders for place, name in enumerate(order))
    assert set(places.values()) == {count // size} and len(places) == size**2
    pairs = Counter(pair for order in orders for pair in pairwise(order))
    assert len(pairs) == size * (size - 1) and len(set(pairs.values())) <= 1


def test_orders_repeat_and_depend_on_the_seed():
    def orders(**changes):
        return [tuple(protocol(4, **changes).order_for(participant)) for participant in range(1, 30)]

    for order in ("random", "counterbalanced"):
        assert orders(order=order, seed=1) == orders(order=order, seed=1) != orders(order=order, seed=2)
    assert len(set(orders(order="random"))) > 10 and set(orders(order="fixed")) == {("a", "b", "c", "d")}


# What is stored


def begun(folder, number=1, **changes):
    participant, rules = Participant(folder, number), protocol(2, order="fixed", **changes)
    with participant.in_use():
        participant.store_consent(rules, True)
    return participant, rules


def test_what_was_stored_is_found_again_and_a_line_that_was_cut_off_is_not_missed(tmp_path):
    participant, rules = begun(tmp_path)
    participant.store_episode("a", RECORD)
    participant.store_episode("a", RECORD._replace(is_whole=False))
    (participant.folder / "episodes.jsonl").open("a").write('{"condition": "a", "is_wh')
    participant.store_episode("b", RECORD)
    participant.store_answers("a", SCALES | {"Why?": "\nSo: ä"})
    again = Participant(tmp_path, 1)
    assert again.has_agreed(rules) and again.order == ["a", "b"]
    assert [len(again.episodes(name)) for name in "ab"] == [1, 1] and again.answers("b") is None
    assert again.answers("a") == {"condition": "a", "raw_tlx": 12.5, "values": SCALES | {"Why?": "\nSo: ä"}}


@pytest.mark.parametrize("change", [{"text": "x"}, {"consent_text": "x"}])
def test_a_changed_protocol_is_refused(tmp_path, change):
    participant, _ = begun(tmp_path)
    with pytest.raises(StudyError, match="not the one that participant 1 has begun with"):
        participant.has_agreed(protocol(2, **change))


def test_who_declined_left_nothing_and_is_not_asked_again(tmp_path):
    participant = Participant(tmp_path, 1)
    with participant.in_use():
        participant.store_consent(protocol(), False)
    assert [file.name for file in participant.folder.iterdir()] == ["consent.json"]
    with pytest.raises(StudyError, match="has declined"):
        participant.has_agreed(protocol())


def test_a_folder_in_use(tmp_path):
    with Participant(tmp_path, 1).in_use():
        with pytest.raises(StudyError, match="participant-001 is in use"), Participant(tmp_path, 1).in_use():
            pass
        with Participant(tmp_path, 2).in_use():
            pass
    assert list(tmp_path.iterdir()) == []  # nothing came of it


def test_the_summary(tmp_path):
    for number in (1, 2):
        participant, _ = begun(tmp_path, number)
        for record in (RECORD, RECORD._replace(cost=0.5, success=False, is_whole=True), RECORD._replace(is_whole=False)):
            participant.store_episode("a", record._replace(human_steps=10 * number))
        participant.store_episode("b", RECORD._replace(cost=None))
    participant.store_answers("a", SCALES)
    rows = summarise(tmp_path)
    assert [(row["participant"], row["condition"], row["place"], row["human_steps"]) for row in rows] == [
        (1, "a", 1, 20), (1, "b", 2, 10), (2, "a", 1, 40), (2, "b", 2, 10)
    ]  # fmt: skip
    assert (rows[2]["cost"], rows[2]["success"], rows[2]["raw_tlx"], rows[2]["seconds"]) == (2.0, 0.5, 12.5, 20.0)
    stored = list(csv.DictReader((tmp_path / SUMMARY).open()))
    assert stored[0]["raw_tlx"] == stored[1]["cost"] == "" and stored[2]["frustration"] == "25"
    first, *lines = [line.split() for line in table(rows).splitlines()]
    means = dict(zip(first, lines[0], strict=True))
    assert (means["participants"], means["human_steps"], means["raw_tlx"]) == ("2", "30", "12.5") and "-" in lines[1]


# Forms


def test_answers_to_forms():
    form = forms.questionnaire("Part 1", ["Why?"])
    given = {"form": 3, "choice": "Continue", "values": SCALES | {"Why?": ""}}
    assert form.parse(json.dumps(given), 3) == ("Continue", given["values"])
    wrong = [
        given | {"form": 2},
        given | {"choice": "x"},
        given | {"values": {}},
        given | {"more": 1},
        given | {"values": given["values"] | {"Why?": 1}},
        *(given | {"values": given["values"] | {"mental": value}} for value in (3, 105, -5, True, "5", None)),
    ]
    for text in ("", "[" * 10**5, "7", *map(json.dumps, wrong)):
        with pytest.raises(BadMessage):
            form.parse(text, 3)


# The page


@contextmanager
def asked(drive, form):
    """Ask inside the block; what it gives tells the answer."""
    future = asyncio.run_coroutine_threadsafe(drive.server.ask(form), drive.loop)
    yield future
    assert drive.server.form is None or future.cancel()


def test_who_may_read_and_answer_a_form(served):  # noqa: F811
    access = served.server.access

    async def post(token, text, origin=None):
        headers = {"Origin": origin or served.origin}
        async with aiohttp.ClientSession() as session:
            async with session.post(f"{served.origin}/form?token={token}", data=text, headers=headers) as response:
                return response.status

    async def come():
        driver, watcher = access.driver_token, access.spectator_token
        assert (await status(served, f"/form?token={driver}"))[0] == 404
        with asked(served, forms.consent_form("T", "<b>Do you?</b>")) as future:
            await asyncio.to_thread(wait_until, lambda: served.server.form)
            for token in ("x", watcher):
                assert (await status(served, f"/form?token={token}"))[0] == await post(token, "{}") == 403
            text = (await status(served, f"/form?token={driver}"))[1]
            assert json.loads(text)["choices"] == [forms.AGREE, forms.DECLINE]
            yes = json.dumps({"form": 1, "choice": forms.AGREE, "values": {}})
            assert await post(driver, yes, "http://evil.example") == 403
            assert await post(driver, "{") == 400 and await post(driver, "x" * 2**17) == 413
            async with served.viewer() as channel, served.viewer() as second:
                assert (await state_of(channel, lambda state: "role" in state))["form"] == 1
                assert (await state_of(second, lambda state: state.get("role") == "taken"))["form"] is None
            assert await post(driver, yes) == 200
            assert future.result(FOREVER) == (forms.AGREE, {}) and await post(driver, yes) == 404

    asyncio.run(come())


def test_a_server_that_is_to_end_asks_nothing_more(served):  # noqa: F811
    form = forms.consent_form("T", "?")
    future = asyncio.run_coroutine_threadsafe(served.server.ask(form), served.loop)
    wait_until(lambda: served.server.form)
    served.loop.call_soon_threadsafe(served.server.quit)
    with pytest.raises(SessionEnded):
        future.result(FOREVER)


@needs_chromium
def test_forms_are_filled_in_with_the_keyboard_and_read_on_a_phone(served):  # noqa: F811
    sizes = {"viewport": {"width": 390, "height": 844}, "has_touch": True}
    with chromium() as browser, opened(browser, served, **sizes) as page:
        with asked(served, forms.consent_form("A study", "Two\nlines, <b>no</b> markup\n" + 80 * "long\n")) as future:
            page.wait_for_selector("#form[open]")
            assert "<b>no</b> markup" in page.inner_text("#form .reading")
            page.keyboard.press("Escape")
            page.keyboard.press("Escape")
            page.wait_for_selector("#form[open]")
            look(page, "consent")
            page.click(f"#form button:text-is('{forms.AGREE}')")
            assert future.result(FOREVER).choice == forms.AGREE
        with asked(served, forms.questionnaire("Part 1 of 2", ["When did you take over?"])) as future:
            page.wait_for_selector("#form input[name=mental]")
            page.click("#form button")
            assert page.inner_text("#form .problem") == "Choose a place on each scale" and not future.done()
            for presses in range(1, 7):  # the page shows the first scale that is missing
                for _ in range(presses):
                    page.keyboard.press("ArrowRight")
                page.keyboard.press("Tab")
            page.keyboard.type("at p, q and h")  # keys of the cockpit are text here
            look(page, "questions")
            page.keyboard.press("Tab")
            page.keyboard.press("Enter")
            values = future.result(FOREVER).values
        assert values == dict(zip(SCALES, range(55, 81, 5), strict=True)) | {"When did you take over?": "at p, q and h"}
        page.wait_for_selector("#form", state="hidden")
        assert served.drive.paused and not served.drive.ended and not served.drive.person.read().takeover


def look(page, name):
    """Nothing is cut off, axe finds nothing, and those who want to look get a picture."""
    box = page.locator("#form").bounding_box()
    assert box["x"] >= 0 and box["y"] >= 0 and box["width"] <= 390 and box["height"] <= 844
    assert page.evaluate("document.getElementById('form').scrollWidth <= document.getElementById('form').clientWidth")
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    found = axe.run(page).response["violations"]
    assert [(rule["id"], node["html"]) for rule in found for node in rule["nodes"]] == []
    if LOOKED_AT:
        page.screenshot(path=Path(LOOKED_AT) / f"study-{name}.png")


@needs_chromium
def test_who_may_only_watch_has_no_takeover(served):  # noqa: F811
    served.drive.person.may_take_over = False
    with chromium() as browser, opened(browser, served) as page:
        page.wait_for_selector("[data-wish=takeover]:disabled")
        page.keyboard.press("KeyP")
        page.keyboard.down("ArrowUp")
        wait_until(lambda: served.tick() or served.steps > 5)
        assert not served.drive.person.read().takeover and served.car.executed[-1][1] == 0


# A scripted participant and the command


class ScriptedParticipant:
    """
    Participant that answers each form, begins each drive and takes over whenever the novice drives.

    :param url: that the command has printed
    :param leave_after: forms until which it takes part
    """

    def __init__(self, url, choose=lambda form: form["choices"][0], leave_after=99):
        self.page, self.token = re.fullmatch(r"(.*)/\?token=(.*)", url).groups()
        self.choose, self.leave_after = choose, leave_after
        self.seen, self.notices = [], set()

    async def take_part(self):
        async with aiohttp.ClientSession(headers={"Origin": self.page}) as self.session:
            async with self.session.ws_connect(f"{self.page}/ws?token={self.token}", max_msg_size=0) as channel:
                self.driver = Driver(channel)
                task = asyncio.create_task(self.driver.tell())
                async for message in channel:
                    if message.type is aiohttp.WSMsgType.TEXT and "role" in (state := json.loads(message.data)):
                        await self.go_on(channel, state)
                    if len(self.seen) == self.leave_after:
                        break
                task.cancel()

    async def go_on(self, channel, state):
        self.notices.add(state["notice"])
        if not state["wants"]:  # a key that is pressed anew takes over
            self.driver.keys = [] if self.driver.keys else ["up"]
        if state["form"] is not None and state["form"] not in [form["number"] for form in self.seen]:
            form = await self.ask()
            self.seen.append(form)
            values = {question["name"]: 25 if question["ends"] else "typed" for question in form["questions"]}
            answer = {"form": form["number"], "choice": self.choose(form), "values": values}
            async with self.session.post(f"{self.page}/form?token={self.token}", json=answer) as response:
                assert response.status == 200
        elif state["form"] is None and re.search("P (begins|goes on)", state["notice"]):
            await channel.send_json({"wish": "pause"})
            await asyncio.sleep(0.1)

    async def ask(self):
        async with self.session.get(f"{self.page}/form?token={self.token}") as response:
            return await response.json()


class Leaving(ScriptedParticipant):
    """Quits in the second episode."""

    async def go_on(self, channel, state):
        await super().go_on(channel, state)
        if dict(state["indicators"])["episode"] == "2":
            await channel.send_json({"wish": "quit"})


def study(folder, kind=ScriptedParticipant, then=None, **script):
    """Run the command with a scripted participant; ``then`` is done with the process when it leaves."""
    own = ["study", "protocol.yaml", "--out", "out", "--participant", "1", "--serve", "0"]
    env = os.environ | {"MINARI_DATASETS_PATH": str(folder / "minari"), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "sb3_chac", *own]
    with subprocess.Popen(command, cwd=folder, env=env, stdout=subprocess.PIPE, text=True) as process:
        try:
            url = process.stdout.readline().split()[-1]
            person = kind(url, **script)
            asyncio.run(person.take_part())
            if then is not None:
                then(process)
            printed = process.stdout.read()
            return person, printed, process.wait(FOREVER)
        finally:
            process.kill()


def test_a_study_is_killed_and_goes_on_at_the_next_episode(tmp_path):
    practice = {"try": SHORT | {"episodes": 1, "takeover": False}}
    write(tmp_path, practice=practice, questions=["Why?"], order="fixed")
    folder = tmp_path / "out" / "participant-001"
    person, _, _ = study(tmp_path, leave_after=2, then=lambda process: process.send_signal(signal.SIGKILL))
    assert [form["title"] for form in person.seen] == ["T", "Part 1 of 2"] and person.seen[0]["text"] == "Do you agree?"
    before = (folder / "episodes.jsonl").read_text()
    assert "Practice, 1 episode. Ready: P begins" in person.notices

    person, printed, code = study(tmp_path)
    assert code == 0 and "Participant 1 has finished" in printed and "human_steps" in printed
    assert [form["title"] for form in person.seen][-1] == "Part 2 of 2"
    participant = Participant(tmp_path / "out", 1)
    assert (folder / "episodes.jsonl").read_text().startswith(before)
    assert [len(participant.episodes(name)) for name in ("try", "a", "b")] == [1, 2, 2]
    # On a busy machine an episode may be over before the person's takeover gets there: one of the four is enough
    driven = [episode["human_steps"] for name in ("a", "b") for episode in participant.episodes(name)]
    assert participant.episodes("try")[0]["human_steps"] == 0 < max(driven)
    assert participant.answers("b")["values"]["Why?"] == "typed" and participant.answers("b")["raw_tlx"] == 25
    assert [path.name for path in folder.glob("*/drive_*-v0")] and (folder / "protocol.yaml").is_file()
    assert len(list(csv.DictReader((tmp_path / "out" / SUMMARY).open()))) == 2


@pytest.mark.slow
def test_in_the_middle_of_a_condition_the_novice_goes_on_with_what_it_has_learned(tmp_path):
    write(tmp_path, conditions={"a": SHORT | {"episodes": 3}})
    folder = tmp_path / "out" / "participant-001"

    _, printed, code = study(tmp_path, Leaving)
    done = len(Participant(tmp_path / "out", 1).episodes("a"))
    assert code == 0 and "Go on with:  sb3-chac study protocol.yaml --out out --participant 1" in printed and 1 <= done < 3
    _, printed, _ = study(tmp_path)
    assert "has finished" in printed and len(Participant(tmp_path / "out", 1).episodes("a")) == 3
    assert [run.name for run in sorted((folder / "a" / "pvp").iterdir())] == ["SafeDrive-v0_1", "SafeDrive-v0_2"]


def test_who_declines_is_let_go(tmp_path):
    write(tmp_path)
    person, printed, code = study(tmp_path, choose=lambda form: form["choices"][1])
    assert code == 0 and "has not agreed: nothing else is stored" in printed and len(person.seen) == 1
    assert [path.name for path in (tmp_path / "out").rglob("*") if path.is_file()] == ["consent.json"]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["nowhere.yaml", "--out", "out"], "nowhere.yaml: cannot be read"),
        (["protocol.yaml"], "--out FOLDER is missing"),
        (["protocol.yaml", "--out", "out", "--participant", "0"], "--participant must be at least 1"),
        (["protocol.yaml", "--out", "out"], "b: --algo sac does not learn from takeovers"),
        (["out", "--summary"], "out holds no episode of a participant"),
    ],
)
def test_one_line_for_mistakes(arguments, message, tmp_path, monkeypatch, capsys):
    write(tmp_path, conditions={"a": SHORT, "b": {"episodes": 1, "algo": "sac"}})
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SB3_CHAC_TRACEBACK", raising=False)
    monkeypatch.setattr("sys.argv", ["sb3-chac", "study", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().err
    assert ended.value.code == 2 and message in said and said.count("\n") == 1 and not (tmp_path / "out").exists()
