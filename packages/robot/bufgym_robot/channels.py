"""Connections that hide no queue: TCP, WebSocket, and the table of all transports."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final, Protocol

from bufgym_robot.bus_channel import BusChannel
from bufgym_robot.buses import BUSES
from bufgym_robot.frames import HEADER_BYTES, MAX_BODY_BYTES, Frame, Room, header, parse, whole
from bufgym_robot.wire.sockets import BACKOFF_S, connected, host_port, unsent_bytes, until_writable

PIECE_BYTES: Final = 16_384
"""Bytes written at a time, so that ``left_bytes`` is known while a large message is under way."""


class Channel(Protocol):
    """A connection on which frames go both ways."""

    async def send(self, frame: Frame) -> None:
        """Send a frame; return when the system has taken the last byte."""

    async def receive(self) -> Frame:
        """Receive the next frame; raise a ConnectionError when there are no more."""

    async def until_wanted(self) -> bool:
        """Wait until the system wants more bytes, whatever is in flight; False at once if the socket is hidden."""

    def left_bytes(self) -> int | None:
        """Bytes given to ``send`` that the system has not sent; None if unknown."""

    def tcp(self) -> socket.socket | None:
        """Its TCP socket, to look at; None if hidden."""

    def close(self) -> None:
        """Close at once."""


class TcpChannel:
    """Frames on a TCP socket, one after the other."""

    def __init__(
        self, connection: socket.socket, max_body_bytes: int = MAX_BODY_BYTES, room: Room | None = None
    ) -> None:
        self._socket = connection
        self._max_body_bytes = max_body_bytes
        self._room = room or Room(max_body_bytes)
        self._unwritten_bytes = 0

    @classmethod
    async def connect(cls, host: str, port: int, *, small: bool = True, backoff_s: float = BACKOFF_S) -> TcpChannel:
        """Connect a sender; ``small=False`` leaves the system's buffers as they are."""
        return cls(await connected(host, port, small, backoff_s))

    async def send(self, frame: Frame) -> None:
        loop = asyncio.get_running_loop()
        head, body = header(frame), memoryview(frame.body)
        self._unwritten_bytes = len(body)
        for start in range(0, max(len(body), 1), PIECE_BYTES):
            piece = body[start : start + PIECE_BYTES]
            await loop.sock_sendall(self._socket, piece if start else head + piece)
            self._unwritten_bytes -= len(piece)

    async def receive(self) -> Frame:
        frame, body_bytes = parse(await self._exactly(HEADER_BYTES), self._max_body_bytes)
        with self._room.taken(body_bytes):
            return frame._replace(body=await self._exactly(body_bytes)) if body_bytes else frame

    async def _exactly(self, size_bytes: int) -> memoryview:
        loop, data, got = asyncio.get_running_loop(), memoryview(bytearray(size_bytes)), 0
        while got < size_bytes:
            more = await loop.sock_recv_into(self._socket, data[got:])
            if more == 0:
                raise ConnectionResetError("the peer has closed the connection")
            got += more
        return data

    async def until_wanted(self) -> bool:
        await until_writable(self._socket)
        return True

    def left_bytes(self) -> int | None:
        unsent = unsent_bytes(self._socket)
        return None if unsent is None else self._unwritten_bytes + unsent

    def tcp(self) -> socket.socket:
        return self._socket

    def close(self) -> None:
        self._socket.close()


class WebSocketChannel:
    """Frames as binary messages of a WebSocket (the library ``websockets``), in fragments."""

    def __init__(self, connection: Any, max_body_bytes: int = MAX_BODY_BYTES, room: Room | None = None) -> None:
        self._connection = connection
        self._max_body_bytes = max_body_bytes
        self._room = room or Room(max_body_bytes)
        self._unwritten_bytes = 0

    @classmethod
    async def connect(
        cls, host: str, port: int, *, small: bool = True, backoff_s: float = BACKOFF_S
    ) -> WebSocketChannel:
        """Connect a sender; ``small=False`` leaves the library's and the system's buffers as they are."""
        from websockets.asyncio.client import connect
        from websockets.exceptions import WebSocketException

        limit: dict[str, Any] = {"write_limit": (1, 0)} if small else {}
        limit["ping_interval"] = None  # a slow link answers late; TCP_USER_TIMEOUT finds a dead one
        try:
            taken = await connected(host, port, small, backoff_s)
            connection = await connect(
                f"ws://{host_port(host, port)}", sock=taken, compression=None, proxy=None, **limit
            )
        except WebSocketException as error:
            raise ConnectionError(f"{host_port(host, port)}: {error}") from None
        return cls(connection)

    async def send(self, frame: Frame) -> None:
        with _as_connection_errors():
            await self._connection.send(self._fragments(header(frame), memoryview(frame.body)))

    def _fragments(self, head: bytes, body: memoryview) -> Iterator[bytes]:
        yield head
        for start in range(0, len(body), PIECE_BYTES):
            self._unwritten_bytes = len(body) - start
            yield bytes(body[start : start + PIECE_BYTES])
        self._unwritten_bytes = 0

    async def receive(self) -> Frame:
        """Receive the next frame; its body takes room once its header is there, and no more than it announces."""
        data, most_bytes, taken = bytearray(), HEADER_BYTES, contextlib.ExitStack()
        with taken, _as_connection_errors():
            async for fragment in self._connection.recv_streaming(decode=False):
                data += fragment
                if len(data) >= HEADER_BYTES == most_bytes:
                    _, body_bytes = parse(data[:HEADER_BYTES], self._max_body_bytes)
                    taken.enter_context(self._room.taken(body_bytes))
                    most_bytes += body_bytes
                if len(data) > most_bytes:
                    break
        return whole(bytes(data), self._max_body_bytes)

    async def until_wanted(self) -> bool:
        await until_writable(self._connection.transport.get_extra_info("socket"))
        return True

    def left_bytes(self) -> int | None:
        transport = self._connection.transport
        unsent = unsent_bytes(transport.get_extra_info("socket"))
        waiting = self._unwritten_bytes + transport.get_write_buffer_size()
        return None if unsent is None else waiting + unsent

    def tcp(self) -> socket.socket | None:
        tcp: socket.socket | None = self._connection.transport.get_extra_info("socket")
        return tcp

    def close(self) -> None:
        self._connection.transport.abort()


@contextlib.contextmanager
def _as_connection_errors() -> Any:
    """Convert errors of ``websockets`` at a connection's end to a ConnectionError."""
    from websockets.exceptions import WebSocketException

    try:
        yield
    except WebSocketException as error:
        raise ConnectionResetError(f"{type(error).__name__}: {error}") from None


TRANSPORTS: Final[dict[str, Callable[..., Any]]] = {
    "tcp": TcpChannel.connect,
    "websocket": WebSocketChannel.connect,
    **{name: partial(BusChannel.connect, opening) for name, opening in BUSES.items()},
}
"""Transport -> function that connects a sender: (host, port, small=True, backoff_s=BACKOFF_S) -> a ``Channel``."""
