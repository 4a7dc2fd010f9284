"""The page over made-up robots that send each type of message, on a desk and on a phone."""

import asyncio
import itertools
import json
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from browser_cases import browsing, shows
from loop_cases import compiled

for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=f"no {library} here: the extra relay")

from page_cases import MadeUp, drawn, health, jpeg  # noqa: E402
from relay_cases import ALL, Rule, client, relay, settings  # noqa: E402
from test_page import SEES, until  # noqa: E402

pytestmark = compiled
WATCHES = Rule(address="127.0.0.2", receive=True)


class Fleet:
    """A relay with made-up robots, in a thread's loop; each publishes five times a second."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self.robots: dict[str, MadeUp] = {}
        self.port, self.over, self.ready = 0, asyncio.Event(), threading.Event()
        self.thread = threading.Thread(target=self.loop.run_until_complete, args=(self.run(),))

    async def run(self) -> None:
        async with relay(settings(rules=(ALL, WATCHES))) as server, client(server.port, name="fleet") as one:
            self.port, self.server, self.one = server.port, server, one
            self.ready.set()
            await one.say("subscribe", id="commands", topic="^/robots/[^/]+/command$")
            hears = asyncio.create_task(self.hear())
            while not self.over.is_set():
                for robot in list(self.robots.values()):
                    await robot.publish()
                await asyncio.sleep(0.2)
            hears.cancel()

    async def hear(self) -> None:
        """A robot answers each command, and refuses a goal beyond 100 m."""
        async for data in self.one.socket:
            if isinstance(data, bytes):
                from bufgym_live.relay import wire

                said = wire.decode(data)
                await self.one.say("ack", seq=said.seq)
                command, robot = json.loads(bytes(said.payload)), self.robots[said.topic.split("/")[2]]
                robot.came.append(command)
                why = "too far" if abs(command.get("x", 0)) > 100 else ""
                robot.says["answer"] = {"id": command.get("id"), "why": why}

    def robot(self, name: str, *topics: tuple[str, str, bytes], **says: Any) -> MadeUp:
        made = MadeUp(self.one, name)
        made.topics, made.says = list(topics), says
        self.robots[name] = made
        return made


@pytest.fixture(scope="module")
def module_fleet() -> Iterator[Fleet]:
    fleet = Fleet()
    fleet.thread.start()
    assert fleet.ready.wait(60), "waited 60 s for a relay"
    yield fleet
    fleet.loop.call_soon_threadsafe(fleet.over.set)
    fleet.thread.join(60)
    assert not fleet.thread.is_alive(), "waited 60 s for a relay's end"


@pytest.fixture
def fleet(module_fleet: Fleet) -> Iterator[Fleet]:
    yield module_fleet
    module_fleet.robots.clear()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with browsing() as one:
        yield one


WIDTHS = [1400, pytest.param(390, marks=pytest.mark.nightly)]


@pytest.mark.parametrize("width", WIDTHS)
def test_who_needs_somebody_comes_first_and_alerts_stay(browser: Any, fleet: Fleet, width: int) -> None:
    fleet.robot("fine-2", ok=True, text="on its way", battery=0.9)
    fleet.robot("fine-10", ok=True, battery=0.9)
    fleet.robot("empty", ok=True, battery=0.1)
    broken = fleet.robot("broken", health(2, "MOTOR FAULT"), ok=True)
    with shows(browser, f"http://127.0.0.1:{fleet.port}/", width=width) as page:
        names = "[...document.querySelectorAll('.card:not([hidden]) .called')].map(one => one.textContent).join()"
        until(page, f"{names} === 'broken,empty,fine-2,fine-10'")
        until(page, "document.querySelector('.card .says').textContent === 'motor left: MOTOR FAULT'")
        says = "[...document.querySelectorAll('#notices p')].map(line => line.textContent).join()"
        until(page, f"{says}.includes('broken') && {says}.includes('MOTOR FAULT')")
        broken.topics = [health(0, "well")]
        until(page, f"{names}.startsWith('empty')", f"{says}.includes('over, lasted')")  # over, but nobody has seen it
        page.click("#notices .all button")
        until(page, "document.querySelector('#notices').hidden")
        page.fill("#search", "WAY")
        assert page.evaluate(names) == "fine-2"


def test_an_address_shows_a_robot_and_back_returns(browser: Any, fleet: Fleet) -> None:
    fleet.robot("one"), fleet.robot("two & a half", health(1, "warm"), estop=True)
    root = f"http://127.0.0.1:{fleet.port}/"
    with shows(browser, root) as page:
        page.goto(root + "#/robot/two%20%26%20a%20half/health")
        until(page, "document.querySelector('#name').textContent === 'two & a half'")
        until(page, "document.querySelector('#verdict-says').textContent === 'emergency stop'")
        until(page, "document.querySelectorAll('#parts tr')[0].textContent === 'warningmotor leftwarm'")
        page.click(".card:has-text('one')")
        until(page, "location.hash === '#/robot/one/health' && document.querySelector('#name').textContent === 'one'")
        page.click("#tabs a:has-text('Cameras')")
        page.go_back()
        page.go_back()
        until(page, "document.querySelector('#name').textContent === 'two & a half'")


def test_what_is_old_looks_old_and_an_absent_relay_covers_the_page(browser: Any, fleet: Fleet) -> None:
    fleet.robot("one", ("front", "", jpeg((200, 30, 30))), location={"x": 0, "y": 0, "yaw": 0})
    with shows(browser, f"http://127.0.0.1:{fleet.port}/") as page:
        until(page, f"({SEES})(document.querySelector('#camera')) >= 1")
        assert page.evaluate("document.querySelector('#first').dataset.old") == ""
        fleet.robots.clear()
        until(page, "document.querySelector('#first').dataset.old.endsWith('s old')")
        until(page, "Number(document.querySelector('#first').style.getPropertyValue('--age')) > 0.3")
        until(page, "document.querySelector('#facts').textContent.endsWith('ago')")
        until(page, "document.querySelector('.card .seen').textContent.startsWith('silent for')")
        assert page.is_hidden("#cover")
        page.context.set_offline(True)
        page.evaluate("window.dispatchEvent(new Event('close-the-socket'))")


@pytest.mark.parametrize("width", WIDTHS)
def test_the_map_shows_layers_of_one_frame(browser: Any, fleet: Fleet, width: int) -> None:
    """The plan lies in odom, 4 m along the map's x: it is drawn where tf leads it, as long as its layer is on."""
    fleet.robot("one", *drawn())
    boxes = "[...document.querySelectorAll('#layers label')].map(one => one.textContent).join()"
    colours = f"({SEES})(document.querySelector('#map'))"
    with shows(browser, f"http://127.0.0.1:{fleet.port}/", width=width) as page:
        until(page, "document.querySelector('#facts').textContent === 'at 5.0, 0.0 m in map'")
        all = "laser walls,trails,map,plan,particles,goal_pose,markers,markers people,markers zones"
        until(page, f"{boxes} === '{all}'", f"{colours} > 20")
        orange = "(c => { const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let n = 0;"
        orange += "for (let k = 0; k < d.length; k += 4) "
        orange += "n += d[k] > 240 && d[k + 1] > 110 && d[k + 1] < 150 && d[k + 2] < 30;"
        orange += "return n; })(document.querySelector('#map'))"
        until(page, f"{orange} > 50")
        page.click("#layers-box summary")
        page.click("#layers label:has-text('zones')")
        page.click("#layers label:has-text('people')")
        until(page, f"{orange} === 0")
        at = page.evaluate("""async () => {
          const {Place, within} = await import("./frames.js"), {tree} = new Place("one");
          tree.add({frame: "map", child: "odom", at: [4, 0, 0], turn: [0, 0, Math.SQRT1_2, Math.SQRT1_2]});
          tree.add({frame: "odom", child: "base_link", at: [1, 0, 0], turn: [0, 0, 0, 1]});
          const {x, y} = within(tree.between("odom", "map"), {x: 2, y: 0});
          const back = within(tree.between("map", "odom"), {x, y});
          return [x, y, back.x, back.y].map(value => Math.round(1000 * value) / 1000 + 0);
        }""")
        assert at == [4, 2, 2, 0]


def test_names_do_not_overlap_and_stay_inside(browser: Any, fleet: Fleet) -> None:
    with shows(browser, f"http://127.0.0.1:{fleet.port}/") as page:
        boxes = page.evaluate("""async () => {
          const {placed} = await import("./labels.js");
          const items = Array.from({length: 60}, (_, k) => ({text: `robot-${k}`, x: k * 37 % 400, y: k * 53 % 300}));
          return placed(items, text => 7 * text.length, 400, 300);
        }""")
    shown = [box for box in boxes if box]
    assert len(shown) > 20 and boxes[0]
    assert all(left >= 0 and top >= 0 and right <= 400 and bottom <= 300 for left, top, right, bottom in shown)
    for one, other in itertools.combinations(shown, 2):
        assert one[0] >= other[2] or one[2] <= other[0] or one[1] >= other[3] or one[3] <= other[1]
