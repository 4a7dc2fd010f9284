"""Paths that lose packets in silence: a router's new address, a forgotten flow, a path that takes no full packet.

Over the kernel's own TCP between two namespaces. Without a watch over the path the first two take 20 s, the third is
silent for ever.
"""

import asyncio
import contextlib
import itertools
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from live_cases import in_order
from needs import needs
from wire_cases import FAR, PORT, Far, Wire, at, program, waited

from bufgym_robot import PolicyQueue
from bufgym_robot.channels import TRANSPORTS
from bufgym_robot.sender import Sender
from bufgym_robot.tunnel import Tunnel

SOON_S = 8.0
"""The bound is 4 to 5 s, on a machine that has time."""
FAR_6, NEAR_6 = "fd79::2", "fd79::1"
Between = tuple[Tunnel, Wire]

nightly = pytest.mark.nightly
ways = pytest.mark.parametrize("transport", ["tcp", pytest.param("websocket", marks=nightly)])


class Near:
    """A sender at the near end, and what it says."""

    def __init__(self, made: Tunnel, transport: str = "tcp", host: str = FAR) -> None:
        self.queue, self.said = PolicyQueue("fifo", 64), list[str]()
        self.sender: Sender
        self._begun = threading.Event()
        self._thread = at(made.near, lambda: asyncio.run(self._send(partial(TRANSPORTS[transport], host, PORT))))
        assert self._begun.wait(10)

    async def _send(self, connect: Any) -> None:
        self.sender = Sender(self.queue, connect, on_status=self.said.append)
        self._begun.set()
        await self.sender.run()

    def put(self, size_bytes: int = 1000) -> None:
        self.queue.put(bytes(size_bytes), size_bytes)

    def end(self) -> None:
        self.queue.close()
        self._thread.join(60)
        assert not self._thread.is_alive()


@ways
def test_a_routers_new_address(transport: str, between: Between) -> None:
    """50 messages a second: each comes once and in order, and it is said why."""
    made, wire = between
    far = Far(made.far, transport=transport)
    near = Near(made, transport)
    for k in range(300):
        if k == 50:
            waited(lambda: len(far.came) > 20)
            wire.forget()
        near.put()
        time.sleep(0.02)
    near.end()
    silent_s = max(b - a for a, b in itertools.pairwise(far.came))
    print(transport, silent_s, near.said)
    assert silent_s < SOON_S
    assert in_order(far.messages) and len(far.messages) == 300 - near.queue.dropped
    assert len(near.sender.faults) == 1 and near.sender.faults[0].endswith("s: connecting anew beside it")


@ways
@pytest.mark.parametrize("idle_s", [0.0, pytest.param(3.0, marks=nightly)])
def test_an_idle_flow_that_is_forgotten(idle_s: float, transport: str, between: Between) -> None:
    """A rare topic, whose next message comes soon all the same."""
    made, wire = between
    far = Far(made.far, transport=transport)
    near = Near(made, transport)
    near.put(100)
    waited(lambda: far.came)
    time.sleep(2.0)
    wire.forget()
    time.sleep(idle_s)
    put_s = time.monotonic()
    near.put(100)
    waited(lambda: len(far.came) == 2)
    print(transport, idle_s, far.came[1] - put_s, near.said)
    assert far.came[1] - put_s < SOON_S
    near.end()
    assert in_order(far.messages) and near.sender.faults[0].endswith("anew beside it") and len(near.sender.faults) == 1


@ways
@pytest.mark.parametrize("host", [FAR, pytest.param(FAR_6, marks=nightly)])
def test_a_path_that_takes_no_full_packet(host: str, transport: str, between: Between) -> None:
    """1300 bytes at most, without ICMP."""
    made, wire = between
    for end, address in ((made.near, NEAR_6), (made.far, FAR_6)) if host == FAR_6 else ():
        words = ["ip", "addr", "add", f"{address}/64", "dev", "bufgym0", "nodad"]
        at(end, partial(subprocess.run, words, check=True)).join()
    wire.most_bytes = 1300
    far = Far(made.far, host, transport)
    began_s = time.monotonic()
    near = Near(made, transport, host)
    for _ in range(5):
        near.put(20_000)
    waited(lambda: len(far.came) == 5)
    print(transport, host, far.came[0] - began_s, near.said)
    assert far.came[0] - began_s < SOON_S
    near.end()
    assert in_order(far.messages)
    mss = 1140 if host == FAR_6 else 1160
    assert near.sender.faults[-1].endswith(f"no full segments: smaller segments (MSS {mss})")


@nightly
@pytest.mark.parametrize("busy", [False, True])
def test_slow_is_not_silent(busy: bool, between: Between) -> None:
    """A message that takes 6 s on the link; a receiver that takes 4 s for one while more wait than it has room for."""
    made, wire = between
    far = Far(made.far, takes_s=4.0 * busy)
    wire.packet_s = 0.0 if busy else 0.15
    near = Near(made)
    for _ in range(5 if busy else 1):
        near.put(3_000_000 if busy else 60_000)
    near.end()
    assert in_order(far.messages) and not near.sender.faults
    assert near.said == [""]


def live(made: Tunnel, folder: Path, size: int, rate: float) -> list[Any]:
    words = ("live", "send", f"{FAR}:{PORT}", "--size", size, "--rate", rate, "--duration", "120")
    return [program(made.near, sys.executable, "-m", "bufgym", *words)]


def sender_in_cpp(made: Tunnel, folder: Path, size: int, rate: float) -> list[Any]:
    from test_ros2_sender import built_with

    built = built_with(folder, "drop-oldest")
    return [program(made.near, built, FAR, PORT, "drop-oldest", 4, folder, 6000, size, rate)]


def ros2_send(made: Tunnel, folder: Path, size: int, rate: float) -> list[Any]:
    pytest.importorskip("rclpy", reason=needs("ros2", "rclpy"))
    from test_outage import CAMERA

    where: Any = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_HOME": str(folder)}
    words = ["ros2", "send", "--to", f"{FAR}:{PORT}", "--ros-args", "-p", "topics:=[/camera]"]
    camera = [sys.executable, CAMERA, "--frames", 6000, "--size", size, "--rate", rate]
    return [program(made.near, sys.executable, "-m", "bufgym", *words, **where), program(made.near, *camera, **where)]


@contextlib.contextmanager
def running(programs: list[Any]) -> Iterator[None]:
    try:
        yield
    finally:
        for one in programs:
            one.kill()
            one.communicate()


@nightly
@pytest.mark.parametrize("rate", [50, 0.2])
@pytest.mark.parametrize("way", [live, sender_in_cpp, ros2_send])
def test_every_way_meets_a_routers_new_address(way: Any, rate: float, between: Between, tmp_path: Path) -> None:
    """Also a rare topic, with a message each 5 s: it comes 4 s after the flow is forgotten."""
    made, wire = between
    far = Far(made.far)
    with running(way(made, tmp_path, 1000, rate)):
        waited(lambda: len(far.came) > (20 if rate > 1 else 1))
        time.sleep(1.0)
        before, forgotten_s = len(far.came), time.monotonic()
        wire.forget()
        waited(lambda: len(far.came) > before + (20 if rate > 1 else 0))
        silent_s = max(b - a for a, b in itertools.pairwise([forgotten_s, *far.came[before:]]))
        print(way.__name__, rate, silent_s)
        assert silent_s < SOON_S and in_order(far.messages)


@nightly
@pytest.mark.parametrize("way", [live, sender_in_cpp, ros2_send])
def test_every_way_meets_a_path_that_takes_no_full_packet(way: Any, between: Between, tmp_path: Path) -> None:
    made, wire = between
    wire.most_bytes = 1300
    far = Far(made.far)
    with running(way(made, tmp_path, 20_000, 10)):
        waited(lambda: far.came)
        print(way.__name__, far.came[0] - wire.refused_s)
        assert far.came[0] - wire.refused_s < SOON_S
