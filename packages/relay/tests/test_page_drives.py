"""Driving on the page over a sleep, a late link and a rule that is hard to match; and what tools on the map cover."""

import asyncio
import time
from typing import Any

import pytest
from browser_cases import shows
from loop_cases import compiled
from needs import needs

for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=needs("extras", library))

from test_page import until  # noqa: E402
from test_page_fleet import PLACE, text  # noqa: E402
from test_page_keys import ALL_COMMANDS, Yard, came, drives, parked  # noqa: E402

from bufgym_relay.config import Rule  # noqa: E402
from bufgym_robot.fleet.drive import Drive  # noqa: E402

pytestmark = compiled


SLEEPS = """
const now = performance.now.bind(performance);
let stood = 0;
performance.now = () => now() - stood;
window.sleeps = ms => { const from = now(); while (now() - from < ms); stood += ms; };
"""


def test_after_a_sleep_the_page_says_so_and_drives_again(browser: Any) -> None:
    """The monotonic clock stood still for 4 s; a robot believes the stamps of before and after."""
    with Yard() as fleet:
        page = browser.new_page()
        page.add_init_script(SLEEPS)
        page.goto(f"http://127.0.0.1:{fleet.port}/")
        parked(fleet, page)
        acted: list[float] = []
        at_s = 0.0
        drive = Drive(lambda velocity: asyncio.sleep(0), lambda: at_s)
        page.click("#drive")
        for sleeps in (False, True):
            page.keyboard.down("w")
            drives(page, fleet, 0.2)
            if sleeps:
                page.evaluate("sleeps(4000)")
                until(page, f"{text('#notices')}.includes('This computer slept for 4.')")
                until(page, f"{text('#state')} === 'live'", "!document.querySelector('#drive').hidden")
                page.keyboard.up("w")
                fleet.velocities.clear()
                page.click("#drive")
                page.keyboard.down("w")
                fleet.driven.clear()
                drives(page, fleet, 0.2)
            page.wait_for_timeout(1500)
            page.keyboard.up("w")
            drives(page, fleet, 0)
            said = list(fleet.velocities)
            for message in said:
                at_s = message.at_us / 1e6
                drive.take(message)
                acted.append(drive.velocity.linear)
            assert len(said) >= 10 and acted[-len(said) :].count(0.2) >= len(said) - 2
        page.close()


BAD = "/robots/([a-z0-9]+-?)+/(command|drive)"


def test_a_rule_that_takes_exponential_time_here_takes_none(browser: Any) -> None:
    """The relay says what a rule allows; a robot that comes later is asked for, too."""
    rules = (Rule(address="127.0.0.0/8", receive=True), Rule(address="127.0.0.0/8", send=True, topic=BAD))
    rules += (Rule(address="127.0.0.0/8", send=True, topic="/robots/[^/]+/(status|odom)"),)
    name = "a" * 30 + "!"
    with Yard(rules=rules) as fleet, shows(browser, f"http://127.0.0.1:{fleet.port}/") as page:
        status = {"location": PLACE, "commands": ALL_COMMANDS}
        fleet.robots[name] = status, ()
        until(page, f"{text('#name')} === '{name}'")
        began_s = time.monotonic()
        until(page, "document.querySelector('#stop').hidden", "document.querySelector('#drive').hidden")
        assert time.monotonic() - began_s < 1.0
        fleet.robots["later-1"] = status, ()
        until(page, f"{text('.called')}.includes('later-1')")
        page.evaluate("location.hash = '#/robot/later-1/overview'")
        until(page, f"{text('#stop')} === 'Stop later-1'", "!document.querySelector('#drive').hidden")
        page.keyboard.press("x")
        assert came(page, fleet.stops, 1)


@pytest.mark.parametrize("width", [1360, 390])
def test_tools_cover_no_robot(browser: Any, width: int) -> None:
    """Each robot of six at the map's edges is seen and chosen by a click, while driving is open."""
    with Yard() as fleet, shows(browser, f"http://127.0.0.1:{fleet.port}/", width=width) as page:
        for k in range(6):
            at = {**PLACE, "x": 4.0 * (k % 3), "y": 6.0 * (k // 3)}
            fleet.robots[f"r{k}"] = {"location": at, "commands": ALL_COMMANDS}, ()
        until(page, f"{text('.called')}.includes('r5')", "!document.querySelector('#drive').hidden")
        spy = "import('./map.js').then(({Map2D}) => { const {draw} = Map2D.prototype;"
        page.evaluate(
            f"{spy} Map2D.prototype.draw = function (...all) {{ window.plan = this; draw.apply(this, all); }}; }})"
        )
        page.click("#drive")
        until(page, "window.plan?.robots?.length === 6")
        page.wait_for_timeout(5_000)  # the map comes to rest
        page.evaluate("document.querySelector('#map').scrollIntoView({block: 'center'})")
        covered = """plan.robots.filter(({pose}) => {
          const {left, top} = plan.canvas.getBoundingClientRect(), [x, y] = plan.at(pose.x, pose.y);
          return document.elementFromPoint(left + x, top + y) !== plan.canvas;
        }).map(robot => robot.name).join()"""
        assert page.evaluate(covered) == ""


def test_late_velocities_are_one_alert(browser: Any) -> None:
    with Yard() as fleet, shows(browser, f"http://127.0.0.1:{fleet.port}/") as page:
        parked(fleet, page)
        page.click("#drive")
        late = "import('./relay.js').then(({Relay}) => { Relay.prototype.until = () => 1; })"
        page.evaluate(late)
        page.keyboard.down("w")
        times = "/drive: came .* after its deadline \\((\\d+) times\\)/"
        until(page, f"Number({times}.exec({text('#notices')})?.[1]) >= 5")
        page.keyboard.up("w")
        assert page.evaluate("document.querySelectorAll('#notices p:not([hidden])').length") == 1


def test_a_page_without_an_answer_sends_no_velocities(browser: Any) -> None:
    """It asks for the relay's time all along; where no answer comes, a velocity would only wait."""
    with Yard() as fleet, shows(browser, f"http://127.0.0.1:{fleet.port}/") as page:
        parked(fleet, page)
        page.click("#drive")
        deaf = "import('./relay.js').then(({Relay}) => { const {hear} = Relay.prototype;"
        deaf += 'Relay.prototype.hear = function (data) { if (!/"op":"clock"/.test(data)) hear.call(this, data); }; })'
        page.evaluate(deaf)
        page.wait_for_timeout(600)
        page.keyboard.down("w")
        until(page, f"{text('#driver')}.includes('the link does not keep up')")
        count = len(fleet.driven)
        page.wait_for_timeout(300)
        assert len(fleet.driven) <= count + 1
        page.keyboard.up("w")


def test_a_network_that_is_back_is_tried_at_once(browser: Any) -> None:
    """The page waits for its next try; the browser says that it is online, or the page is looked at again."""
    page = browser.new_page()
    tries: list[Any] = []
    page.on("websocket", lambda one: tries.append(one))
    with Yard() as fleet:
        page.goto(f"http://127.0.0.1:{fleet.port}/")
        until(page, f"{text('#state')} === 'live'")
        page.evaluate("Math.random = () => 1")
    until(page, f"{text('#state')} === 'not connected'")
    page.evaluate("window.setTimeout = () => 1")  # a try of its own comes no more
    page.wait_for_timeout(2_500)
    for event in ("dispatchEvent(new Event('online'))", "document.dispatchEvent(new Event('visibilitychange'))"):
        count = len(tries)
        page.evaluate(event)
        came(page, tries, count + 1)
        assert len(tries) == count + 1
        page.wait_for_timeout(500)
    page.close()
