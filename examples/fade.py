"""Link and stream of ``ros1/fade.py`` and ``ros2/fade.py``, and their simulation.

The link has 24 Mbit/s, but 2 Mbit/s for a quarter of the time in the middle. Frames of 230 kB come at 30 Hz into a
queue of 15.
"""

import contextlib
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from bufgym import policies
from bufgym.model import Link, qoi
from bufgym.scenario import Episode, messages
from bufgym.sim import outcome, run
from bufgym.traces import Trace

RATE_HZ, SIZE_BYTES, QUEUE_SIZE = 30.0, 230_000, 15
FAST, SLOW = 3_000_000, 250_000
"""Bytes a second."""
V = qoi.exponential(0.618)
HEADINGS = """\
| queue | delivered | QoI | longest gap | in the simulator: delivered | QoI | longest gap |
|---|---:|---:|---:|---:|---:|---:|"""


def fade(seconds: float) -> Trace:
    """Make the link, which is slow from 3/8 to 5/8 of the time."""
    times = seconds * np.array([0, 3, 5, 8]) / 8
    carried = np.append(0, np.cumsum(np.diff(times) * [FAST, SLOW, FAST]))
    return Trace("fade", np.rint(times * 1e6).astype(np.int64), np.rint(carried).astype(np.int64), "hold")


def arrived(frames: Sequence[int]) -> dict[str, Any]:
    """Measure a run by the numbers of the frames that came."""
    gaps = np.diff(sorted(frames))
    return {
        "delivered": len(frames),
        "qoi": round(V.information(sorted(frames)), 2),
        "longest_gap": int(gaps.max(initial=0)),
    }


def simulated(policy: str, seconds: float) -> dict[str, Any]:
    """Run the same in the simulator."""
    times = np.arange(round(seconds * RATE_HZ)) * round(1e6 / RATE_HZ)
    episode = Episode(messages(times, SIZE_BYTES), Link(fade(seconds)))
    stats = outcome(run(policies.get(policy), [episode], QUEUE_SIZE, V), 0)
    return {"delivered": stats.delivered, "qoi": round(stats.qoi, 2), "longest_gap": int(stats.longest_gap)}


def line(name: str, *rows: dict[str, Any] | None) -> str:
    """A line of the table."""
    keys = ("delivered", "qoi", "longest_gap")
    cells = [f"{row[key]:g}" if row else "" for row in rows for key in keys]
    return f"| {name} | {' | '.join(cells)} |"


# --- processes -------------------------------------------------------------------------------------------------------


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
        """Wait until the stream has ended and nothing has come for 2 s; measure the frames."""
        began_s = time.monotonic()
        while time.monotonic() < max(began_s + seconds + 1, self.latest_s + 2):
            time.sleep(0.05)
        return arrived(self.frames)


@contextlib.contextmanager
def ended(*processes: subprocess.Popen[str]) -> Iterator[None]:
    try:
        yield
    finally:
        for process in processes:
            process.kill()  # a node stopped otherwise prints a long trace
            process.wait()


# --- a link of the kernel's ------------------------------------------------------------------------------------------

ROBOT, BASE = (["ip", "netns", "exec", f"bufgym-{end}"] for end in ("robot", "base"))
"""Prefixes that run a command in a namespace."""
ADDRESSES = "10.99.0.1", "10.99.0.2"
"""Addresses of robot and base."""


def shell(command: str) -> None:
    subprocess.run(command.split(), check=True, capture_output=True)


@contextlib.contextmanager
def namespaces() -> Iterator[None]:
    """Two network namespaces with a pair of devices between them, the camera's shaped."""
    shell("ip netns add bufgym-robot")
    shell("ip netns add bufgym-base")
    try:
        shell("ip link add robot netns bufgym-robot type veth peer name base netns bufgym-base")
        for address, end in zip(ADDRESSES, ("robot", "base"), strict=True):
            inside = f"ip netns exec bufgym-{end} ip"
            shell(f"{inside} addr add {address}/24 dev {end}")
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


def fade_away(viewer: Viewer, seconds: float) -> None:
    """Fade the link and restore it, timed from the viewer's first frame."""
    deadline_s = time.monotonic() + 60
    while not viewer.frames and time.monotonic() < deadline_s:
        time.sleep(0.01)
    for at, rate in ((3 / 8, SLOW), (5 / 8, FAST)):
        threading.Timer(at * seconds, shaped, (rate,)).start()
