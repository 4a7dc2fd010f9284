"""Robots with Robofleet's released client on the page: what their flatbuffers say is shown like ours."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from browser_cases import browsing, shows
from loop_cases import compiled
from needs import needs

flatbuffers = pytest.importorskip("flatbuffers", reason=needs("extras", "flatbuffers"))
for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=needs("extras", library))

from made_up_robot import jpeg  # noqa: E402
from page_cases import Fleet, Topics  # noqa: E402
from test_page import SEES, until  # noqa: E402

pytestmark = compiled
COUNT = """([red, green, blue]) => {
  const canvas = document.querySelector("#map"), {data} = canvas.getContext("2d", {willReadFrequently: true})
    .getImageData(0, 0, canvas.width, canvas.height);
  let xs = [], ys = [];
  for (let k = 0; k < data.length; k += 4)
    if (Math.max(Math.abs(data[k] - red), Math.abs(data[k + 1] - green), Math.abs(data[k + 2] - blue)) < 20) {
      xs.push(k / 4 % canvas.width);
      ys.push(Math.floor(k / 4 / canvas.width));
    }
  const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  return xs.length && {x: (left + right) / 2, y: (low + high) / 2, width: right - left, height: high - low};
}"""
PLACE = "at 10.0, 0.0 m in map"
RED, GREEN, BLUE = 0xFF0000, 0x00C000, 0x0000FF


def at(colour: int) -> str:
    """An expression for where a colour is on the map, in pixels, and how large; 0 where it is not."""
    return f"({COUNT})([{colour >> 16}, {colour >> 8 & 255}, {colour & 255}])"


def flat(*fields: Any) -> bytes:
    """A message without metadata: texts, numbers, arrays, tuples as tables, and lists of them."""
    builder = flatbuffers.Builder(1024)

    def table(fields: tuple[Any, ...]) -> int:
        slots = [("Uint32", 0), *(slot(value) for value in fields)]
        builder.StartObject(len(slots))
        for k, (kind, value) in enumerate(slots):
            getattr(builder, f"Prepend{kind}Slot")(k, value, 0)
        return int(builder.EndObject())

    def slot(value: Any) -> tuple[str, Any]:
        match value:
            case str():
                return "UOffsetTRelative", builder.CreateString(value)
            case tuple():
                return "UOffsetTRelative", table(value)
            case np.ndarray():
                return "UOffsetTRelative", builder.CreateNumpyVector(value)
            case list():
                tables = [table(one) for one in value]
                builder.StartVector(4, len(tables), 4)
                for one in reversed(tables):
                    builder.PrependUOffsetTRelative(one)
                return "UOffsetTRelative", builder.EndVector()
            case bool():
                return "Bool", value
            case int():
                return "Uint32", value
            case np.float64():
                return "Float64", value
        return "Float32", value

    builder.Finish(table(fields))
    return bytes(builder.Output())


def header(frame: str) -> tuple[Any, ...]:
    return (0, 0, frame)


def drawing(frame: str, space: str, **parts: list[Any]) -> bytes:
    names = ("particles", "path_options", "points", "lines", "arcs")
    return flat(header(frame), space, *(parts.get(name, []) for name in names))


def jackal() -> Topics:
    """At (10, 0) in the map, looking along y. A red line 2 m ahead of it, a green arc and a blue point."""
    scan = (
        header("laser"),
        -1.0,
        1.0,
        0.02,
        0.0,
        0.0,
        0.1,
        30.0,
        np.full(100, 2.0, np.float32),
        np.zeros(0, np.float32),
    )
    picture = np.frombuffer(jpeg(np.full((120, 160, 3), (220, 30, 30), np.uint8)), np.uint8)
    far = [((12.0, 0.0), BLUE)]
    circle = [((8.0, 0.0), 1.0, 0.0, 2 * math.pi, GREEN)]
    ahead = [((2.0, -1.0), (2.0, 1.0), RED)]
    return tuple(
        (f"/ut/jackal/{topic}", type, data)
        for topic, type, data in (
            ("status", "amrl_msgs/RobofleetStatus", flat("patrol", True, 0.5, "GDC")),
            ("localization", "amrl_msgs/Localization2DMsg", flat(header("map"), (10.0, 0.0, math.pi / 2), "GDC1")),
            ("visualization", "amrl_msgs/VisualizationMsg", drawing("base_link", "nav", lines=ahead)),
            ("visualization", "amrl_msgs/VisualizationMsg", drawing("map", "loc", points=far, arcs=circle)),
            ("velodyne_2dscan", "sensor_msgs/LaserScan", flat(*scan)),
            ("image_compressed/main", "sensor_msgs/CompressedImage", flat(header("cam"), "jpeg", picture)),
        )
    )


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[Any, Fleet]]:
    with browsing() as browser, Fleet() as fleet:
        yield browser, fleet


@pytest.mark.parametrize(("scheme", "width"), [("light", 1400), pytest.param("dark", 390, marks=pytest.mark.nightly)])
def test_a_robot_of_robofleet_s_is_shown_like_ours(running: tuple[Any, Fleet], scheme: str, width: int) -> None:
    browser, fleet = running
    fleet.released = jackal()
    with shows(browser, f"http://127.0.0.1:{fleet.port}/", scheme, width) as page:
        until(page, "document.querySelector('.called')?.textContent === 'ut/jackal'")
        says = "document.querySelector('{}').textContent.includes('{}')"
        for selector, text in (
            (".says", "patrol, at GDC"),
            ("#facts", "at 10.0, 0.0 m in map"),
            ("#facts", "battery 50 %"),
        ):
            until(page, says.format(selector, text))
        until(page, f"{at(0x8C96A3 if scheme == 'light' else 0x76818E)} !== 0")  # the walls that the laser saw
        for canvas, colours in (("#camera", 1), ("#scan", 3)):
            until(page, f"({SEES})(document.querySelector('{canvas}')) >= {colours}")
        page.focus("#map")
        for _ in range(4):
            page.keyboard.press("-")  # the phone's map is small
        until(page, *(f"{at(colour)} !== 0" for colour in (RED, GREEN, BLUE)))
        red, green, blue = (page.evaluate(at(colour)) for colour in (RED, GREEN, BLUE))
        metre = (blue["x"] - green["x"]) / 4  # the circle's middle is at x = 8, the point at x = 12
        assert green["width"] == pytest.approx(2 * metre, rel=0.1) == green["height"]
        assert red["width"] == pytest.approx(2 * metre, rel=0.1)  # ahead is along y, so the line is along x
        assert (red["x"] - green["x"], green["y"] - red["y"]) == pytest.approx((2 * metre, 2 * metre), rel=0.1)
        page.click("#layers-box summary")
        page.click("#layers label:has-text('visualization loc')")
        until(page, f"{at(GREEN)} === 0 && {at(BLUE)} === 0 && {at(RED)} !== 0")


def test_a_flatbuffer_that_is_none_freezes_nothing(running: tuple[Any, Fleet]) -> None:
    """Each message cut, and with each of its first bytes as large as can be."""
    browser, fleet = running
    broken = [
        (topic, type, part)
        for topic, type, data in jackal()
        for part in (data[: len(data) // 2], *(data[:k] + b"\xff" + data[k + 1 :] for k in range(0, 120, 3)))
    ]
    fleet.released = (*broken, *jackal()[:2])
    with shows(browser, f"http://127.0.0.1:{fleet.port}/") as page:
        until(page, f"document.querySelector('#facts').textContent.includes('{PLACE}')")
