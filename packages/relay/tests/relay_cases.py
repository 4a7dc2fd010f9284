"""A relay in the test's own loop, and clients that say exactly what they are told to."""

import asyncio
import contextlib
import socket
import ssl
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import loop_cases
import pytest
from needs import needs

for library in ("websockets", "re2", "jwt"):
    pytest.importorskip(library, reason=needs("extras", library))

from websockets.asyncio.client import ClientConnection, connect  # noqa: E402
from websockets.typing import Subprotocol  # noqa: E402

from bufgym_relay.config import Config, Rule  # noqa: E402
from bufgym_relay.server import Server  # noqa: E402
from bufgym_robot.wire import messages as wire  # noqa: E402
from bufgym_robot.wire.messages import Message  # noqa: E402

PATIENCE_S = 120.0
"""Ends a wait that hangs. No test waits for it."""
ALL = Rule(address="127.0.0.0/8", send=True, receive=True, command_s=86_400)


def settings(**changed: Any) -> Config:
    """All is allowed to this machine."""
    return Config(**{"port": 0, "rules": (ALL,), "policies": ("drop-oldest", "skip-pending", "robofleet"), **changed})


@contextlib.asynccontextmanager
async def within(what: str) -> AsyncIterator[None]:
    """Fail, naming ``what`` is waited for, where the block takes too long."""
    limit = asyncio.timeout(PATIENCE_S)
    try:
        async with limit:
            yield
    except TimeoutError:
        assert not limit.expired(), f"waited {PATIENCE_S:g} s for {what}"
        raise


async def wait(what: str, done: Awaitable[Any]) -> Any:
    async with within(what):
        return await done


async def until(what: str, holds: Callable[[], Any]) -> None:
    """Return once ``holds()``."""
    await wait(what, loop_cases.until(holds))


class Client:
    """Says hello, and then what it is told to."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.welcome: dict[str, Any] = {}

    async def say(self, op: str, **fields: Any) -> None:
        await self.socket.send(wire.say(op, **fields))

    async def put(self, topic: str, payload: bytes = b"1", **fields: Any) -> None:
        await self.socket.send(wire.encode(Message(topic, payload, **{"encoding": "raw", **fields})))

    async def command(self, seq: int, topic: str, **fields: Any) -> None:
        await self.put(topic, str(seq).encode(), **{"encoding": "json", "seq": seq, "no_drop": True, **fields})

    async def next(self) -> Any:
        """What comes next: a ``Message``, or the object of a text frame."""
        data = await wait("the relay's next frame", self.socket.recv())
        return wire.decode(data) if isinstance(data, bytes) else wire.heard(data)

    async def rest(self) -> list[Any]:
        """All that still comes of what the relay has been told so far.

        The relay answers a request before it sends messages that wait. So it is asked again until nothing lies between
        two answers.
        """
        found: list[Any] = []
        for asked in range(10**6):
            before = len(found)
            await self.say("recordings")
            while not isinstance(said := await self.next(), dict) or said["op"] != "recordings":
                found.append(said)
            if asked and len(found) == before:
                break
        return found

    async def subscribe(self, topic: str, id: str = "a", **fields: Any) -> dict[str, Any]:
        await self.say("subscribe", id=id, topic=topic, **fields)
        said: dict[str, Any] = await self.next()
        return said

    async def acked(self, topic: str, *seqs: int, **fields: Any) -> None:
        """Send commands of these numbers; the relay acks each."""
        for seq in seqs:
            await self.command(seq, topic, **fields)
            assert await self.next() == {"op": "ack", "seq": seq}

    async def came(self, *seqs: int, payload: bytes | None = None) -> None:
        """The next messages have these numbers and, unless it is given, payload; they are no_drop."""
        for seq in seqs:
            message = await self.next()
            expected = (seq, b"%d" % seq if payload is None else payload, True)
            assert (message.seq, bytes(message.payload), message.no_drop) == expected


async def nothing(*clients: Client) -> bool:
    """Whether nothing comes to any of these, once the relay has taken all that they have said."""
    return not any([await one.rest() for one in clients] + [await one.rest() for one in clients])


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
    own.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
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
async def untrusted(port: int, local: str = "127.0.0.1") -> AsyncIterator[tuple[Any, Any]]:
    """A bare TCP connection: its reader and its writer."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(local, 0))
    try:
        yield reader, writer
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await wait("the end of a TCP connection", writer.wait_closed())


@contextlib.asynccontextmanager
async def relay(config: Config | None = None) -> AsyncIterator[Server]:
    """A relay with settings that no other test of the module wants."""
    server = Server(config or settings())
    await wait("a relay's start", server.start())
    try:
        yield server
    finally:
        await wait("a relay's end", server.close())


@contextlib.contextmanager
def full_disk() -> Iterator[None]:
    """No file can grow while this lasts."""
    resource = pytest.importorskip("resource", reason=needs("system", "resource"))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextlib.asynccontextmanager
async def process(port: int, folder: Path, table: str = "", command_s: float = 86_400) -> AsyncIterator[Any]:
    """A relay in a process of its own; it is killed in the end, without warning."""
    config = folder / "relay.toml"
    rule = f'[[rules]]\naddress = "127.0.0.1"\nsend = true\nreceive = true\ncommand_s = {command_s}\n'
    config.write_text(f'port = {port}\nfolder = "held"\npolicies = ["drop-oldest"]\n{rule}{table}')
    words = ["-um", "bufgym", "relay", "serve", "--config", str(config)]
    one = await asyncio.create_subprocess_exec(sys.executable, *words, stdout=asyncio.subprocess.PIPE)
    try:
        assert one.stdout is not None and b"http" in await wait("a relay's first line", one.stdout.readline())
        yield one
    finally:
        with contextlib.suppress(ProcessLookupError):
            one.kill()
        await wait("a killed relay's end", one.wait())


class Corner:
    """A test's corner of the module's relay: an address, and a robot with its topics, that no other test has."""

    def __init__(self, server: Server, number: int) -> None:
        self.server, self.hub, self.port = server, server.hub, server.port
        self.url = f"ws://127.0.0.1:{server.port}"
        self.robot = f"r{number}"
        self.address = f"127.1.{number // 250}.{1 + number % 250}"
        self.command = self.topic("command")

    def topic(self, name: str) -> str:
        return f"/robots/{self.robot}/{name}"

    def client(self, **settings: Any) -> contextlib.AbstractAsyncContextManager[Client]:
        return client(self.port, **{"local": self.address, **settings})
