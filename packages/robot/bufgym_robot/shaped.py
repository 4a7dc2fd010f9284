"""A link with a trace's capacity between real sockets: a TCP proxy in user space that needs no root.

Towards the receiver it forwards each byte when the simulator's link would have carried it; the way back is only
delayed. Its own buffers are small, so that it hides no queue. Normally the sender connects to the receiver. With
``back`` the receiver connects to the sender, as a ROS 1 subscriber does.
"""

import asyncio
import contextlib
import socket
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from bufgym.model.link import FOREVER, Link
from bufgym_robot.receiver import listener
from bufgym_robot.wire.tasks import Tasks, until_one_ends

RECEIVE_BUFFER_BYTES: Final = 16_384
_PIECE_BYTES: Final = 16_384
_MOST_PIECES: Final = 4096  # limit on pieces on their way to the receiver at a time
_SLACK_S: Final = 0.005
"""Longest wait for the next bytes during which the link counts as busy. Programs need this time between an ack and the
next message, so it is not charged to the link."""
_STALL_S: Final = 0.1  # longest stall of this program, on a busy machine, that a busy link makes up for


class ShapedLink:
    """Forwards connections to ``target``, a (host, port), at the pace of ``link``.

    Time runs ``speed`` times faster. ``back`` applies the pace to data that come back from the target.
    """

    def __init__(
        self,
        link: Link,
        target: tuple[str, int],
        *,
        back: bool = False,
        speed: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link = link
        self._target = target
        self._back = back
        self._speed = speed
        self._clock = clock
        self._began_s = clock()
        self._begun = asyncio.Event()
        self._position = 0
        self._open = asyncio.Event()
        self._open.set()
        self._sockets: set[socket.socket] = set()
        self._tasks = Tasks()
        self._turn = asyncio.Lock()
        self.carried_bytes = 0
        """Bytes carried to the receiver so far."""

    async def listen(self, port: int = 0, host: str = "127.0.0.1") -> int:
        """Begin to listen and return the port; 0 takes any free port."""
        listening = await listener(host, port, RECEIVE_BUFFER_BYTES)
        self._sockets.add(listening)
        self._tasks.begin(self._accept(listening))
        return int(listening.getsockname()[1])

    def begin(self) -> None:
        """Begin the trace now, also for the bytes that are just crossing."""
        self._began_s = self._clock()
        self._position = 0
        self._begun.set()
        self._begun = asyncio.Event()

    def cut(self) -> None:
        """Break all connections and accept no new ones until ``mend``."""
        self._open.clear()
        self._tasks.cancel("connection")

    def mend(self) -> None:
        """Accept connections again."""
        self._open.set()

    async def close(self) -> None:
        """Break all connections and stop listening."""
        await self._tasks.end()
        for one in self._sockets:
            one.close()

    async def _accept(self, listening: socket.socket) -> None:
        while True:
            near, _ = await asyncio.get_running_loop().sock_accept(listening)
            near.setblocking(False)
            if self._open.is_set():
                forwarding = self._tasks.begin(self._forward(near), "connection")
                # A task that is cancelled before it begins closes nothing.
                forwarding.add_done_callback(partial(_close, near))
            else:
                near.close()

    async def _forward(self, near: socket.socket) -> None:
        """Forward one connection to its end."""
        with near, socket.socket() as far, contextlib.suppress(OSError):  # without a target the sender reconnects
            far.setblocking(False)
            for one in (near, far):
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._back:
                far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            await asyncio.get_running_loop().sock_connect(far, self._target)
            sender, receiver = (far, near) if self._back else (near, far)
            await until_one_ends(self._up(sender, receiver), self._down(receiver, sender))

    async def _up(self, sender: socket.socket, receiver: socket.socket) -> None:
        """Forward to the receiver each piece once it has crossed; connections take turns."""
        propagation_s = self._link.propagation_us / 1e6 / self._speed
        crossed: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(_MOST_PIECES)
        delivery = asyncio.create_task(self._deliver(crossed, receiver))
        try:
            while True:
                waited_s, piece = await _piece(sender)
                if not piece:
                    break
                async with self._turn:
                    crossed_s = await self._cross(len(piece), waited_s)
                self.carried_bytes += len(piece)
                await crossed.put((crossed_s + propagation_s, piece))
            await crossed.join()
        finally:
            delivery.cancel()

    async def _deliver(self, crossed: asyncio.Queue[tuple[float, bytes]], receiver: socket.socket) -> None:
        """Deliver pieces a propagation delay after they have crossed."""
        while True:
            arrives_s, piece = await crossed.get()
            while (rest_s := arrives_s - self._clock()) > 0:
                await asyncio.sleep(rest_s)
            await asyncio.get_running_loop().sock_sendall(receiver, piece)
            crossed.task_done()

    async def _down(self, receiver: socket.socket, sender: socket.socket) -> None:
        """Forward data back to the sender."""
        loop = asyncio.get_running_loop()
        while piece := await loop.sock_recv(receiver, 65_536):
            await asyncio.sleep(self._link.propagation_us / 1e6 / self._speed)
            await loop.sock_sendall(sender, piece)

    def _now_s(self) -> float:
        """The link's time."""
        return (self._clock() - self._began_s) * self._speed

    def _crossed_s(self, size_bytes: int, waited_s: float) -> float:
        """Link time at which these bytes have crossed; ``waited_s`` is how long the link waited for them."""
        if waited_s > 0:
            late_s = _SLACK_S if waited_s > _SLACK_S else _STALL_S
            idle_us = max(0, int((self._now_s() - late_s * self._speed) * 1e6))
            self._position = max(self._position, self._link.carried_at(idle_us))
        self._position += size_bytes
        crossed_us = self._link.time_at(self._position)
        return float("inf") if crossed_us == FOREVER else crossed_us / 1e6

    async def _cross(self, size_bytes: int, waited_s: float) -> float:
        """Return once these bytes have crossed, and the clock's time of that; never if the link has stopped.

        If the trace begins meanwhile, they cross at its beginning.
        """
        time_s, begun = self._crossed_s(size_bytes, waited_s), self._begun
        while (rest_s := (time_s - self._now_s()) / self._speed) > 0:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(min(rest_s, 1.0)):
                    await begun.wait()
                time_s, begun = self._crossed_s(size_bytes, 0.0), self._begun
        return self._began_s + time_s / self._speed


async def _piece(connection: socket.socket) -> tuple[float, bytes]:
    """Receive the next bytes, none at the end; also return the wait for them, without waits for a processor."""
    try:
        return 0.0, connection.recv(_PIECE_BYTES)
    except BlockingIOError:
        began_s, starved_s = time.monotonic(), _starved_s()
        piece = await asyncio.get_running_loop().sock_recv(connection, _PIECE_BYTES)
        return max(1e-6, time.monotonic() - began_s - (_starved_s() - starved_s)), piece


def _starved_s() -> float:
    """Time that this thread was ready without a processor; 0 where the system does not tell."""
    try:
        return int(Path("/proc/thread-self/schedstat").read_text(encoding="ascii").split()[1]) / 1e9
    except (OSError, ValueError, IndexError):
        return 0.0


def _close(one: socket.socket, task: asyncio.Task[None]) -> None:
    """Close the socket of a task that has ended."""
    one.close()
