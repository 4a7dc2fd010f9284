"""Relays that share topics over NATS: robots at one, viewers at another; commands arrive once."""

import asyncio
import contextlib
import itertools
import shutil
import signal
import sys
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest
from relay_cases import ALL, client, nothing, relay, settings, stranger, until, wait, within

from bufgym.ground.errors import BufgymError
from bufgym.relay import Nats, Rule, Server, StoreLimits
from bufgym.relay.hub import Hub
from bufgym.relay.peers import Delays, Peers
from bufgym.relay.wire import Message, encode
from bufgym.robot.sockets import free_port

nats: Any = pytest.importorskip("nats", reason="no nats here: the extra mesh")
NATS_SERVER = shutil.which("nats-server") or shutil.which("nats-server", path="/usr/sbin")
pytestmark = pytest.mark.skipif(NATS_SERVER is None, reason="no nats-server here")
SHARED = Rule(nats=True, send=True, receive=True, topic="/robots/[^/]+/(odom|secret|command)")
_NUMBERS = itertools.count()


@contextlib.asynccontextmanager
async def nats_server(port: int, folder: Path, *more: str) -> AsyncIterator[Any]:
    words = [*more, "-js", "-a", "127.0.0.1", "-p", str(port), "-sd", str(folder)]
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


async def test_a_command_too_large_for_nats_is_refused_and_the_next_goes_on(relays: list[Server], robot: str) -> None:
    """NATS takes 1 MiB with the headers, for which 256 bytes are left."""
    a, b, _ = relays
    command = f"{robot}/command"
    async with client(a.port) as operator, client(b.port) as one:
        await one.subscribe(f"^{command}$")
        await operator.put(command, bytes(2**20), seq=1, no_drop=True)
        refused = await operator.next()
        assert (refused["op"], refused["code"], refused["seq"]) == ("refused", "too_large", 1)
        frame_bytes = 32 + len(command) + len("raw") + len("127.0.0.1") + 2**20
        assert refused["why"] == f"topic {command}: {frame_bytes} bytes: must be at most 1048320 for NATS"
        await operator.put(f"{robot}/odom", bytes(2**20))  # any other is dropped, and ends no connection either
        await operator.acked(command, 1)
        await one.came(1)
        await until("the audit", lambda: f"topic {robot}/odom: " in str(a.hub.audit.recent))
        assert a.hub.status()["nats"] == "connected"


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
            await bus.publish("bufgym.relay.message", data, headers={"Relay": "x", "Put": "1"})
        await wait("NATS to have all", bus.flush())
        await operator.acked(command, 1)
        await one.came(1)
        await operator.put(odometry, b"2", encoding="json")
        assert (await viewer.next())["data"] == 2
        said = " ".join(entry["why"] for entry in b.hub.audit.recent if entry.get("what") == "nats")
        assert (
            "without the headers Nats" in said
            and "headers Relay and Put" in said
            and "payload must be JSON" in said
            and "frame of 8 bytes" in said
        )
    await bus.close()


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Relays wait little for NATS."""
    for name in ("ANSWER_S", "ASK_S"):
        monkeypatch.setattr(f"bufgym.relay.bus.{name}", 0.5)
    monkeypatch.setattr("bufgym.relay.backoff.MOST_S", 0.1)


async def connected(*relays: Server) -> None:
    await until("relays to have NATS", lambda: all(each.hub.peers.state == "connected" for each in relays))


async def alone(*relays: Server) -> None:
    await until("relays to miss NATS", lambda: all(each.hub.peers.state != "connected" for each in relays))


@pytest.mark.usefixtures("hasty")
async def test_relays_hear_each_other_again_after_nats_has_stood_still(tmp_path: Path) -> None:
    """A stopped server still holds its connections. The relays give them up, and find each other on new ones."""
    port = free_port("127.0.0.1")
    async with (
        nats_server(port, tmp_path) as server,
        shared(port, "a") as a,
        shared(port, "b") as b,
        client(a.port) as robot,
        client(b.port) as viewer,
    ):
        await viewer.subscribe("odom$")
        server.send_signal(signal.SIGSTOP)
        await robot.put("/robots/a/odom", b"1")
        await alone(a, b)
        server.send_signal(signal.SIGCONT)
        await connected(a, b)
        await robot.put("/robots/a/odom", b"2")
        while bytes((await viewer.next()).payload) != b"2":
            pass


@pytest.mark.usefixtures("hasty")
async def test_a_relay_connects_again_whose_library_has_stopped_to_read(tmp_path: Path) -> None:
    """A header that is no text ends the reader of the library, which tells nobody."""
    port, broken = free_port("127.0.0.1"), b"NATS/1.0 \xff\xff\xff x\r\n\r\n"
    async with nats_server(port, tmp_path), shared(port, "a") as a, stranger(port) as (_, bus):
        bus.write(b'CONNECT {"verbose": false, "headers": true}\r\n')
        bus.write(b"HPUB bufgym.relay.message %d %d\r\n%b\r\n" % (len(broken), len(broken), broken))
        await wait("NATS to have it", bus.drain())
        await alone(a)
        await connected(a)


@pytest.mark.usefixtures("hasty")
async def test_without_nats_a_relay_serves_its_own_robots_and_joins_when_it_comes(tmp_path: Path) -> None:
    """It says how it stands. A command for a robot elsewhere is refused, not held for nobody."""
    port, command = free_port("127.0.0.1"), "/robots/a/command"
    async with shared(port, "a") as a, shared(port, "b") as b, client(a.port) as operator, client(a.port) as here:
        await here.subscribe("^/robots/a/")
        await here.subscribe("^/relay/status$", id="status")
        while b"nats" not in bytes((status := await here.next()).payload):
            pass
        assert f'"nats": "nats: nats://127.0.0.1:{port}: ' in bytes(status.payload).decode()
        assert a.hub.audit.recent[0]["event"] == "nats"
        await here.say("unsubscribe", id="status")
        await operator.acked(command, 1)
        await here.came(1)
        await operator.command(2, "/robots/b/command")
        refused = await operator.next()
        assert (refused["code"], refused["why"][-39:]) == ("no_receiver", ", and the other relays are out of reach")
        async with nats_server(port, tmp_path), client(b.port) as there:
            await connected(a, b)
            await there.subscribe("^/robots/b/")
            await operator.acked("/robots/b/command", 2)
            await there.came(1, payload=b"2")


async def test_a_message_that_comes_late_is_not_shown_as_new(relays: list[Server], robot: str) -> None:
    """Relay x's clock is an hour behind. Its messages come at once, but one 3 s late, after a freeze on the way."""
    a, _, _ = relays
    topic, now_us = f"{robot}/odom", time.time_ns() // 1000
    assert a.config.nats is not None
    bus = await wait("a connection to NATS", nats.connect(a.config.nats.url))
    async with client(a.port) as viewer:
        await viewer.subscribe(f"^{topic}$")
        for payload, late_us in ((b"1", 0), (b"2", 3_000_000), (b"3", 0)):
            headers = {"Relay": robot, "Put": str(now_us - 3_600_000_000 - late_us)}
            await bus.publish("bufgym.relay.message", encode(Message(topic, payload, "raw")), headers=headers)
        assert [bytes((await viewer.next()).payload) for _ in range(2)] == [b"1", b"3"]
        assert "later than late_s = 2" in a.hub.audit.recent[-1]["why"]
    await bus.close()


def test_a_clock_that_is_set_back_makes_messages_late_for_two_minutes_at_most() -> None:
    delays = Delays()
    assert [delays.extra_s(delay_s, now_s) for now_s, delay_s in ((0, 5), (1, 4), (30, 4.5))] == [0, 0, 0.5]
    assert [delays.extra_s(14, now_s) for now_s in (40, 61, 122)] == [10, 10, 0]


@pytest.mark.usefixtures("hasty")
async def test_commands_outlive_the_loss_of_the_stream(tmp_path: Path) -> None:
    """NATS comes back with nothing on its disk. Relay b is away meanwhile: a keeps b's place among the relays."""
    port, command = free_port("127.0.0.1"), "/robots/a/command"
    async with shared(port, "a") as a, client(a.port) as operator:
        async with (
            nats_server(port, tmp_path / "1"),
            shared(port, "b", folder=tmp_path / "b") as b,
            client(b.port, session="robot") as one,
        ):
            await one.subscribe("^/robots/", durable=True)
            await until("a to know b", lambda: a.hub.peers._known == {"a", "b"})
        await alone(a)
        async with nats_server(port, tmp_path / "2"):
            await connected(a)
            await operator.acked(command, 1)
            async with shared(port, "b", folder=tmp_path / "b") as b, client(b.port, session="robot") as one:
                await one.came(1)


@pytest.mark.usefixtures("hasty")
async def test_a_relay_that_is_gone_for_good_is_forgotten(tmp_path: Path) -> None:
    """Commands are kept for it no longer than for a session, here for a second. So it does not fill the stream."""
    port = free_port("127.0.0.1")
    async with nats_server(port, tmp_path), shared(port, "a", store=StoreLimits(keep_s=1.0)) as a:
        async with shared(port, "b", store=StoreLimits(keep_s=1.0)):
            await until("a to know b", lambda: a.hub.peers._known == {"a", "b"})
        await until("a to forget b", lambda: a.hub.peers._known == {"a"})


async def test_a_second_relay_of_a_name_is_refused(relays: list[Server]) -> None:
    """Both would take from one place, each some of the commands."""
    a, _, _ = relays
    with pytest.raises(BufgymError, match="nats: name = 'a': another relay has it; each needs its own"):
        async with relay(settings(nats=a.config.nats)):
            pass


@pytest.mark.usefixtures("hasty")
async def test_a_command_whose_answer_was_lost_arrives_once(tmp_path: Path) -> None:
    """NATS stands still: the sender's connection ends, unanswered. It comes again and sends the same again."""
    port, command = free_port("127.0.0.1"), "/robots/a/command"
    async with (
        nats_server(port, tmp_path) as server,
        shared(port, "a") as a,
        shared(port, "b") as b,
        client(b.port) as one,
    ):
        await one.subscribe("^/robots/")
        async with client(a.port, session="operator") as operator:
            server.send_signal(signal.SIGSTOP)
            await operator.command(1, command, stamp_us=1)
            with pytest.raises(Exception, match="NATS does not answer"):
                await operator.next()
        server.send_signal(signal.SIGCONT)
        await connected(a, b)
        async with client(a.port, session="operator") as operator:
            assert operator.welcome["received"] == 0
            await operator.acked(command, 1, stamp_us=1)
            await one.came(1)
            assert await nothing(one)


async def test_a_wrong_password_ends_the_start_at_once_and_is_not_told(tmp_path: Path) -> None:
    port = free_port("127.0.0.1")
    async with nats_server(port, tmp_path, "--user", "west", "--pass", "r#ght"):
        async with relay(settings(nats=Nats(f"nats://west:r%23ght@127.0.0.1:{port}", "a"))) as a:
            assert a.hub.status()["nats"] == "connected"
        with pytest.raises(BufgymError) as failed:
            async with relay(settings(nats=Nats(f"nats://west:wrong@127.0.0.1:{port}", "a"))):
                pass
        assert str(failed.value) == f"nats: nats://127.0.0.1:{port}: 'Authorization Violation'"


def test_credentials_are_looked_at_before_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The library that signs with them may be missing, and so may they."""
    credentials = tmp_path / "west.creds"
    with_them = settings(nats=Nats("nats://127.0.0.1:1", "a", str(credentials)))
    monkeypatch.setitem(sys.modules, "nkeys", None)
    with pytest.raises(BufgymError, match=r"bufgym\.relay needs nkeys: pip install "):
        Peers(Hub(with_them), with_them.nats)
    monkeypatch.setitem(sys.modules, "nkeys", object())
    with pytest.raises(BufgymError, match=r"west\.creds: no such file"):
        Peers(Hub(with_them), with_them.nats)
    credentials.write_text("a password\n")
    with pytest.raises(BufgymError, match=r"west\.creds: no NATS credentials: must have -----BEGIN NATS USER JWT-----"):
        Peers(Hub(with_them), with_them.nats)
    with pytest.raises(BufgymError, match=r"url = 'nats://west\.example': must be nats://HOST:PORT") as failed:
        Nats("nats://west:p#ss@west.example", "a")
    assert "p#ss" not in str(failed.value)
