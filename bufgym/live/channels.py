"""Connections that hide no queue: TCP as it is, and WebSocket.

A connection with the system's default buffers takes megabytes at once, and what lies there no policy can drop. So the
sender's socket gets a small send buffer, the kernel keeps little beyond what is on its way (TCP_NOTSENT_LOWAT), and
``left_bytes`` says how much the peer's kernel has not acked yet (SIOCOUTQ).
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import sys
from collections.abc import Callable
from typing import Any, Final, Protocol

from bufgym.live.extra import needs
from bufgym.live.frames import HEADER_BYTES, MAX_BODY_BYTES, Frame, FrameError, header, parse

SEND_BUFFER_BYTES: Final = 32_768
UNSENT_BYTES: Final = 16_384
"""TCP_NOTSENT_LOWAT: so much may wait in the kernel beyond what is on its way."""
DEAD_AFTER_S: Final = 20.0
"""A connection on which nothing was acked for so long is given up, where the system can tell."""
PIECE_BYTES: Final = 16_384
"""Written at a time, so that ``left_bytes`` is known while a large message is under way."""


class Channel(Protocol):
    """A connection on which frames go both ways."""

    async def send(self, frame: Frame) -> None:
        """Returns when the system has taken the last byte."""

    async def receive(self) -> Frame:
        """The next frame; a ConnectionError when there is none any more."""

    def left_bytes(self) -> int | None:
        """Bytes given to ``send`` that the peer's system has not acked; None where nobody can tell."""

    def close(self) -> None:
        """At once."""


def unacked_bytes(connection: socket.socket) -> int | None:
    """Bytes in the kernel's send queue, on their way or not (SIOCOUTQ); None where the system has no such call."""
    if not sys.platform.startswith("linux"):
        return None
    import fcntl
    import termios

    try:
        return int(struct.unpack("i", fcntl.ioctl(connection.fileno(), termios.TIOCOUTQ, b"\0\0\0\0"))[0])
    except (OSError, ValueError):  # it is closed
        return None


def small_buffers(connection: socket.socket) -> None:
    """Set a sender's socket so that little waits in the system."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    _set(connection, "TCP_NOTSENT_LOWAT", UNSENT_BYTES)


def _set(connection: socket.socket, option: str, number: int) -> None:
    """Set an option of TCP, where the system has it."""
    if hasattr(socket, option):
        connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), number)


async def _connected(host: str, port: int, small: bool = True) -> socket.socket:
    """A connected TCP socket of a sender."""
    loop = asyncio.get_running_loop()
    family, kind, protocol, _, address = (await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM))[0]
    connection = socket.socket(family, kind, protocol)
    try:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if small:
            small_buffers(connection)
            _set(connection, "TCP_USER_TIMEOUT", round(DEAD_AFTER_S * 1000))
        await loop.sock_connect(connection, address)
    except BaseException:
        connection.close()
        raise
    return connection


class TcpChannel:
    """Frames on a TCP socket, one after the other."""

    def __init__(self, connection: socket.socket, max_body_bytes: int = MAX_BODY_BYTES) -> None:
        self._socket = connection
        self._max_body_bytes = max_body_bytes
        self._unwritten_bytes = 0

    @classmethod
    async def connect(cls, host: str, port: int, *, small: bool = True) -> TcpChannel:
        """A sender's connection; ``small=False`` leaves the system's buffers as they are."""
        return cls(await _connected(host, port, small))

    async def send(self, frame: Frame) -> None:
        loop = asyncio.get_running_loop()
        head, body = header(frame), memoryview(frame.body)
        self._unwritten_bytes = len(body)
        await loop.sock_sendall(self._socket, head)
        for start in range(0, len(body), PIECE_BYTES):
            piece = body[start : start + PIECE_BYTES]
            await loop.sock_sendall(self._socket, piece)
            self._unwritten_bytes -= len(piece)

    async def receive(self) -> Frame:
        frame, body_bytes = parse(await self._exactly(HEADER_BYTES), self._max_body_bytes)
        return frame._replace(body=await self._exactly(body_bytes)) if body_bytes else frame

    async def _exactly(self, size_bytes: int) -> memoryview:
        loop, data, got = asyncio.get_running_loop(), memoryview(bytearray(size_bytes)), 0
        while got < size_bytes:
            more = await loop.sock_recv_into(self._socket, data[got:])
            if more == 0:
                raise ConnectionResetError("the peer has closed the connection")
            got += more
        return data

    def left_bytes(self) -> int | None:
        unacked = unacked_bytes(self._socket)
        return None if unacked is None else self._unwritten_bytes + unacked

    def close(self) -> None:
        self._socket.close()


class WebSocketChannel:
    """Frames as binary messages of a WebSocket (the library ``websockets``)."""

    def __init__(self, connection: Any, max_body_bytes: int = MAX_BODY_BYTES) -> None:
        self._connection = connection
        self._max_body_bytes = max_body_bytes

    @classmethod
    async def connect(cls, host: str, port: int, *, small: bool = True) -> WebSocketChannel:
        """A sender's connection; ``small=False`` leaves the library's and the system's buffers as they are."""
        with needs("websockets"):
            from websockets.asyncio.client import connect
            from websockets.exceptions import WebSocketException
        limit: dict[str, Any] = {"write_limit": (1, 0)} if small else {}
        try:
            connection = await connect(
                f"ws://{host}:{port}",
                sock=await _connected(host, port, small),
                compression=None,
                ping_interval=None,  # a slow link answers late; TCP_USER_TIMEOUT finds a dead one
                proxy=None,
                **limit,
            )
        except WebSocketException as error:
            raise ConnectionError(f"{host}:{port}: {error}") from None
        return cls(connection)

    async def send(self, frame: Frame) -> None:
        with _as_connection_errors():
            await self._connection.send(header(frame) + bytes(frame.body))

    async def receive(self) -> Frame:
        with _as_connection_errors():
            data = await self._connection.recv()
        if not isinstance(data, bytes):
            raise FrameError("a text message: must be binary")
        frame, body_bytes = parse(data, self._max_body_bytes)
        if len(data) != HEADER_BYTES + body_bytes:
            raise FrameError(f"message of {len(data)} bytes: must be {HEADER_BYTES + body_bytes}, as its header says")
        return frame._replace(body=memoryview(data)[HEADER_BYTES:])

    def left_bytes(self) -> int | None:
        transport = self._connection.transport
        unacked = unacked_bytes(transport.get_extra_info("socket"))
        return None if unacked is None else transport.get_write_buffer_size() + unacked

    def close(self) -> None:
        self._connection.transport.abort()


@contextlib.contextmanager
def _as_connection_errors() -> Any:
    """What ``websockets`` raises when a connection ends, as a ConnectionError."""
    from websockets.exceptions import WebSocketException

    try:
        yield
    except WebSocketException as error:
        raise ConnectionResetError(f"{type(error).__name__}: {error}") from None


TRANSPORTS: Final[dict[str, Callable[..., Any]]] = {"tcp": TcpChannel.connect, "websocket": WebSocketChannel.connect}
"""How a sender connects: (host, port, small=True) -> a ``Channel``."""
