"""How the page reads point clouds: any fields, and fewer points where the machine is busy."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from browser_cases import browsing, shows
from loop_cases import compiled
from needs import needs

for library in ("websockets", "re2", "rosbags"):
    pytest.importorskip(library, reason=needs("extras", library))

from page_cases import CLOUD, Fleet, cdr, cloud, made  # noqa: E402

pytestmark = compiled


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    with browsing() as browser, Fleet() as fleet, shows(browser, f"http://127.0.0.1:{fleet.port}/") as one:
        yield one


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_cloud_has_any_fields(page: Any, order: str) -> None:
    """Of four points one has no place. A red and a green one, by rgb; brightness from its lowest to its highest."""
    layout = {"names": ["ring", "z", "x", "y", "rgb", "light"], "offsets": [0, 1, 9, 13, 18, 23], "itemsize": 27}
    formats = [f"{order}{kind}" for kind in ("u1", "f8", "f4", "i2", "u4", "u2")]
    points = np.zeros(4, np.dtype({**layout, "formats": formats}))
    points["x"], points["y"], points["z"] = [1.5, np.nan, -2, 0], [-3, 0, 7, 1], [0.25, 0, 1e9, -8]
    points["rgb"], points["light"] = [0xFF0000, 0, 0, 0x00FF00], [100, 0, 0, 60_000]
    read = """async ([bytes, by]) => {
      const {cloud} = await import("./cloud.js"), message = {payload: new Uint8Array(bytes)};
      const {places, colours, ...rest} = cloud(message, by);
      return {...rest, places: [...places], colours: [...colours]};
    }"""
    said = page.evaluate(read, [list(cloud(points)), ""])
    assert (said["frame"], said["count"], said["by"]) == ("base_link", 2, "rgb")
    assert said["places"] == [1.5, -3, 0.25, 0, 1, -8] and said["colours"] == [255, 0, 0, 255, 0, 255, 0, 255]
    low, high = np.reshape(page.evaluate(read, [list(cloud(points)), "light"])["colours"], (2, 4))
    assert low[2] > low[0] and high[0] > high[2]  # blue, red
    broken = cloud(points)[:-30]
    fails = f"cloud => ({read})([cloud, '']).then(() => 'read', error => error.name)"
    assert page.evaluate(fails, list(broken)) == "RangeError"


def test_a_busy_machine_draws_fewer_points_rather_than_old_ones(page: Any) -> None:
    """Two late frames make it one point of four; 30 quick ones one of two. Of 3 rows of 5, every fourth is read."""
    steps = """async frames => {
      const {Thinning} = await import("./cloud.js"), thinning = new Thinning();
      return frames.map(ms => (thinning.took(ms), thinning.every));
    }"""
    assert page.evaluate(steps, [20, 150, 101, 60, *[20] * 30, *[20] * 31]) == [
        1,
        2,
        4,
        4,
        *[4] * 29,
        2,
        *[2] * 29,
        1,
        1,
    ]
    assert page.evaluate(steps, [500] * 8)[-2:] == [64, 64]
    rows = np.zeros(15, np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")]))
    rows["x"] = np.arange(15)
    fields = [
        made("sensor_msgs/msg/PointField", name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate("xyz")
    ]
    size = {"height": 3, "width": 5, "point_step": 12, "row_step": 60}
    data = np.frombuffer(rows.tobytes(), np.uint8)
    read = """async ([bytes, every]) => {
      const {cloud} = await import("./cloud.js"), {count, places} = cloud({payload: new Uint8Array(bytes)}, "", every);
      return [count, ...places.filter((_, k) => k % 3 === 0)];
    }"""
    message = cdr(CLOUD, "base_link", fields=fields, is_bigendian=False, data=data, **size)
    for every in (1, 4, 5, 7, 64):
        there = list(range(0, 15, every))
        count, *x = page.evaluate(read, [list(message), every])
        assert (count, x) == (len(there), there)
