"""A node with subscribers in one process, for test_ros1.py: prints what came, as JSON. Needs rospy and rosmaster."""

import json
import os
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rosmaster.master import Master

from bufgym_robot import ros1

MESSAGES = 60
"""Of each topic; not more than five of them are on their way at a time."""


def wait(holds: Callable[[], bool]) -> None:
    ends_s = time.monotonic() + 60
    while not holds():
        if time.monotonic() > ends_s:
            raise TimeoutError(f"60 s, and still not so: line {sys._getframe(1).f_lineno}")
        time.sleep(0.001)


def raw_subscriber(topic: str, kind: type) -> Any:
    """A second connection to a topic of this process, of which nothing is read."""
    from rosgraph.network import write_ros_handshake_header
    from rospy.impl.tcpros_base import get_tcpros_server_address, start_tcpros_server

    start_tcpros_server()
    connection = socket.create_connection(("127.0.0.1", get_tcpros_server_address()[1]))
    fields = {"topic": topic, "callerid": "/raw", "md5sum": kind._md5sum, "type": kind._type, "tcp_nodelay": "0"}
    write_ros_handshake_header(connection, fields)
    return connection


def main(folder: str) -> None:
    master = Master(0)
    master.start()
    port = master.master_node.server.socket.getsockname()[1]
    os.environ.update(ROS_MASTER_URI=f"http://127.0.0.1:{port}", ROS_IP="127.0.0.1", ROS_LOG_DIR=folder)

    import rospy
    from nav_msgs.msg import Odometry
    from std_msgs.msg import String

    ros1.install("afr", topics={"/named": "drop-oldest", "/plain": None}, odometry="/odom", log=folder)
    rospy.init_node("session", disable_signals=True, disable_rosout=True)
    sizes = {"chosen": 10, "named": 10, "plain": 10, "endless": 0, "at_once": None}
    came: dict[str, list[str]] = {topic: [] for topic in sizes}
    publishers = {topic: rospy.Publisher(topic, String, queue_size=size) for topic, size in sizes.items()}
    odometry = rospy.Publisher("odom", Odometry, queue_size=10)
    publishers["latched"] = rospy.Publisher("latched", String, queue_size=10, latch=True)
    came["latched"] = []
    for topic in came:
        rospy.Subscriber(topic, String, lambda text, topic=topic: came[topic].append(text.data))
    wait(lambda: all(one.get_num_connections() for one in (*publishers.values(), odometry)))
    # Two subscribers of one process have one connection: a raw one is the second.
    second = raw_subscriber("/chosen", String)
    wait(lambda: publishers["chosen"].get_num_connections() == 2)
    for k in range(MESSAGES):
        wait(lambda k=k: all(len(texts) > k - 5 for texts in came.values()))  # type: ignore[misc]
        pose = Odometry()
        pose.header.stamp = rospy.Time(100, k * 16_000_000)
        pose.pose.pose.position.x = 0.03 * k
        pose.pose.pose.orientation.w = 1.0
        odometry.publish(pose)
        for one in publishers.values():
            one.publish(str(k))
    wait(lambda: all(len(texts) == MESSAGES for texts in came.values()))
    kinds = {topic: [type(one).__name__ for one in each.impl.connections] for topic, each in publishers.items()}
    statistics = publishers["named"].impl.get_stats()
    second.close()
    rospy.signal_shutdown("done")  # ends the logs
    logs = sorted(path.name for path in Path(folder).glob("*.mcap"))
    print(json.dumps({"came": came, "kinds": kinds, "logs": logs, "named": statistics[2]}), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1])
