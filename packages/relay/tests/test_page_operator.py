"""What an operator looks for: who is silent, who is near whom, what a robot does, a stop for all, a goal by keys."""

from typing import Any

import numpy as np
import pytest
from browser_cases import shows
from loop_cases import compiled
from needs import needs

for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=needs("extras", library))

from page_cases import Fleet, drawn  # noqa: E402
from test_page import until  # noqa: E402
from test_page_fleet import PLACE, text  # noqa: E402

pytestmark = compiled


def card(name: str, part: str) -> str:
    """An expression for the text of a part of a robot's card."""
    return f"document.querySelector(\".card[href*='{name}'] .{part}\").textContent"


def test_a_silent_robot_says_so_and_has_a_place(browser: Any) -> None:
    """It fell silent before the page was opened; nothing says that it still drives to its dock."""
    with Fleet() as fleet:
        fleet.robots["here"] = {"location": PLACE, "text": "waits"}, ()
        fleet.robots["gone"] = {"location": {**PLACE, "x": 4}, "text": "drives to dock 4"}, ()
        with shows(browser, f"http://127.0.0.1:{fleet.port}/#/robot/gone/overview") as page:
            until(page, f"{text('#doing')} === 'drives to dock 4'", "!document.querySelector('#no-map').hidden")
            until(page, f"/^drives to dock 4, for [3-9].[0-9] s$/.test({text('#doing')})")
            del fleet.robots["gone"]
            until(page, f"{card('gone', 'says')} === 'silent; before: drives to dock 4'")
        with shows(browser, f"http://127.0.0.1:{fleet.port}/#/robot/here/overview") as page:
            until(page, f"{text('#doing')} === 'waits'", f"{card('gone', 'seen')}.endsWith(' ago at 4.0, 0.0 m')")
            until(page, f"{card('gone', 'says')} === 'silent; before: drives to dock 4'")
            on_map = "import('./map.js').then(({Map2D}) => { const {draw} = Map2D.prototype;"
            on_map += "Map2D.prototype.draw = function (robots, ...rest) { window.mapped = robots.map(one => one.name);"
            page.evaluate(f"{on_map} draw.call(this, robots, ...rest); }}; }})")
            until(page, "(window.mapped ?? []).sort().join() === 'gone,here'")
            fleet.robots["here"] = {"location": PLACE}, drawn()
            until(page, "document.querySelector('#no-map').hidden")


def test_robots_that_are_near_each_other_are_marked(browser: Any) -> None:
    """Of three, two are .6 m apart, and the third is in another frame. The distance can be set."""
    with Fleet() as fleet, shows(browser, f"http://127.0.0.1:{fleet.port}/") as page:
        for name, at in (("a", PLACE), ("b", {**PLACE, "x": 0.6}), ("c", {**PLACE, "frame": "hall"})):
            fleet.robots[name] = {"location": at, "ok": True}, ()
        until(page, f"{text('.card .says')} === '0.6 m from b,0.6 m from a,OK'")
        page.click("#layers-box summary")
        page.fill("#near", "0.5")
        page.keyboard.press("Enter")
        until(page, f"{text('.card .says')} === 'OK,OK,OK'")
        page.reload()
        until(page, f"{text('.card .says')} === 'OK,OK,OK'")
        assert page.input_value("#near") == "0.5"


def test_all_robots_stop_at_a_second_press(browser: Any) -> None:
    with Fleet() as fleet, shows(browser, f"http://127.0.0.1:{fleet.port}/") as page:
        for name in ("a", "b", "c"):
            fleet.robots[name] = {"location": PLACE, "commands": ["stop"]}, ()
        fleet.robots["d"] = {"location": PLACE}, ()
        until(page, f"{text('#stop-all')} === 'Stop all 3'")
        page.click("#stop-all")
        until(page, f"{text('#stop-all')} === 'Stop all 3: press again'")
        until(page, f"{text('#stop-all')} === 'Stop all 3'")  # nobody pressed again
        assert fleet.came == []
        page.click("#stop-all")
        page.click("#stop-all")
        until(page, f"{text('#command-status')} === 'stop: 3 of 3 robots have confirmed'")
        assert [said["command"] for said in fleet.came] == ["stop"] * 3


def test_a_goal_by_keys(browser: Any) -> None:
    """From the middle of the map two steps of 15 px to the right and one up; then a quarter turn to the left."""
    with Fleet() as fleet, shows(browser, f"http://127.0.0.1:{fleet.port}/") as page:
        fleet.robots["one"] = {"location": PLACE, "commands": ["stop", "goal"]}, ()
        until(page, f"{text('#facts')} !== ''", "!document.querySelector('#goal').hidden")
        page.focus("#goal")
        page.keyboard.press("Enter")
        until(page, f"{text('#command-status')}.includes('arrows, Enter')", "document.activeElement.id === 'map'")
        for key in ("ArrowRight", "ArrowRight", "ArrowUp", "Enter", *["ArrowLeft"] * 6, "Enter"):
            page.keyboard.press(key)
        until(page, f"{text('#command-status')} === 'goal: one answers: done'")
        (said,) = fleet.came
        assert said["x"] == pytest.approx(2 * said["y"], abs=2e-3) and said["y"] > 0
        assert said["yaw"] == pytest.approx(np.pi / 2, abs=1e-3)


def test_at_200_percent_stop_covers_no_tool(browser: Any) -> None:
    """A window of 1280 x 720 at 200 % has 640 x 360 CSS pixels: three alerts take two lines of it."""
    with Fleet() as fleet:
        fleet.robots["one"] = {"location": PLACE, "commands": ["stop", "goal", "drive"], "estop": True}, ()
        fleet.robots |= {name: ({"battery": 0.1}, ()) for name in ("two", "three")}
        page = browser.new_page(viewport={"width": 640, "height": 360})
        page.goto(f"http://127.0.0.1:{fleet.port}/#/robot/one/overview")
        until(page, f"{text('#notices p')}.includes('and 2 more')", "!document.querySelector('#goal').hidden")
        page.evaluate("document.querySelector('#tools').scrollIntoView({block: 'end'})")
        over = """["goal", "drive", "stop"].filter(id => {
          const {left, top, width, height} = document.getElementById(id).getBoundingClientRect();
          return document.elementFromPoint(left + width / 2, top + height / 2)?.id !== id;
        }).join()"""
        until(page, f"{over} === ''")
        assert page.locator("#notices").bounding_box()["height"] < 360 / 3
        page.close()
