"""The page over made-up robots that send each type of message: troubles, layers, cameras, commands."""

import base64
import io
import itertools
import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from browser_cases import shows
from loop_cases import compiled
from needs import needs

for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=needs("extras", library))

from made_up_robot import jpeg  # noqa: E402
from page_cases import CLOUD, Fleet, cdr, cloud, drawn, health  # noqa: E402
from PIL import Image  # noqa: E402
from pose_cases import ESTIMATE, POSE  # noqa: E402
from test_page import SEES, until  # noqa: E402

from bufgym_robot.wire import ros_messages  # noqa: E402

pytestmark = compiled
RED = jpeg(np.full((120, 160, 3), (220, 30, 30), np.uint8))
PICTURE = "sensor_msgs/msg/CompressedImage"
PLACE = {"x": 0, "y": 0, "yaw": 0, "frame": "map"}
WIDTHS = [1400, pytest.param(390, marks=pytest.mark.nightly)]
COUNT = """([red, green, blue]) => {
  const canvas = document.querySelector("#map"), {data} = canvas.getContext("2d", {willReadFrequently: true})
    .getImageData(0, 0, canvas.width, canvas.height);
  let found = 0;
  for (let k = 0; k < data.length; k += 4)
    found += Math.max(Math.abs(data[k] - red), Math.abs(data[k + 1] - green), Math.abs(data[k + 2] - blue)) < 20;
  return found;
}"""
ORANGE, WALL = (f"({COUNT})({colour})" for colour in ("[255, 128, 0]", "[140, 150, 163]"))
"""How many pixels of the map have the colour of the markers, and of the walls of a grid."""


@pytest.fixture(params=WIDTHS)
def opened(browser: Any, request: pytest.FixtureRequest) -> Iterator[tuple[Any, Fleet]]:
    """The page, which must say no error and fit its window's width, and a fleet that has no robots yet."""
    with Fleet() as fleet, shows(browser, f"http://127.0.0.1:{fleet.port}/", width=request.param) as page:
        page.set_default_timeout(120_000)
        yield page, fleet


def text(selector: str) -> str:
    """An expression for the texts of these elements, joined by commas."""
    return f"[...document.querySelectorAll('{selector}')].map(one => one.textContent).join()"


def test_who_needs_somebody_comes_first_and_alerts_stay(opened: tuple[Any, Fleet]) -> None:
    page, fleet = opened
    fine = {"ok": True, "battery": 0.9}
    fleet.robots |= {
        "fine-2": ({**fine, "text": "on its way"}, ()),
        "fine-10": (fine, ()),
        "empty": ({"battery": 0.1}, ()),
    }
    fleet.robots |= {"broken": (fine, health(2, "MOTOR FAULT"))}
    names = text(".card:not([hidden]) .called")
    until(page, f"{names} === 'broken,empty,fine-2,fine-10'", f"{text('.says')}.startsWith('motor left: MOTOR FAULT')")
    until(page, f"{text('#notices p')} !== ''")
    fleet.robots["broken"] = (fine, health(0, "well"))
    until(
        page,
        f"{names}.startsWith('empty')",
        f"!{text('#notices p')}.includes('broken') || {text('#notices p')}.includes('over')",
    )
    page.click("#notices .all button")
    assert page.is_hidden("#notices")
    page.fill("#search", "WAY")
    assert page.evaluate(names) == "fine-2"


def test_an_address_shows_a_robot_and_back_returns(opened: tuple[Any, Fleet]) -> None:
    page, fleet = opened
    fleet.robots |= {"one": ({}, ()), "two & a half": ({"estop": True}, health(1, "warm"))}
    page.evaluate("location.hash = '#/robot/two%20%26%20a%20half/health'")
    until(
        page,
        f"{text('#verdict-says')} === 'emergency stop'",
        f"{text('#parts td')}.startsWith('warning,motor left,warm')",
    )
    page.click(".card:has-text('one')")
    until(page, f"location.hash === '#/robot/one/health' && {text('#name')} === 'one'")
    page.click("#tabs a:has-text('Cameras')")
    page.go_back()
    page.go_back()
    until(page, f"{text('#name')} === 'two & a half'")


def test_the_map_shows_layers_of_one_frame(opened: tuple[Any, Fleet]) -> None:
    """By tf (4, 0) and a quarter turn, odom's (2, 0) is the map's (4, 2)."""
    page, fleet = opened
    fleet.robots["one"] = {}, drawn()
    layers = "laser walls,trails,map,plan,particles,goal_pose,markers,markers people,markers zones"
    until(page, f"{text('#facts')} === 'at 5.0, 0.0 m in map'", f"{text('#layers label')} === '{layers}'")
    for _ in range(4):  # on a phone the markers are beyond the edge
        page.locator("#map").press("-")
    until(page, f"{ORANGE} > 50", f"({SEES})(document.querySelector('#map')) > 8")
    page.click("#layers-box summary")
    for space in ("people", "zones"):
        page.click(f"#layers label:has-text('{space}')")
    until(page, f"{ORANGE} === 0")
    at = page.evaluate("""async () => {
      const {Place, within} = await import("./frames.js"), {tree} = new Place("one");
      tree.add({frame: "map", child: "odom", at: [4, 0, 0], turn: [0, 0, Math.SQRT1_2, Math.SQRT1_2]});
      const {x, y} = within(tree.between("odom", "map"), {x: 2, y: 0});
      const back = within(tree.between("map", "odom"), {x, y});
      return [x, y, back.x, back.y];
    }""")
    assert at == pytest.approx([4, 2, 2, 0], abs=1e-9)


def test_a_map_that_was_published_before_is_shown(opened: tuple[Any, Fleet]) -> None:
    page, fleet = opened
    fleet.robots["one"] = {}, drawn()
    until(page, f"{text('#layers label')}.includes('markers people')")  # these came after the map
    kinds = {topic: {"type": type, "encoding": "cdr"} for topic, type, _ in drawn()}
    fleet.robots["one"] = {"publishes": kinds, "location": PLACE}, ()
    page.reload()
    until(page, f"{text('#facts')} === 'at 0.0, 0.0 m in map'", f"{WALL} > 50")


def test_the_3d_tab_shows_points_and_markers(opened: tuple[Any, Fleet]) -> None:
    """Magenta points of a wall before the robot, and its orange markers; they turn with the mouse."""
    page, fleet = opened
    wall = np.zeros(3000, np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")]))
    wall["x"], wall["y"], wall["z"], wall["rgb"] = 1, np.arange(3000) / 1500 - 1, np.arange(3000) % 50 / 25, 0xFF00FF
    fleet.robots["one"] = {}, (*drawn(), ("velodyne", CLOUD, cloud(wall)))
    until(page, f"{text('#facts')} === 'at 5.0, 0.0 m in map'")
    loaded = "performance.getEntriesByType('resource').filter(one => one.name.endsWith('scene.js')).length"
    assert page.evaluate(loaded) == 0
    page.evaluate("import('./cloud.js').then(({Thinning}) => { Thinning.prototype.took = () => {}; })")  # all points
    page.click("#tabs a:has-text('3-D')")
    until(page, f"{text('#space figcaption')}.startsWith('velodyne: 3,000 points')")

    def shown(holds: Callable[[int, int], bool]) -> int:
        """How many points there are in a picture of which it holds, by their number and that of markers' pixels."""
        for _ in range(600):
            picture = Image.open(io.BytesIO(page.locator("#space").screenshot())).convert("RGB")
            seen = np.asarray(picture).reshape(-1, 3).astype(int)
            points, markers = (int((abs(seen - one) < 40).all(1).sum()) for one in ((255, 0, 255), (255, 128, 0)))
            if holds(points, markers):
                return points
            page.wait_for_timeout(50)
        pytest.fail(f"at last {points} and {markers}")

    before = shown(lambda points, markers: points > 500 and markers > 50)
    page.locator("#space").hover()
    page.mouse.down()
    page.mouse.move(10, 500, steps=3)
    page.mouse.up()
    shown(lambda points, _: points not in (0, before))
    page.click("#layers-box summary")
    page.click("#layers label:has-text('velodyne')")
    until(page, f"{text('#space figcaption')} === 'no PointCloud2'")
    shown(lambda points, markers: points == 0 and markers > 0)


def test_names_do_not_overlap_and_stay_inside(opened: tuple[Any, Fleet]) -> None:
    boxes = opened[0].evaluate("""async () => {
      const {placed} = await import("./labels.js");
      const items = Array.from({length: 60}, (_, k) => ({text: `robot-${k}`, x: k * 37 % 400, y: k * 53 % 300}));
      return placed(items, text => 7 * text.length, 400, 300);
    }""")
    seen = [box for box in boxes if box]
    assert len(seen) > 20 and all(box[0] >= 0 and box[1] >= 0 and box[2] <= 400 and box[3] <= 300 for box in seen)
    for one, other in itertools.combinations(seen, 2):
        assert one[0] >= other[2] or one[2] <= other[0] or one[1] >= other[3] or one[3] <= other[1]


def test_cameras_and_what_is_old(opened: tuple[Any, Fleet]) -> None:
    """A picture that says to have 900 million pixels is not decoded. An old one says so, and loses its colour."""
    page, fleet = opened
    bomb = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 30_000, 30_000)
    fleet.robots["one"] = {"location": PLACE}, (("front", "", RED), ("rear", "", bomb))
    until(page, f"{text('#name')} === 'one'")
    page.evaluate("location.hash = '#/robot/one/cameras'")
    until(page, f"{text('#cameras figcaption')}.endsWith('rear: 30000 × 30000 pixels are too many')")
    until(page, f"({SEES})(document.querySelector('#cameras canvas')) >= 1")
    page.click("#cameras figure")
    until(page, f"document.querySelector('#large').open && ({SEES})(document.querySelector('#large canvas')) >= 1")
    page.click("#large button")
    fleet.robots.clear()
    old = "document.querySelector('#cameras figure')"
    until(page, f"{old}.dataset.old.endsWith('s old') && {old}.style.getPropertyValue('--age') > 0.3")
    # Soon the relay says, too, that it is away.
    seen = text(".card[aria-current] .seen")
    until(page, f"{text('#facts')}.endsWith('ago')", f"/^(silent for|last seen) [0-9]/.test({seen})")


def test_video_that_cannot_be_shown_is_named(opened: tuple[Any, Fleet]) -> None:
    """By its type or its name, and nobody asks for it; by the format that a picture says."""
    page, fleet = opened
    kinds = ("front/theora", "theora_image_transport/msg/Packet"), ("depth/compressedDepth", PICTURE)
    said = {topic: {"type": type, "encoding": "cdr"} for topic, type in kinds}
    fleet.robots["one"] = {"location": PLACE, "publishes": said}, ()
    first = "front/theora: this page cannot show theora; send front/compressed"
    until(page, f"{text('#first.blank figcaption')} === '{first}'")
    page.click("#tabs a:has-text('Cameras')")
    other = "depth/compressedDepth: this page cannot show compressedDepth; send depth/compressed"
    until(page, f"{text('#cameras .blank figcaption')} === '{first},{other}'")
    packet = cdr(PICTURE, format="h264", data=np.zeros(9, np.uint8))
    fleet.robots["one"] = {"location": PLACE}, (("side", PICTURE, packet),)
    until(page, f"{text('#cameras .blank figcaption')}.endsWith('side: this page cannot show h264')")


def test_commands_by_hand(opened: tuple[Any, Fleet]) -> None:
    """A goal looks where the drag went; a refusal stays until it is read. Not every robot takes a stop."""
    page, fleet = opened
    fleet.robots["one"] = {"location": PLACE, "commands": ["stop", "goal", "cancel"]}, ()
    until(page, f"{text('#stop')} === 'Stop one'", f"{text('#facts')} !== ''")
    assert page.is_hidden("#pose")
    page.click("#stop")
    until(page, f"{text('#command-status')} === 'stop: one answers: done'")
    for aside, status in ((60, "goal: one answers: done"), (160, "goal: one answers: refused")):
        page.click("#goal")
        page.evaluate("document.querySelector('#map').scrollIntoView()")
        box = page.locator("#map").bounding_box()
        x, y = box["x"] + box["width"] / 2 + aside, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x, y - 50)
        page.mouse.up()
        until(page, f"{text('#command-status')} === '{status}'")
    stop, near, _ = fleet.came
    assert (stop["command"], near["command"], near["frame"]) == ("stop", "goal", "map")
    assert near["yaw"] == pytest.approx(np.pi / 2, abs=0.01) and near["y"] == pytest.approx(0, abs=0.1)
    until(page, f"{text('#notices p')}.includes('refused: goal: too far')")
    page.click("#notices .refused button")
    fleet.robots["one"] = {"location": PLACE, "answer": fleet.robots["one"][0]["answer"]}, ()  # it says so on and on
    until(page, f"{text('#stop')} === 'one takes no stop'", f"!{text('#notices p')}.includes('refused')")
    assert page.is_disabled("#stop") and page.is_hidden("#goal")


def test_what_the_page_writes_is_ros(opened: tuple[Any, Fleet]) -> None:
    """A goal, a pose and a stop in CDR; a robot of ROS 1 gets the same in its own encoding."""
    write = """async isEstimate => {
      const {stamped, still} = await import("./cdr_write.js");
      return isEstimate === null ? still() : stamped(isEstimate, {x: 1.5, y: -2, yaw: Math.PI / 2, frame: "map"});
    }"""
    for kind, type in ((False, POSE), (True, ESTIMATE), (None, "geometry_msgs/msg/Twist")):
        payload = base64.b64decode(opened[0].evaluate(write, kind))
        old = ros_messages.as_ros1(payload, type)
        for read in (ros_messages.read(payload, type), ros_messages.read(old, type, "ros1")):
            if kind is None:
                assert (read.linear.x, read.linear.y, read.angular.z) == (0, 0, 0)
                continue
            pose = read.pose.pose if kind else read.pose
            said = ros_messages.planar(pose.position, pose.orientation)
            assert (read.header.frame_id, said) == ("map", {"x": 1.5, "y": -2.0, "yaw": round(np.pi / 2, 4)})
            assert not kind or read.pose.covariance[[0, 7, 35]].tolist() == [0.25, 0.25, 0.0685]


def test_driving_by_hand(opened: tuple[Any, Fleet]) -> None:
    """Messages come while the pad or a key is held, each with a deadline. Letting go, or leaving it, sends zeros."""
    page, fleet = opened
    fleet.robots["one"] = {"location": PLACE}, ()
    fleet.driven.clear()
    until(page, f"{text('#facts')} !== ''")
    assert page.is_hidden("#drive")
    fleet.robots["one"] = {"location": PLACE, "commands": ["drive"]}, ()
    page.click("#drive")
    page.evaluate("document.querySelector('#map').scrollIntoView()")

    def driven(holds: Callable[[list[Any]], bool]) -> list[Any]:
        """The messages since the last call, once it holds of them."""
        for _ in range(1_500):
            if fleet.driven and holds(fleet.driven):
                said = list(fleet.driven)
                fleet.driven.clear()
                return said
            page.wait_for_timeout(20)
        pytest.fail(f"at last {fleet.driven}")

    still = {"linear": 0, "angular": 0, "for_ms": 0}
    box = page.locator("#pad").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 3)
    page.mouse.down()
    (zeros, ahead, *_) = driven(lambda said: len(said) >= 3)
    assert zeros == still
    assert ahead["linear"] == pytest.approx(0.2, abs=0.01) and ahead["angular"] == pytest.approx(0, abs=0.01)
    assert ahead["for_ms"] == 400
    page.mouse.up()
    driven(lambda said: said[-1] == still)
    page.select_option("#speed-most", "0.5")
    for leaves in ("dispatchEvent(new Event('blur'))", "document.querySelector('#pad').blur()"):
        page.focus("#pad")
        page.keyboard.down("ArrowUp")
        page.keyboard.down("a")
        driven(lambda said: said[-1] == {"linear": 0.5, "angular": 1, "for_ms": 400})
        page.evaluate(leaves)
        driven(lambda said: said[-1] == still)
        page.keyboard.up("a")
        page.keyboard.up("ArrowUp")
    fleet.robots["one"] = {"location": PLACE}, ()
    until(page, "document.querySelector('#drive').hidden && document.querySelector('#driving').hidden")
    assert fleet.driven == []


def test_an_absent_relay_covers_the_page(browser: Any) -> None:
    page = browser.new_page()
    with Fleet() as fleet:
        page.goto(f"http://127.0.0.1:{fleet.port}/")
        until(page, f"{text('#state')} === 'live'")
        assert page.is_hidden("#cover")
    until(page, "!document.querySelector('#cover').hidden && document.querySelector('#main').inert")
    page.close()
