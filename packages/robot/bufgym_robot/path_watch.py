"""A watch over the path of a sender's connection: a second connection races one on which nothing is heard.

A router with a new public address, or one that has forgotten a flow, loses its packets in silence. So does a path that
takes no full packet and says nothing. TCP repeats them for DEAD_AFTER_S or for ever, while a new connection may get
through at once. An ack of TCP is life: a slow link or a busy receiver is not silent.
"""

import asyncio
import socket
import time
from collections.abc import Awaitable, Callable
from typing import Final

from bufgym_robot.channels import Channel
from bufgym_robot.wire.sockets import PACKET_BYTES, Heard, drop_unacked, heard, moved_to, segment_bytes

PING_S: Final = 1.0  # Time without a sign of life after which a connection with nothing on its way is asked for one
SILENT_S: Final = 2.0  # Time without a sign of life after which a second connection is tried
LOOK_S: Final = 0.25  # Time between two looks
AGAIN_S: Final = 0.5  # Time between two tries of a second connection
MOST_HEADER_BYTES: Final = 72  # of IPv6 and of TCP with timestamps
SMALLER_BYTES: Final = (1200, 576)  # Packets for a path that does not take full ones


class PathWatch:
    """Makes a sender's connections, one after the other, and says when to give one up."""

    def __init__(
        self,
        connect: Callable[[], Awaitable[Channel]],
        on_silence: Callable[[Exception | None], None],
        ping: Callable[[Channel], Awaitable[None]],
    ) -> None:
        """``on_silence`` is called with a reason when a second connection is tried, and with None if the first lives.

        ``ping`` sends something small, where it would not have to wait.
        """
        self._connect, self._on_silence, self._ping = connect, on_silence, ping
        self._packet_bytes: int | None = None
        self._winner: Channel | None = None

    @property
    def ready(self) -> bool:
        """Whether a second connection has won."""
        return self._winner is not None

    async def connected(self) -> Channel:
        """Return the connection that has won, or make one."""
        if self._winner is not None:
            winner, self._winner = self._winner, None
            return winner
        return await self._made(self._packet_bytes)

    def close(self) -> None:
        """Close a connection that has won and was not taken."""
        if self._winner is not None:
            self._winner.close()

    async def watch(self, channel: Channel) -> None:
        """Raise a ConnectionAbortedError when the connection is to be given up."""
        tcp = channel.tcp()
        if tcp is None:
            await asyncio.Event().wait()
            return
        silence = _Silence(tcp)
        while True:
            if (new := moved_to(tcp)) is not None:  # what is sent to the old one does not arrive
                self._packet_bytes = None
                raise ConnectionAbortedError(f"this machine's address has become {new}")
            if silence.s() >= SILENT_S:
                await self._race(tcp, silence)
            elif silence.wants_ping():
                await self._ping(channel)
            await asyncio.sleep(LOOK_S)

    async def _race(self, tcp: socket.socket, silence: "_Silence") -> None:
        """Try second connections, one at a time, while the first is silent; raise an error once one has won."""
        reason = ConnectionAbortedError(f"no answer for {silence.s():.1f} s: connecting anew beside it")
        self._on_silence(reason)
        packet_bytes, smaller_bytes = self._packet_bytes, _smaller(self._packet_bytes)
        if silence.of_more_than(smaller_bytes):
            packet_bytes = smaller_bytes
        while silence.s() >= SILENT_S:
            winner = await self._second(packet_bytes, silence)
            if winner is None:
                continue
            if packet_bytes is not None and packet_bytes != self._packet_bytes:
                mss = segment_bytes(tcp, packet_bytes)
                reason = ConnectionAbortedError(
                    f"the path takes handshakes but no full segments: smaller segments (MSS {mss})"
                )
            self._packet_bytes, self._winner = packet_bytes, winner
            drop_unacked(tcp)
            raise reason
        self._on_silence(None)

    async def _second(self, packet_bytes: int | None, silence: "_Silence") -> Channel | None:
        """Make a connection; None if it failed or the first one was heard meanwhile."""
        making, taken = asyncio.create_task(self._made(packet_bytes)), False
        try:
            while silence.s() >= SILENT_S:
                await asyncio.wait([making], timeout=LOOK_S)
                if making.done() and silence.s() >= SILENT_S:
                    made = making.result()
                    taken = True
                    return made
        except (OSError, TimeoutError):
            await asyncio.sleep(AGAIN_S)
        finally:
            if not taken:
                making.cancel()
                making.add_done_callback(_close)
        return None

    async def _made(self, packet_bytes: int | None) -> Channel:
        PACKET_BYTES.set(packet_bytes)
        return await self._connect()


class _Silence:
    """How long a connection that waits for an answer has heard nothing."""

    def __init__(self, tcp: socket.socket) -> None:
        self._tcp, self._asked_s = tcp, time.monotonic()
        self._last: Heard | None = None

    def s(self) -> float:
        """Look again; 0 while it waits for no answer, or for the receiver to take more."""
        self._last, now_s = heard(self._tcp), time.monotonic()
        if self._last is None or not self._last.in_flight:
            self._asked_s = now_s
            return 0.0
        return min(now_s - self._asked_s, self._last.silent_s)

    def of_more_than(self, packet_bytes: int) -> bool:
        """Whether more than fits such a packet waits, and no full segment has ever got through."""
        last = self._last
        return last is not None and not last.full and last.waiting_bytes > packet_bytes - MOST_HEADER_BYTES

    def wants_ping(self) -> bool:
        """Whether nothing is on its way, and nothing was heard for ``PING_S``."""
        last = self._last
        return last is not None and last.waiting_bytes == 0 and last.silent_s >= PING_S


def _smaller(packet_bytes: int | None) -> int:
    return next((size for size in SMALLER_BYTES if packet_bytes is None or size < packet_bytes), SMALLER_BYTES[-1])


def _close(making: asyncio.Task[Channel]) -> None:
    """Close what was made too late."""
    if not making.cancelled() and making.exception() is None:
        making.result().close()
