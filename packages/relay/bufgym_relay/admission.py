"""Connections before they are let in, and the bytes that have come from each and are not taken yet.

Whoever sends the beginnings of large messages, or many small pieces, uses up its own share of the relay's memory.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter, deque
from collections.abc import Callable, Generator
from functools import partial
from typing import Any, Final
from urllib.parse import urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.frames import DATA_OPCODES, Frame
from websockets.http11 import Request
from websockets.protocol import Event, State

from bufgym_relay import turns
from bufgym_relay.config import Limits
from bufgym_relay.hub import Hub
from bufgym_relay.rules import Identity, Permissions, plain_address
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import RefusedError
from bufgym_robot.wire.sockets import BACKOFF_S, DEAD_AFTER_S, bounded_backoff, little_unsent, set_option

POLICY_VIOLATION: Final = 1008
_OTHER_METHODS: Final = frozenset(b"HEAD POST PUT DELETE CONNECT OPTIONS TRACE PATCH".split())
_CLOSE_S: Final = 1.0  # time for a client to answer that its connection is closed
_FRAME_BYTES: Final = 256  # memory of a frame beside its bytes
_SLICE_BYTES: Final = 4_096  # bytes behind a frame that are read without a look at the clock; they may be 680 frames
_TURN_S: Final = 0.005  # time for which what has come is read; the rest waits for the next turn of the event loop


class Incoming:
    """Bytes that have come and are not taken, of each identity and of each address."""

    def __init__(self, limits: Limits, clock: Callable[[], float]) -> None:
        self._limits, self._clock = limits, clock
        self.bytes: dict[str, int] = {}
        """Identity, or address behind "@" -> bytes, more than none."""
        self._waiting: dict[Accepted, tuple[float, int]] = {}
        """Connection -> when its last message was whole or its first byte came, s, and bytes; oldest first."""

    def count(self, one: Accepted, size_bytes: int, anew: bool = False) -> None:
        """Note how many bytes of a connection wait; where its share is full, the one that waits longest is ended.

        ``anew`` says that one of its messages has become whole.
        """
        since_s, before = self._waiting.get(one, (self._clock(), 0))
        if anew or not size_bytes:
            self._waiting.pop(one, None)
            since_s = self._clock()
        if size_bytes:
            self._waiting[one] = since_s, size_bytes
        for who in one.shares:
            if now := self.bytes.pop(who, 0) + size_bytes - before:
                self.bytes[who] = now
        for who, most in one.shares.items():
            while self.bytes.get(who, 0) > most:
                oldest = next(each for each in self._waiting if who in each.shares)
                oldest.fail("too_many", f"must be at most {most} bytes of messages that are not whole or not taken")

    def end_late(self) -> None:
        """End connections whose message has not become whole in the time that a pong may take behind it."""
        for one, (since_s, _) in list(self._waiting.items()):
            if self._clock() - since_s < wire.PONG_S:
                break
            if one.is_partial:
                one.fail("too_slow", f"message not whole within {wire.PONG_S:g} s")

    def shares(self, identity: Identity) -> dict[str, int]:
        """Give the most bytes of an identity, and the most of its address."""
        most = self._limits.incoming_bytes
        return {identity.key: most, f"@{identity.address}": most * self._limits.identities}


class Admission:
    """Admission of connections to the handshake."""

    def __init__(self, hub: Hub) -> None:
        self.hub = hub
        self.waiting: Counter[str] = Counter()
        """Address -> its connections that have not said hello."""
        self.open: set[Accepted] = set()
        self.incoming = Incoming(hub.config.limits, lambda: hub.clock())

    def enter(self, one: Accepted) -> None:
        """Count a new connection.

        Raises RefusedError: too many.
        """
        limits = self.hub.config.limits
        if len(self.open) >= limits.all_connections:
            raise RefusedError("too_many", f"must be at most {limits.all_connections} connections in all")
        if self.waiting[one.address] >= limits.connections:
            raise RefusedError("too_many", f"must be at most {limits.connections} connections that have not said hello")
        self.open.add(one)
        self.waiting[one.address] += 1

    def refusal(self, address: str, request: Request) -> RefusedError | None:
        """Give the reason to deny this request, or None."""
        config = self.hub.config
        by_address = Permissions(config.rules, Identity(address)).rules
        proves_more = config.tokens is not None or (config.tls is not None and config.tls.clients != "")
        if not by_address and not (proves_more and any(rule.email for rule in config.rules)):
            return RefusedError("unauthorized", "no rule allows anything to this address")
        origins = request.headers.get_all("Origin")
        if "Upgrade" in request.headers and any(not self._is_own(each, request) for each in origins):
            return RefusedError("unauthorized", f"origin {origins[0]!r}: a page of another server")
        return None

    def _is_own(self, origin: str, request: Request) -> bool:
        """Whether the connecting page is ours or named in the configuration.

        Otherwise a page of any server could use the address of its viewer's machine. A foreign name can resolve to our
        address, so a host counts as our own only if it is an address, localhost or named in the configuration.
        """
        if origin in self.hub.config.origins:
            return True
        try:
            parts = urlsplit(origin)
            host = parts.hostname or ""
            if host != "localhost":
                plain_address(host)
        except ValueError:
            return False
        return parts.netloc in request.headers.get_all("Host")


class Accepted(ServerConnection):
    """A TCP connection, from its first byte on."""

    def __init__(self, admission: Admission, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self._admission = admission
        self.address = ""
        self.shares: dict[str, int] = {}
        """Whom its bytes count for -> the most bytes."""
        self._waits = False
        self._whole: deque[int] = deque()
        """Bytes of each whole message, the one that is being worked on first."""
        self._whole_bytes = self._part_bytes = 0
        self._unread = b""
        reader, self._wanted_bytes = self.protocol.reader, 0
        reader.read_exact = partial(self._read_exact, reader.read_exact)  # type: ignore[method-assign]
        self._working = self._anew = False
        self.ended = False
        """Whether it has used too much, so that nothing more is read or done of it."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self.recv_messages.resume = self._resume
        try:
            self.address = plain_address(transport.get_extra_info("peername")[0])
            self.is_of(Identity(self.address))
            self._admission.enter(self)
        except (TypeError, IndexError):  # the peer has gone already
            self.transport.abort()
            return
        except RefusedError as refused:
            self.refused(refused.code, refused)
            self.transport.abort()
            return
        self._waits = True
        tcp = transport.get_extra_info("socket")
        with contextlib.suppress(OSError):
            set_option(tcp, "TCP_USER_TIMEOUT", round(DEAD_AFTER_S * 1000))
            bounded_backoff(tcp, BACKOFF_S)  # so a stop is there a second after a dead link's return
            if self._admission.hub.config.small_buffers:
                little_unsent(tcp)

    def greeted(self) -> None:
        """Note that the client has said hello, or has gone."""
        if self._waits:
            self._waits = False
            self._admission.waiting[self.address] -= 1
            if not self._admission.waiting[self.address]:
                del self._admission.waiting[self.address]

    def is_of(self, identity: Identity) -> None:
        """Count its bytes for this identity."""
        self._admission.incoming.count(self, 0)
        self.shares = self._admission.incoming.shares(identity)
        self._count()

    def data_received(self, data: bytes) -> None:
        if self.request is None and not self.ended and data.partition(b" ")[0] in _OTHER_METHODS:
            self._not_allowed(data.partition(b" ")[0].decode())
        under_way = bool(self._unread)
        self._unread += b"" if self.ended else data
        if not under_way:
            self._read(_TURN_S)

    def _not_allowed(self, method: str) -> None:
        """Answer a request that is no GET; the library knows no other, and would end the connection without a word."""
        self.ended = True
        self.refused("wrong", f"method {method}: must be GET")
        body = b"" if method == "HEAD" else b"only GET\n"
        head = (
            f"HTTP/1.1 405 Method Not Allowed\r\nAllow: GET\r\nConnection: close\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        self.transport.write(head.encode() + body)
        self.loop.call_later(_CLOSE_S, self.transport.close)  # a body that is on its way would reset the connection

    def eof_received(self) -> None:
        self._read(float("inf"))
        super().eof_received()

    def _read(self, most_s: float) -> None:
        """Read what has come, for so long; the rest follows in further turns."""
        began_s = turns.clock()
        while self._unread and not self.ended and turns.clock() - began_s < most_s:
            size = _SLICE_BYTES + max(0, self._wanted_bytes - len(self.protocol.reader.buffer))
            data, self._unread = self._unread[:size], self._unread[size:]
            super().data_received(data)
        self._count()
        self._admission.hub.turns.note(self.address, began_s)
        if self._unread and not self.ended:
            self.transport.pause_reading()
            self.loop.call_soon(self._read, _TURN_S)
        else:
            self._resume()

    def _resume(self) -> None:
        if not (self._unread or self.recv_messages.paused):
            self.transport.resume_reading()

    def _read_exact(self, read: Callable[[int], Generator[None, None, bytearray]], n: int) -> Generator[Any, Any, Any]:
        """Note how many bytes the frame lacks, as long as it does."""
        self._wanted_bytes = n
        data = yield from read(n)
        self._wanted_bytes = 0
        return data

    def process_event(self, event: Event) -> None:
        if self.ended:
            return
        super().process_event(event)
        if isinstance(event, Frame) and not (event.fin and event.opcode in DATA_OPCODES):
            hub = self._admission.hub
            if not hub.quotas.of(next(iter(self.shares))).frames.take(1, hub.clock()):
                most = f"must be at most {hub.config.limits.messages_per_s} pings, pongs and pieces a second"
                self.fail("too_fast", most)
        if isinstance(event, Frame) and event.opcode in DATA_OPCODES:
            self._part_bytes += len(event.data) + _FRAME_BYTES
            if event.fin:
                self._whole.append(self._part_bytes)
                self._whole_bytes, self._part_bytes = self._whole_bytes + self._part_bytes, 0
                self._anew = True

    async def recv(self, decode: bool | None = None) -> Any:
        """Receive the next message; the last one counts no more."""
        if self._working:
            self._whole_bytes -= self._whole.popleft()
            self._count()
        self._working = False
        data = await super().recv(decode)
        self._working = True
        return data

    def _count(self) -> None:
        anew, self._anew = self._anew, False
        self._admission.incoming.count(self, 0 if self.ended else self._held_bytes, anew)

    async def send_frame(self, frame: bytes) -> None:
        """Send a whole frame, which was written for all its receivers."""
        await self.until_open()
        self.transport.write(frame)
        await self.drain()

    async def until_open(self) -> None:
        """Raise ConnectionClosed, once a connection that is not open has ended."""
        if self.protocol.state is not State.OPEN:
            async with self.send_context():
                pass

    @property
    def takes_more(self) -> bool:
        """Whether a frame could be written now, with none before it that has not left."""
        return self.protocol.state is State.OPEN and not self.paused and not self.transport.is_closing()

    @property
    def _held_bytes(self) -> int:
        return len(self._unread) + len(self.protocol.reader.buffer) + self._part_bytes + self._whole_bytes

    @property
    def is_partial(self) -> bool:
        """Whether the rest of a message is missing, and would be read."""
        return bool(self.protocol.reader.buffer or self._part_bytes) and not self.recv_messages.paused

    def fail(self, code: str, why: str) -> None:
        """End it at once, with the bytes that wait."""
        self.ended = True
        self._unread = b""
        self.refused(code, why)
        self._count()
        self.protocol.fail(POLICY_VIOLATION, why)
        self.send_data()
        self.loop.call_later(_CLOSE_S, self.transport.abort)

    def connection_lost(self, exc: Exception | None) -> None:
        if self in self._admission.open:
            self._admission.open.remove(self)
            if self.response is None:
                fault = self.protocol.handshake_exc
                self.refused("wrong", f"{type(fault).__name__}: {fault}" if fault else "no whole request in time")
            self.greeted()
        self.ended = True
        self._count()
        super().connection_lost(exc)

    def refused(self, code: str, why: object) -> None:
        """Log why it was not let in."""
        self._admission.hub.audit.repeated(what="connection", code=code, address=self.address, why=str(why))
