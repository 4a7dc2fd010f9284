"""Relays that share topics over NATS: robots at one, viewers at another; commands arrive once."""

import asyncio
import contextlib
import itertools
import shutil
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest
from relay_cases import ALL, client, nothing, relay, settings, wait, within

from bufgym.ground.errors import BufgymError
from bufgym.relay import Nats, Rule, Server, StoreLimits
from bufgym.relay.wire import Message, encode
from bufgym.robot.sockets import free_port

nats: Any = pytest.importorskip("nats", reason="no nats here: the extra mesh")
NATS_SERVER = shutil.which("nats-server") or shutil.which("nats-server", path="/usr/sbin")
pytestmark = pytest.mark.skipif(NATS_SERVER is None, reason="no nats-server here")
SHARED = Rule(nats=True, send=True, receive=True, topic="/robots/[^/]+/(odom|secret|command)")
_NUMBERS = itertools.count()


@contextlib.asynccontextmanager
async def nats_server(port: int, folder: Path) -> AsyncIterator[Any]:
    words = ["-js", "-a", "127.0.0.1", "-p", str(port), "-sd", str(folder)]
    quiet = asyncio.subprocess.DEVNULL
    process = await asyncio.create_subprocess_exec(str(NATS_SERVER), *words, stdout=quiet, stderr=quiet)
    try:
        async with within("NATS to listen"):
            while True:
                with contextlib.suppress(OSError):
                    _, writer = await asyncio.open_connection("127.0.0.1", port)
                    writer.close()
                    break
                await asyncio.sleep(0.02)
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await wait("the end of NATS", process.wait())


def shared(port: int, name: str, **changed: Any) -> contextlib.AbstractAsyncContextManager[Server]:
    where = Nats(f"nats://127.0.0.1:{port}", name)
    return relay(settings(**{"policies": ("drop-oldest",), "nats": where, "rules": (ALL, SHARED), **changed}))


@pytest.fixture(scope="module")
def relays(runner: asyncio.Runner, tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Server]]:
    """The second has little room, the third few rights."""
    stack, port, folder = contextlib.AsyncExitStack(), free_port("127.0.0.1"), tmp_path_factory.mktemp("nats")
    narrow = (Rule(address="127.0.0.1", send=True, receive=True, topic="/robots/[^/]*/odom"), SHARED)

    async def start() -> list[Server]:
        await stack.enter_async_context(nats_server(port, folder / "nats"))
        servers = [
            shared(port, "a", folder=folder / "a"),
            shared(port, "b", folder=folder / "b", store=StoreLimits(bytes=400)),
            shared(port, "c", rules=narrow),
        ]
        return [await stack.enter_async_context(one) for one in servers]

    yield runner.run(start())
    runner.run(stack.aclose())


@pytest.fixture
def robot() -> str:
    """The beginning of the topics of a robot that no other test has."""
    return f"/robots/r{next(_NUMBERS)}"


async def test_a_viewer_sees_a_robot_at_another_relay_as_far_as_rules_allow(relays: list[Server], robot: str) -> None:
    """Rules for ``nats`` say what relays share; a viewer's own relay says what the viewer may see of it."""
    odometry = f"{robot}/odom"
    a, b, c = relays
    async with client(a.port, name="robot") as sender, client(b.port) as viewer, client(c.port) as guest:
        await viewer.subscribe(f"^{robot}/")
        await guest.subscribe(f"^{robot}/")
        await sender.put(f"{robot}/own", b"not shared")
        await sender.put(f"{robot}/secret", b"no")
        assert (await viewer.next()).topic == f"{robot}/secret"
        await sender.put(odometry, b"x" * 50_000, seq=7, stamp_us=5)
        message, seen = await viewer.next(), await guest.next()
        assert (message.topic, message.sender, message.seq, message.stamp_us) == (odometry, "robot", 7, 5)
        assert seen.topic == odometry and len(seen.payload) == 50_000  # once, and not the secret
        assert await nothing(sender, viewer, guest)


async def test_a_command_arrives_once_at_a_robot_of_another_relay(relays: list[Server], robot: str) -> None:
    a, b, _ = relays
    command, name = f"{robot}/command", f"{robot[8:]}-robot"
    async with client(a.port, session=f"{robot[8:]}-operator") as operator:
        async with client(b.port, session=name) as one:
            await one.subscribe(f"^{command}$", durable=True)
            await operator.acked(command, 1)
            await one.came(1)
            await one.say("ack", seq=1)
            assert await nothing(one)
        await operator.acked(command, 2)  # the robot is away: its relay holds it
        assert a.hub.store.bytes == 0

        # Sent again because an answer was lost: NATS knows it.
        message = Message(command, b"3", "json", "", "operator", 3, 1, True)
        session = a.hub.store.sessions["127.0.0.1", f"{robot[8:]}-operator"]
        assert a.hub.peers is not None
        assert [await a.hub.peers.hold(session, message) for _ in range(2)] == [True, True]
        assert not await a.hub.peers.hold(session, message._replace(topic="/robots/private"))
        async with client(b.port, session=name, received=1) as one:
            await one.came(2, 3)
            await one.say("ack", seq=3)
            assert await nothing(one)


async def test_a_relay_without_room_is_given_the_message_again(relays: list[Server], robot: str) -> None:
    a, b, _ = relays
    command = f"{robot}/command"
    async with client(a.port) as operator, client(b.port) as one:
        await one.subscribe(f"^{command}$")
        for seq, payload in ((1, b'"%s"' % (b"x" * 200)), (2, b'"%s"' % (b"y" * 200)), (3, b"3")):
            await operator.put(command, payload, encoding="json", seq=seq, no_drop=True)
            assert (await operator.next())["op"] == "ack"
        await one.came(1, payload=b'"%s"' % (b"x" * 200))
        assert await nothing(one)  # no room for the second, and the third waits behind it
        assert [entry["why"] for entry in b.hub.audit.recent if entry.get("what") == "nats"]
        await one.say("ack", seq=1)
        await one.came(2, payload=b'"%s"' % (b"y" * 200))
        await one.say("ack", seq=2)
        await one.came(3)


async def test_what_comes_from_the_bus_is_doubted(relays: list[Server], robot: str) -> None:
    """A stranger on the bus sends rubbish: it is audited, nobody's connection ends, and commands go on."""
    a, b, _ = relays
    command, odometry = f"{robot}/command", f"{robot}/odom"
    assert a.config.nats is not None
    bus = await wait("a connection to NATS", nats.connect(a.config.nats.url))
    async with client(a.port) as operator, client(b.port, form="json") as viewer, client(b.port) as one:
        await viewer.subscribe(f"^{odometry}$")
        await one.subscribe(f"^{command}$")
        headers = {"Nats-Msg-Id": robot, "Relay": "x"}
        frame = encode(Message(command, b"{", "json", no_drop=True))
        for data, extra in ((b"no frame", {}), (b"no frame", {"Relay": "x"}), (b"no frame", headers), (frame, headers)):
            await bus.publish("bufgym.relay.hold", data, headers=extra or None)
        for data in (b"", b"no frame", encode(Message(odometry, b"{", "json"))):
            await bus.publish("bufgym.relay.message", data)
        await wait("NATS to have all", bus.flush())
        await operator.acked(command, 1)
        await one.came(1)
        await operator.put(odometry, b"2", encoding="json")
        assert (await viewer.next())["data"] == 2
        said = " ".join(entry["why"] for entry in b.hub.audit.recent if entry.get("what") == "nats")
        assert "without the headers" in said and "payload must be JSON" in said and "frame of 8 bytes" in said
    await bus.close()


async def test_without_nats_commands_wait_and_the_rest_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sender's connection ends, unanswered. Once NATS is back it sends the same again, which arrives once."""
    port, command = free_port("127.0.0.1"), "/robots/a/command"
    for name in ("ANSWER_S", "ASK_S"):
        monkeypatch.setattr(f"bufgym.relay.peers.{name}", 0.3)
    with pytest.raises(BufgymError, match=f"nats: nats://127.0.0.1:{port}"):
        async with shared(port, "a"):
            pass
    async with contextlib.AsyncExitStack() as stack:
        async with nats_server(port, tmp_path):
            a, b = [await stack.enter_async_context(shared(port, name)) for name in "ab"]
            one = await stack.enter_async_context(client(b.port))
            await one.subscribe("^/robots/")
        here = await stack.enter_async_context(client(a.port))
        await here.subscribe("odom$")
        async with client(a.port, session="operator") as operator:
            await operator.put("/robots/a/odom", b"1")
            assert bytes((await here.next()).payload) == b"1"
            await operator.command(1, command, stamp_us=1)
            with pytest.raises(Exception, match="NATS does not answer"):
                await operator.next()
        await stack.enter_async_context(nats_server(port, tmp_path))
        while True:
            async with within("an ack over NATS"), client(a.port, session="operator") as operator:
                assert operator.welcome["received"] == 0
                await operator.command(1, command, stamp_us=1)
                with contextlib.suppress(Exception):
                    assert (await operator.next())["op"] == "ack"
                    break
        await one.came(1)
        assert await nothing(one)
