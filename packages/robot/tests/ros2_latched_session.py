"""Latched topics through a dead link, a restart and to late viewers, for test_ros2_latched.py: prints what came.

robot: /tf_static of 40 publishers, /map, /description, a camera -> `/*` -> base: viewers. Needs rclpy.
"""

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from itertools import count

from rclpy.qos import DurabilityPolicy, QoSProfile
from ros2_session import BASE, LATCHED, ROBOT, Side, processes, start
from std_msgs.msg import String

from bufgym_robot.wire.sockets import free_port

DRIVERS = 40
STATES = ("/tf_static", "/map", "/description")
ALL = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def main(dead_s: float) -> None:
    robot, base = Side(ROBOT, "robot"), Side(BASE, "base")
    drivers = [robot.node.create_publisher(String, "/tf_static", LATCHED) for _ in range(DRIVERS)]
    single = {name: robot.node.create_publisher(String, name, LATCHED) for name in STATES[1:]}
    camera = robot.node.create_publisher(String, "/camera", 10)
    for name in STATES:
        base.hear(name, ALL)
    base.hear("/camera", 10)
    port, due_s, frames = str(free_port("127.0.0.1")), 0.0, count()
    viewers: list[Side] = []

    def spin(what: str, holds: Callable[[], bool], seconds: float = 60.0) -> None:
        nonlocal due_s
        ends_s = time.monotonic() + seconds
        while not holds():
            if time.monotonic() > ends_s:
                raise TimeoutError(f"waited for {what}; came: { {k: v[-45:] for k, v in base.came.items()} }")
            if time.monotonic() > due_s:  # a camera at 30 Hz
                due_s = time.monotonic() + 1 / 30
                camera.publish(String(data=f"{next(frames)}" + "." * 50_000))
            for side in (robot, base, *viewers):
                side.spin()

    def publish(era: str) -> None:
        for k, driver in enumerate(drivers):
            driver.publish(String(data=f"{era} {k}"))
        for name, publisher in single.items():
            publisher.publish(String(data=f"{era} {name}"))

    def whole(side: Side, era: str) -> bool:
        """Whether the last of every publisher came."""
        tf = {f"{era} {k}" for k in range(DRIVERS)} <= set(side.came["/tf_static"])
        return tf and all(side.came[name][-1:] == [f"{era} {name}"] for name in single)

    def late(era: str) -> dict[str, list[str]]:
        """What a viewer gets that comes now, once it has all, and half a second later."""
        viewers.append(Side(BASE, f"viewer{len(viewers)}"))
        for name in STATES:
            viewers[-1].hear(name, ALL)
        spin(f"a late viewer's {era}", lambda: whole(viewers[-1], era))
        until_s = time.monotonic() + 0.5
        spin("half a second", lambda: time.monotonic() > until_s)
        return {name: list(texts) for name, texts in viewers[-1].came.items()}

    def restart(how: int) -> None:
        processes[-1 if len(processes) > 2 else 0].send_signal(how)
        processes[-1 if len(processes) > 2 else 0].wait(20)
        start(BASE, "receive", "--port", port)

    try:
        publish("first")
        start(BASE, "receive", "--port", port)
        start(ROBOT, "send", "--to", f"127.0.0.1:{port}", "--capacity", "8", "--ros-args", "-p", "topics:=['/*']")
        spin("the first", lambda: whole(base, "first"))
        spin("pictures", lambda: len(base.came["/camera"]) > 10)
        seen = {"late": late("first")}
        restart(signal.SIGKILL)
        seen["after a restart"] = late("first")
        processes[-1].send_signal(signal.SIGSTOP)
        until_s = time.monotonic() + dead_s
        spin("a dead link", lambda: time.monotonic() > until_s, dead_s + 60)
        publish("second")
        until_s = time.monotonic() + 1
        spin("a dead link", lambda: time.monotonic() > until_s)
        processes[-1].send_signal(signal.SIGCONT)
        spin("the second", lambda: whole(base, "second"))
        seen["after a dead link"] = late("second")
        publish("third")
        spin("the third", lambda: whole(base, "third"))
        restart(signal.SIGINT)
        seen["after all"] = late("third")
        print(json.dumps(seen), flush=True)
    finally:
        for process in processes:
            process.kill()
    os._exit(0)


if __name__ == "__main__":
    main(float(sys.argv[1]))
