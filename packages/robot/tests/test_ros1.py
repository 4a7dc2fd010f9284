"""ROS 1: a policy's queue inside rospy. Nodes run where rospy and rosmaster are; the connection alone everywhere."""

import json
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cli_cases import fails
from live_cases import VALIDATE, as_simulated
from loop_cases import compiled
from refusal_cases import refuse
from ros1_cases import played

from bufgym.policies import get
from bufgym.traces import MotionSettings, motion_from_poses
from bufgym.traces.poses import Poses, unit
from bufgym_robot import PolicyQueue, replay, ros1
from bufgym_robot.ros1 import new_address
from bufgym_robot.ros1.__main__ import main as command
from bufgym_robot.ros1.connection import PolicyConnection
from bufgym_robot.wire.log import of, read_log
from bufgym_robot.wire.odometry import Odometry

pytestmark = compiled

REPO = Path(__file__).resolve().parents[3]
FADE = REPO / "examples" / "ros1" / "fade.py"


@pytest.mark.nightly
def test_a_policy_in_an_untouched_node(ros: dict[str, str]) -> None:
    """6 s with a fade of 1.5 s. Over 20 s, quiet machine: H 1.47 times that of rospy's own queue, the gap a tenth."""
    printed = [played(ros, FADE, "--one", policy, "--seconds", 6) for policy in ("rospy", "afr")]
    stock, afr = (json.loads(out.splitlines()[-1]) for out in printed)
    assert afr["longest_gap"] < stock["longest_gap"]  # what a busy machine does not turn round


def test_each_subscriber_has_its_queue_and_each_topic_its_policy(ros: dict[str, str], tmp_path: Path) -> None:
    seen = json.loads(played(ros, Path(__file__).with_name("ros1_session.py"), tmp_path).splitlines()[-1])
    assert seen["came"] == {topic: [str(k) for k in range(60)] for topic in seen["came"]}
    assert {topic: sorted(kinds) for topic, kinds in seen["kinds"].items()} == {
        "chosen": ["PolicyConnection"] * 2,
        "named": ["PolicyConnection"],
        "plain": ["QueuedConnection"],
        "endless": ["QueuedConnection"],
        "at_once": ["TCPROSTransport"],
        "latched": ["QueuedConnection"],
    }
    [(_, _, messages, connected)] = seen["named"]
    assert messages == 60 and connected
    logs = [read_log(tmp_path / name) for name in seen["logs"]]
    policies = {name.rpartition("-")[0]: log[0]["policy"] for name, log in zip(seen["logs"], logs, strict=True)}
    assert policies == {"chosen": "afr", "named": "drop-oldest", "odom": "afr"} and len(logs) == 4
    for log in logs:
        assert replay(log).differences == ()
    # 1.8 m of motion at a scene scale of 2 m; the first subscriber's queue came before the odometry.
    moved = [record["x"] for log in logs[:2] for record in of(log, "put")]
    assert 0.7 < max(moved) <= 0.9


@pytest.mark.nightly
def test_an_episode_through_a_node_is_that_of_the_simulator(ros: dict[str, str], tmp_path: Path) -> None:
    played(ros, *VALIDATE, "ros1", "--out", tmp_path)
    assert as_simulated(tmp_path)


def test_without_ros_it_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "rospy", None)
    refuse(r"bufgym_robot\.ros1 needs rospy: .* python3-rospy", ros1.install, "afr")
    fails([*VALIDATE[1:], "ros1"], "bufgym_robot.ros1 needs rospy", capsys)


@pytest.fixture
def topics(monkeypatch: pytest.MonkeyPatch) -> Any:
    """rospy's modules as far as the command needs them; its ``topics``."""
    for name in ("rospy", "rospy.topics", "rospy.impl", "rospy.impl.tcpros_pubsub"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    sys.modules["rospy.impl.tcpros_pubsub"].QueuedConnection = list  # type: ignore[attr-defined]
    sys.modules["rospy"].topics = sys.modules["rospy.topics"]  # type: ignore[attr-defined]
    known = SimpleNamespace(get_publisher_impl=lambda topic: SimpleNamespace(is_latch=topic == "/map"))
    sys.modules["rospy.topics"].get_topic_manager = lambda: known  # type: ignore[attr-defined]
    monkeypatch.setattr(new_address, "watch", lambda: None)  # it asks rospy itself
    monkeypatch.setattr(sys, "argv", sys.argv)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return sys.modules["rospy.topics"]


def test_the_command_names_what_is_wrong(topics: Any, capsys: pytest.CaptureFixture[str]) -> None:
    for options, words in (
        (["none.py"], "none.py: no such file"),
        (["--policy", "/camera=nobody", __file__], "unknown policy 'nobody'"),
        (["--value", "round:1", __file__], "round"),
    ):
        assert command(options) == 2
        printed = capsys.readouterr().err
        assert printed.startswith("bufgym_robot.ros1: error: ") and words in printed and printed.count("\n") == 1


def test_the_node_finds_itself_as_if_run_alone(topics: Any, tmp_path: Path) -> None:
    node = tmp_path / "node.py"
    node.write_text("import sys, beside\nraise SystemExit([__name__, sys.argv[1:]])")
    (tmp_path / "beside.py").touch()
    ros1.install(get("afr"), topics={"/scan": get("afr")})  # a policy itself may stand for its name
    policies = ["--policy", "/camera=decimate:every=2", "--policy", "rospy", "--policy", "/rosout=afr"]
    with pytest.raises(SystemExit) as ended:
        command([*policies, str(node), "--policy", "its own", "__name:=camera"])
    assert ended.value.code == ["__main__", ["--policy", "its own", "__name:=camera"]]
    transport = Transport()
    transport.name = "/other"
    assert topics.QueuedConnection.__name__ == "queued"
    with pytest.raises(TypeError):  # rospy's own, which is a list here
        topics.QueuedConnection(transport, 3)
    transport.name = "/map"
    with pytest.raises(TypeError):  # a latched publisher that nobody named keeps it too
        topics.QueuedConnection(transport, 3)
    transport.name = "/camera"
    connection = topics.QueuedConnection(transport, 3)
    assert connection.queue.policy.name.startswith("decimate") and connection.queue._row.senders.capacity == 3
    transport.close()
    transport.peer.close()
    assert ended_thread(connection)


class Transport:
    """What rospy's TCPROSTransport is to a queue, on a pair of TCP sockets."""

    def __init__(self) -> None:
        self.peer = socket.socket()
        self.peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16_384)
        with socket.create_server(("127.0.0.1", 0)) as server:
            self.peer.connect(server.getsockname())
            self.socket, _ = server.accept()
        self.name, self.endpoint_id, self.done, self.stat_num_msg = "/camera", "/viewer", False, 0
        self.write_error: Exception | None = None

    def write_data(self, data: memoryview) -> None:
        if self.write_error is not None:
            raise self.write_error
        self.socket.sendall(data)
        self.stat_num_msg += 1

    def set_cleanup_callback(self, callback: Any) -> None:
        self.cleanup = callback

    def close(self) -> None:
        self.done = True
        self.socket.shutdown(socket.SHUT_RDWR)
        self.socket.close()
        self.cleanup(self)

    def read(self, size_bytes: int) -> bytes:
        with self.peer.makefile("rb") as stream:
            return stream.read(size_bytes)


@pytest.fixture
def transport() -> Iterator[Transport]:
    one = Transport()
    yield one
    one.peer.close()


def ended_thread(connection: PolicyConnection) -> bool:
    connection._thread.join(60)
    return not connection._thread.is_alive()


def test_a_message_at_a_time(transport: Transport) -> None:
    """The peer reads nothing: of 12 messages of 1 MB the first is being sent, L = 3 are queued, 8 are dropped."""
    queue = PolicyQueue("drop-oldest", 3)
    connection = PolicyConnection(transport, queue)
    bodies = [bytes([k]) * 10**6 for k in range(12)]
    for body in bodies:
        connection.write_data(body)
    assert (len(queue), queue.in_flight, queue.dropped) == (3, 1, 8)
    assert transport.read(4 * 10**6) == b"".join(bodies[k] for k in (0, 9, 10, 11))
    while connection.stat_num_msg < 4:
        time.sleep(0.001)
    transport.close()
    assert ended_thread(connection) and connection.write_data(b"late")


def test_closing_wakes_a_sender_that_waits_for_its_peer(transport: Transport) -> None:
    connection = PolicyConnection(transport, PolicyQueue("afr", 4))
    for _ in range(10):
        connection.write_data(bytes(5 * 10**6))
    threading.Timer(0.02, transport.close).start()
    assert ended_thread(connection)


def test_what_sending_raised_is_told_at_the_next_message(transport: Transport) -> None:
    connection = PolicyConnection(transport, PolicyQueue("afr", 4))
    transport.write_error = ConnectionResetError("gone")
    connection.write_data(b"a")
    while connection.queue.in_flight:
        time.sleep(0.001)
    refuse("gone", connection.write_data, b"b", kind=ConnectionResetError)
    transport.close()
    assert ended_thread(connection)


def test_x_by_hand() -> None:
    """A turn of 30 of 60 degrees and 1 m of 2 m: half a view each."""
    odometry = Odometry()
    odometry(10.0, (0, 0, 0), (0, 0, 0, 1))
    odometry(10.1, (1, 0, 0), (0, 0, 0, 1))
    assert odometry.x == 0.5
    odometry(10.11, (9, 9, 9), (0, 0, 0, 1))  # sooner than a camera's next frame
    odometry(10.2, (np.nan, 0, 0), (0, 0, 0, 1))
    odometry(10.2, (1, 0, 0), (0, 0, 0, 0))
    assert odometry.x == 0.5
    half = np.radians(15)
    odometry(10.2, (1, 0, 0), (0, 0, np.sin(half), np.cos(half)))
    assert odometry.x == pytest.approx(1.0)
    odometry(0.0, (50, 0, 0), (0, 0, 0, 1))  # the clock fell: it goes on from here
    odometry(0.1, (52, 0, 0), (0, 0, 0, 1))
    assert odometry.x == pytest.approx(2.0)


def test_x_is_that_of_a_recording() -> None:
    rng = np.random.default_rng(0)
    steps = rng.normal(size=(200, 7)).cumsum(axis=0) * 0.05 + [0, 0, 0, 0, 0, 0, 9]
    time_us = np.arange(200) * 100_000
    poses = Poses(time_us, steps[:, :3], unit(steps[:, 3:]))
    settings = MotionSettings(fov_deg=70)
    odometry = Odometry(settings)
    for at_us, place, turn in zip(time_us, poses.position_m, poses.quaternion, strict=True):
        odometry(at_us / 1e6, place, turn)
    assert odometry.x == pytest.approx(motion_from_poses(poses, settings).total)
