"""A relay that is told all in ROS 2's own words, for test_ros2.py: prints what came, as JSON. Needs rclpy.

robot: /front/camera, /scan_left, /scan_right, /odd (of a package that is nowhere installed) -> base, renamed there
/lost is subscribed to as transient local, which it is not, and so is /scan_left by a reader at the base.
"""

import json
import os
import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.qos import LivelinessPolicy, QoSProfile
from rclpy.serialization import serialize_message
from ros2_session import BASE, LATCHED, ROBOT, Side, processes, start
from std_msgs.msg import String

from bufgym_robot.ros2.uninstalled import stand_in

ODD = stand_in("no_such_msgs/msg/Thing")
CAREFUL = QoSProfile(
    depth=10,
    deadline=Duration(seconds=50),
    lifespan=Duration(seconds=60),
    liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
    liveliness_lease_duration=Duration(seconds=70),
)


def main() -> None:
    robot, base = Side(ROBOT, "robot"), Side(BASE, "base")
    publishers = {name: robot.node.create_publisher(String, name, 10) for name in ("/scan_left", "/scan_right")}
    publishers["/front/camera"] = robot.node.create_publisher(String, "/front/camera", CAREFUL)
    publishers["/lost"] = robot.node.create_publisher(String, "/lost", 10)
    publishers["/odd"] = robot.node.create_publisher(ODD, "/odd", 10)
    for name in ("/scan_left", "/scan_right", "/robot1/camera"):
        base.hear(name, 10)
    base.node.create_subscription(String, "/scan_left", print, LATCHED)
    odd: list[bytes] = []
    base.node.create_subscription(ODD, "/odd", odd.append, 10, raw=True)
    arrays: list[Any] = []
    robot.node.create_subscription(DiagnosticArray, "/diagnostics", arrays.append, 10)
    try:
        renamed = ("-r", "/front/camera:=/robot1/camera", "-r", "__node:=bufgym_receive_1")
        there = start(BASE, "receive", "--port", "0", "--ros-args", *renamed).rpartition(" ")[2]
        host, _, port = there.rpartition(":")
        names = ("-r", "__ns:=/robot", "-r", "camera:=/front/camera", "-p", "use_sim_time:=true")
        numbers = ("-p", f"host:={host}", "-p", f"port:={port}", "-p", "capacity:=7", "-p", "policy:=fifo")
        depth = ("-p", "qos_overrides./odd.subscription.reliability:=best_effort")
        depth += ("-p", "qos_overrides./lost.subscription.durability:=transient_local")
        topics = ("-p", "topics:=['camera', '/scan_*', '/odd', '/lost']")
        start(ROBOT, "send", "--ros-args", *names, *numbers, *depth, *topics)

        def spin(what: str, holds: Callable[[], bool], publish: bool = False) -> None:
            ends_s = time.monotonic() + 60
            while not holds():
                if time.monotonic() > ends_s:
                    raise TimeoutError(f"waited 60 s for {what}; came: {base.came}, {odd}, {arrays}")
                for name, publisher in publishers.items() if publish else ():
                    text = String(data=name)
                    publisher.publish(serialize_message(text) if name == "/odd" else text)
                    time.sleep(0.02)
                robot.spin()
                base.spin()

        spin("a message of each topic", lambda: all(base.came.values()) and bool(odd), publish=True)
        arrays.clear()
        spin("diagnostics", lambda: bool(arrays))
        [seen] = base.node.get_publishers_info_by_topic("/robot1/camera")
        qos = seen.qos_profile
        [asked] = robot.node.get_subscriptions_info_by_topic("/odd")
        result: dict[str, Any] = {"came": {name: texts[0] for name, texts in base.came.items()}}
        result["odd"] = odd[0][8:].rstrip(b"\0").decode()
        result["types"] = dict(base.node.get_topic_names_and_types())["/odd"]
        result["by"] = f"{seen.node_namespace}{seen.node_name}", f"{asked.node_namespace}/{asked.node_name}"
        result["reliability"] = asked.qos_profile.reliability.name
        times = (qos.deadline, qos.lifespan, qos.liveliness_lease_duration)
        result["qos"] = [time.nanoseconds / 1e9 for time in times], qos.liveliness.name
        result["diagnostics"] = [
            [one.name, one.message, {pair.key: float(pair.value) for pair in one.values}]
            for array in arrays[:1]
            for one in array.status
        ]
        result["said"] = []
        for process in processes:
            process.terminate()
            result["said"] += [
                line for line in process.communicate(timeout=20)[0].splitlines() if "gets nothing" in line
            ]
        print(json.dumps(result), flush=True)
    finally:
        for process in processes:
            process.kill()
    os._exit(0)


if __name__ == "__main__":
    main()
