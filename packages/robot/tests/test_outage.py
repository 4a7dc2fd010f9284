"""Links that die and come back, and a robot's new address, over the kernel's own TCP between two namespaces."""

import asyncio
import itertools
import socket
import subprocess
import sys
import threading
import time
import xmlrpc.client
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import roscpp_cases
from needs import needs
from ros1_cases import SYSTEM, environment
from wire_cases import FAR, NEAR, PORT, Far, Wire, at, program, waited

from bufgym_robot import PolicyQueue
from bufgym_robot.channels import TcpChannel
from bufgym_robot.sender import Sender
from bufgym_robot.tunnel import Tunnel
from bufgym_robot.wire.sockets import bounded_backoff

MOVED = "10.79.0.3"
MASTER = 11311
DEAD_S, NO_LINK_S, SOON_S = 20.0, 2.0, 3.0
CAMERA = Path(__file__).resolve().parents[3] / "examples" / "ros2" / "camera.py"
NODE = """
import rospy
from std_msgs.msg import String
rospy.init_node("camera")
rospy.Subscriber("odom", rospy.AnyMsg, print)
publisher, rate = rospy.Publisher("camera", String, queue_size=5), rospy.Rate(50)
while not rospy.is_shutdown():
    publisher.publish(String(data="x" * 1000))
    rate.sleep()
"""
SUBSCRIBER = """
import rospy
rospy.init_node("viewer")
rospy.Subscriber("camera", rospy.AnyMsg, lambda message: print("message"), queue_size=5)
rospy.spin()
"""


def new_address() -> None:
    """What a robot meets that comes into another network."""
    for verb, address in (("del", NEAR), ("add", MOVED)):
        subprocess.run(["ip", "addr", verb, f"{address}/24", "dev", "bufgym0"], check=True)


def test_a_robots_new_address_is_a_new_connection(between: tuple[Tunnel, Wire]) -> None:
    """Ten messages, a new address in place of the old one, ten more: each comes, in order, and the sender says why."""
    made, _ = between
    far, queue = Far(made.far), PolicyQueue("fifo", 64)
    senders: list[Sender] = []

    async def send() -> None:
        senders.append(Sender(queue, lambda: TcpChannel.connect(FAR, PORT)))
        await senders[0].run()

    sending = at(made.near, lambda: asyncio.run(send()))
    for _ in range(10):
        queue.put(b"before", 6)
    waited(lambda: len(far.came) == 10)
    at(made.near, new_address).join()
    for _ in range(10):
        queue.put(b"after", 5)
    queue.close()
    sending.join(60)
    assert len(far.came) == 20
    assert f"this machine's address has become {MOVED}" in senders[0].faults[0]


def test_the_kernel_bounds_its_backoff_or_says_that_it_cannot() -> None:
    """1 to 120 s, from Linux 6.15 on; what it takes can be read back in ms."""
    with socket.socket() as one:
        if bounded_backoff(one, 2.0):
            assert one.getsockopt(socket.IPPROTO_TCP, 44) == 2000
        assert not bounded_backoff(one, 0.5) and not bounded_backoff(one, 121)


def live(made: Tunnel, folder: Path) -> tuple[list[float], list[Any]]:
    far = Far(made.far)
    words = ("live", "send", f"{FAR}:{PORT}", "--size", "1000", "--duration", "120")
    return far.came, [program(made.near, sys.executable, "-m", "bufgym", *words)]


def sender_in_cpp(made: Tunnel, folder: Path) -> tuple[list[float], list[Any]]:
    from test_ros2_sender import built_with

    far = Far(made.far)
    return far.came, [
        program(made.near, built_with(folder, "drop-oldest"), FAR, PORT, "drop-oldest", 4, folder, 6000, 1000, 50)
    ]


def ros2_send(made: Tunnel, folder: Path) -> tuple[list[float], list[Any]]:
    pytest.importorskip("rclpy", reason=needs("ros2", "rclpy"))
    far, where = Far(made.far), {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_HOME": str(folder)}
    words = ["ros2", "send", "--to", f"{FAR}:{PORT}", "--ros-args", "-p", "topics:=[/camera]"]
    camera = [sys.executable, CAMERA, "--frames", 6000, "--size", 1000, "--rate", 50]
    return far.came, [
        program(made.near, sys.executable, "-m", "bufgym", *words, **where),
        program(made.near, *camera, **where),
    ]


def ros1(made: Tunnel, folder: Path, talker: list[Any], **settings: str) -> tuple[list[float], list[Any]]:
    """The talker at the near end; at the far one ROS 1's master and a subscriber, which prints a line a message."""
    if not (SYSTEM / "rospy").is_dir():
        pytest.skip(needs("ros1"))
    where = {**environment(folder), "ROS_MASTER_URI": f"http://{FAR}:{MASTER}", "ROS_HOME": str(folder)}
    (folder / "subscriber.py").write_text(SUBSCRIBER)
    words = (sys.executable, "-u", folder / "subscriber.py")
    hears = program(made.far, *words, stdout=subprocess.PIPE, **where, ROS_IP=FAR)
    came: list[float] = []

    def hear() -> None:
        for _ in hears.stdout or ():
            came.append(time.monotonic())

    threading.Thread(target=hear, daemon=True).start()
    master = program(made.far, "rosmaster", "--core", "-p", MASTER, **where, ROS_IP=FAR)
    return came, [master, hears, program(made.near, *talker, **where, ROS_IP=NEAR, **settings)]


def registered(made: Tunnel) -> tuple[str, str, set[tuple[int, str]]]:
    """What the far end's master says: the talker's address, that of its services, and all that it has registered."""
    found: list[tuple[str, str, set[tuple[int, str]]]] = []

    def ask() -> None:
        with xmlrpc.client.ServerProxy(f"http://{FAR}:{MASTER}") as proxy:
            master: Any = proxy
            [talker] = roscpp_cases.publishers(master, "camera")
            state = enumerate(master.getSystemState("/test")[2])
            names = {(kind, name) for kind, part in state for name, nodes in part if talker in nodes}
            hosts = master.lookupNode("/test", talker)[2], master.lookupService("/test", f"{talker}/get_loggers")[2]
            found.append((*(str(urlsplit(host).hostname) for host in hosts), names))  # type: ignore[arg-type]

    at(made.far, ask).join()
    return found[0]


def node_in_cpp(made: Tunnel, folder: Path) -> tuple[list[float], list[Any]]:
    if reason := roscpp_cases.missing():
        pytest.skip(needs("roscpp", reason))
    library = roscpp_cases.build(folder, "afr")
    words = [folder / "talker", "camera", 5, 6000, 1000, 50]
    return ros1(made, folder, words, LD_PRELOAD=str(library), BUFGYM_POLICY="afr", BUFGYM_ODOMETRY="/odom")


def node_in_python(made: Tunnel, folder: Path) -> tuple[list[float], list[Any]]:
    (folder / "node.py").write_text(NODE)
    return ros1(made, folder, [sys.executable, "-m", "bufgym_robot.ros1", "--policy", "afr", folder / "node.py"])


@pytest.mark.nightly
@pytest.mark.parametrize("way", [live, sender_in_cpp, ros2_send, node_in_cpp, node_in_python])
def test_frames_come_soon_after_a_link_that_was_dead(way: Any, between: tuple[Tunnel, Wire], tmp_path: Path) -> None:
    """Dead for 20 s, in which every packet is lost: with TCP's own backoff the next frame comes up to 18 s later."""
    made, wire = between
    came, started = way(made, tmp_path)
    try:
        waited(lambda: len(came) > 20)
        wire.cut.set()
        time.sleep(DEAD_S)
        before, back_s = len(came), time.monotonic()
        wire.cut.clear()
        waited(lambda: len(came) > before)
        print(way.__name__, came[before] - back_s)
        assert came[before] - back_s < SOON_S
        waited(lambda: len(came) > before + 50)  # and they go on
    finally:
        for one in started:
            one.kill()
            one.communicate()


@pytest.mark.nightly
@pytest.mark.parametrize("way", [live, sender_in_cpp, ros2_send, node_in_cpp, node_in_python])
def test_frames_come_soon_after_a_new_address(way: Any, between: tuple[Tunnel, Wire], tmp_path: Path) -> None:
    """Without a look at its address a sender is silent until TCP gives up, and a node of ROS 1 for ever."""
    made, wire = between
    came, started = way(made, tmp_path)
    try:
        waited(lambda: len(came) > 20)
        known = registered(made) if way in (node_in_cpp, node_in_python) else None
        wire.cut.set()
        at(made.near, new_address).join()
        time.sleep(NO_LINK_S)  # between two networks: what is tried meanwhile fails
        wire.cut.clear()
        before, changed_s = len(came), time.monotonic()
        waited(lambda: len(came) > before + 20)  # more than was on its way
        silent_s = max(b - a for a, b in itertools.pairwise([changed_s, *came[before:]]))
        print(way.__name__, silent_s)
        assert silent_s < SOON_S
        if known is not None:  # the node can still be called, stopped and sent messages to
            assert known[:2] == (NEAR, NEAR) and {(0, "/camera"), (1, "/odom")} <= known[2]
            waited(lambda: registered(made) == (MOVED, MOVED, known[2]))
    finally:
        for one in started:
            one.kill()
            one.communicate()
