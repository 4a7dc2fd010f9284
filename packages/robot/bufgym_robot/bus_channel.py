"""Frames over a publish-subscribe library, one library message per frame.

The library hides its socket. On Linux it is found among this process's, so that the system says when it wants more;
elsewhere the receiver's acks do.

A sender has a name of its own for every connection. It publishes to the receiver under that name and hears what the
receiver publishes for it. None of these libraries tells which messages a broken connection lost. So a receiver
announces its presence, and a sender that sees it go gives the connection up. An empty message hangs up.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import os
import socket
import threading
from collections.abc import Callable, Coroutine
from typing import Any, Final, Protocol
from weakref import WeakSet

from bufgym_robot.frames import HEADER_BYTES, MAX_BODY_BYTES, Frame, Room, header, whole
from bufgym_robot.wire.sockets import (
    BACKOFF_S,
    bounded_backoff,
    connections_to,
    little_unsent,
    unsent_bytes,
    until_writable,
)

_MOST_WAITING: Final = 1024  # limit on frames waiting to be taken, more than a sender ever has unacked
_LEAVE_S: Final = 3.0  # time for a library to leave when the program ends
_aside_threads: WeakSet[threading.Thread] = WeakSet()


class Bus(Protocol):
    """One end of a connection in such a library."""

    def publish(self, name: str, data: bytes) -> None:
        """Send data to or from the sender of this name; may block while the link is busy."""

    def close(self) -> None:
        """Leave; may block."""


Hear = Callable[[str, bytes], None]
"""Called with (name, data) from the library's threads when data to or from the sender of this name arrive."""
Peer = Callable[[bool], None]
"""Called from the library's threads with True when the receiver appears and False when it goes."""
Open = Callable[[str, int, str, Hear, Peer], Bus]
"""(host, port, sender's name or "" for the receiver, hear, peer) -> ``Bus``; raises an OSError if it can't."""


class BusChannel:
    """Frames between one sender and the receiver."""

    def __init__(self, name: str, max_body_bytes: int = MAX_BODY_BYTES, room: Room | None = None) -> None:
        self.name = name
        self.publish: Callable[[str, bytes], None] = lambda name, data: None
        self.on_close: Callable[[], None] = lambda: None
        self._max_body_bytes, self._room = max_body_bytes, room or Room(_MOST_WAITING * max_body_bytes)
        self._loop = asyncio.get_running_loop()
        self.socket: socket.socket | None = None
        """The library's socket, if it was found: then the system says when it wants more."""
        self._came: asyncio.Queue[bytes] = asyncio.Queue()
        self._there = asyncio.Event()

    @classmethod
    async def connect(
        cls, opening: Open, host: str, port: int, *, small: bool = True, backoff_s: float = BACKOFF_S
    ) -> BusChannel:
        """Connect a sender once the receiver is there; ``small`` has no effect on the library's buffers."""
        channel = cls(os.urandom(8).hex())
        there = host, port, channel.name, lambda _, data: channel.soon(channel.take, data), channel.peer
        made = asyncio.ensure_future(asyncio.to_thread(_opened, opening, *there))
        try:
            bus, channel.socket = await asyncio.shield(made)
        except asyncio.CancelledError:
            made.add_done_callback(_abandoned)
            raise
        if channel.socket is not None:
            bounded_backoff(channel.socket, backoff_s)
        channel.publish, channel.on_close = bus.publish, lambda: _aside(bus.close)
        try:
            await channel._there.wait()
        except BaseException:
            channel.close()
            raise
        return channel

    def soon(self, do: Callable[..., None], *arguments: Any) -> None:
        """Call in the loop's thread, unless the loop has ended."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(do, *arguments)

    def take(self, data: bytes) -> None:
        """Take data that arrived; hang up if too much waits."""
        fits = self._came.qsize() < _MOST_WAITING and len(data) <= self._room.left_bytes
        self._came.put_nowait(data if fits else b"")
        self._room.left_bytes -= len(data) if fits else 0

    def peer(self, there: bool) -> None:
        """Note that the receiver is there or gone; its going ends the connection."""
        self.soon(self._there.set if there else self._lost)

    def _lost(self) -> None:
        if self._there.is_set():
            self.take(b"")

    async def send(self, frame: Frame) -> None:
        await asyncio.to_thread(self.publish, self.name, header(frame) + bytes(frame.body))

    async def receive(self) -> Frame:
        data = await self._came.get()
        self._room.left_bytes += len(data)
        if not data:
            raise ConnectionResetError("the peer has gone")
        return whole(data, self._max_body_bytes)

    async def until_wanted(self) -> bool:
        if self.socket is not None:
            await until_writable(self.socket)
        return self.socket is not None

    def left_bytes(self) -> int | None:
        return None if self.socket is None else unsent_bytes(self.socket)

    def tcp(self) -> socket.socket | None:
        return self.socket

    def close(self) -> None:
        while not self._came.empty():
            self._room.left_bytes += len(self._came.get_nowait())
        if self.socket is not None:
            self.socket.close()
        self.on_close()


class BusServer:
    """The receiver's end: a channel for each sender that speaks."""

    def __init__(
        self, serve: Callable[[BusChannel], Coroutine[Any, Any, None]], begin: Any, max_body_bytes: int, room: Room
    ):
        """``begin`` runs ``serve`` of a channel as a task."""
        self._serve, self._begin, self._max_body_bytes, self._room = serve, begin, max_body_bytes, room
        self._channels: dict[str, BusChannel] = {}
        self._loop = asyncio.get_running_loop()
        self._bus: Bus | None = None
        self._early: list[tuple[str, bytes]] | None = []
        """Data that arrived before ``listen`` had the bus."""

    async def listen(self, opening: Open, host: str, port: int) -> None:
        """Announce the receiver and listen."""
        self._bus = await asyncio.to_thread(opening, host, port, "", self._hear, lambda there: None)
        early, self._early = self._early or [], None
        for name, data in early:
            self._take(name, data)

    async def close(self) -> None:
        """Withdraw the receiver and close."""
        bus, self._bus = self._bus, None
        if bus is not None:
            await asyncio.to_thread(bus.close)

    def _hear(self, name: str, data: bytes) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._take, name, data)

    def _take(self, name: str, data: bytes) -> None:
        if self._early is not None:
            self._early.append((name, data))
            return
        channel = self._channels.get(name)
        if channel is None:
            if len(data) < HEADER_BYTES or self._bus is None:
                return
            channel = self._channels[name] = BusChannel(name, self._max_body_bytes, self._room)
            channel.publish, channel.on_close = self._bus.publish, lambda: self._hang_up(name)
            self._begin(self._serve(channel))
        channel.take(data)

    def _hang_up(self, name: str) -> None:
        if self._channels.pop(name, None) is not None and self._bus is not None:
            _aside(self._bus.publish, name, b"")


def _opened(opening: Open, host: str, port: int, *others: Any) -> tuple[Bus, socket.socket | None]:
    """Open a bus and find its socket among those of this process."""
    before = connections_to(host, port)
    bus = opening(host, port, *others)
    after = connections_to(host, port)
    found = next((after.pop(inode) for inode in after if inode not in before), None)
    for one in (*before.values(), *after.values()):
        one.close()
    if found is not None:
        little_unsent(found)
    return bus, found


def _abandoned(made: asyncio.Future[tuple[Bus, socket.socket | None]]) -> None:
    """Close a bus whose opener has given up."""
    if not made.cancelled() and made.exception() is None:
        bus, found = made.result()
        if found is not None:
            found.close()
        _aside(bus.close)


def _aside(do: Callable[..., None], *arguments: Any) -> None:
    """Call it in a thread of its own, because it may block as long as the link does."""

    def quietly() -> None:
        with contextlib.suppress(Exception):
            do(*arguments)

    thread = threading.Thread(target=quietly, daemon=True)
    _aside_threads.add(thread)
    thread.start()


@atexit.register
def _leave() -> None:
    """Let the libraries leave: Zenoh's threads abort a program that ends under them."""
    for thread in list(_aside_threads):
        thread.join(_LEAVE_S)
