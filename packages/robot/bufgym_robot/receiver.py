"""The receiving end: takes messages from any number of senders, acks each, and delivers none twice."""

import asyncio
import contextlib
import inspect
import json
import os
import socket
import time
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from bufgym.model.checks import whole
from bufgym.utils.errors import BufgymError
from bufgym_robot.ahead import Ahead
from bufgym_robot.bus_channel import BusServer
from bufgym_robot.buses import BUSES, MQTT_PORT
from bufgym_robot.channels import TRANSPORTS, Channel, TcpChannel, WebSocketChannel
from bufgym_robot.frames import (
    ACK,
    DATA,
    GOODBYE,
    GREETING,
    HEADER_BYTES,
    LATCHED,
    MAX_BODY_BYTES,
    PING,
    Frame,
    FrameError,
    Room,
)
from bufgym_robot.wire.mcap_file import McapFile
from bufgym_robot.wire.sockets import BACKOFF_S, bounded_backoff, free_port, host_port
from bufgym_robot.wire.tasks import Tasks

MAX_STREAMS: Final = 64  # Number of latest senders that are remembered
MAX_PEERS: Final = 2 * MAX_STREAMS  # Connections at a time, with those that senders have given up
MAX_ARRIVING_BYTES: Final = 2**28
"""Bodies that arrive at the same time; a sender beyond is hung up on, and tries again."""
FRAGMENT_BYTES: Final = 2**20
"""A fragment of a WebSocket's message, which the library holds as a whole before its header is seen."""
IDLE_S: Final = 600.0
"""Time for a whole frame; later the connection is closed. A sender that is still there connects again."""
_GREETING_S: Final = 20.0  # time for a sender's greeting; later the connection is closed


class Received(NamedTuple):
    """A received message."""

    stream: str
    """Sender's stream in hexadecimal digits."""
    number: int
    """Index among all messages that the sender's socket dequeued."""
    seq: int
    """Index among all messages put."""
    at_us: int
    """Time of the put by the sender's clock."""
    x: float
    topic: int
    body: bytes | memoryview
    received_ns: int
    """Time of receipt by this system's clock."""
    source: int | None = None
    """Publisher of latched state, which is no message of the queue: ``number`` is its own, ``at_us`` its publication;
    None for a message."""


@dataclass
class _Talk:
    """State of one sender's stream."""

    expected: int
    task: asyncio.Task[Any] | None = None
    """Task of its connection, ended by cancelling; closing the socket would not end it."""


class Receiver:
    """Listens and calls ``on_message`` with each ``Received`` in its sender's order, then acks it.

    Where it has to wait, ``expect`` is called with the bodies of messages that come after (``Ahead``).
    It closes the connection of a peer that breaks the protocol or sends a body larger than ``max_body_bytes``.
    """

    def __init__(
        self,
        on_message: Callable[[Received], Awaitable[None] | None],
        *,
        max_body_bytes: int = MAX_BODY_BYTES,
        expect: Callable[[bytes | memoryview], None] = lambda body: None,
    ) -> None:
        self.faults: deque[str] = deque(maxlen=100)
        """Why connections ended, the last 100."""
        self._on_message, self._expect = on_message, expect
        self._run = int.from_bytes(os.urandom(7)) + 1  # the number of this receiver, another after a restart
        self._max_body_bytes = max_body_bytes
        self._streams: OrderedDict[bytes, _Talk] = OrderedDict()
        self._room = Room(max(MAX_ARRIVING_BYTES, max_body_bytes))
        self._peers = 0
        self._tasks = Tasks()
        self._ends = contextlib.AsyncExitStack()

    async def listen(self, port: int = 0, host: str = "127.0.0.1", transport: str = "tcp") -> int:
        """Begin to listen and return the port; 0 takes any free port, or the standard one of an MQTT broker."""
        if transport == "tcp":
            listening = await listener(host, port)
            self._ends.callback(listening.close)
            self._ends.push_async_callback(self._tasks.end)
            self._tasks.begin(self._accept(listening))
            return int(listening.getsockname()[1])
        if transport in BUSES:
            port = port or (MQTT_PORT if transport == "mqtt" else free_port(host))
            bus = BusServer(self._serve, self._tasks.begin, self._max_body_bytes, self._room)
            self._ends.push_async_callback(self._tasks.end)
            self._ends.push_async_callback(bus.close)
            await bus.listen(BUSES[transport], host, port)
            return port
        if transport != "websocket":
            raise BufgymError(f"transport {transport!r}: must be one of {', '.join(TRANSPORTS)}")
        from websockets.asyncio.server import serve

        most = self._max_body_bytes
        limits: dict[str, Any] = {"max_size": (most + HEADER_BYTES, FRAGMENT_BYTES), "max_queue": 1}
        limits |= {"compression": None, "ping_interval": None}
        server = await serve(lambda one: self._serve(WebSocketChannel(one, most, self._room)), host, port, **limits)
        await self._ends.enter_async_context(server)
        return int(next(iter(server.sockets)).getsockname()[1])

    async def close(self) -> None:
        """Close all connections and stop listening."""
        await self._ends.aclose()

    async def _accept(self, listening: socket.socket) -> None:
        while True:
            connection, _ = await asyncio.get_running_loop().sock_accept(listening)
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            bounded_backoff(connection, BACKOFF_S)  # acks that a dead link lost go again soon, too
            self._tasks.begin(self._serve(TcpChannel(connection, self._max_body_bytes, self._room)))

    async def _serve(self, channel: Channel) -> None:
        """Serve one connection to its end."""
        self._peers += 1
        try:
            if self._peers > MAX_PEERS:
                raise ConnectionRefusedError(f"must be at most {MAX_PEERS} connections")
            async with asyncio.timeout(_GREETING_S):
                greeting = await channel.receive()
            async with Ahead(channel, self._expect) as frames:
                await self._take(channel, greeting, frames)
        except (OSError, TimeoutError) as error:
            self.faults.append(f"{type(error).__name__}: {error}")
        finally:
            self._peers -= 1
            channel.close()

    async def _take(self, channel: Channel, greeting: Frame, frames: Ahead) -> None:
        if greeting.kind != GREETING:
            raise FrameError(f"frame of kind {greeting.kind}: must be a greeting first")
        name = bytes(greeting.body)
        stream = self._streams.setdefault(name, _Talk(greeting.number))
        self._streams.move_to_end(name)
        while stream.task is not None and not stream.task.done():  # another connection may have come while this waits
            stream.task.cancel()  # the sender has given that connection up
            await asyncio.wait([stream.task])
        stream.task = asyncio.current_task()
        if len(self._streams) > MAX_STREAMS:
            _, oldest = self._streams.popitem(last=False)
            if oldest.task is not None:
                oldest.task.cancel()
        await channel.send(Frame(GREETING, stream.expected, self._max_body_bytes, self._run))
        while True:
            async with asyncio.timeout(IDLE_S):  # wait_for would lose a cancellation that comes with the frame
                frame = await frames.receive()
            if frame.kind == PING:
                continue
            if frame.kind == GOODBYE:
                self._streams.pop(name, None)
                return
            if frame.kind == LATCHED:
                await self._hand_on(Received(name.hex(), *frame[1:], time.time_ns(), frame.seq), frames)
                await channel.send(Frame(LATCHED, frame.number))
                continue
            if frame.kind != DATA or frame.number > stream.expected:
                what = f"frame of kind {frame.kind}, number {frame.number}"
                raise FrameError(f"{what}: must be message {stream.expected}")
            if frame.number == stream.expected:
                await self._hand_on(Received(name.hex(), *frame[1:], time.time_ns()), frames)
                stream.expected += 1
            await channel.send(Frame(ACK, frame.number))

    async def _hand_on(self, message: Received, frames: Ahead) -> None:
        answer = self._on_message(message)
        if inspect.isawaitable(answer):
            await frames.during(answer)


async def listener(host: str, port: int, receive_buffer_bytes: int | None = None) -> socket.socket:
    """Open a listening TCP socket."""
    whole("port", port, 0, 2**16 - 1)
    found = await asyncio.get_running_loop().getaddrinfo(host, port, type=socket.SOCK_STREAM)
    family, kind, protocol, _, address = found[0]
    listening = socket.socket(family, kind, protocol)
    try:
        listening.setblocking(False)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if receive_buffer_bytes is not None:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer_bytes)
        listening.bind(address)
        listening.listen()
    except OSError as error:
        listening.close()
        raise BufgymError(f"{host_port(host, port)}: {error.strerror or error}") from None
    return listening


class Recording(McapFile):
    """Recording of received messages in an MCAP file, with bodies on ``/topic_0`` and so on, the rest on
    ``/received``."""

    left_out = 0
    """Messages on topics beyond the channels of a file (``robot.mcap_file``)."""

    def __call__(self, message: Received) -> None:
        """Write one message; an ``on_message`` of ``Receiver``."""
        times, seq = (message.received_ns, message.at_us * 1000), message.seq
        body, encoding = bytes(message.body), "application/octet-stream"
        if not self.write(f"/topic_{message.topic}", body, *times, encoding=encoding, seq=seq):
            self.left_out += 1
            return
        about = {**message._asdict(), "size_bytes": len(body)}
        del about["body"]
        self.write("/received", json.dumps(about).encode(), *times, schema="bufgym.live.Received", seq=seq)
