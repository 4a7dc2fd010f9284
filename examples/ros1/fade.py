"""Frames of a rospy camera that arrive over a fading link, with rospy's own queue and under policies.

``examples/fade.py`` defines link and stream. The node is the unmodified ``camera.py``. The subscriber is rospy's and
connects through ``bufgym_robot.ShapedLink``. The same policies also run in the simulator. Run it with a Python
that has rospy, rosmaster and bufgym:

    python3 examples/ros1/fade.py --policies rospy,drop-oldest,afr
"""

import argparse
import asyncio
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from fade import (
    ADDRESSES,
    BASE,
    FAST,
    HEADINGS,
    RATE_HZ,
    ROBOT,
    Viewer,
    arrived,
    ended,
    fade,
    fade_away,
    line,
    namespaces,
    shaped,
    simulated,
)

from bufgym.model import Link
from bufgym_robot import ShapedLink

PORT = 11399
"""Port of the master in a namespace of its own."""
CAMERA = Path(__file__).with_name("camera.py")


class Fade:
    """Subscribes to the camera through the link, and notes which frames come; one rospy process, so one run."""

    def __init__(self, seconds: float) -> None:
        import rospy
        from rospy.impl import tcpros_pubsub
        from sensor_msgs.msg import CompressedImage

        self.frames: list[int] = []
        self.latest_s = time.monotonic()
        loop = asyncio.new_event_loop()
        threading.Thread(target=loop.run_forever, daemon=True).start()
        create = tcpros_pubsub.TCPROSHandler.create_transport

        async def shape(target: tuple[str, int]) -> int:
            link = ShapedLink(Link(fade(seconds)), target, back=True)
            port = await link.listen()
            link.begin()
            return port

        def through_the_link(handler: Any, name: str, uri: str, protocol: list[Any]) -> Any:
            port = asyncio.run_coroutine_threadsafe(shape((protocol[1], protocol[2])), loop).result()
            return create(handler, name, uri, [protocol[0], "127.0.0.1", port])

        tcpros_pubsub.TCPROSHandler.create_transport = through_the_link
        rospy.init_node("viewer", anonymous=True, disable_signals=True, disable_rosout=True)
        rospy.Subscriber("/camera", CompressedImage, self._take)

    def _take(self, frame: Any) -> None:
        self.frames.append(int(frame.format))
        self.latest_s = time.monotonic()


def play(policy: str, seconds: float) -> dict[str, Any]:
    """One run: a master, the camera as its own process, and a subscriber in a process of its own."""
    command = [sys.executable, __file__, "--one", policy, "--seconds", str(seconds)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=seconds + 150)
    if done.returncode != 0:
        raise SystemExit(f"{policy}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def one(policy: str, seconds: float) -> dict[str, Any]:
    """The run itself."""
    from rosmaster.master import Master

    master = Master(0)
    master.start()
    port = master.master_node.server.socket.getsockname()[1]
    os.environ.update(ROS_MASTER_URI=f"http://127.0.0.1:{port}", ROS_IP="127.0.0.1", PYTHONWARNINGS="ignore")
    run_by = [] if policy == "rospy" else ["-m", "bufgym_robot.ros1", "--policy", policy]
    frames = round(seconds * RATE_HZ)
    camera = subprocess.Popen([sys.executable, *run_by, str(CAMERA), "--frames", str(frames)], stdout=sys.stderr)
    try:
        seen = Fade(seconds)
        began_s = time.monotonic()
        while not seen.frames and camera.poll() is None and time.monotonic() - began_s < 120:
            time.sleep(0.05)
        began_s = time.monotonic()
        while time.monotonic() < max(began_s + seconds + 1, seen.latest_s + 2):
            time.sleep(0.05)
    finally:
        camera.terminate()
        camera.wait(10)
    return arrived(seen.frames)


def through_the_kernel(policy: str, seconds: float) -> dict[str, Any]:
    """The same with two network namespaces, `tc tbf` and 200 kB of queue as the link. Takes root on Linux."""
    master = f"from rosmaster.master import Master; import time; Master({PORT}).start(); time.sleep({seconds + 100})"
    run_by = [] if policy == "rospy" else ["-m", "bufgym_robot.ros1", "--policy", policy]
    camera = [*run_by, str(CAMERA), "--frames", str(round(seconds * RATE_HZ))]
    place = {**os.environ, "ROS_MASTER_URI": f"http://{ADDRESSES[0]}:{PORT}", "PYTHONWARNINGS": "ignore"}
    robot, base = {**place, "ROS_IP": ADDRESSES[0]}, {**place, "ROS_IP": ADDRESSES[1]}
    with namespaces():
        shaped(FAST, "add")
        serving = subprocess.Popen([*ROBOT, sys.executable, "-c", master], env=robot)
        time.sleep(1)
        viewer = Viewer([*BASE, sys.executable, str(CAMERA.with_name("viewer.py"))], base)
        publishing = subprocess.Popen([*ROBOT, sys.executable, *camera], env=robot)
        with ended(publishing, viewer.process, serving):
            fade_away(viewer, seconds)
            return viewer.wait(seconds)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--policies", default="rospy,drop-oldest,afr,min-motion-gap")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--tbf", action="store_true", help="over a link of the kernel's (root)")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(one(options.one, options.seconds)), flush=True)
        os._exit(0)  # rospy's threads have nothing left to say
    print(HEADINGS)
    for policy in options.policies.split(","):
        same = "drop-oldest" if policy == "rospy" else policy
        run = through_the_kernel if options.tbf else play
        print(line(policy, run(policy, options.seconds), simulated(same, options.seconds)), flush=True)


if __name__ == "__main__":
    main()
