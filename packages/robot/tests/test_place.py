"""Where a robot is: by one topic in one frame, on the robot, of made-up messages and of a recording."""

import asyncio
import math
from pathlib import Path

import pytest
from loop_cases import compiled
from needs import needs
from pose_cases import ESTIMATE, POSE, TF, message
from recording_cases import fetched
from refusal_cases import refuse

pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))

from bufgym.traces import read_workload
from bufgym.traces.formats.bag_poses import ODOMETRY, carries_poses
from bufgym_robot.fleet.bag import BagSource
from bufgym_robot.fleet.robot import Robot
from bufgym_robot.wire.place import Place
from tests.traces.bag_cases import write_mcap

Said = tuple[str, str, float, str]
"""Topic, type, x in metres and frame of a message, or frame/child."""


def place_after(said: list[Said], named: str | None = None, encoding: str = "cdr") -> Place:
    """A place that has taken these messages, a second apart."""
    place = Place(named)
    for second, (topic, type, x_m, frames) in enumerate(said):
        frame, _, child = frames.partition("/")
        place.take(topic, message(type, second, x_m, frame, child or "base", encoding), type, encoding)
    return place


DRIVE: list[Said] = [
    ("amcl_pose", ESTIMATE, 100.0, "map"),
    ("goal_pose", POSE, 120.0, "map"),
    ("wheels", ODOMETRY, 0.0, "odom"),
    ("amcl_pose", ESTIMATE, 101.0, "map"),
    ("fused", ODOMETRY, 50.0, "odom"),
    ("tf", TF, 7.0, "odom/base"),
    ("tf", TF, 100.0, "map/odom"),
    ("wheels", ODOMETRY, 1.0, "odom"),
    ("fused", ODOMETRY, 53.0, "odom"),
    ("tf", TF, 12.0, "odom/base"),
    ("initialpose", ESTIMATE, 0.0, "map"),
]
"""By the wheels it drives 1 m, by amcl 1 m, as fused 3 m, by tf 5 m. A view is 2 m."""


@pytest.mark.parametrize(
    ("named", "x", "at_m", "frame"),
    [
        (None, 0.5, 1.0, "odom"),
        ("/wheels", 0.5, 1.0, "odom"),
        ("amcl_pose", 0.5, 101.0, "map"),
        ("/fused:odom", 1.5, 53.0, "odom"),
        ("/tf:odom:base", 2.5, 12.0, "odom"),
        ("/tf:map:/odom", 0.0, 100.0, "map"),
    ],
)
@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_one_topic_says_where_it_is(named: str | None, x: float, at_m: float, frame: str, encoding: str) -> None:
    place = place_after(DRIVE, named, encoding)
    assert place.x == x and place.location == {"x": at_m, "y": 0.0, "yaw": 0.0, "frame": frame}


def test_frames_are_never_mixed() -> None:
    """Two robots, or two maps, on one topic: the first one's frames count, or those that are named."""
    twice: list[Said] = [
        ("pose", POSE, 0.0, "map"),
        ("pose", POSE, 90.0, "odom"),
        ("pose", POSE, 1.0, "map"),
        ("pose", POSE, 94.0, "odom"),
    ]
    assert place_after(twice).x == 0.5 and place_after(twice, "pose:odom").x == 2.0
    fleet: list[Said] = [("odom", ODOMETRY, float(k * (k % 2)), f"odom/{'ab'[k % 2]}") for k in range(6)]
    assert place_after(fleet).x == 0.0  # a stands still
    assert place_after(fleet, "odom:odom:b").x == 2.0  # from 1 m to 5 m


def test_without_an_odometry_it_is_the_first_pose_that_is_no_goal() -> None:
    """An Odometry that comes later is the source from then on, and x goes on: 1 m by amcl, then 3 m by odometry."""
    said: list[Said] = [
        ("goal_pose", POSE, 9.0, "map"),
        ("amcl_pose", ESTIMATE, 1.0, "map"),
        ("pose", POSE, 70.0, "map"),
        ("amcl_pose", ESTIMATE, 2.0, "map"),
    ]
    assert place_after(said[:1]).location is None and place_after(said).x == 0.5
    said += [("odom", ODOMETRY, 0.0, "odom"), ("amcl_pose", ESTIMATE, 4.0, "map"), ("odom", ODOMETRY, 3.0, "odom")]
    assert place_after(said).x == 2.0


def test_what_is_no_number_is_no_place() -> None:
    place = place_after([("odom", ODOMETRY, 2.0, "odom"), ("odom", ODOMETRY, math.nan, "odom")])
    assert place.location == {"x": 2.0, "y": 0.0, "yaw": 0.0, "frame": "odom"} and place.x == 0


GOALS = ("/goal_pose", "/move_base_simple/goal", "/move_base/current_goal", "/r1/goalPose", "/initialpose")
MORE_GOALS = (
    "/initial_pose",
    "/goal_update",
    "/goal/pose",
    "/mavros/setpoint_position/local",
    "/set_pose",
    "/waypoint",
)


@pytest.mark.parametrize("topic", GOALS + MORE_GOALS)
def test_goals(topic: str) -> None:
    assert not carries_poses(topic, POSE) and not carries_poses(topic, ESTIMATE)
    refuse(f"odom = '{topic}': {topic} is a goal, no place where the robot is: name its odometry", Place, topic)


def test_names_that_only_look_like_goals() -> None:
    for topic in ("/amcl_pose", "/goalkeeper/pose", "/mavros/local_position/pose", "/target_robot/amcl_pose", "/pose"):
        assert carries_poses(topic, POSE)


def test_a_transform_is_named_with_its_frames() -> None:
    refuse("odom = '/tf': say which transform, as /tf:odom:base_link", Place, "/tf")
    refuse("odom = '/tf:a:b:c': must be a topic, TOPIC:FRAME, or TOPIC:PARENT:CHILD", Place, "/tf:a:b:c")


def played(path: Path, named: str | None) -> Place:
    """The place of a robot that has played a recording, without waiting."""
    robot = Robot("ws://127.0.0.1:1", "r", BagSource(path, loops=False), policy="drop-oldest", odometry=named)

    async def at_once(seconds: float) -> None:
        """Play without waiting."""

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bufgym_robot.fleet.bag.asyncio.sleep", at_once)
        patch.setattr("bufgym_robot.fleet.bag._LATE_S", math.inf)
        asyncio.run(robot.source.run(robot))
    return robot.place


def agrees(path: Path, named: str | None, topic: str, x: float, frame: str) -> None:
    """The robot that plays the recording and the workload of a benchmark are at x."""
    place = played(path, named)
    assert place.location is not None and (round(place.x, 1), place.location["frame"]) == (x, frame)
    workload = read_workload(path, topics=[topic], odom=named or topic, bridge_gaps=True)
    assert workload.x is not None and round(float(workload.x[-1]), 1) == x


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """``DRIVE`` as a recording, a message each second."""
    entries = []
    for second, (topic, type, x_m, frames) in enumerate(DRIVE):
        frame, _, child = frames.partition("/")
        entries.append((1000 * second, f"/{topic}", type, message(type, second, x_m, frame, child or "base")))
    return write_mcap(tmp_path / "drive.mcap", entries)


@compiled
@pytest.mark.parametrize(
    ("named", "topic", "x", "frame"),
    [
        (None, "/wheels", 0.5, "odom"),
        ("/amcl_pose", "/amcl_pose", 0.5, "map"),
        ("/fused", "/fused", 1.5, "odom"),
        ("/tf:odom:base", "/tf", 2.5, "odom"),
    ],
)
def test_a_recording_is_at_the_same_place_on_a_robot_and_in_a_benchmark(
    drive: Path, named: str | None, topic: str, x: float, frame: str
) -> None:
    agrees(drive, named, topic, x, frame)


@compiled
@pytest.mark.nightly
@pytest.mark.parametrize(
    ("named", "x", "frame"), [(None, 30.6, "odom"), ("/odom", 30.6, "odom"), ("/amcl_pose", 30.0, "map")]
)
def test_a_recorded_robot(named: str | None, x: float, frame: str) -> None:
    """A drive with Nav2, by odometry and by amcl; mixed, its x would be 868.8."""
    agrees(fetched("evo-bags") / "nav2_turtlebot.mcap", named, named or "/odom", x, frame)


def test_a_recording_without_the_named_topic(drive: Path) -> None:
    source = BagSource(drive)
    robot = Robot("ws://127.0.0.1:1", "r", source, policy="drop-oldest", odometry="/nope")
    says = r"no messages of topic '/nope'; it has: /amcl_pose, /fused, /goal_pose, /initialpose, /tf, /wheels"
    refuse(says, lambda: asyncio.run(source.run(robot)))
