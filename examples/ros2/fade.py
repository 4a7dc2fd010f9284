"""What arrives of a ROS 2 camera over a link that fades: by DDS itself, and by the relay under policies.

The link is that of ``examples/fade.py``. The relay's uplink goes through ``bufgym.live.shaped``; robot and viewer are
in two domains of DDS. ``best-effort`` and ``reliable`` are DDS itself, between two network namespaces with `tc tbf`
and 200 kB of queue, which takes root on Linux.

    python3 examples/ros2/fade.py --queues best-effort,reliable,drop-oldest,afr
"""

import argparse
import asyncio
import contextlib
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from fade import FAST, HEADINGS, QUEUE_SIZE, RATE_HZ, SIZE_BYTES, SLOW, arrived, fade, line, simulated

from bufgym.live.shaped import ShapedLink
from bufgym.model.link import Link

DOMAIN = 20 + os.getpid() % 40 * 2
"""Of DDS, and the next one: others for each run, as two may run at a time."""
HERE = Path(__file__).resolve().parent
CONFIG = f"""\
[[topic]]
name = "/camera"
rate_hz = {RATE_HZ}
size_bytes = {SIZE_BYTES}
value = "exponential:0.618"
"""


class Viewer:
    """``viewer.py`` as a process, and the frames that it has seen."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        self.frames: list[int] = []
        self.latest_s = time.monotonic()
        self.process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for text in self.process.stdout or ():
            self.frames.append(int(text))
            self.latest_s = time.monotonic()

    def wait(self, seconds: float) -> dict[str, Any]:
        """What came until the stream had ended and nothing more came for 2 s."""
        began_s = time.monotonic()
        while time.monotonic() < max(began_s + seconds + 1, self.latest_s + 2):
            time.sleep(0.05)
        return arrived(self.frames)


def environment(domain: int) -> dict[str, str]:
    return {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONWARNINGS": "ignore"}


@contextlib.contextmanager
def ended(*processes: subprocess.Popen[str]) -> Iterator[None]:
    try:
        yield
    finally:
        for process in processes:
            process.kill()  # a node that is stopped otherwise tells of its executor's end at length
            process.wait()


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
        told = (receive.stdout or iter(())).readline()
        link = ShapedLink(Link(fade(seconds)), ("127.0.0.1", int(told.rpartition(":")[2])))
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


def shell(command: str) -> None:
    subprocess.run(command.split(), check=True, capture_output=True)


@contextlib.contextmanager
def namespaces() -> Iterator[None]:
    """Two network namespaces with a pair of devices between them, the camera's shaped."""
    shell("ip netns add bufgym-robot")
    shell("ip netns add bufgym-base")
    try:
        shell("ip link add robot netns bufgym-robot type veth peer name base netns bufgym-base")
        for k, end in enumerate(("robot", "base")):
            inside = f"ip netns exec bufgym-{end} ip"
            shell(f"{inside} addr add 10.99.0.{k + 1}/24 dev {end}")
            shell(f"{inside} link set {end} up")
            shell(f"{inside} link set lo up")
            shell(f"{inside} route add 224.0.0.0/4 dev {end}")
        yield
    finally:
        shell("ip netns delete bufgym-robot")
        shell("ip netns delete bufgym-base")


def shaped(bytes_per_s: int, verb: str = "change") -> None:
    # tbf counts the headers of Ethernet, IP and TCP too.
    kbit = round(bytes_per_s * 8 / 1000 * 1514 / 1448)
    inside = "ip netns exec bufgym-robot tc qdisc"
    shell(f"{inside} {verb} dev robot root tbf rate {kbit}kbit burst 5000 limit 200000")


def direct(options: list[str], seconds: float) -> dict[str, Any]:
    """Camera and viewer as they are, in two network namespaces."""
    with namespaces():
        shaped(FAST, "add")
        place = environment(DOMAIN)
        viewer = Viewer(["ip", "netns", "exec", "bufgym-base", *python("viewer.py", *options)], place)
        frames = ["--frames", str(round(seconds * RATE_HZ))]
        command = ["ip", "netns", "exec", "bufgym-robot", *python("camera.py", *frames, *options)]
        camera = subprocess.Popen(command, env=place)
        with ended(camera, viewer.process):
            deadline_s = time.monotonic() + 60
            while not viewer.frames and time.monotonic() < deadline_s:
                time.sleep(0.01)
            for at, rate in ((3 / 8, SLOW), (5 / 8, FAST)):
                threading.Timer(at * seconds, shaped, (rate,)).start()
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
