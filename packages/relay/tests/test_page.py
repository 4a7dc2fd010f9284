"""The page in a browser: robots, map, senses, queue, a command, a recording; on a desk and on a phone."""

import asyncio
import contextlib
import json
import math
import queue
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser_cases import shows
from loop_cases import compiled
from needs import needs

for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=needs("extras", library))

import fleet_demo as demo  # noqa: E402
from pose_cases import ESTIMATE, ODOMETRY, POSE, TF, message  # noqa: E402
from relay_cases import client  # noqa: E402

pytestmark = compiled

SEES = """canvas => {
  const seen = new Set();
  const {data} = canvas.getContext("2d", {willReadFrequently: true}).getImageData(0, 0, canvas.width, canvas.height);
  for (let k = 0; k < data.length; k += 4)
    if (data[k + 3]) seen.add(data[k] >> 4 << 8 | data[k + 1] >> 4 << 4 | data[k + 2] >> 4);
  return seen.size;
}"""
"""How many colours a canvas has."""


@contextlib.contextmanager
def recorded(folder: Path) -> Iterator[int]:
    """The port of a relay with two made-up robots, in a thread; it records."""
    found: queue.Queue[int] = queue.Queue()
    over = threading.Event()

    async def show() -> None:
        async with demo.running(2, policy="drop-oldest", fades=False, folder=folder) as number:
            found.put(number)
            await asyncio.to_thread(over.wait, 600)

    thread = threading.Thread(target=lambda: asyncio.run(show()))
    thread.start()
    yield found.get(timeout=120)
    over.set()
    thread.join(120)
    assert not thread.is_alive(), "waited 120 s for the relay's end"


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    """Of a relay for one test: what a test adds, the relay keeps."""
    with recorded(tmp_path) as number:
        yield number


def until(page: Any, *expressions: str) -> None:
    """Wait until these have held on the page, one after the other."""
    for expression in expressions:
        for _ in range(1_500):  # the page's own rules forbid it to wait for text that is evaluated there
            if page.evaluate(expression):
                break
            page.wait_for_timeout(20)
        else:
            pytest.fail(f"never {expression}")


@pytest.mark.parametrize(("scheme", "width"), [("light", 1360), pytest.param("dark", 390, marks=pytest.mark.nightly)])
def test_it_shows_the_robots(browser: Any, port: int, scheme: str, width: int) -> None:
    with shows(browser, f"http://127.0.0.1:{port}/", scheme, width) as page:
        until(page, "document.querySelectorAll('.card').length === 2")
        for id, text in (("camera", "camera"), ("scan", "laser")):
            until(page, f"document.querySelector('#{id}-says').textContent.startsWith('{text}')")
        until(page, "document.querySelectorAll('#topics tr').length === 5")
        names = page.eval_on_selector_all(".called", "cards => cards.map(card => card.textContent)")
        assert sorted(names) == ["robot-1", "robot-2"]
        page.click(".card:has-text('robot-2')")
        until(page, "document.querySelector('#name').textContent === 'robot-2'")
        until(page, "document.querySelector('#facts').textContent.includes('battery')")
        for canvas, colours in (("#camera", 20), ("#scan", 3), ("#map", 5), ("#slots", 1)):
            until(page, f"({SEES})(document.querySelector('{canvas}')) >= {colours}")
        assert page.text_content("#state") == "live"


BAD_NUMBERS = (1e17, -1e300, "far", None, [1], {"x": 1})
FRAMES = "window.frames_drawn = 0, (function count() { window.frames_drawn++; requestAnimationFrame(count); })()"


def cdr(x: float, rays: int | None = None) -> bytes:
    """A PoseStamped at x, or a LaserScan that says to have so many rays and has one."""
    head = bytes([0, 1, 0, 0]) + struct.pack("<iIIxxxx", 0, 0, 0)
    if rays is None:
        return head + struct.pack("<7d", x, 0, 0, 0, 0, 0, 1)
    return head + struct.pack("<7fIf", 0, 1, 1, 0, 0, 0, 9, rays, max(-3e38, x))


@pytest.mark.parametrize("number", [*BAD_NUMBERS, float("nan"), float("inf")], ids=str)
def test_no_number_freezes_the_page(browser: Any, port: int, number: Any) -> None:
    """A robot says it everywhere, as JSON and in ROS's encoding; the page goes on, and shows the others."""

    async def rave(page: Any) -> None:
        async with client(port, name="mad") as robot:
            for _ in range(3):
                if not isinstance(number, float) or abs(number) < 1e301:  # what JSON can say
                    at = {"x": number, "y": number, "yaw": number}
                    queue = {"capacity": number, "queued": number, "waiting": number, "topics": {"a": number}}
                    scan = {"angle_min": 0, "angle_increment": number, "ranges": [number] * 9}
                    said = {"odom": at, "scan": scan, "queue": queue, "status": {"location": at, "queue": queue}}
                    for name, what in [*said.items(), ("status", number), ("queue", number), ("scan", number)]:
                        await robot.put(f"/robots/mad/{name}", json.dumps(what).encode(), encoding="json")
                if isinstance(number, float):
                    pose, scan_type = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/LaserScan"
                    await robot.put("/robots/mad/localization", cdr(number), encoding="cdr", type=pose)
                    await robot.put("/robots/mad/laser", cdr(number, 2**32 - 1), encoding="cdr", type=scan_type)
            await robot.put("/robots/mad/status", b"{}", encoding="json")
            assert await robot.rest() == []

    with shows(browser, f"http://127.0.0.1:{port}/") as page:
        until(page, "[...document.querySelectorAll('.called')].map(card => card.textContent).includes('robot-1')")
        threading_run(rave(page))
        mad = "[...document.querySelectorAll('.card')].find(card => card.textContent.includes('mad'))"
        until(page, f"{mad} !== undefined")
        page.evaluate(f"{mad}.click()")
        threading_run(rave(page))
        page.evaluate(FRAMES)
        until(page, "window.frames_drawn > 30")
        page.evaluate("[...document.querySelectorAll('.card')].find(c => c.textContent.includes('robot-2')).click()")
        until(page, f"({SEES})(document.querySelector('#scan')) >= 3")


def test_a_robot_has_one_place_in_one_frame(browser: Any, port: int) -> None:
    """By tf it is 3 m along an odom that lies at x = 100 in the map and is turned to the left: at (100, 3).

    Neither its odometry nor its goal is its place. Robots of another frame are on another map. One with odometry alone
    is in the frame of its first.
    """
    odom = message(TF, 0, 100.0, "map", "odom", yaw=math.pi / 2), TF
    base = message(TF, 0, 3.0, "odom", "base_link"), TF
    wheel, goal = (message(TF, 0, 9.0, "base_link", "wheel"), TF), (message(POSE, 0, 50.0, "map"), POSE)
    wheels = message(ODOMETRY, 0, 3.0, "odom", "base_link"), ODOMETRY
    away = message(ODOMETRY, 0, 7.0, "hall"), ODOMETRY
    tree = [("tf", odom), ("tf", base), ("tf", wheel)]
    poses = [("odom", wheels), ("goal_pose", goal), ("amcl_pose", (message(ESTIMATE, 0, 90.0, "map"), ESTIMATE))]
    said = {
        "by-tf": tree,
        "nav": [*poses, *tree, *poses],
        "wheels": [("odom", away), ("goal_pose", goal), ("odom", (message(ODOMETRY, 0, 1.0, "map"), ODOMETRY))],
        "stray": poses[1:2],
    }

    async def drive() -> None:
        async with client(port, name="fleet") as fleet:
            for name, messages in said.items():
                kinds = {topic: {"type": type, "encoding": "cdr"} for topic, (_, type) in messages}
                status = json.dumps({"publishes": kinds}).encode()
                await fleet.put(f"/robots/{name}/status", status, encoding="json")
            await fleet.rest()
            await asyncio.sleep(1.0)  # until the page has asked for their topics
            for _ in range(3):  # the page takes none that comes before its time by the robot's clock
                for name, messages in said.items():
                    for topic, (payload, type) in messages:
                        await fleet.put(f"/robots/{name}/{topic}", payload, encoding="cdr", type=type)
                        await asyncio.sleep(0.01)
            assert await fleet.rest() == []

    with shows(browser, f"http://127.0.0.1:{port}/") as page:
        until(page, "document.querySelectorAll('.card').length >= 2")
        threading_run(drive())
        for name, facts in (("nav", "at 100.0, 3.0 m in map"), ("by-tf", "at 100.0, 3.0 m in map"), ("stray", "")):
            page.evaluate(f"document.querySelector(\".card[href*='/{name}']\").click()")  # others say who is near
            until(page, f"document.querySelector('#name').textContent === '{name}'")
            until(page, f"document.querySelector('#facts').textContent === '{facts}'")
            until(page, "document.querySelector('#frame').textContent === 'in map, 1 in other frames'")
        page.evaluate("[...document.querySelectorAll('.card')].find(c => c.textContent.includes('wheels')).click()")
        until(page, "document.querySelector('#facts').textContent === 'at 7.0, 0.0 m in hall'")
        until(page, "document.querySelector('#frame').textContent === 'in hall, 4 in other frames'")


def threading_run(work: Any) -> None:
    """Run it in a thread: playwright has this one's loop."""
    thread = threading.Thread(target=lambda: asyncio.run(work))
    thread.start()
    thread.join(120)
    assert not thread.is_alive(), "waited 120 s for a robot"


@pytest.mark.nightly
def test_a_viewer_chooses_the_policy_and_plays_a_recording(browser: Any, port: int) -> None:
    with shows(browser, f"http://127.0.0.1:{port}/#/robot/robot-1") as page:
        cards = "document.querySelectorAll('.card').length >= 2"
        until(page, f"{cards} && document.querySelector('#policy').value === 'drop-oldest'")
        page.select_option("#policy", "drop-newest")
        until(page, "document.querySelector('#command-status').textContent.endsWith('done')")
        until(page, "document.querySelector('#policy').value === 'drop-newest'")
        page.click("#recordings")
        page.click("#files li button")
        until(page, f"{cards} && document.querySelector('#clock').textContent !== ''")
        until(page, "document.querySelector('#camera-says').textContent.startsWith('camera')")
        assert page.text_content("#state") == "replay" and page.is_disabled("#policy")
        page.click("#play")
        assert page.text_content("#play") == "Play"
        page.click("#live")
        until(page, f"document.querySelector('#state').textContent === 'live' && {cards}")
