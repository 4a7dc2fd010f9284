"""Senders over a round trip: what arrives of a stream, by round trip and rate of the link.

    sudo python -m studies.round_trips                     # every round trip and rate, steady
    sudo python -m studies.round_trips --fade --rtt 50     # 24 Mbit/s, for a quarter of the time a twelfth of that
    sudo python -m studies.round_trips --fade --rtt 50 --control bbr reno

Frames of 230 kB come at 30 Hz into a queue of 15; V = 1 - 0.618^d over frames. Each run has two network namespaces of
its own with tun devices between (``bufgym_robot.tunnel``); the bottleneck's buffer holds 200 kB. "system's
buffers" is a sender as stock ROS has it: Drop Oldest, and a socket that takes whatever the system takes. An age is the
time from the camera to the receiver. ``--control`` is the congestion control of TCP in both namespaces; by default they
have the machine's. A sender that cannot run here is left out, and the exit code is 1.
"""

import argparse
import importlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.scenario import Episode, messages
from bufgym.sim import outcome, run
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError
from bufgym_robot import far, tunnel
from bufgym_robot.receiver import Received
from website.markdown import table

RATE_HZ, SIZE_BYTES, CAPACITY = 30, 230_000, 15
BYTES_PER_MBIT = 125_000
V = qoi.exponential(0.618)
ROUND_TRIPS_MS, MBITS = (1, 10, 50, 100, 200), (2, 24, 100)

Play = Callable[[tunnel.Tunnel, Episode, str], list[Received]]


def _over(transport: str, **settings: Any) -> Play:
    return lambda through, episode, policy: far.over(through, transport)(
        policies.get(policy), episode, CAPACITY, V, **settings
    )


def _mqtt(through: tunnel.Tunnel, episode: Episode, policy: str) -> list[Received]:
    """By a broker (Debian's mosquitto) at the far end."""
    with tempfile.NamedTemporaryFile("w", suffix=".conf") as settings:
        settings.write(f"listener 1883 {through.far.address}\nallow_anonymous true\n")
        settings.flush()
        command = [
            shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin") or "mosquitto",
            "-c",
            settings.name,
        ]
        with subprocess.Popen(command, preexec_fn=through.far.enter, stderr=subprocess.DEVNULL) as broker:
            try:
                time.sleep(1)
                return far.over(through, "mqtt", 1883)(policies.get(policy), episode, CAPACITY, V)
            finally:
                broker.kill()


def _ros(version: str) -> Play:
    def play(through: tunnel.Tunnel, episode: Episode, policy: str) -> list[Received]:
        player = importlib.import_module(f"bufgym_robot.{version}.episode").player(through)
        came: list[Received] = player(policies.get(policy), episode, CAPACITY, V)
        return came

    return play


SENDERS: dict[str, tuple[str, Play]] = {
    "system's buffers": ("drop-oldest", _over("tcp", leaves="written", small=False)),
    "one by one": ("afr", _over("tcp", leaves="acked")),
    "tcp": ("afr", _over("tcp")),
    "websocket": ("afr", _over("websocket")),
    "zenoh": ("afr", _over("zenoh")),
    "mqtt": ("afr", _mqtt),
    "ros1": ("afr", _ros("ros1")),
    "ros2": ("afr", _ros("ros2")),
}
"""Name -> policy, and how an episode is sent."""


def link(mbit: float, seconds: float, fades: bool, round_trip_ms: float) -> Link:
    """A steady link; with ``fades`` it has a twelfth of its rate from 3/8 to 5/8 of the time."""
    times = seconds * np.array([0, 3, 5, 8]) / 8
    rates = mbit * BYTES_PER_MBIT * np.array([1, 1 / 12 if fades else 1, 1])
    carried = np.append(0, np.cumsum(np.diff(times) * rates))
    trace = Trace("link", np.rint(times * 1e6).astype(np.int64), np.rint(carried).astype(np.int64), "hold")
    return Link(trace, 0, round(round_trip_ms * 500))


def cells(name: str, mbit: float, seconds: float, fades: bool, round_trip_ms: float, control: str) -> list[str]:
    """Delivered, QoI, longest gap and ages of a run, and the simulator's first three."""
    policy, play = SENDERS[name]
    times = np.arange(round(seconds * RATE_HZ)) * round(1e6 / RATE_HZ)
    episode = Episode(messages(times, SIZE_BYTES), link(mbit, seconds, fades, round_trip_ms))
    with tunnel.opened() as through:
        for end in (through.near, through.far):
            end.set_congestion_control(control)
        came = play(through, episode, policy)
    frames = [message.seq for message in came]
    x = episode.arrivals["x"][frames]
    simulated = outcome(run(policies.get(policy), [episode], CAPACITY, V), 0)
    gap = int(np.diff(frames).max(initial=0))
    ages_s = np.array([message.received_ns for message in came]) / 1e9 - times[frames] / 1e6
    return [
        f"{round_trip_ms:g}", f"{mbit:g}", control, name, policy, f"{len(frames)}", f"{V.information(x):.1f}", f"{gap}",
        f"{np.median(ages_s):.2f}", f"{ages_s.max(initial=0):.2f}",
        f"{simulated.delivered}", f"{simulated.qoi:.1f}", f"{simulated.longest_gap:g}",
    ]  # fmt: skip


HEAD = [
    "RTT, ms", "Mbit/s", "TCP", "sender", "policy", "delivered", "QoI", "longest gap", "median age, s", "oldest, s",
    *(3 * ["simulated"]),
]  # fmt: skip


def main() -> None:
    """Print a table, a row as it is measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rtt", type=float, nargs="+", default=ROUND_TRIPS_MS, help="round trips, ms")
    parser.add_argument(
        "--mbit", type=float, nargs="+", help="rates of the link, Mbit/s (default: 2 24 100; 24 fading)"
    )
    parser.add_argument("--senders", nargs="+", choices=SENDERS, default=["system's buffers", "tcp"])
    parser.add_argument("--control", nargs="+", help="TCP's congestion control, as bbr reno (default: the machine's)")
    parser.add_argument("--seconds", type=float, help="length of the stream (default: 10; fading 20)")
    parser.add_argument("--fade", action="store_true", help="let the link fade")
    options = parser.parse_args()
    seconds = options.seconds or (20.0 if options.fade else 10.0)
    rows, left_out = [], 0
    for mbit in options.mbit or ((24,) if options.fade else MBITS):
        for round_trip_ms in options.rtt:
            for control in options.control or [tunnel.congestion_control()]:
                for name in options.senders:
                    try:
                        rows.append(cells(name, mbit, seconds, options.fade, round_trip_ms, control))
                    except BufgymError as error:  # as of a program that is not here
                        left_out += 1
                        print(f"left out: {name}: {error}", flush=True)
                    else:
                        print("measured:", *rows[-1], flush=True)
    print(table(HEAD, rows))
    if left_out:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
