"""The page on a link that a test cuts and freezes, and under a browser whose date is wrong."""

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from browser_cases import shows
from loop_cases import beside, compiled
from needs import needs

for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=needs("extras", library))

from cut_cases import cuttable  # noqa: E402
from relay_cases import Client, client, relay, settings  # noqa: E402
from test_page import until  # noqa: E402
from test_page_fleet import text  # noqa: E402
from test_stops import Program  # noqa: E402

from bufgym_relay.config import Limits, Rule  # noqa: E402
from bufgym_robot.fleet.robot import Robot  # noqa: E402

pytestmark = compiled
HOUR_S = 3600.0
RULE = Rule(address="127.0.0.0/8", send=True, receive=True)


class Car(Program):
    """A robot's program that says where it is."""

    async def run(self, robot: Robot) -> None:
        while True:
            await asyncio.sleep(0.1)
            robot.place.location = {"x": 1.0, "y": 2.0, "frame": "map"}

    async def on_command(self, command: Any) -> None:
        self.done.append((command["command"], time.monotonic()))


class Stage:
    """In a thread: a relay, a robot, and a link on which the page is; a second robot's messages are the test's."""

    def __init__(self) -> None:
        self.ready, self.over = threading.Event(), asyncio.Event()
        self.car = Car()
        self.thread = threading.Thread(target=lambda: asyncio.run(self.run()))
        self.thread.start()
        assert self.ready.wait(60), "waited 60 s for a relay"

    async def run(self) -> None:
        self.loop = asyncio.get_running_loop()
        kept = settings(rules=(RULE,), limits=Limits(hello_s=60))
        async with relay(kept) as server, cuttable(server.port) as self.link:
            self.port = server.port
            self.robot = Robot(f"ws://127.0.0.1:{server.port}", "car", self.car, policy="drop-oldest")
            async with beside(self.robot.run()), client(server.port, name="odd") as self.odd:
                self.ready.set()
                await self.over.wait()

    def do(self, what: Any) -> None:
        """Call a function in the thread's loop."""
        self.loop.call_soon_threadsafe(what)

    def gone(self) -> None:
        """A third robot says what it takes, and is gone."""

        async def say() -> None:
            async with client(self.port, session="gone", robot="gone") as robot:
                status = {"ok": True, "commands": ["goal", "stop"], "location": {"x": 1.0, "y": 2.0, "frame": "map"}}
                await robot.put("/robots/gone/status", json.dumps(status).encode(), encoding="json")
                await robot.rest()

        asyncio.run_coroutine_threadsafe(say(), self.loop).result(60)

    def place(self, x: float, off_s: float = 0.0) -> None:
        """The second robot says where it is, in a message stamped so much off."""
        payload = json.dumps({"x": x, "y": 0.0, "yaw": 0.0}).encode()
        stamp_us = round((time.time() + off_s) * 1e6)
        odd: Client = self.odd
        sent = odd.put("/robots/odd/odom", payload, encoding="json", stamp_us=stamp_us)
        asyncio.run_coroutine_threadsafe(sent, self.loop).result(60)


@pytest.fixture(scope="module")
def stage() -> Iterator[Stage]:
    one = Stage()
    yield one
    one.do(one.over.set)
    one.thread.join(60)
    assert not one.thread.is_alive(), "waited 60 s for a relay's end"


STATE, COMMAND = text("#state"), text("#command-status")


def test_a_frozen_link_is_not_live_and_a_stop_is_kept_for_it(browser: Any, stage: Stage) -> None:
    """X is pressed on a frozen link and says so. A goal of before is not executed; the robot stands until a release."""
    with shows(browser, f"http://127.0.0.1:{stage.link.port}/") as page:
        page.evaluate("location.hash = '#/robot/car/overview'")
        until(page, f"{STATE} === 'live'", f"{text('#stop')} === 'Stop car'", "!document.querySelector('#goal').hidden")
        before = len(stage.car.names)
        stage.do(stage.link.freeze)
        page.click("#goal")
        page.mouse.click(500, 400)  # on the map: the link has frozen, and the page does not know yet
        began_s = time.monotonic()
        until(page, f"{STATE} !== 'live'")
        assert time.monotonic() - began_s < 3.5  # 3 s, and what the test itself takes
        until(page, "document.querySelector('#goal').hidden", "!document.querySelector('#cover').hidden")
        page.keyboard.press("x")
        until(page, f"{COMMAND} === 'stop: kept: car stops as soon as it can be reached'")
        assert stage.car.names[before:] == []
        until(page, f"{STATE} === 'not connected' || {STATE} === 'connecting'")
        stage.do(stage.link.thaw)
        until(page, f"{STATE} === 'live'", f"{COMMAND} === 'stop: car answers: done'")
        assert stage.car.names[before:] == ["stop"]
        assert page.evaluate(text("#notices span")).startswith("refused: goal: withdrawn by a stop")
        until(page, f"{text('.says')}.includes('stopped by page-')")
        page.click("#release")
        until(page, f"{COMMAND} === 'release: car answers: done'", "document.querySelector('#release').hidden")


def test_a_command_that_reached_no_robot_says_so(browser: Any, stage: Stage) -> None:
    """Its robot has just gone: the relay holds the goal for 3 s, and then says what became of it."""
    with shows(browser, f"http://127.0.0.1:{stage.link.port}/") as page:
        page.evaluate("location.hash = '#/robot/gone/overview'")
        until(page, f"{STATE} === 'live'")
        stage.gone()
        until(page, "!document.querySelector('#goal').hidden")
        page.click("#goal")
        page.mouse.click(500, 400)
        until(page, f"{COMMAND} === 'goal: held by the relay, until the robot answers'")
        until(page, f"{text('#notices span')}.includes('goal: not reached')")


def test_what_a_break_left_unconfirmed_is_asked_for_again(browser: Any, stage: Stage) -> None:
    """A goal that was sent into a frozen link is not executed when it comes back, but if somebody wants it still."""
    with shows(browser, f"http://127.0.0.1:{stage.link.port}/") as page:
        page.evaluate("location.hash = '#/robot/car/overview'")
        until(page, f"{STATE} === 'live'", "!document.querySelector('#goal').hidden")
        before = len(stage.car.names)
        stage.do(stage.link.freeze)
        page.click("#goal")
        page.mouse.click(500, 400)
        until(page, f"{text('#notices span')}.includes('refused: goal: not confirmed before the link broke')")
        stage.do(stage.link.thaw)
        until(page, f"{STATE} === 'live'", "!document.querySelector('#goal').hidden")
        assert len(stage.car.names) == before
        page.click("#notices button:has-text('Send again')")
        until(page, f"{COMMAND} === 'goal: car answers: done'")
        assert stage.car.names[before:] == ["goal"]


def placed(page: Any, stage: Stage) -> None:
    """The second robot's first place is shown; a message may come before the relay has heard what the page wants."""
    while not page.evaluate(f"{text('#facts')}.startsWith('at 1.0, 0.0 m')"):
        stage.place(1.0)
        page.wait_for_timeout(200)


@pytest.mark.parametrize("hours", [-1, 1, 24])
def test_the_browsers_date_changes_no_age(browser: Any, stage: Stage, hours: int) -> None:
    """A robot is silent for 6 s and says so, whatever the browser believes the time to be."""
    page = browser.new_page()
    page.add_init_script(f"const now = Date.now; Date.now = () => now() + {hours} * 3600e3;")
    page.goto(f"http://127.0.0.1:{stage.link.port}/#/robot/odd/overview")
    until(page, f"{STATE} === 'live'")
    placed(page, stage)
    assert "ago" not in page.evaluate(text("#facts"))
    silent = "document.querySelector('.card[href*=odd] .seen').textContent"
    until(page, f"/^silent for [5-9]\\.\\d s$/.test({silent})", f"{text('#facts')}.includes(' s ago')")
    page.close()


def test_a_stamp_that_jumps_moves_no_place_into_the_future(browser: Any, stage: Stage) -> None:
    """One message stamped an hour ahead is taken, and so is each after it; the jump is a trouble."""
    with shows(browser, f"http://127.0.0.1:{stage.link.port}/") as page:
        page.evaluate("location.hash = '#/robot/odd/health'")
        until(page, f"{STATE} === 'live'")
        placed(page, stage)
        for x, off_s in ((2.0, HOUR_S), (3.0, 0.0), (4.0, -HOUR_S), (5.0, 0.0)):
            stage.place(x, off_s)
            until(page, f"{text('#facts')}.startsWith('at {x:.1f}, 0.0 m')")
            assert "ago" not in page.evaluate(text("#facts"))
        until(page, f"{text('#verdict-says')} === 'its clock jumped by 3600 s'")


def test_stamps_by_hand(browser: Any, stage: Stage) -> None:
    """A robot 100 s behind: the promptest message came at once, one is 2 s late, and then its clock jumps."""
    page = browser.new_page()
    page.goto(f"http://127.0.0.1:{stage.link.port}/")
    made = page.evaluate("""async () => {
      const {Stamps} = await import("./clock.js"), stamps = new Stamps();
      const said = [[0, 100e3], [1e3, 103e3], [3700e3, 110e3], [3701e3, 111.5e3], [11e3, 112e3]];
      return [...said.map(([stampMs, atMs]) => stamps.made(stampMs, atMs)), stamps.jump.byMs];
    }""")
    assert made == [100e3, 101e3, 110e3, 111e3, 112e3, -3691e3]
    page.close()
