"""Two namespaces, the wire between them, and what runs at its ends."""

import asyncio
import contextlib
import os
import select
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from needs import needs

from bufgym_robot import tunnel
from bufgym_robot.receiver import Received, Receiver
from bufgym_robot.tunnel import ADDRESSES, End, Tunnel

NEAR, FAR = ADDRESSES
PORT = 7410


class Wire:
    """The link between both ends, which loses every packet while it is cut, and others as a test says."""

    def __init__(self, between: Tunnel) -> None:
        self.cut = threading.Event()
        self.most_bytes = 2000
        """Larger packets are lost, and nobody is told."""
        self.refused_s = 0.0
        """When the first one came."""
        self.packet_s = 0.0
        """Time that a packet takes."""
        self.mute: int | None = None
        """Device of the end whose packets are lost."""
        self._known, self._forgotten = set[bytes](), set[bytes]()
        self._ended = threading.Event()
        self._devices = {between.near.device: between.far.device, between.far.device: between.near.device}
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()

    def forget(self) -> None:
        """Lose all packets of the flows so far in silence, as a router with a new public address does."""
        self._forgotten |= self._known

    def _passes(self, packet: bytes) -> bool:
        head = 20 if packet[0] >> 4 == 4 else 40
        ports = packet[head : head + 4]
        flow = min(ports, ports[2:] + ports[:2])
        self._known.add(flow)
        if len(packet) > self.most_bytes:
            self.refused_s = self.refused_s or time.monotonic()
        return not self.cut.is_set() and len(packet) <= self.most_bytes and flow not in self._forgotten

    def _run(self) -> None:
        while not self._ended.is_set():
            for device in select.select(list(self._devices), [], [], 0.05)[0]:
                with contextlib.suppress(OSError):
                    packet = os.read(device, 2000)
                    time.sleep(self.packet_s)
                    if device != self.mute and self._passes(packet):
                        os.write(self._devices[device], packet)


def at(end: End, work: Callable[[], Any]) -> threading.Thread:
    """Run it in a thread of its own in this namespace."""

    def run() -> None:
        end.enter()
        work()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def program(end: End, *words: Any, stdout: int = subprocess.DEVNULL, **settings: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        list(map(str, words)), env={**os.environ, **settings}, preexec_fn=end.enter, text=True,
        stdin=subprocess.PIPE, stdout=stdout, stderr=subprocess.DEVNULL,
    )  # fmt: skip


class Far:
    """A receiver at the far end, when messages came, and which."""

    def __init__(self, end: End, host: str = FAR, transport: str = "tcp", takes_s: float = 0.0) -> None:
        self.came: list[float] = []
        self.messages: list[Received] = []
        self.listens = threading.Event()
        self._where, self._takes_s = (PORT, host, transport), takes_s
        at(end, lambda: asyncio.run(self._receive()))
        assert self.listens.wait(10)

    async def _receive(self) -> None:
        receiver = Receiver(self._take)
        await receiver.listen(*self._where)
        self.listens.set()
        await asyncio.Event().wait()

    async def _take(self, message: Received) -> None:
        await asyncio.sleep(self._takes_s)
        self.messages.append(message)
        self.came.append(time.monotonic())


def waited(holds: Callable[[], Any]) -> None:
    ends_s = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < ends_s
        time.sleep(0.01)


@pytest.fixture
def between() -> Iterator[tuple[Tunnel, Wire]]:
    if reason := tunnel.impossible():
        pytest.skip(needs("root", reason))
    with tunnel.opened() as made:
        wire = Wire(made)
        yield made, wire
        wire.close()
