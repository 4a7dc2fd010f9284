"""Nodes in two domains with the relay between them, for test_ros2.py: prints what came, as JSON. Needs rclpy.

robot (domain 71): camera, odometry, status (transient local)  -> send ... receive -> base (domain 72): viewers
base: commands, no_drop                                        -> send ... receive -> robot: driver
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from bufgym_robot.ros2 import Publisher

ROBOT = 20 + os.getpid() % 40 * 2
BASE = ROBOT + 1
"""Domains of DDS, others for each run: two may run at a time."""
TOPIC = '[[topic]]\nname = "{}"\nrate_hz = {}\nsize_bytes = {}\n'
CONFIGS = {
    "client": TOPIC.format("camera", 50, 1000)
    + "moves = true\n"
    + TOPIC.format("/status", 1, 100)
    + TOPIC.format("ghost", 1, 100),
    "commands": TOPIC.format("commands", 10, 100) + "no_drop = true\n",
}
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)


class Side:
    """A node in a domain of its own, and what it has heard."""

    def __init__(self, domain: int, name: str) -> None:
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, domain_id=domain)
        self.node = rclpy.create_node(name, context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.came: dict[str, list[str]] = {}

    def hear(self, topic: str, qos: Any) -> None:
        heard = self.came.setdefault(topic, [])
        self.node.create_subscription(String, topic, lambda text: heard.append(text.data), qos)

    def spin(self) -> None:
        self.executor.spin_once(timeout_sec=0.0)


processes: list[subprocess.Popen[str]] = []


def start(domain: int, *words: str, lines: int = 1) -> str:
    """Start a command of the relay in its domain; its first lines."""
    place = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    command = [sys.executable, "-u", "-m", "bufgym", "ros2", *words]
    processes.append(subprocess.Popen(command, env=place, stdout=subprocess.PIPE, text=True))
    stdout = processes[-1].stdout
    assert stdout is not None
    return "\n".join(stdout.readline().strip() for _ in range(lines))


def main(folder: str) -> None:
    robot, base = Side(ROBOT, "robot"), Side(BASE, "base")
    for name, text in CONFIGS.items():
        Path(folder, f"{name}.toml").write_text(text)
    base.hear("camera", BEST_EFFORT)
    base.hear("status", LATCHED)
    base.hear("own/echo", 10)
    robot.hear("commands", 10)
    camera = robot.node.create_publisher(String, "camera", BEST_EFFORT)
    odometry = robot.node.create_publisher(PoseStamped, "odom", 10)
    robot.node.create_publisher(String, "status", LATCHED).publish(String(data="up"))
    commands = base.node.create_publisher(String, "commands", 10)
    try:
        there = start(BASE, "receive", "--port", "0").rpartition(" ")[2]
        back = start(ROBOT, "receive", "--port", "0").rpartition(" ")[2]
        log = ["--policies", "fifo", "--log", str(Path(folder, "log.mcap"))]
        start(ROBOT, "send", "--config", f"{folder}/client.toml", "--to", there, "--odom", "odom", *log)
        said = start(BASE, "send", "--config", f"{folder}/commands.toml", "--to", back, lines=2).split("\n")
        own = Publisher(robot.node, String, "own/echo", to=("127.0.0.1", int(there.rpartition(":")[2])))
        came = base.came | robot.came

        def spin(what: str, holds: Callable[[], bool], seconds: float = 60.0, must: bool = True) -> None:
            ends_s = time.monotonic() + seconds
            while not holds() and time.monotonic() < ends_s:
                robot.spin()
                base.spin()
            if must and not holds():
                counts = {topic: len(texts) for topic, texts in came.items()}
                raise TimeoutError(f"waited {seconds:g} s for {what}; came: {counts}")

        def last(topic: str) -> int:
            return int(came[topic][-1]) if came[topic] else -1

        spin(
            "the robot's two subscriptions",
            lambda: camera.get_subscription_count() + odometry.get_subscription_count() == 2,
        )
        for k in range(100):
            # Not more than five are on their way at a time; best effort may lose one.
            spin(f"message {k - 5}", lambda k=k: last("own/echo") >= k - 5)  # type: ignore[misc]
            spin(f"picture {k - 5}", lambda k=k: last("camera") >= k - 5, 1.0, must=False)  # type: ignore[misc]
            pose = PoseStamped()
            pose.header.stamp.sec, pose.header.stamp.nanosec = 100, k * 9_000_000
            pose.pose.position.x, pose.pose.orientation.w = 0.02 * k, 1.0
            odometry.publish(pose)
            camera.publish(String(data=str(k)))
            own.publish(String(data=str(k)))
            if k % 10 == 0:
                commands.publish(String(data=str(k)))
        spin("all reliable messages", lambda: sum(len(came[t]) for t in ("own/echo", "status", "commands")) == 111)
        spin("the last picture", lambda: last("camera") == 99, 2.0, must=False)
        own.destroy(1.0)
        quality = base.node.get_publishers_info_by_topic("/camera")[0]
        seen = {
            "came": came,
            "said": sorted(line.replace(back, "BACK") for line in said),
            "by": quality.node_name,
            "faults": list(own.sender.faults),
        }
        seen["best_effort"] = quality.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        print(json.dumps(seen), flush=True)
        for process in processes:
            process.terminate()
            process.wait(20)
    finally:
        for process in processes:
            process.kill()
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1])
