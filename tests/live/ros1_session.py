"""A node with subscribers in one process, for test_ros1.py: prints what came, as JSON. Needs rospy and rosmaster."""

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from rosmaster.master import Master

from bufgym import ros1


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
    topics = ("chosen", "named", "plain", "endless", "at_once")
    came: dict[str, list[str]] = {topic: [] for topic in topics}
    sizes = {"endless": 0, "at_once": None}
    publishers = {topic: rospy.Publisher(topic, String, queue_size=sizes.get(topic, 10)) for topic in topics}
    odometry = rospy.Publisher("odom", Odometry, queue_size=10)
    for topic in topics:
        rospy.Subscriber(topic, String, lambda text, topic=topic: came[topic].append(text.data))
    # Two subscribers of one process have one connection: a raw one is the second.
    second = raw_subscriber("/chosen", String)
    deadline_s = time.monotonic() + 20
    while any(one.get_num_connections() < 1 for one in (*publishers.values(), odometry)):
        time.sleep(0.01)
        if time.monotonic() > deadline_s:
            raise SystemExit("no connections")
    for k in range(200):
        pose = Odometry()
        pose.header.stamp = rospy.Time(100, k * 4_000_000)
        pose.pose.pose.position.x = 0.01 * k
        pose.pose.pose.orientation.w = 1.0
        odometry.publish(pose)
        for one in publishers.values():
            one.publish(str(k))
        time.sleep(0.004)
    time.sleep(0.5)
    kinds = {
        topic: [type(one).__name__ for one in publisher.impl.connections] for topic, publisher in publishers.items()
    }
    statistics = publishers["named"].impl.get_stats()
    second.close()
    rospy.signal_shutdown("done")
    time.sleep(0.5)
    logs = sorted(path.name for path in Path(folder).glob("*.mcap"))
    print(json.dumps({"came": came, "kinds": kinds, "logs": logs, "named": statistics[2]}), flush=True)
    os._exit(0)


def raw_subscriber(topic: str, kind: type) -> Any:
    """A second connection to a topic of this process, of which nothing is read."""
    import socket

    import rospy
    from rosgraph.network import write_ros_handshake_header
    from rospy.impl.tcpros_base import get_tcpros_server_address, start_tcpros_server

    start_tcpros_server()
    connection = socket.create_connection(("127.0.0.1", get_tcpros_server_address()[1]))
    fields = {"topic": topic, "callerid": "/raw", "md5sum": kind._md5sum, "type": kind._type, "tcp_nodelay": "0"}
    write_ros_handshake_header(connection, fields)
    rospy.sleep(0.2)
    return connection


if __name__ == "__main__":
    main(sys.argv[1])
