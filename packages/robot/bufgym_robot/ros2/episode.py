"""Episode through ROS 2: a rclpy node, the relay pair with a shaped link between, a rclpy viewer.

    node (camera, odometry) -> relay ==shaped link==> relay -> viewer

Node and viewer are ordinary nodes in two DDS domains. The relay has x from the odometry's topic. Everything runs in
real time.
"""

import asyncio
import importlib
import math
import os
import threading
import time
from array import array
from collections.abc import Sequence
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.policies.registry import Policy
from bufgym.scenario import Client, Episode, Stream
from bufgym.traces import Trace, load_motion
from bufgym_robot import PolicyQueue, programs
from bufgym_robot.receiver import Received
from bufgym_robot.ros2.names import needs_rclpy
from bufgym_robot.ros2.relay import RosSender, receive
from bufgym_robot.shaped import ShapedLink
from bufgym_robot.tunnel import End, Tunnel, ends
from bufgym_robot.validate import Play, warm
from bufgym_robot.wire.log import Record, of

_DOMAIN = 20 + os.getpid() % 40 * 2
"""Domain of the robot; the base has the next. Each process has its own, because two may run at a time."""
_WARM_UP = -1  # number of a frame before the first, because a new DDS publisher needs time to find its subscribers
_DEPTH = 100  # history depth of each topic in DDS; on one machine nothing waits there for long
_SETTLED_S = 1.0  # time after which published messages have arrived


def player(tunnel: Tunnel | None = None) -> Play:
    """Plays episodes through ROS 2, through the tunnel if there is one.

    Raises:
        BufgymError: ROS 2 is not installed.
    """
    with needs_rclpy():
        importlib.import_module("rclpy")
        programs.check_messages("get_fields_and_field_types")
    return partial(play, tunnel=tunnel)


def play(
    policy: Policy,
    episode: Episode,
    capacity: int,
    value: Value,
    *,
    speed: float = 1.0,
    seed: int = 0,
    tunnel: Tunnel | None = None,
) -> list[Received]:
    """Play the episode; return the messages that a viewer got. Randomised policies use their own draws."""
    programs.check_speed(speed)
    warm(PolicyQueue(policy, capacity, value=value))
    near, far = ends(tunnel)
    works = {
        "receive": partial(_receive, far),
        "send": partial(_send, near, policy, capacity, value),
        "viewer": partial(_view, far),
        "camera": partial(_publish, near, episode),
    }
    if tunnel is not None:
        works["link"] = partial(tunnel.carry, episode.link)
    with programs.running(**works) as workers:
        return asyncio.run(_play(workers, episode, far.address))


async def _play(workers: Sequence[programs.Worker], episode: Episode, address: str) -> list[Received]:
    receiving, sending, viewer, camera, *carrier = workers
    to = address, await receiving.receive()
    link = None if carrier else ShapedLink(episode.link, to)
    try:
        sending.send(to if link is None else (address, await link.listen()))
        await viewer.receive()  # of a frame before the first
        began_s = time.monotonic() + programs.START_S
        if link is not None:
            asyncio.get_running_loop().call_at(began_s, link.begin)
        for worker in (*carrier, camera):
            worker.send(began_s)
        sending.send(await camera.receive(patience_s=math.inf))
        viewer.send(await sending.receive(patience_s=math.inf))
        return programs.received(await viewer.receive(), episode, began_s)
    finally:
        if link is not None:
            await link.close()


def _on(domain: int, end: End) -> None:
    """Put this process into a domain limited to this machine, at one end of the tunnel if there is one."""
    end.enter()
    os.environ.update(ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")


def _node(domain: int, name: str, end: End) -> Any:
    _on(domain, end)
    import rclpy

    rclpy.init(args=[])
    return rclpy.create_node(name, enable_rosout=False, start_parameter_services=False)


def _receive(end: End, parent: Connection) -> None:
    def say(text: str) -> None:
        if text.startswith("listening on "):
            parent.send(int(text.rpartition(":")[2]))

    _on(_DOMAIN + 1, end)
    asyncio.run(receive(0, end.address, say=say))


def _send(end: End, policy: Policy, capacity: int, value: Value, parent: Connection) -> None:
    records: list[Record] = []
    stream = Stream(Topic(programs.CAMERA), rate_hz=30.0, size_bytes=1, moves=True)
    # Where a client is simulated, it needs a link and a motion as well.
    client = Client((stream,), (Trace.steps([(1.0, 1e6)]),), (load_motion("drive-0"),), value=value)
    _on(_DOMAIN, end)
    to, odometry = parent.recv(), programs.ODOMETRY
    robot = RosSender(client, *to, policy=policy, capacity=capacity, odometry=odometry, log=records.append)

    def all_sent() -> None:
        parent.recv()
        time.sleep(_SETTLED_S)
        parent.send(programs.drained(robot.queue, len(list(of(records, "put")))))

    async def relay() -> None:
        await asyncio.gather(robot.run(), asyncio.to_thread(all_sent))

    asyncio.run(relay())


def _view(end: End, parent: Connection) -> None:
    node, seen = _node(_DOMAIN + 1, "viewer", end), programs.Seen()

    import rclpy
    from sensor_msgs.msg import CompressedImage

    node.create_subscription(CompressedImage, programs.CAMERA, seen.take, _DEPTH)
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    seen.wait(1)
    parent.send("a frame")
    seen.wait(parent.recv(), _SETTLED_S)
    parent.send([(k, at_ns) for k, at_ns in seen.frames if k != _WARM_UP])
    parent.recv()


def _publish(end: End, episode: Episode, parent: Connection) -> None:
    node = _node(_DOMAIN, "camera", end)

    from geometry_msgs.msg import PoseStamped
    from sensor_msgs.msg import CompressedImage

    camera = node.create_publisher(CompressedImage, programs.CAMERA, _DEPTH)
    odometry = node.create_publisher(PoseStamped, programs.ODOMETRY, _DEPTH)
    body = array("B", bytes(int(episode.arrivals["size_bytes"].max())))

    def move(k: int, metres: float) -> None:
        pose = PoseStamped()
        pose.header.stamp.sec, pose.header.stamp.nanosec = programs.pose_stamp(k)
        pose.pose.position.x, pose.pose.orientation.w = metres, 1.0
        odometry.publish(pose)

    def show(k: int, size_bytes: int) -> None:
        camera.publish(CompressedImage(format=str(k), data=body[:size_bytes]))

    while camera.get_subscription_count() == 0 or odometry.get_subscription_count() == 0:
        time.sleep(0.01)
    while not parent.poll(0.5):
        show(_WARM_UP, 1)
    programs.publish_in_time(episode, parent.recv(), move, show)
    parent.send("all is published")
    parent.recv()
