"""A disk that stands still: what must be on it waits, all else goes on, and nothing is acked before it is there."""

import asyncio
import contextlib
import json
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from loop_cases import beside
from relay_cases import client, nothing, relay, settings, until, untrusted, wait

from bufgym_relay import connection, disk
from bufgym_relay.audit import FILE, _Lines
from bufgym_relay.config import Limits, StoreLimits
from bufgym_relay.held import Held
from bufgym_relay.server import Server
from bufgym_robot.wire.session import Session

COMMAND, PICTURE = "/robots/a/command", "/robots/a/camera"


@pytest.fixture
def go(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """While it is cleared, no transaction of a store ends, nor a write of an audit log."""
    goes, transaction, write = threading.Event(), Held.transaction, _Lines.write

    @contextlib.contextmanager
    def stalling(held: Held, **how: bool) -> Iterator[None]:
        with transaction(held, **how):
            yield
            assert goes.wait(60.0)

    def writing(lines: _Lines, text: str) -> None:
        assert goes.wait(60.0)
        write(lines, text)

    monkeypatch.setattr(Held, "transaction", stalling)
    monkeypatch.setattr(_Lines, "write", writing)
    monkeypatch.setattr(disk, "STALL_S", 0.05)
    monkeypatch.setattr("bufgym_relay.server.TICK_S", 0.01)
    goes.set()
    yield goes
    goes.set()


def said_last(server: Server) -> dict[str, str]:
    """Part of the relay -> the log's last word of its disk; a busy machine's disk may stall by itself before."""
    disks = [entry for entry in server.hub.audit.recent if entry["event"].startswith("disk_")]
    return {entry["part"]: entry["event"] for entry in disks}


async def health(server: Server) -> str:
    """The status line of the answer to ``GET /healthz``, and the answer."""
    async with untrusted(server.port) as (reader, writer):
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        return str(await wait("an answer", reader.read()))


async def test_commands_wait_and_pictures_go_on(tmp_path: Path, go: threading.Event) -> None:
    """A relay killed meanwhile has none of the three commands, and none was acked. In the end each arrives, once."""
    config = settings(folder=tmp_path / "relay")
    async with (
        relay(config) as server,
        client(server.port, session="o") as operator,
        client(server.port, session="a") as robot,
    ):
        await robot.subscribe("^/robots/a/command$", durable=True)
        assert "200" in await health(server)
        go.clear()
        for seq in (1, 2, 3):
            await operator.command(seq, COMMAND)
        stalls = dict.fromkeys(("held messages", "audit log"), "disk_stalls")
        await until("its log", lambda: len(server.hub.ills) == 2 and said_last(server) == stalls)
        async with client(server.port, session="v") as viewer:
            await viewer.subscribe("camera$")
            for k in range(3):
                await operator.put(PICTURE, b"%d" % k)
                assert (await viewer.next()).payload == b"%d" % k
        assert await nothing(operator, robot)
        said = await health(server)
        assert "503" in said and "the disk stalls: held messages" in said
        shutil.copytree(tmp_path / "relay", tmp_path / "killed")
        assert said_last(server) == stalls
        go.set()
        for seq in (1, 2, 3):
            assert await operator.next() == {"op": "ack", "seq": seq}
        await robot.came(1, 2, 3)
        await robot.say("ack", seq=3)
        assert [(await operator.next())["op"] for _ in range(3)] == ["delivered"] * 3
        await until("its log", lambda: said_last(server)["held messages"] == "disk_goes_on")
        await until("its health", lambda: not server.hub.ills)
        assert await nothing(operator, robot)
    written = [json.loads(line)["event"] for line in (tmp_path / "relay" / FILE).read_text().splitlines()]
    assert written.count("joined") == 3
    async with (
        relay(settings(folder=tmp_path / "killed")) as server,
        client(server.port, session="o") as operator,
        client(server.port, session="a") as robot,
    ):
        assert operator.welcome["received"] == 0
        await operator.acked(COMMAND, 1)
        await robot.came(1)


async def test_too_much_waits_for_the_disk(
    tmp_path: Path, go: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With 800 bytes of 1,000 on their way to the disk, 300 are refused as busy; the client tries until they are held.

    A session that ends while its first command is on the way is not forgotten.
    """
    monkeypatch.setattr(connection, "BUSY_S", 0.01)
    came = list[Any]()
    config = settings(folder=tmp_path, store=StoreLimits(bytes=1_000))
    async with relay(config) as server, client(server.port, session="a") as robot:
        await robot.subscribe("^/robots/a/command$", durable=True)
        other = Session(f"ws://127.0.0.1:{server.port}", "other")
        async with beside(other.run()):
            await wait("a welcome", other.connected.wait())
            go.clear()
            async with client(server.port, session="o") as operator:
                await operator.command(1, COMMAND)
                await operator.put(COMMAND, bytes(800), seq=2, no_drop=True)
                await operator.rest()
                waiting = asyncio.ensure_future(other.command(COMMAND, "x" * 300))
                await until("refusals", lambda: server.hub.audit.refusals["busy"])
            await until("its end", lambda: len(server.hub.members) == 2)
            assert not waiting.done()
            go.set()
            for _ in range(2):
                message = await robot.next()
                came.append(bytes(message.payload)[:2])
                await robot.say("ack", seq=message.seq)
            await wait("an answer", waiting)
            async with client(server.port, session="o") as operator:
                assert operator.welcome["received"] == 1
    assert sorted(came) == [b'"x', b"1"]


async def test_a_session_whose_command_waits_keeps_its_place(tmp_path: Path, go: threading.Event) -> None:
    """One session at most. Another client is refused while the command waits; sent again, the command is taken once."""
    config = settings(folder=tmp_path, limits=Limits(sessions=1))
    async with relay(config) as server, client(server.port, local="127.0.0.2", session="a") as robot:
        await robot.subscribe("^/robots/a/command$", durable=True)
        go.clear()
        async with client(server.port, session="o") as operator:
            await operator.command(1, COMMAND)
            await operator.rest()
        await until("its end", lambda: len(server.hub.members) == 1)
        async with client(server.port, session="x") as untrusted:
            assert untrusted.welcome["code"] == "too_many"
        go.set()
        await robot.came(1)
        async with client(server.port, session="o") as operator:
            assert operator.welcome["received"] == 1
            await operator.acked(COMMAND, 1)
            assert await nothing(operator, robot)
        await until("its end", lambda: len(server.hub.members) == 1)
        async with client(server.port, session="x") as untrusted:
            assert untrusted.welcome["op"] == "welcome"
