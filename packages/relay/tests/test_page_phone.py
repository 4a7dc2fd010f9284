"""The page in a hand and by keys: fingers, targets, colours, cards, the order of Tab, the slider of a recording."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser_cases import browsing
from loop_cases import compiled
from needs import needs

for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=needs("extras", library))

from made_up_robot import jpeg  # noqa: E402
from page_cases import CLOUD, Fleet, cloud, drawn, health  # noqa: E402
from test_page import until  # noqa: E402
from test_page_fleet import PLACE, text  # noqa: E402

pytestmark = compiled
OTHERS = [(390, "dark"), (320, "light"), (1400, "light"), (1400, "dark")]
TABS = ("overview", "cameras", "3d", "health")
PICTURE = jpeg(np.full((120, 160, 3), (60, 120, 90), np.uint8))
LOOKS = (Path(__file__).parent / "page_looks.js").read_text()
COUNTED = """import("./map.js").then(({Map2D}) => {
  const {zoom, shift} = Map2D.prototype;
  Object.assign(window, {zoomed: 1, across: 0, down: 0});
  Map2D.prototype.zoom = function (factor, at) { zoomed *= factor; zoom.call(this, factor, at); };
  Map2D.prototype.shift = function (dx, dy) { across += dx; down += dy; shift.call(this, dx, dy); };
})"""
"""Count how far the map is moved, and how much it is zoomed."""


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[Any, Fleet]]:
    """A browser, and a fleet of a robot that sends all, one with a fault, and one with a long name."""
    points = np.zeros(50, np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")]))
    topics = {"link_to_the_base_station": {"age_s": 0.2, "left": 12_345, "dropped": 6789, "qoi": 0.91}}
    queue = {"policy": "drop-oldest", "capacity": 16, "queued": 5, "put": 9, "dropped": 3, "topics": topics}
    says = {"location": PLACE, "battery": 0.7, "ok": True, "text": "on its way to the third charging station in hall B"}
    says |= {"commands": ["stop", "goal", "pose", "cancel", "drive"], "policies": ["drop-oldest"], "queue": queue}
    pictures = (("front_camera/left/image_raw/compressed", "", PICTURE), ("rear", "", b"no picture"))
    with browsing() as browser, Fleet() as fleet:
        sends = (*drawn(), *health(1, "warm"), *pictures, ("velodyne", CLOUD, cloud(points)))
        fleet.robots["one"] = says, sends
        fleet.robots["broken"] = {"battery": 0.1}, health(2, "MOTOR FAULT, and " * 6)
        fleet.robots["the-robot-with-a-name-that-is-longer-than-any-card-of-the-list"] = {"ok": True}, ()
        yield browser, fleet


def looks(page: Any) -> tuple[Any, ...]:
    """What has too little contrast, what runs out of its box, and on a phone what is too small to hit."""
    kinds = ("faint", "wide", "small") if page.viewport_size["width"] < 1000 else ("faint", "wide")
    return tuple(page.evaluate(f"{LOOKS}.{kind}()") for kind in kinds)


def nightly(values: tuple[int, str]) -> Any:
    return pytest.param(*values, marks=pytest.mark.nightly)


def phone(browser: Any, port: int, width: int = 390, scheme: str = "light", fingers: bool = True) -> Any:
    """The page of robot "one" at this width."""
    size = {"width": width, "height": 844 if width < 1000 else 900}
    page = browser.new_page(viewport=size, color_scheme=scheme, has_touch=fingers, is_mobile=fingers)
    page.goto(f"http://127.0.0.1:{port}/#/robot/one/overview")
    until(page, f"{text('#facts')}.includes('in map')", f"{text('#notices p')}.includes('broken')")
    return page


@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (320, "dark"), *map(nightly, OTHERS)])
def test_all_can_be_read_and_hit(running: tuple[Any, Fleet], width: int, scheme: str) -> None:
    browser, fleet = running
    page = phone(browser, fleet.port, width, scheme, width < 1000)
    for tab in TABS:
        page.evaluate(f"location.hash = '#/robot/one/{tab}'")
        until(page, f"document.body.dataset.tab === '{tab}' && !document.querySelector('#tab-{tab}').hidden")
        if tab == "cameras":
            until(page, f"{text('#cameras .blank figcaption')} !== ''")
        if tab in ("overview", "3d"):
            page.click("#drive" if tab == "overview" else "#layers-box summary")
        assert not any(found := looks(page)), (tab, found)
    page.close()


def spot(page: Any) -> tuple[float, float]:
    """The middle of the map, which is scrolled to."""
    page.evaluate("document.querySelector('#map').scrollIntoView({block: 'center'})")
    box = page.locator("#map").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_one_finger_scrolls_and_two_move_the_map(running: tuple[Any, Fleet]) -> None:
    """Two fingers 100 px apart go 40 px up and to 200 px apart: the map is twice as large."""
    browser, fleet = running
    page = phone(browser, fleet.port)
    hands = page.context.new_cdp_session(page)

    def touch(kind: str, *fingers: tuple[float, float]) -> None:
        points = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(fingers)]
        hands.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    page.evaluate(COUNTED)
    (x, y), before = spot(page), page.evaluate("scrollY")
    touch("touchStart", (x - 50, y), (x + 50, y))
    for k in range(1, 11):
        touch("touchMove", (x - 50 - 5 * k, y - 4 * k), (x + 50 + 5 * k, y - 4 * k))
    touch("touchEnd")
    until(page, "Math.abs(zoomed - 2) < .01 && Math.hypot(across, down + 40) < 1")
    assert page.evaluate("scrollY") == before
    touch("touchStart", (x, y))
    for k in range(1, 11):
        touch("touchMove", (x, y - 10 * k))
    touch("touchEnd")
    until(page, f"scrollY > {before} + 40")
    assert page.evaluate("Math.abs(zoomed - 2) < .01 && Math.hypot(across, down + 40) < 1")
    page.close()


def test_all_can_be_done_by_keys(running: tuple[Any, Fleet]) -> None:
    """Tab goes through the page as it is read, each stop with a ring; X stops, and Escape closes what lies above."""
    browser, fleet = running
    page = phone(browser, fleet.port, 1400, fingers=False)
    seen: list[str] = []
    focus = "document.activeElement"
    page.keyboard.press("Tab")
    while not page.evaluate(f"{focus} === document.body || 'been' in {focus}.dataset"):
        name = f"{focus}.id || {focus}.dataset.tab || {focus}.className || {focus}.textContent"
        seen.append(page.evaluate(name))
        assert page.evaluate(f"getComputedStyle({focus}).outlineStyle") != "none", seen[-1]
        page.evaluate(f"{focus}.dataset.been = ''")
        page.keyboard.press("Tab")
    stops = [
        "recordings",
        "stop",
        "search",
        "card",
        "map",
        "Layers",
        "goal",
        "drive",
        "fit",
        "overview",
        "first",
        "policy",
    ]
    assert [name for name in seen if name in stops] == stops
    page.focus(".card:not([tabindex='-1'])")
    page.keyboard.press("ArrowUp")
    page.keyboard.press("Enter")
    until(page, f"{text('#name')} === 'broken'")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    until(page, f"{text('#name')} === 'one'", "!document.querySelector('#drive').hidden")
    until(page, f"{text('#first figcaption')}.includes(' a second')")
    for opens, closed in (
        ("#layers-box summary", "!document.querySelector('#layers-box').open"),
        ("#drive", "document.querySelector('#driving').hidden"),
        ("#first", "!document.querySelector('#large').open"),
    ):
        page.focus(opens)
        page.keyboard.press("Enter")
        until(page, f"!({closed})")
        page.keyboard.press("Escape")
        until(page, closed)
    fleet.came.clear()
    page.focus("#search")
    page.keyboard.type("x")
    page.fill("#search", "")
    page.focus("#map")
    page.keyboard.press("x")
    until(page, f"{text('#command-status')} === 'stop: one answers: done'")
    assert [said["command"] for said in fleet.came] == ["stop"]
    page.close()


def test_a_recording_of_half_an_hour_is_moved_to_the_second(running: tuple[Any, Fleet]) -> None:
    """The middle of the slider is at 15 minutes; keys move it by 5 s and by a minute, buttons by 10 s."""
    page = phone(running[0], running[1].port)
    page.evaluate("""import("./player.js").then(({Player}) => {
      window.asked = [];
      const relay = {say: (_, said) => asked.push(said)}, on = {message() {}, begin() {}, jump() {}, end() {}};
      const player = new Player(id => document.getElementById(id), relay, on);
      player.play("half an hour");
      player.replay.take({id: asked[0].id, first_us: 0, last_us: 1800e6, next_us: null, messages: []});
      player.say();
    })""")
    assert page.text_content("#clock") == "00:00 of 30:00"
    assert not any(looks(page))
    page.click("#layers-box summary")
    above = page.evaluate("""(() => {
      const [layers, ahead] = ["layers", "ahead"].map(id => document.getElementById(id).getBoundingClientRect());
      scrollBy(0, layers.top - ahead.top);
      return document.elementFromPoint(ahead.right - 5, ahead.top + ahead.height / 2).id;
    })()""")
    assert above == "ahead", "the map's layers go below the player"
    page.keyboard.press("Escape")
    page.locator("#when").tap()
    minutes, _, rest = page.text_content("#clock").partition(":")
    assert minutes in ("14", "15") and rest.endswith(" of 30:00")
    page.focus("#when")
    for key, says in (("Home", "00:00"), ("PageUp", "01:00"), ("ArrowRight", "01:05"), ("ArrowLeft", "01:00")):
        page.keyboard.press(key)
        assert page.text_content("#clock") == f"{says} of 30:00"
    for button, says in (("#ahead", "01:10"), ("#back", "01:00")):
        page.tap(button)
        assert page.text_content("#clock") == f"{says} of 30:00"
    assert page.evaluate("asked.at(-1).from_us") == 58e6, "two seconds before: what was said last holds"
    page.close()
