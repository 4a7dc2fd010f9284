"""Frames of a ROS 2 camera that arrive over a fading link, by DDS itself and by the relay under policies.

``examples/fade.py`` defines the link. The relay's uplink goes through ``bufgym_robot.ShapedLink``; robot and
viewer are in two DDS domains. ``best-effort`` and ``reliable`` are DDS itself, between two network namespaces with
`tc tbf` and 200 kB of queue, which takes root on Linux.

    python3 examples/ros2/fade.py --queues best-effort,reliable,drop-oldest,afr
"""

import argparse
import asyncio
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from fade import (
    BASE,
    FAST,
    HEADINGS,
    QUEUE_SIZE,
    RATE_HZ,
    ROBOT,
    SIZE_BYTES,
    Viewer,
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

DOMAIN = 20 + os.getpid() % 40 * 2
"""DDS domain; the next one is used too. Each process has its own, because two may run at a time."""
HERE = Path(__file__).resolve().parent
CONFIG = f"""\
[[topic]]
name = "/camera"
rate_hz = {RATE_HZ}
size_bytes = {SIZE_BYTES}
value = "exponential:0.618"
"""


def environment(domain: int) -> dict[str, str]:
    return {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONWARNINGS": "ignore"}


def python(script: str, *options: str) -> list[str]:
    return [sys.executable, str(HERE / script), *options]


# --- the relay -------------------------------------------------------------------------------------------------------


def relayed(policy: str, seconds: float) -> dict[str, Any]:
    """Through ``bufgym ros2 send`` and ``bufgym ros2 receive``, camera and viewer as they are."""
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, daemon=True).start()
    robot, base = environment(DOMAIN), environment(DOMAIN + 1)
    robot["ROS_AUTOMATIC_DISCOVERY_RANGE"] = base["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    bufgym = [sys.executable, "-u", "-m", "bufgym", "ros2"]
    receive = subprocess.Popen([*bufgym, "receive", "--port", "0"], env=base, stdout=subprocess.PIPE, text=True)
    viewer = Viewer(python("viewer.py"), base)
    with ended(receive, viewer.process), tempfile.TemporaryDirectory() as folder:
        listening = (receive.stdout or iter(())).readline()
        link = ShapedLink(Link(fade(seconds)), ("127.0.0.1", int(listening.rpartition(":")[2])))
        port = asyncio.run_coroutine_threadsafe(link.listen(), loop).result()
        config = Path(folder, "client.toml")
        config.write_text(CONFIG)
        options = ["--policies", policy, "--capacity", str(QUEUE_SIZE), "--to", f"127.0.0.1:{port}"]
        command = [*bufgym, "send", "--config", str(config), *options]
        send = subprocess.Popen(command, env=robot, stdout=subprocess.PIPE, text=True)
        camera = subprocess.Popen(python("camera.py", "--frames", str(round(seconds * RATE_HZ))), env=robot)
        with ended(send, camera):
            (send.stdout or iter(())).readline()  # it has subscribed: the camera begins
            loop.call_soon_threadsafe(link.begin)
            return viewer.wait(seconds)


# --- DDS itself ------------------------------------------------------------------------------------------------------


def direct(options: list[str], seconds: float) -> dict[str, Any]:
    """Camera and viewer as they are, in two network namespaces."""
    with namespaces():
        shaped(FAST, "add")
        place = environment(DOMAIN)
        viewer = Viewer([*BASE, *python("viewer.py", *options)], place)
        frames = ["--frames", str(round(seconds * RATE_HZ))]
        command = [*ROBOT, *python("camera.py", *frames, *options)]
        camera = subprocess.Popen(command, env=place)
        with ended(camera, viewer.process):
            fade_away(viewer, seconds)
            return viewer.wait(seconds)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--queues", default="best-effort,reliable,drop-oldest,afr,min-motion-gap")
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    print(HEADINGS)
    for queue in options.queues.split(","):
        if queue in ("best-effort", "reliable"):
            wishes = ["--best-effort"] if queue == "best-effort" else []
            print(line(f"DDS, {queue}", direct(wishes, options.seconds), None), flush=True)
        else:
            row = relayed(queue, options.seconds)
            print(line(f"relay, {queue}", row, simulated(queue, options.seconds)), flush=True)


if __name__ == "__main__":
    main()
