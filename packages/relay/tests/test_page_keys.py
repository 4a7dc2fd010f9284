"""Keys and gamepads on the page: stops and driving, whatever the layout and whatever has the focus."""

import asyncio
import contextlib
import json
import time
from typing import Any

import pytest
from browser_cases import shows
from loop_cases import compiled
from needs import needs

for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=needs("extras", library))

from page_cases import Fleet  # noqa: E402
from relay_cases import client  # noqa: E402
from test_page import until  # noqa: E402
from test_page_fleet import PLACE, text  # noqa: E402
from websockets.exceptions import ConnectionClosed  # noqa: E402

from bufgym_relay.config import Limits  # noqa: E402
from bufgym_robot.wire.messages import Message  # noqa: E402

pytestmark = compiled

LAYOUTS = {"en": "x", "ru": "ч", "el": "χ", "he": "ס", "fr": "x"}
"""What the key with the X of an English keyboard types."""
CONTROLS = """[...document.querySelectorAll("button, select, input, summary, a[href], [tabindex]")].filter(one =>
  one.checkVisibility() && !one.disabled && !one.matches("[type=search], [type=number], [type=password]"))"""
ALL_COMMANDS = ["stop", "release", "goal", "pose", "cancel", "drive"]
STILL = {"linear": 0, "angular": 0, "for_ms": 0}


class Yard(Fleet):
    """A fleet whose stops and velocities are timed as they come, and confirmed."""

    def __init__(self, **changed: Any) -> None:
        super().__init__(**changed)
        self.stops: list[float] = []
        self.velocities: list[Message] = []

    async def run(self) -> None:
        await asyncio.gather(super().run(), self.watch())

    async def watch(self) -> None:
        while not self.port:
            await asyncio.sleep(0.01)
        async with client(self.port, **{**self.hello, "name": "watch"}) as one:
            await one.subscribe("^/robots/[^/]+/(stop|drive)$")
            with contextlib.suppress(ConnectionClosed):  # the relay has ended
                while isinstance(said := await one.next(), Message):
                    if said.topic.endswith("/drive"):
                        self.velocities.append(said)
                        continue
                    self.stops.append(time.monotonic())
                    for status, _ in self.robots.values():
                        status["stops"] = json.loads(bytes(said.payload))["stops"]


def press(devtools: Any, code: str, key: str, *kinds: str, **fields: Any) -> None:
    """A trusted key, as a keyboard of some layout sends it."""
    virtual = ord(code[-1]) if code.startswith("Key") else 0
    for kind in kinds or ("keyDown", "keyUp"):
        typed = {"text": key} if kind == "keyDown" and len(key) == 1 and not fields.get("modifiers") else {}
        said = {"type": kind, "code": code, "key": key, "windowsVirtualKeyCode": virtual, **typed, **fields}
        devtools.send("Input.dispatchKeyEvent", said)


def came(page: Any, seen: list[Any], count: int) -> bool:
    """Whether so many have come, within 5 s."""
    for _ in range(1_000):
        if len(seen) >= count:
            return True
        page.wait_for_timeout(5)
    return False


def parked(fleet: Fleet, page: Any, **status: Any) -> None:
    """A robot that takes all commands is chosen."""
    fleet.robots["one"] = {"location": PLACE, "commands": ALL_COMMANDS, "policies": ["afr", "xerox"], **status}, ()
    fleet.robots["one"][0]["queue"] = {"capacity": 8, "policy": "afr"}
    until(
        page,
        f"{text('#stop')} === 'Stop one'",
        "!document.querySelector('#drive').hidden",
        "!document.querySelector('#policy').disabled",
    )


def test_x_stops_on_each_layout_and_from_each_control(browser: Any) -> None:
    """A select with an entry that begins with an x keeps its choice; a text field takes the letter."""
    took: dict[str, list[float]] = {layout: [] for layout in LAYOUTS}
    names: set[str] = set()
    often = Limits(hello_s=60, messages_per_s=10**5)
    with Yard(limits=often) as fleet, shows(browser, f"http://127.0.0.1:{fleet.port}/") as page:
        parked(fleet, page)
        devtools = page.context.new_cdp_session(page)
        for tab in ("overview", "cameras", "3d", "health"):
            page.evaluate(f"location.hash = '#/robot/one/{tab}'")
            until(page, f"document.body.dataset.tab === '{tab}'")
            shown = "document.querySelector('#player').hidden = document.querySelector('#driving').hidden = false;"
            page.evaluate(shown + "document.querySelector('#layers-box').open = true;")
            page.wait_for_timeout(300)
            for k in range(page.evaluate(f"{CONTROLS}.length")):
                for layout, key in LAYOUTS.items():
                    if tab != "overview" and layout not in ("ru", "fr"):
                        continue
                    was = page.evaluate(f"(window.one = {CONTROLS}[{k}]).focus(), one.value")
                    who = page.evaluate("one.id || one.dataset.tab || one.className || one.tagName")
                    names.add(who)
                    before, began_s = len(fleet.stops), time.monotonic()
                    press(devtools, "KeyX", key)
                    assert came(page, fleet.stops, before + 1), f"{tab}, {who}, {layout}"
                    took[layout].append(fleet.stops[before] - began_s)
                    assert page.evaluate("one.value") == was
        assert len(fleet.stops) == sum(map(len, took.values()))  # one for each press
        print({layout: f"{1e3 * max(each):.0f} ms at most of {len(each)}" for layout, each in took.items()})
        assert {"policy", "speed", "speed-most", "when", "stop", "map", "pad", "recordings", "shade", "home"} <= names
        assert max(map(max, took.values())) < 1.0
        page.evaluate("location.hash = '#/robot/one/overview'")
        until(page, "document.body.dataset.tab === 'overview'")
        for select in ("speed-most", "speed", "policy"):  # and over its open list
            before = len(fleet.stops)
            page.focus(f"#{select}")
            page.keyboard.press("Space")
            until(page, f"document.querySelector('#{select}').matches(':open')")
            press(devtools, "KeyX", "ч")
            assert came(page, fleet.stops, before + 1), select
            page.keyboard.press("Escape")
        for modified in ({"modifiers": 2}, {"modifiers": 1}, {"modifiers": 4}):
            press(devtools, "KeyX", "x", **modified)
        before = len(fleet.stops)
        page.focus("#search")
        press(devtools, "KeyX", "x")
        until(page, "document.querySelector('#search').value === 'x'")
        page.fill("#search", "")
        page.focus("#map")
        press(devtools, "KeyX", "X", modifiers=8)
        assert came(page, fleet.stops, before + 1)
        page.wait_for_timeout(200)
        assert len(fleet.stops) == before + 1


@pytest.mark.parametrize("key", ["z", "ц"])
def test_the_place_of_w_drives_and_no_control_takes_it(browser: Any, key: str) -> None:
    """Driving is open: an arrow on the select of the speed drives, and a modified key does nothing."""
    with Yard() as fleet, shows(browser, f"http://127.0.0.1:{fleet.port}/") as page:
        parked(fleet, page)
        devtools = page.context.new_cdp_session(page)
        page.click("#drive")
        page.select_option("#speed-most", "0.5")
        assert page.evaluate("document.activeElement.id") == "pad"
        for focus, code, what, ahead in (
            ("pad", "KeyW", key, 0.5),
            ("speed-most", "ArrowDown", "ArrowDown", -0.5),
            ("policy", "KeyS", "ы", -0.5),
            ("fit", "ArrowUp", "ArrowUp", 0.5),
        ):
            page.focus(f"#{focus}")
            was = page.evaluate("document.activeElement.value")
            press(devtools, code, what, "keyDown")
            for _ in range(400):
                if fleet.driven and fleet.driven[-1]["linear"] == ahead:
                    break
                page.wait_for_timeout(20)
            else:
                pytest.fail(f"{focus}, {code}: {fleet.driven[-3:]}")
            press(devtools, code, what, "keyUp")
            page.wait_for_timeout(400)
            assert fleet.driven[-1] == STILL
            assert page.evaluate("document.activeElement.value") == was
        fleet.driven.clear()
        press(devtools, "KeyW", key, modifiers=2)
        page.focus("#map")
        press(devtools, "ArrowUp", "ArrowUp")
        page.wait_for_timeout(300)
        assert fleet.driven == []


PADS = """
window.pads = [];
navigator.getGamepads = () => window.pads;
window.hold = (axes, ...pressed) => { window.pads = [{connected: true, mapping: "standard", index: 0, axes,
  buttons: [...Array(17).keys()].map(k => ({pressed: pressed.includes(k), value: 0}))}]; };
"""
SHOULDER, B = 4, 1


def drives(page: Any, fleet: Fleet, linear: float, angular: float = 0.0) -> None:
    """Wait for such a velocity."""
    for _ in range(400):
        last = fleet.driven[-1] if fleet.driven else {"linear": None, "angular": None}
        if [last["linear"], last["angular"]] == [linear, angular]:
            return
        page.wait_for_timeout(20)
    pytest.fail(f"never {linear}: {fleet.driven[-3:]}")


def test_a_gamepad_drives_while_its_shoulder_button_is_held(browser: Any) -> None:
    """B stops. A stop and a pad that is gone end it; the button counts again once it was let go."""
    with Yard() as fleet:
        page = browser.new_page()
        page.add_init_script(PADS)
        page.goto(f"http://127.0.0.1:{fleet.port}/")
        parked(fleet, page)
        connected = "dispatchEvent(new Event('gamepadconnected'))"
        page.evaluate(f"hold([0, -1, 0, 0]); {connected}")
        page.wait_for_timeout(300)
        assert fleet.driven == []  # the stick alone
        page.evaluate(f"hold([0, -1, 0, 0], {SHOULDER})")
        drives(page, fleet, 0.2)
        page.evaluate(f"hold([-1, 0.05, 0, 0], {SHOULDER})")  # the dead zone
        drives(page, fleet, 0, 0.4)
        page.evaluate("hold([-1, 0.05, 0, 0])")
        drives(page, fleet, 0)
        for ends in (
            f"hold([0, 1, 0, 0], {SHOULDER}, {B})",
            "dispatchEvent(new Event('blur'))",
            "window.pads = []; dispatchEvent(new Event('gamepaddisconnected'))",
        ):
            page.evaluate(f"hold([0, 1, 0, 0]); {connected}")
            page.wait_for_timeout(150)
            page.evaluate(f"hold([0, 1, 0, 0], {SHOULDER})")
            drives(page, fleet, -0.2)
            page.evaluate(ends)
            drives(page, fleet, 0)
            page.evaluate(f"hold([0, 1, 0, 0], {SHOULDER}); {connected}")
            page.wait_for_timeout(300)
            assert fleet.driven[-1] == STILL
        assert len(fleet.stops) == 1
        page.close()
