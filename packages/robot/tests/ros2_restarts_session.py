"""A receiver that is killed five times beside a viewer, for test_ros2_restarts.py: prints what came, as JSON.

robot: /t0 to /t29, one /late after the first restart -> `/*` -> base: a viewer of all. Needs rclpy.
"""

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from ros2_session import BASE, ROBOT, Side, processes, start
from std_msgs.msg import String

from bufgym_robot.wire.sockets import free_port

RESTARTS = 5


def most_mb(pid: int) -> float:
    """Largest memory of a process so far."""
    words = Path(f"/proc/{pid}/status").read_text().split("VmHWM:")[1].split()
    return int(words[0]) * 1024 / 1e6


def main(folder: str) -> None:
    robot, base = Side(ROBOT, "robot"), Side(BASE, "base")
    names = [f"/t{k}" for k in range(30)]
    publishers = {name: robot.node.create_publisher(String, name, 10) for name in names}
    for name in (*names, "/late"):
        base.hear(name, 1000)
    port, log = str(free_port("127.0.0.1")), str(Path(folder, "log.mcap"))
    sent, due_s = 0, 0.0

    def spin(what: str, holds: Callable[[], bool], publish: bool = False) -> None:
        nonlocal sent, due_s
        ends_s = time.monotonic() + 60
        while not holds():
            if time.monotonic() > ends_s:
                raise TimeoutError(f"waited 60 s for {what}; came: { {k: len(v) for k, v in base.came.items()} }")
            if publish and time.monotonic() > due_s:  # each topic at 5 Hz
                due_s = time.monotonic() + 0.2
                for publisher in publishers.values():
                    publisher.publish(String(data=f"{sent}"))
                    sent += 1
            robot.spin()
            base.spin()

    try:
        start(BASE, "receive", "--port", port)
        words = ("--capacity", "64", "--window", "4", "--policies", "fifo", "--log", log, "--ros-args")
        start(ROBOT, "send", "--to", f"127.0.0.1:{port}", *words, "-p", "topics:=['/*']")
        sender = processes[-1].pid
        spin("thirty subscriptions", lambda: all(one.get_subscription_count() for one in publishers.values()))
        spin("thirty topics", lambda: sum(map(bool, base.came.values())) == 30, publish=True)
        memory = [most_mb(sender), most_mb(processes[0].pid)]
        publishers["/late"] = robot.node.create_publisher(String, "/late", 10)
        spin("the late topic", lambda: bool(base.came["/late"]), publish=True)
        for k in range(RESTARTS):
            came = sum(map(len, base.came.values()))
            spin("more", lambda came=came: sum(map(len, base.came.values())) > came + 100, publish=True)  # type: ignore[misc]
            processes[-1 if k else 0].send_signal(signal.SIGINT if k % 2 else signal.SIGKILL)
            processes[-1 if k else 0].wait(20)
            start(BASE, "receive", "--port", port)
        came = sum(map(len, base.came.values()))
        spin("more", lambda: sum(map(len, base.came.values())) > came + 100, publish=True)
        came, quiet_s = 0, time.monotonic()

        def quiet() -> bool:
            nonlocal came, quiet_s
            if came != (now := sum(map(len, base.came.values()))):
                came, quiet_s = now, time.monotonic()
            return time.monotonic() > quiet_s + 3

        spin("what is under way", quiet)
        print(json.dumps({"came": base.came, "memory_mb": memory}), flush=True)
    finally:
        for process in processes:
            process.kill()
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1])
