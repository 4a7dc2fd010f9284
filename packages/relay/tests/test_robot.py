"""Robots: what a made-up one sees, how a queue is told, recordings, commands."""

import asyncio
import json
import math
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import ros_program
from loop_cases import beside, compiled
from made_up_robot import HALF_M, ODOMETRY, PICTURE, SCAN, MadeUp, Pose, cast, jpeg, odometry, picture, pose_at, scan
from needs import needs
from refusal_cases import refuse
from relay_cases import Corner, settings, until, wait
from websockets.exceptions import ConnectionClosedError

from bufgym.model import qoi
from bufgym.model.topics import Topic
from bufgym.utils.errors import BufgymError
from bufgym_robot.fleet import robot
from bufgym_robot.fleet.bag import BagSource
from bufgym_robot.fleet.monitor import Monitor
from bufgym_robot.fleet.robot import Robot
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire import ros_messages
from bufgym_robot.wire.session import Session

pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))
pytest.importorskip("PIL", reason=needs("extras", "PIL"))
CONFIG = settings(policies=("drop-oldest",))


def test_rays_by_hand() -> None:
    """From (-3, 0), looking along x: the table in the middle begins at x = -1.4; behind is the room's wall at -6."""
    pose = Pose(-3.0, 0.0, 0.0)
    distance, _, along = cast(pose, np.radians([0.0, 90.0, 180.0, -90.0]))
    assert distance == pytest.approx([3 - 1.4, HALF_M[1], 3.0, HALF_M[1]])
    assert along[0] == pytest.approx(0.6)  # the middle of its short side, 1.2 m
    assert cast(pose._replace(yaw=math.pi / 2), np.array([0.0]))[0] == pytest.approx([HALF_M[1]])


def test_robots_stay_clear_of_all_walls() -> None:
    everywhere = np.radians(np.arange(0, 360, 5.0))
    for number in range(20):
        for time_s in np.linspace(0, 40, 80):
            assert cast(pose_at(number, float(time_s)), everywhere)[0].min() > 0.25, number


def test_the_camera_sees_ceiling_wall_and_floor() -> None:
    frame = picture(Pose(-3.0, 0.0, math.pi))  # 3 m before the room's wall
    assert frame.shape == (PICTURE[1], PICTURE[0], 3)
    top, middle, bottom = (frame[row, PICTURE[0] // 2].astype(int) for row in (0, PICTURE[1] // 2, -1))
    assert top.min() > 150 and middle[0] > middle[2] + 8 and bottom.max() < 130  # light; warm; dark tiles
    assert jpeg(frame)[:3] == b"\xff\xd8\xff"


def test_a_queue_told_by_hand() -> None:
    """Five messages of 1,000 bytes half a second apart; 0, 1 and 4 leave, 2 and 3 are dropped: x = 0, 1, 4.

    V halves with each step of x: H = 1 + 1/2 + 7/8 of all five's 1 + 4/2.
    """
    now_s = 0.0
    monitor = Monitor([Topic("a"), Topic("b")], qoi.exponential(0.5), clock=lambda: now_s)
    monitor(0, {"event": "settings", "policy": "afr", "capacity": 2})
    for seq in range(5):
        now_s = seq / 2
        monitor(0, {"event": "put", "seq": seq, "x": float(seq), "topic": 0, "size_bytes": 1000})
        if seq in (0, 1, 4):
            monitor(0, {"event": "dequeued", "seq": seq})
            monitor(0, {"event": "gone", "seq": seq})
        else:
            monitor(0, {"event": "dropped", "seq": seq, "why": "rejected"})
    now_s = 2.25
    monitor(0, {"event": "put", "seq": 5, "x": 5.0, "topic": 1, "size_bytes": 10})
    state = monitor.state()
    assert (state["policy"], state["capacity"], state["queued"], state["waiting"]) == ("afr", 2, 1, [1])
    assert (state["put"], state["left"], state["dropped"]) == (6, 3, 2)
    assert state["rate_bps"] == 8_000  # 1,000 bytes in the last second
    h = 1 + 0.5 + 0.875
    assert state["topics"]["a"] == {"put": 5, "left": 3, "dropped": 2, "age_s": 0.25, "qoi": round(h / 3, 3)}
    assert state["topics"]["b"]["age_s"] is None and state["qoi"] == round(h / 3, 3)
    monitor(1, {"event": "settings", "policy": "drop-oldest", "capacity": 2})  # another queue counts on
    for event in ({"event": "put", "x": 0.0, "topic": 0, "size_bytes": 1}, {"event": "dequeued"}, {"event": "gone"}):
        monitor(1, {"seq": 0, **event})
    assert monitor.state()["policy"] == "drop-oldest" and monitor.state()["left"] == 4


def test_messages_read_as_they_were_made() -> None:
    made = odometry(1_500_000, "r", Pose(1.0, -2.0, 0.5), 0.25)
    read = ros_messages.read(made, ODOMETRY)
    assert (read.header.stamp.sec, read.header.stamp.nanosec, read.child_frame_id) == (1, 500_000_000, "r/base")
    assert ros_messages.planar(read.pose.pose.position, read.pose.pose.orientation) == {"x": 1.0, "y": -2.0, "yaw": 0.5}
    angles = np.radians([-90.0, 0.0, 90.0])
    laser = ros_messages.read(scan(0, "r", angles, np.array([1.0, 2.0, 3.0])), SCAN)
    assert laser.ranges.tolist() == [1, 2, 3] and laser.angle_increment == pytest.approx(math.pi / 2)
    refuse("message of 3 bytes: no nav_msgs/msg/Odometry in cdr", ros_messages.read, b"abc", ODOMETRY)
    old = ros_messages.as_ros1(made, ODOMETRY)
    assert ros_messages.modern(old, ODOMETRY, "ros1") == ("cdr", made)
    assert ros_messages.modern(b"?", "my_msgs/msg/Own", "ros1") == ("ros1", b"?")
    assert b"float32[] ranges" in ros_messages.definition(SCAN)


Came = dict[str, list[wire.Message]]


async def watched(corner: Corner, source: Any, story: Any, **settings: Any) -> Came:
    """What a viewer receives of a robot while ``story(viewer, came)`` goes on, by the last part of the topic."""
    came: Came = defaultdict(list)
    viewer = Session(corner.url, "viewer")
    viewer.subscribe(f"^{corner.topic('')}", lambda message: came[message.topic.rpartition("/")[2]].append(message))
    async with beside(viewer.run()):
        await wait("the viewer", viewer.ready.wait())
        async with beside(Robot(corner.url, corner.robot, source, capacity=16, **settings).run()):
            await story(viewer, came)
    return came


@compiled
async def test_the_made_up_robot_and_a_command(corner: Corner, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot, "STATUS_S", 0.1)
    monkeypatch.setattr(robot, "QUEUE_S", 0.1)

    async def story(viewer: Session, came: Came) -> None:
        topics = ("odom", "scan", "camera", "queue", "status")
        await until("two of each", lambda: all(len(came[topic]) >= 2 for topic in topics))
        for wrong in ({"command": "policy", "policy": "oracle"}, "stop", 3):
            with pytest.raises(BufgymError, match="must be"):
                await wait("a refusal", viewer.command(corner.command, wrong))
        await wait("an ack", viewer.command(corner.command, {"command": "policy", "policy": "drop-newest", "id": "7"}))
        await until("the policy", lambda: json.loads(bytes(came["queue"][-1].payload))["policy"] == "drop-newest")
        await until("its answer", lambda: said(came)["answer"] == {"id": "7", "why": ""})
        with pytest.raises(BufgymError, match="must be in the room"):
            far = {"command": "goal", "x": 1e9, "y": 0, "yaw": 0, "id": "8"}
            await wait("a refusal", viewer.command(corner.command, far))
        await until("a refusal", lambda: "must be in the room" in said(came)["answer"]["why"])
        await wait("an ack", viewer.command(corner.command, {"command": "stop"}))
        await until("it stands", lambda: said(came)["text"] == "stands")

    def said(came: Came) -> Any:
        return json.loads(bytes(came["status"][-1].payload))

    came = await watched(corner, MadeUp(), story, policy="drop-oldest", policies=("drop-newest",))
    status = said(came)
    assert 0.9 < status["battery"] <= 1 and abs(status["location"]["x"]) < HALF_M[0]
    assert status["policies"] == ["drop-oldest", "drop-newest"]
    assert status["publishes"]["scan"] == {"type": SCAN, "encoding": "cdr"}
    assert set(status["queue"]["topics"]) == {"status", "queue", "odom", "scan", "camera"}
    every = [message for topic in status["queue"]["topics"] for message in came[topic]]  # /last is the relay's
    assert all(message.sender == corner.robot for message in every)
    pose = ros_messages.read(bytes(came["odom"][0].payload), ODOMETRY)
    assert abs(pose.pose.pose.position.y) < HALF_M[1]
    assert bytes(came["camera"][0].payload[:2]) == b"\xff\xd8"


class Unmeasured(MadeUp):
    """Its first three are no JSON; the others have a battery that is not measured, and a number of NumPy's."""

    states = 0

    def status(self) -> dict[str, Any]:
        self.states += 1
        error = {1: self, 2: np.zeros(2), 3: "\ud800"}.get(self.states)
        return {"battery": math.nan, "volts": np.float32(12), "error": error}


@compiled
async def test_a_state_that_is_no_json_stops_no_robot(corner: Corner, monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(viewer: Session, came: Came) -> None:
        await until("a state", lambda: came["status"])

    monkeypatch.setattr(robot, "STATUS_S", 0.05)
    source = Unmeasured()
    came = await watched(corner, source, story, policy="drop-oldest")
    state = json.loads(bytes(came["status"][0].payload))
    assert (state["battery"], state["volts"], state["error"]) == (None, 12.0, None) and source.states > 3


@compiled
async def test_a_robot_pings_once_at_a_time(corner: Corner, monkeypatch: pytest.MonkeyPatch) -> None:
    """No ping is answered while ten states come. One that ends with its connection ends no robot."""
    asked, real = list[str](), robot.RobotClient.ping

    async def ping(client: Session) -> None:
        asked.append(client.name)
        await asyncio.Event().wait()

    async def broken() -> None:
        raise ConnectionClosedError(None, None)

    async def story(viewer: Session, came: Came) -> None:
        viewer._connection = SimpleNamespace(ping=broken, transport=viewer._connection.transport)
        await real(viewer)  # type: ignore[arg-type]
        assert viewer.round_trip_s is None
        await until("ten", lambda: len(came["status"]) >= 10)

    monkeypatch.setattr(robot, "STATUS_S", 0.05)
    monkeypatch.setattr(robot.RobotClient, "ping", ping)
    await watched(corner, MadeUp(), story, policy="drop-oldest")
    assert asked == [corner.robot]


def recording(path: Path) -> Path:
    """Two topics over 0.1 s: 10 scans, and 5 messages of a type of one's own."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        scans = writer.register_channel("/scan", "cdr", writer.register_schema(SCAN, "ros2msg", b""))
        notes = writer.register_channel("/notes", "json", writer.register_schema("own", "jsonschema", b"{}"))
        for k in range(10):
            payload = scan(k, "bag", np.radians([0.0, 1.0]), np.array([float(k), 1.0]))
            writer.add_message(scans, log_time=k * 10**7, publish_time=k * 10**7, data=payload)
            if k % 2 == 0:
                writer.add_message(notes, log_time=k * 10**7 + 1, publish_time=0, data=b'{"k":%d}' % k)
        writer.finish()
    return path


@compiled
async def test_a_recording_is_a_robot(corner: Corner, tmp_path: Path) -> None:
    """It is played again and again. (A busy machine may drop a scan, but not change their order.)"""

    async def story(viewer: Session, came: Came) -> None:
        await until("the recording, twice", lambda: len(came["scan"]) >= 12 and came["status"] and came["notes"])
        await wait("an ack", viewer.command(corner.command, {"command": "stop", "id": "1"}))
        await until("its answer", lambda: json.loads(bytes(came["status"][-1].payload))["answer"].get("why"))

    source = BagSource(recording(tmp_path / "drive.mcap"))
    assert [(stream.topic.name, stream.rate_hz) for stream in source.streams] == [("notes", 5.0), ("scan", 10.0)]
    came = await watched(corner, source, story, policy="drop-oldest")
    ranges = [ros_messages.read(bytes(one.payload), one.type).ranges[0] for one in came["scan"]]
    falls = [k for k in range(1, len(ranges)) if ranges[k] <= ranges[k - 1]]
    assert set(ranges) <= set(range(10)) and 1 <= len(falls) < len(ranges) / 2
    assert came["notes"][0].encoding == "json"
    assert json.loads(bytes(came["status"][0].payload))["recording"] == "drive.mcap"
    assert json.loads(bytes(came["status"][-1].payload))["answer"]["why"].endswith("a recording, which takes none")


def test_what_a_recording_lacks(tmp_path: Path) -> None:
    path = recording(tmp_path / "drive.mcap")
    camera = [stream for stream in MadeUp().streams if stream.topic.name == "camera"]
    refuse(r"no messages of topic '/camera'; it has: /notes, /scan", BagSource, path, camera)
    refuse("no such file", BagSource, tmp_path / "none.mcap")
    refuse("robot 'a/b': must be a printable text without '/'", Robot, "ws://a:1", "a/b", MadeUp())


# --- robots of ROS: what a node publishes arrives byte by byte, and commands become messages of ROS ------------------

SEEN = {
    "exact": True,
    "kinds": [["cdr", "std_msgs/msg/String"]],
    "heard": [str(k) for k in range(8)],
    "unheard": ["nobody here subscribes to /unheard"],
    "location": {"x": 3.0, "y": 0.0, "yaw": 0.0, "frame": "map"},
    "goal": ["map", 1.5],
    "pose": ["map", -2.0],
    "moves": [[0.0, 0.0], [0.3, -0.2], [0.0, 0.0]],
}
"""Each command once and in order; nothing of what was broken, or meant for other topics.

It moves as a stop says, as somebody drives it, and not any more once the link is cut.
"""


@pytest.mark.nightly
@pytest.mark.parametrize("version", ["1", "2"])
def test_a_robot_of_ros(version: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    seen, errors = ros_program.run(request, "ros_session.py", version, tmp_path, limit_s=300)
    assert "not published" in errors
    assert seen == SEEN
