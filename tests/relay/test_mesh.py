"""Three relays that share topics: robots at one, viewers at another; one is killed; commands arrive once."""

import asyncio
import contextlib
import ipaddress
import itertools
import json
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from relay_cases import Client, client, nothing, process, relay, settings

from bufgym.relay.config import Mesh, Rule
from bufgym.relay.server import Server
from bufgym.relay.wire import Message
from bufgym.robot.sockets import free_port

pytest.importorskip("zenoh", reason="no Zenoh here: the extra zenoh")

_NUMBERS = itertools.count()


def address() -> str:
    return f"127.0.0.1:{free_port('127.0.0.1')}"


@contextlib.asynccontextmanager
async def meshed(listen: str | Mesh, *connect: str, **changed: Any) -> AsyncIterator[Server]:
    mesh = listen if isinstance(listen, Mesh) else Mesh(listen, connect)
    async with relay(settings(policies=("drop-oldest",), mesh=mesh, **changed)) as server:
        yield server


async def found(topic: str, sender: Client, *receivers: Client) -> None:
    """Return when each hears the sender, and nothing more is on its way."""
    for k in itertools.count():
        await sender.put(topic, b"%d" % k)
        await sender.rest()
        await asyncio.sleep(0.01)
        heard = [{bytes(message.payload) for message in await one.rest()} for one in receivers]
        if all(heard):
            break
    await sender.put(topic, b"last")
    for one in receivers:
        while bytes((await one.next()).payload) != b"last":
            pass


@pytest.fixture(scope="module")
def mesh(runner: asyncio.Runner, tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Server]]:
    """The first relay knows nobody, the others know the first. The second has little room, the third few rights."""
    stack, first = contextlib.AsyncExitStack(), address()
    narrow = (Rule(address="127.0.0.1", send=True, receive=True, topic="/robots/[^/]*/odom"),)

    async def start() -> list[Server]:
        folder = tmp_path_factory.mktemp("mesh")
        room = replace(settings().store, bytes=400)
        relays = [
            meshed(first, folder=folder / "a"),
            meshed(address(), first, folder=folder / "b", store=room),
            meshed(address(), first, rules=narrow),
        ]
        return [await stack.enter_async_context(one) for one in relays]

    yield runner.run(start())
    runner.run(stack.aclose())


@pytest.fixture
def robot() -> str:
    """The beginning of the topics of a robot that no other test has."""
    return f"/robots/r{next(_NUMBERS)}"


async def test_a_viewer_sees_a_robot_at_another_relay_as_far_as_its_own_relay_allows(
    mesh: list[Server], robot: str
) -> None:
    """The rules are those of the relay where the viewer is."""
    odometry = f"{robot}/odom"
    a, b, c = mesh
    async with client(a.port, name="robot") as sender, client(b.port) as viewer, client(c.port) as guest:
        await viewer.subscribe(f"^{robot}/")
        await guest.subscribe(f"^{robot}/")
        await found(odometry, sender, viewer, guest)
        await sender.put(f"{robot}/secret", b"no")
        assert (await viewer.next()).topic == f"{robot}/secret"
        await sender.put(odometry, b"x" * 50_000, seq=7, stamp_us=5)
        message, seen = await viewer.next(), await guest.next()
        assert (message.topic, message.sender, message.seq, message.stamp_us) == (odometry, "robot", 7, 5)
        assert seen.topic == odometry and len(seen.payload) == 50_000  # once, and not the secret
        assert await nothing(sender, viewer, guest)


async def test_a_command_arrives_once_at_a_robot_of_another_relay(mesh: list[Server], robot: str) -> None:
    """It is on the disk of the robot's relay before it is acked, and comes though the robot was away."""
    a, b, _ = mesh
    command = f"{robot}/command"
    async with client(a.port, session=f"{robot[8:]}-operator") as operator:
        name = f"{robot[8:]}-robot"
        async with client(b.port, session=name) as one:
            await one.subscribe(f"^{command}$", durable=True)
            await one.subscribe(f"^{robot}/odom$", id="b")
            await found(f"{robot}/odom", operator, one)
            await operator.command(1, command)
            assert (await operator.next())["op"] == "ack"
            await one.came(1, b"1")
            await one.say("ack", seq=1)
            assert await nothing(one)
        await operator.command(2, command)  # the robot is away: its relay holds it
        assert (await operator.next())["op"] == "ack"
        assert a.hub.store.bytes == 0

        # Sent again because an answer was lost: known by its fingerprint, held once.
        message = Message(command, b"3", "json", "", "operator", 3, 1, True)
        session, held = a.hub.store.sessions["127.0.0.1", f"{robot[8:]}-operator"], b.hub.status()["held"]
        assert a.hub.others is not None
        assert [await a.hub.others.hold(session, message) for _ in range(2)] == [1, 1]
        assert b.hub.status()["held"] == held + 1
        assert await a.hub.others.hold(session, message._replace(payload=b"4", seq=4)) == 1
        assert b.hub.status()["held"] == held + 2
        async with client(b.port, session=name, received=1) as one:
            for seq in (2, 3, 4):
                await one.came(seq, b"%d" % seq)
            await one.say("ack", seq=4)
            assert await nothing(one)
            await one.say("unsubscribe", id="command")


async def test_what_nobody_receives_or_holds_at_any_relay_is_refused(mesh: list[Server], robot: str) -> None:
    a, b, _ = mesh
    command = f"{robot}/command"
    async with client(a.port) as operator, client(b.port) as one:
        await one.subscribe(f"^{robot}/odom$")
        await found(f"{robot}/odom", operator, one)
        await operator.command(1, command)
        assert (await operator.next())["code"] == "no_receiver"
        await one.subscribe(f"^{command}$", id="c")
        await operator.put(command, json.dumps("x" * 400).encode(), encoding="json", seq=1, no_drop=True)
        assert (await operator.next())["code"] == "store_full"
        await operator.command(1, command)
        assert (await operator.next())["op"] == "ack"
        await one.came(1, b"1")


async def test_a_relay_that_does_not_answer_is_asked_again(
    mesh: list[Server], robot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sender's connection ends, unanswered; it connects, and sends the same again."""
    a, command, session = mesh[0], f"{robot}/command", f"{robot[8:]}-operator"
    async with client(a.port) as one:
        await one.subscribe(f"^{command}$")
        assert a.hub.others is not None
        answers = [None, 0]

        async def hold(*_: object) -> int | None:
            return answers.pop(0)

        monkeypatch.setattr(a.hub.others, "hold", hold)
        async with client(a.port, session=session) as operator:
            await operator.command(1, command)
            with pytest.raises(Exception, match="another relay does not answer"):
                await operator.next()
        async with client(a.port, session=session) as operator:
            assert operator.welcome["received"] == 0
            await operator.command(1, command)
            assert (await operator.next())["op"] == "ack"
        assert (await one.next()).seq == 1 and await nothing(one)


async def test_with_certificates_only_relays_of_the_authority_share(tmp_path: Path) -> None:
    pytest.importorskip("cryptography", reason="no cryptography here: the extra relay")
    from cryptography import x509
    from test_identity import Authority

    first, odometry = address(), "/robots/a/odom"
    here = x509.IPAddress(ipaddress.ip_address("127.0.0.1"))
    fleet, other = Authority(tmp_path, "fleet"), Authority(tmp_path, "other")

    def files(authority: Authority, name: str) -> dict[str, str]:
        certificate, key = authority.issue(name, here)
        return {"certificate": certificate, "key": key, "authority": str(fleet.file)}

    async with (
        meshed(Mesh(first, **files(fleet, "a"))) as a,
        meshed(Mesh(address(), (first,), **files(other, "c"))) as c,
        meshed(Mesh(address(), (first,))) as d,
        meshed(Mesh(address(), (first,), **files(fleet, "b"))) as b,  # the last: others have had their time
        client(a.port) as robot,
        client(b.port) as viewer,
        client(c.port) as stranger,
        client(d.port) as plain,
    ):
        for each in (viewer, stranger, plain):
            await each.subscribe("^/robots/")
        await found(odometry, robot, viewer)
        assert await nothing(robot, stranger, plain)


@pytest.mark.nightly
async def test_a_killed_relay_takes_nothing_but_its_own(tmp_path: Path) -> None:
    """Robots at the first, a viewer at the third; the second, which introduced them to each other, is killed."""
    second, port, odometry = address(), free_port("127.0.0.1"), "/robots/a/odom"
    async with (
        process(port, tmp_path, f'[mesh]\nlisten = "{second}"\n') as killed,
        meshed(address(), second) as a,
        meshed(address(), second) as c,
        client(a.port, name="robot") as robot,
        client(c.port) as viewer,
    ):
        async with client(port) as other:
            await viewer.subscribe("odom$", capacity=100)
            await other.subscribe("odom$")
            await found(odometry, robot, viewer, other)
        for k in range(40):
            if k == 10:
                killed.kill()
                await killed.wait()
            await robot.put(odometry, str(k).encode(), seq=k)
            assert (await viewer.next()).seq == k
