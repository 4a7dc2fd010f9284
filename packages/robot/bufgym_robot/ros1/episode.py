"""Episode through ROS 1: a rospy node under ``install``, a shaped link, a rospy subscriber.

    node (camera, odometry) -> PolicyConnection ==shaped link==> subscriber

An ordinary node, unaware of any policy, publishes camera and odometry. The policy has x from the odometry's topic.
Everything runs in real time.
"""

import asyncio
import importlib
import math
import os
import tempfile
import threading
import time
from collections.abc import Sequence
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from bufgym.model.qoi import Value
from bufgym.policies.registry import Policy
from bufgym.scenario import Episode
from bufgym_robot import PolicyQueue, programs, ros1
from bufgym_robot.receiver import Received
from bufgym_robot.shaped import ShapedLink
from bufgym_robot.tunnel import HERE, End, Tunnel, ends
from bufgym_robot.validate import Play, warm


def player(tunnel: Tunnel | None = None) -> Play:
    """Plays episodes through ROS 1, through the tunnel if there is one.

    Raises:
        BufgymError: ROS 1 is not installed.
    """
    with ros1.needs_rospy():
        for module in ("rospy", "rosmaster.master"):
            importlib.import_module(module)
        programs.check_messages("_md5sum")
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
    """Play the episode; return the messages that a rospy subscriber got. Randomised policies use their own draws."""
    programs.check_speed(speed)
    warm(PolicyQueue(policy, capacity, value=value))
    with tempfile.TemporaryDirectory() as logs:
        near, far = ends(tunnel)
        camera = partial(_publish, logs, near, policy, episode, capacity, value)
        works = {"viewer": partial(_view, logs, far), "camera": camera}
        if tunnel is not None:
            works["link"] = partial(tunnel.carry, episode.link)
        with programs.running(**works) as workers:
            return asyncio.run(_play(workers, episode))


async def _play(workers: Sequence[programs.Worker], episode: Episode) -> list[Received]:
    viewer, camera, *carrier = workers
    camera.send(await viewer.receive())  # where the master is
    link = None
    try:
        if not carrier:
            link = ShapedLink(episode.link, await viewer.receive(), back=True)
            viewer.send(await link.listen())
        await camera.receive()
        began_s = time.monotonic() + programs.START_S
        if link is not None:
            asyncio.get_running_loop().call_at(began_s, link.begin)
        for worker in (*carrier, camera):
            worker.send(began_s)
        viewer.send(await camera.receive(patience_s=math.inf))
        return programs.received(await viewer.receive(patience_s=math.inf), episode, began_s)
    finally:
        if link is not None:
            await link.close()


def _in_ros(uri: str, logs: str, node: str, end: End) -> None:
    """Make this process a node of that name."""
    os.environ.update(ROS_MASTER_URI=uri, ROS_IP=end.address, ROS_LOG_DIR=logs)
    import rospy

    rospy.init_node(node, disable_signals=True, disable_rosout=True, disable_rostime=True)


def _view(logs: str, end: End, parent: Connection) -> None:
    """Run the master, and a subscriber that connects through the link: by a proxy, or at the tunnel's far end."""
    end.enter()
    from rosmaster.master import Master

    master = Master(0)
    master.start()
    uri = f"http://{end.address}:{master.master_node.server.socket.getsockname()[1]}"

    import rospy
    from rospy.impl.tcpros_pubsub import TCPROSHandler
    from sensor_msgs.msg import CompressedImage

    create, connected = TCPROSHandler.create_transport, threading.Event()

    def through_the_link(handler: Any, name: str, uri: str, protocol: list[Any]) -> Any:
        parent.send((protocol[1], protocol[2]))
        port = parent.recv()
        connected.set()
        return create(handler, name, uri, [protocol[0], "127.0.0.1", port])

    if end is HERE:
        TCPROSHandler.create_transport = through_the_link
    else:
        connected.set()
    _in_ros(uri, logs, "viewer", end)
    seen = programs.Seen()
    rospy.Subscriber(programs.CAMERA, CompressedImage, seen.take, tcp_nodelay=True)
    parent.send(uri)
    connected.wait()
    seen.wait(parent.recv())
    parent.send(seen.frames)
    parent.recv()


def _publish(
    logs: str, end: End, policy: Policy, episode: Episode, capacity: int, value: Value, parent: Connection
) -> None:
    """Run the node, and report its progress to the other programs."""
    end.enter()
    uri = parent.recv()
    ros1.install(policy, topics={programs.ODOMETRY: None}, odometry=programs.ODOMETRY, value=value)

    import rospy
    from geometry_msgs.msg import PoseStamped
    from sensor_msgs.msg import CompressedImage

    _in_ros(uri, logs, "camera", end)
    camera = rospy.Publisher(programs.CAMERA, CompressedImage, queue_size=capacity)
    odometry = rospy.Publisher(programs.ODOMETRY, PoseStamped, queue_size=100)

    def move(k: int, metres: float) -> None:
        pose = PoseStamped()
        pose.header.stamp = rospy.Time(*programs.pose_stamp(k))
        pose.pose.position.x, pose.pose.orientation.w = metres, 1.0
        odometry.publish(pose)

    def show(k: int, size_bytes: int) -> None:
        camera.publish(CompressedImage(format=str(k), data=bytes(size_bytes)))

    while camera.get_num_connections() == 0 or odometry.get_num_connections() == 0:
        time.sleep(0.01)
    parent.send("both are subscribed to")
    programs.publish_in_time(episode, parent.recv(), move, show)
    parent.send(programs.drained(camera.impl.connections[0].queue, len(episode.arrivals)))
    parent.recv()
