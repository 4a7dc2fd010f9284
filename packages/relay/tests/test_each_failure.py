"""A relay's day, again and again: each time another write, send, accept or reading of the clock fails once.

A robot streams and takes commands, an operator sends them, a viewer watches, all is recorded. Whatever failed, the
relay goes on, each acked command arrives once and in order, and the recording opens.
"""

import asyncio
import contextlib
import errno
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from loop_cases import beside, compiled
from needs import needs
from relay_cases import ALL, Server, settings, until, wait
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosedError

from bufgym.model.topics import Topic
from bufgym.traces.formats import bags
from bufgym.utils.errors import BufgymError
from bufgym_relay import audit, server
from bufgym_relay.config import Rule
from bufgym_relay.hub import Hub
from bufgym_relay.recorder import FOLDER
from bufgym_relay.store import Store
from bufgym_robot.fleet.client import RobotClient
from bufgym_robot.wire import backoff
from bufgym_robot.wire.mcap_file import McapFile
from bufgym_robot.wire.session import Session

pytest.importorskip("mcap", reason=needs("extras", "mcap"))
RULES = (ALL, Rule(recorder=True, receive=True, topic="/robots/.*"))
CAMERA, COMMAND = "/robots/a/camera", "/robots/a/command"
COMMANDS = 4
FULL = OSError(errno.ENOSPC, "No space left on device")
DISK = ((McapFile, "write"), (McapFile, "flush"), (audit._Lines, "write"))


class Fails:
    """Counts what may fail; the n-th does."""

    def __init__(self, n: int) -> None:
        self.n, self.counts = n, Counter[str]()
        self.failed = ""

    def due(self, what: str) -> bool:
        self.counts[what] += 1
        due = self.counts.total() == self.n
        self.failed = what if due else self.failed
        return due

    def wrapped(self, what: str, function: Callable[..., Any], error: Exception) -> Callable[..., Any]:
        def call(*words: Any, **named: Any) -> Any:
            if self.due(what):
                raise error
            return function(*words, **named)

        return call


@contextlib.contextmanager
def failing(fails: Fails) -> Iterator[None]:
    """Within the block the n-th of these fails."""
    began, made, clock = Store.__init__, server.Accepted.connection_made, Hub.__init__

    def store(self: Store, *words: Any, **named: Any) -> None:
        began(self, *words, **named)
        held, broken = self._held, sqlite3.OperationalError("disk I/O error")
        real = held._db
        held._db = Mock(wraps=real, execute=fails.wrapped("statement", real.execute, broken))
        type(held._db).in_transaction = property(lambda _: real.in_transaction)

    def hub(self: Hub, *words: Any, **named: Any) -> None:
        clock(self, *words, **named)
        real = self.clock
        self.clock = lambda: real() + 3_600 * fails.due("clock")

    def accepted(self: Any, transport: Any) -> None:
        if fails.due("accept"):
            transport.abort()  # the peer has gone already
        made(self, transport)

    def send(real: Callable[..., Any]) -> Callable[..., Any]:
        async def call(self: ServerConnection, *words: Any) -> None:
            if fails.due("send"):
                self.transport.abort()
                raise ConnectionClosedError(None, None)
            await real(self, *words)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for kind, name, function in (
            *((Store, "__init__", store), (Hub, "__init__", hub)),
            (server.Accepted, "connection_made", accepted),
            (server.Accepted, "send_frame", send(server.Accepted.send_frame)),
            (ServerConnection, "send", send(ServerConnection.send)),
            *((kind, name, fails.wrapped(f"{kind.__name__}.{name}", getattr(kind, name), FULL)) for kind, name in DISK),
        ):
            patch.setattr(kind, name, function)
        yield


async def day(folder: Path, fails: Fails) -> None:
    came: list[int] = []
    seen: list[int] = []
    acked: list[int] = []
    with failing(fails):
        one = Server(settings(folder=folder, rules=RULES))
        url = f"ws://127.0.0.1:{await wait('a start', one.start())}"
        robot = RobotClient(url, "a", topics=(Topic(CAMERA),), policy="drop-oldest", capacity=8)
        robot.subscribe(f"^{COMMAND}$", lambda message: came.append(int(bytes(message.payload))), durable=True)
        viewer, operator = Session(url, "v"), Session(url, "o")
        viewer.subscribe(f"^{CAMERA}$", lambda message: seen.append(message.seq))
        async with beside(robot.run(), viewer.run(), operator.run()):
            for k in range(COMMANDS):
                await until("all to be ready", lambda: robot.ready.is_set() and viewer.ready.is_set())
                robot.publish(CAMERA, b"picture", "jpeg")
                with contextlib.suppress(BufgymError):
                    await wait("an answer", operator.command(COMMAND, k))
                    acked.append(k)
            await until("the commands", lambda: len(came) >= len(acked))
            before = len(seen)
            while len(seen) == before:  # the relay still forwards
                robot.publish(CAMERA, b"picture", "jpeg")
                await asyncio.sleep(0.005)
            one.hub.tick()
        await wait("an end", one.close())
    assert [k for k in came if k in acked] == acked and len(acked) >= COMMANDS - 1, fails.failed
    assert sorted(set(came)) == sorted(came), fails.failed
    recorded = sum(len(bags.read_bag(path).time_ns) for path in sorted((folder / FOLDER).glob("*.mcap")))
    # A recording whose disk is full pauses for some seconds.
    assert recorded >= len(came) + len(seen) or "McapFile" in fails.failed, fails.failed


@compiled
async def test_whatever_fails_once_the_relay_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backoff, "MOST_S", 0.01)
    calm = Fails(0)
    await day(tmp_path / "calm", calm)
    assert {"statement", "accept", "clock", "send", "McapFile.write", "_Lines.write"} <= set(calm.counts)
    for n in range(1, calm.counts.total() + 1):
        await day(tmp_path / str(n), Fails(n))
