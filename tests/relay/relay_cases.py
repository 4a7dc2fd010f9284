"""A relay in the test's own loop, and clients that say exactly what they are told to."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

for library in ("websockets", "re2", "jwt"):
    pytest.importorskip(library, reason=f"no {library} here: the extra relay")

from websockets.asyncio.client import ClientConnection, connect  # noqa: E402
from websockets.typing import Subprotocol  # noqa: E402

from bufgym.relay import wire  # noqa: E402
from bufgym.relay.config import Config, Rule  # noqa: E402
from bufgym.relay.server import Server  # noqa: E402
from bufgym.relay.wire import Message  # noqa: E402

ALL = Rule(address="127.0.0.1", send=True, receive=True)
COMMAND = "/robots/a/command"


def settings(**changed: Any) -> Config:
    """All is allowed to this machine."""
    return Config(**{"port": 0, "rules": (ALL,), "policies": ("drop-oldest", "skip-pending", "robofleet"), **changed})


class Client:
    """Says hello, and then what it is told to."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.welcome: dict[str, Any] = {}

    async def say(self, op: str, **fields: Any) -> None:
        await self.socket.send(wire.say(op, **fields))

    async def put(self, topic: str, payload: bytes = b"1", **fields: Any) -> None:
        await self.socket.send(wire.encode(Message(topic, payload, **{"encoding": "raw", **fields})))

    async def command(self, seq: int, topic: str = COMMAND) -> None:
        await self.put(topic, str(seq).encode(), encoding="json", seq=seq, no_drop=True)

    async def next(self, timeout_s: float = 20.0) -> Any:
        """What comes next: a ``Message``, or the object of a text frame."""
        async with asyncio.timeout(timeout_s):  # wait_for of Python 3.11 can lose a cancellation
            data = await self.socket.recv()
        return wire.decode(data) if isinstance(data, bytes) else wire.heard(data)

    async def nothing(self, for_s: float = 0.15) -> bool:
        try:
            return await self.next(for_s) is None
        except TimeoutError:
            return True

    async def subscribe(self, topic: str, id: str = "a", **fields: Any) -> dict[str, Any]:
        await self.say("subscribe", id=id, topic=topic, **fields)
        said: dict[str, Any] = await self.next()
        return said


@contextlib.asynccontextmanager
async def client(
    port: int,
    local: str = "127.0.0.1",
    tls: ssl.SSLContext | None = None,
    receive_buffer_bytes: int | None = None,
    **hello: Any,
) -> AsyncIterator[Client]:
    """Connected and welcomed, or with the refusal in ``welcome``."""
    own = socket.socket()
    if receive_buffer_bytes is not None:
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer_bytes)
    own.bind((local, 0))
    own.setblocking(False)
    stack = contextlib.AsyncExitStack()
    stack.callback(own.close)
    async with stack:
        await asyncio.get_running_loop().sock_connect(own, ("127.0.0.1", port))
        # The server pings: a client that is not read, or whose connection is taken over, would miss its own pongs.
        options = {"compression": None, "proxy": None, "ping_interval": None, "close_timeout": 0.2, "max_queue": 1}
        url = f"{'wss' if tls else 'ws'}://127.0.0.1:{port}{wire.PATH}"
        connecting = connect(url, sock=own, ssl=tls, subprotocols=[Subprotocol(wire.SUBPROTOCOL)], **options)
        one = Client(await stack.enter_async_context(connecting))
        await one.say("hello", **{"version": 1, **hello})
        one.welcome = await one.next()
        yield one


@contextlib.asynccontextmanager
async def stranger(
    port: int, local: str = "127.0.0.1"
) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """A bare TCP connection."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(local, 0))
    try:
        yield reader, writer
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


@contextlib.asynccontextmanager
async def relay(config: Config | None = None) -> AsyncIterator[Server]:
    server = Server(config or settings())
    await server.start()
    try:
        yield server
    finally:
        await server.close()


def run(story: Callable[[], Awaitable[None]], most_s: float = 60.0) -> None:
    asyncio.run(asyncio.wait_for(story(), most_s))  # type: ignore[arg-type]


def in_folder(folder: Path, **changed: Any) -> Config:
    return settings(folder=folder, **changed)
