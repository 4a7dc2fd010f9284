"""ROS 2: the relay and the publisher. Nodes run where rclpy is; what the relay says of a topic everywhere."""

import asyncio
import importlib.util
import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from cli_cases import fails
from hypothesis import given
from hypothesis import strategies as st
from live_cases import VALIDATE, as_simulated
from needs import needs
from refusal_cases import refuse
from ros1_cases import played

from bufgym.jit import JIT
from bufgym.model.qoi import exponential
from bufgym.model.topics import Topic
from bufgym.scenario import Stream, read_client
from bufgym.utils.errors import BufgymError
from bufgym_robot import PolicyQueue, replay
from bufgym_robot.frames import FrameError
from bufgym_robot.ros2 import relay
from bufgym_robot.ros2.diagnostics import Diagnostics
from bufgym_robot.ros2.names import Published, parse
from bufgym_robot.ros2.places import Place, left_out, places
from bufgym_robot.ros2.relay import RosSender
from bufgym_robot.wire.log import of, read_log

REPO = Path(__file__).resolve().parents[3]
NO_ROS = not JIT or importlib.util.find_spec("rclpy") is None
in_ros = pytest.mark.skipif(NO_ROS, reason=needs("ros2" if JIT else "compiled"))


def run(*words: object) -> str:
    where = {
        **os.environ,
        "PYTHONPATH": f"{REPO}:{REPO / 'packages' / 'robot'}",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    return played(where, *words)


@in_ros
@pytest.mark.nightly
def test_the_relay_over_a_fade_is_as_good_as_the_simulator() -> None:
    """6 s with a fade of 1.5 s. Over 20 s, quiet machine: 98 % of the simulator's QoI."""
    cells = run(REPO / "examples/ros2/fade.py", "--queues", "afr", "--seconds", 6).splitlines()[-1].split("|")
    print(cells)
    assert float(cells[3]) > 0.7 * float(cells[6])  # through the relay, in the simulator


@in_ros
@pytest.mark.nightly
def test_topics_cross_as_they_are_and_commands_come_back(tmp_path: Path) -> None:
    numbers = [str(k) for k in range(100)]
    seen = json.loads(run(REPO / "packages/robot/tests/ros2_session.py", tmp_path).splitlines()[-1])
    pictures = seen["came"].pop("camera")
    assert len(pictures) >= 90 and pictures == [number for number in numbers if number in pictures]  # best effort
    assert seen["came"] == {"status": ["up"], "own/echo": numbers, "commands": numbers[::10]}
    assert seen["said"] == ["/commands: std_msgs/msg/String, reliable", "connected to BACK"]
    assert seen["best_effort"] and seen["by"] == "bufgym_receive" and seen["faults"] == []
    log = read_log(tmp_path / "log.mcap")
    assert log[0]["policy"] == "fifo" and replay(log).differences == ()
    # 2 m of motion at a scene scale of 2 m, compared 30 times a second at most.
    moved = [record["x"] for record in of(log, "put") if record["topic"] == 0]
    assert moved[0] < 0.1 and 0.85 < moved[-1] <= 1.0


@in_ros
@pytest.mark.nightly
def test_the_relay_takes_ros_2s_own_words() -> None:
    """Namespace, remappings at both ends, topics by pattern, all of QoS, /diagnostics; a package that is nowhere."""
    seen = json.loads(run(REPO / "packages/robot/tests/ros2_args_session.py").splitlines()[-1])
    came = {name: name for name in ("/scan_left", "/scan_right")}
    assert seen["came"] == {**came, "/robot1/camera": "/front/camera"}
    assert seen["odd"] == "/odd" and seen["types"] == ["no_such_msgs/msg/Thing"]
    assert seen["by"] == ["/bufgym_receive_1", "/robot/bufgym_send"]
    assert seen["said"] == [
        "/scan_left: a reader here gets nothing: it asks for transient local, and a publisher of it is volatile",
        "/lost: this relay gets nothing: it asks for transient local, and a publisher here is volatile",
    ]
    assert seen["qos"] == [[50, 60, 70], "MANUAL_BY_TOPIC"] and seen["reliability"] == "BEST_EFFORT"
    statuses = {name: (message, numbers) for name, message, numbers in seen["diagnostics"]}
    assert statuses.pop("/robot/bufgym_send: /lost")[1]["arrived"] == 0
    topics = ("/front/camera", "/scan_left", "/scan_right", "/odd")
    assert statuses.pop("/robot/bufgym_send: uplink") == ("connected", {})
    assert set(statuses) == {f"/robot/bufgym_send: {name}" for name in topics}
    for message, numbers in statuses.values():
        assert message == "connected" and numbers["arrived"] == numbers["left"] >= 1
        assert numbers["QoI"] == pytest.approx(1 + 0.382 * (numbers["left"] - 1))


@in_ros
@pytest.mark.nightly
def test_an_episode_through_the_relay_is_that_of_the_simulator(tmp_path: Path) -> None:
    run(*VALIDATE, "ros2", "--out", tmp_path)
    assert as_simulated(tmp_path)


def test_a_topic_goes_with_each_of_its_messages() -> None:
    topic = Published("/arm/camera", "sensor_msgs/msg/Image", reliable=False, transient_local=True, depth=15)
    strict = replace(topic, manual=True, deadline_ns=1, lifespan_ns=2**61, lease_ns=3)
    assert parse(strict.head()) == (strict, b"")
    assert parse(replace(strict, lease_ns=2**63 - 1).head())[0].lease_ns == 0  # DDS's "for ever" is no limit
    assert parse(memoryview(topic.head() + b"image")) == (topic, b"image")
    assert len(topic.head()) == 29 + len("/arm/camera") + len("sensor_msgs/msg/Image")


@given(st.binary(max_size=60))
def test_what_is_no_message_of_a_relay_ends_the_connection(body: bytes) -> None:
    refuse("no message of a relay", parse, b"\x03\x05\0\0\x01" + bytes(24) + b"/a;" + body, kind=FrameError)


def test_diagnostics_by_hand() -> None:
    """Two topics in 4 s: of three messages of the first one is dropped, one has left, one waits for 3 s."""
    now_s = [0.0]
    diagnostics = Diagnostics([exponential(0.5)] * 2, clock=lambda: now_s[0])
    queue = PolicyQueue("drop-oldest", 1, topics=[Topic("a"), Topic("b")], log=diagnostics, value=exponential(0.5))
    queue.put("goes", 500_000, 0.0, 0)
    queue.put("is dropped", 500_000, 1.0, 0)
    now_s[0] = 1.0
    queue.put("waits", 500_000, 2.0, 0)
    queue.get()
    queue.gone()
    now_s[0] = 4.0
    first, second = diagnostics.tell()
    assert first == {
        **{"arrived": 3, "left": 1, "dropped": 1, "queued": 0, "oldest s": 0.0, "QoI": 1.0},
        **{"arrived per s": 0.75, "left per s": 0.25, "left Mbit/s": 1.0},
    }
    assert set(second.values()) == {0}
    queue.put("waits behind it", 500_000, 3.0, 0)
    queue.get()
    queue.gone()
    now_s[0] = 6.0
    first, _ = diagnostics.tell()
    assert (first["left"], first["QoI"], first["left per s"]) == (2, 1.75, 0.5)  # 1 + V(2)


def test_places_by_name_and_by_pattern() -> None:
    """Names that are taken, of others or of ROS 2 itself, are no pattern's."""
    node = SimpleNamespace(resolve_topic_name=lambda name: f"/robot/{name}", get_namespace=lambda: "/robot")
    made = places(None, ["camera", "/scan*", "own*"], moves=False)
    for place in made:
        place.resolve(node)
    published = ["/scan1", "/robot/camera", "/scan2", "/rosout", "/robot/own", "/robot/owner"]
    for place in made:
        place.find(published, [one.name for one in made])
    names = [place.name for place in made]
    assert names == ["/robot/camera", "/scan1", "/scan2", *[None] * 62, "/robot/own", "/robot/owner", *[None] * 62]
    assert left_out(made, published) == {}
    every = places(None, ["*"], moves=False)
    for place in every:
        place.find(["/rosout", "/clock", "/a"], [one.name for one in every])
    assert [place.name for place in every[:2]] == ["/a", None]
    assert every[0].x(node, None) is None and every[0].x(node, 2.5) == 2.5
    refuse("no topics: name them in --config", places, None, [], False)


def test_a_pattern_sends_all_or_names_what_it_leaves_out() -> None:
    """``/*`` has 64 numbers: for 30 topics, for 33 that come late, and for one that has a number of its own."""
    every = places(None, ["/*", "/t000"], moves=False)
    every[-1].name = "/t000"
    for count in (30, 63, 65, 67):
        names = ["/rosout", *(f"/t{k:03}" for k in range(count))]
        for place in every:
            place.find(names, [one.name for one in every])
        assert sum(place.name is not None for place in every) == min(count, 65)
    assert left_out(every, names) == {
        name: "/* stands for 64 topics at most: name it in topics, or split the pattern" for name in ("/t065", "/t066")
    }


def test_all_patterns_together_stand_for_as_many_topics_as_a_queue_has() -> None:
    """Five patterns and 31 names share 256 numbers: 45 for each pattern, and 31."""
    made = places(None, [*(f"/{k}/*" for k in range(5)), *(f"/n{k}" for k in range(31))], moves=False)
    assert len(made) == 5 * 45 + 31 == 256


def test_x_of_a_ruled_topic_is_the_nodes_time() -> None:
    """At 10 Hz 0.5 s are five steps; a simulation that starts again does not set x back."""
    now_ns = [0]
    clock = SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=now_ns[0]))
    place = Place(Topic("a"), "a", Stream(Topic("a"), rate_hz=10, size_bytes=1))
    seen = []
    for now_ns[0] in (7_000_000_000, 7_500_000_000, 0):
        seen.append(place.x(SimpleNamespace(get_clock=lambda: clock), None))
    assert seen == [0, 5, 5]


def test_a_topic_that_a_receiver_publishes_beside_others_is_left_out() -> None:
    """In one domain the relay would hear its copies and send them again, round and round, until the receiver goes."""
    found = {"/camera": "camera", "/commands": "bufgym_receive"}
    offers = {name: [SimpleNamespace(node_name=whose)] for name, whose in found.items()}
    node = SimpleNamespace(get_publishers_info_by_topic=lambda name: offers[name])
    said: list[str] = []
    robot = RosSender(None, "127.0.0.1", 1, topics=["/camera", "/commands"], say=said.append)
    fits = []
    alone = offers["/camera"]
    for now in ([*alone, SimpleNamespace(node_name="bufgym_receive_1")], alone):
        offers["/camera"] = now
        for _ in range(2):  # looked at twice, told once
            robot._look_for_circles(node, list(offers))
        fits.append([robot._fits(name, b"head", b"image") for name in offers])
    assert fits == [[False, True], [True, True]]
    assert said == [
        "/camera: left out: bufgym_receive_1 publishes it in this domain, too, and its copies would be sent again: "
        "give bufgym_receive_1 another ROS_DOMAIN_ID, or start it with --ros-args -r /camera:=/base/camera",
        "/camera: no longer left out",
    ]


def test_topics_that_cannot_be_relayed() -> None:
    """Names that are none, a type that is not installed, and what moves without odometry."""
    wrong = [("camera", "a/msg/B"), ("/a//b", "a/msg/B"), ("/a", "os"), ("/a", "../os/msg/B"), ("/a", "a/srv/B")]
    for name, kind in wrong:
        refuse("must", Published, name, kind)
    with pytest.raises(BufgymError, match=r"topic /a: messages of no_such_msgs/msg/B, which is not installed here"):
        _ = Published("/a", "no_such_msgs/msg/B").message_class
    with pytest.raises(BufgymError, match=r"topic 'pointcloud': moves, which needs a topic with odometry"):
        RosSender(read_client(REPO / "examples" / "client.toml"), "127.0.0.1", 1)


async def test_a_topic_is_subscribed_again_when_its_publisher_comes_back_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A camera goes, comes back best effort, and stays; a topic of a type that is not here stops no other."""
    camera, odd = Published("/camera", "a/msg/B"), Published("/odd", "no_such_msgs/msg/B")
    seen = [None, camera, None, *[replace(camera, reliable=False)] * 2]
    made: list[Published] = []
    gone: list[Published] = []
    said: list[str] = []
    ended = asyncio.Event()

    def published(node: Any, name: str, but_not: str) -> Published | None:
        if name == "/camera" and not seen:
            ended.set()
        return odd if name == "/odd" else seen.pop(0) if seen else None

    def found(topic: Published) -> list[Published]:
        if topic is odd:
            _ = topic.message_class
        made.append(topic)
        return [topic]

    monkeypatch.setattr(relay, "published", published)
    monkeypatch.setattr(relay, "LOOK_S", 0.0)
    node = SimpleNamespace(destroy_subscription=gone.append)
    looking = asyncio.create_task(relay.look(node, lambda: ["/odd", "/camera"], found, "me", said.append))
    await asyncio.wait_for(ended.wait(), 10)
    looking.cancel()
    assert [topic.reliable for topic in made] == [True, False] and gone == [camera]
    assert said == ["/odd: left out: topic /odd: messages of no_such_msgs/msg/B, which is not installed here"]


@pytest.mark.filterwarnings("ignore:module 'sre_")  # a parser of rclpy's imports what Python calls deprecated
def test_the_command_names_what_is_wrong(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    config = tmp_path / "client.toml"
    config.write_text('[[topic]]\nname = "camera"\nrate_hz = 30\nsize_bytes = 1000\n')
    fails(["ros2", "send", "--config", "none.toml"], "none.toml", capsys)
    fails(["ros2", "send", "--config", str(config), "--to", "robot"], "robot: must be HOST:PORT", capsys)
    fails(["ros2", "send", "--config", str(config), "--policies", "oracle"], "oracle", capsys)
    monkeypatch.setitem(sys.modules, "rclpy", None)
    for words in (["receive", "--port", "0"], ["send", "--config", str(config)]):
        fails(["ros2", *words], "bufgym_robot.ros2 needs rclpy", capsys)
    fails([*VALIDATE[1:], "ros2"], "bufgym_robot.ros2 needs rclpy", capsys)


@in_ros
@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore:module 'sre_")  # a parser of rclpy's imports what Python calls deprecated
@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("send --ros-args -p capacity:=7", "no topics: name them in --config"),
        ("send --ros-args -p capacity:=many", "parameter capacity: "),
        ("send --ros-args -p topics:=[a] -p value:=linear", "linear"),
        ("send --ros-args -p topics:=['a-b']", "topic 'a-b': failed to resolve name: topic name must not contain"),
        ("send --ros-args -p topics:=[a] -p odometry:=a-b", "topic 'a-b': failed to resolve"),
        ("send --ros-args -p topics:=[a] -p port:=65536", "127.0.0.1:65536: must be HOST:PORT"),
        ("send --ros-args -r a:=", "--ros-args -r a:=: "),
        ("receive --ros-args -r __node:=ear", "node 'ear': must have bufgym_receive in its name"),
    ],
)
def test_ros_2s_own_words_that_are_wrong(
    words: str, why: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    fails(["ros2", *words.split()], why, capsys)
