"""Three relays that share topics: robots at one, viewers at another; one is killed; commands arrive once."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import json
import sys
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from relay_cases import COMMAND, Client, client, relay, run, settings

from bufgym.errors import BufgymError
from bufgym.live.sockets import free_port
from bufgym.relay.config import Mesh, Rule
from bufgym.relay.server import Server
from bufgym.relay.wire import Message

pytest.importorskip("zenoh", reason="no Zenoh here: the extra zenoh")

ODOMETRY = "/robots/a/odom"


def addresses(count: int) -> list[str]:
    return [f"127.0.0.1:{free_port('127.0.0.1')}" for _ in range(count)]


@contextlib.asynccontextmanager
async def meshed(listen: str | Mesh, *connect: str, **changed: Any) -> AsyncIterator[Server]:
    mesh = listen if isinstance(listen, Mesh) else Mesh(listen, connect)
    async with relay(settings(policies=("drop-oldest",), mesh=mesh, **changed)) as server:
        yield server


async def found(sender: Client, *receivers: Client) -> None:
    """Each hears the sender, and nothing more is on its way."""
    for receiver in receivers:
        for _ in range(200):
            await sender.put(ODOMETRY, b"found")
            if not await receiver.nothing(0.1):
                break
        else:
            raise AssertionError("the relays have not found each other")
    for receiver in receivers:
        while not await receiver.nothing(0.3):
            pass


def test_a_viewer_sees_a_robot_at_another_relay_as_far_as_its_own_relay_allows() -> None:
    """The first knows nobody, the others know the first; the rules are those of the relay where the viewer is."""

    async def story() -> None:
        first, second, third = addresses(3)
        narrow = (Rule(address="127.0.0.1", send=True, receive=True, topic="/robots/a/odom"),)
        async with (
            meshed(first) as a,
            meshed(second, first) as b,
            meshed(third, first, rules=narrow) as c,
            client(a.port, name="robot") as robot,
            client(b.port) as viewer,
            client(c.port) as guest,
        ):
            await viewer.subscribe("^/robots/")
            await guest.subscribe("^/robots/")
            await found(robot, viewer, guest)
            await robot.put("/robots/a/secret", b"no")
            await robot.put(ODOMETRY, b"x" * 50_000, seq=7, stamp_us=5)
            messages = [await viewer.next(), await viewer.next()]
            assert [message.topic for message in messages] == ["/robots/a/secret", ODOMETRY]
            assert (messages[1].sender, messages[1].seq, messages[1].stamp_us) == ("robot", 7, 5)
            seen = await guest.next()
            assert seen.topic == ODOMETRY and len(seen.payload) == 50_000  # once, and not the secret
            assert await guest.nothing() and await viewer.nothing() and await robot.nothing()

    run(story)


def test_a_killed_relay_takes_nothing_but_its_own(tmp_path: Path) -> None:
    """Robots at the first, a viewer at the third; the second, which introduced them to each other, is killed."""

    async def story() -> None:
        first, second, third = addresses(3)
        process = await asyncio.create_subprocess_exec(sys.executable, __file__, second, stdout=asyncio.subprocess.PIPE)
        assert process.stdout is not None
        try:
            port = int(await process.stdout.readline())
            async with (
                meshed(first, second) as a,
                meshed(third, second) as c,
                client(a.port, name="robot") as robot,
                client(c.port) as viewer,
                client(port) as other,
            ):
                await viewer.subscribe("odom$", policy="drop-oldest", capacity=100)
                await other.subscribe("odom$")
                await found(robot, viewer, other)
                for k in range(40):
                    if k == 10:
                        process.kill()
                    await robot.put(ODOMETRY, str(k).encode(), seq=k)
                    await asyncio.sleep(0.02)
                assert [(await viewer.next()).seq for _ in range(40)] == list(range(40))
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()

    run(story)


def test_a_command_arrives_once_at_a_robot_of_another_relay(tmp_path: Path) -> None:
    """It is on the disk of the robot's relay before it is acked, and comes though the robot was away."""

    async def story() -> None:
        first, second = addresses(2)
        async with (
            meshed(first, folder=tmp_path / "a") as a,
            meshed(second, first, folder=tmp_path / "b") as b,
            client(a.port, session="operator") as operator,
        ):
            async with client(b.port, session="robot") as robot:
                await robot.subscribe("command$", durable=True)
                await robot.subscribe("odom$", id="b")
                await found(operator, robot)
                await operator.command(1)
                assert (await operator.next())["op"] == "ack"
                taken = await robot.next()
                assert (taken.seq, bytes(taken.payload), taken.no_drop) == (1, b"1", True)
                await robot.say("ack", seq=1)
            await operator.command(2)  # the robot is away: its relay holds it
            assert (await operator.next())["op"] == "ack"
            async with client(b.port, session="robot", received=1) as robot:
                taken = await robot.next()
                assert (taken.seq, bytes(taken.payload)) == (2, b"2")
                await robot.say("ack", seq=2)
                await operator.command(3, "/robots/nobody/command")
                assert (await robot.next()).seq == 3  # its pattern is "command$"
                await robot.say("ack", seq=3)
                assert (await operator.next())["op"] == "ack"
            assert a.hub.store.bytes == 0

            # Sent again because an answer was lost: known by its fingerprint, held once.
            message = Message(COMMAND, b"4", "json", "", "operator", 4, 1, True)
            session = a.hub.store.sessions["127.0.0.1", "operator"]
            held = b.hub.status()["held"]
            assert a.hub.others is not None
            assert [await a.hub.others.hold(session, message) for _ in range(2)] == [1, 1]
            assert b.hub.status()["held"] == held + 1
            assert await a.hub.others.hold(session, message._replace(payload=b"5", seq=5)) == 1
            assert b.hub.status()["held"] == held + 2

    run(story)


def test_what_nobody_receives_or_holds_at_any_relay_is_refused(tmp_path: Path) -> None:
    async def story() -> None:
        first, second = addresses(2)
        async with (
            meshed(first) as a,
            meshed(second, first, store=replace(settings().store, bytes=300)) as b,
            client(a.port, session="operator") as operator,
            client(b.port, session="robot") as robot,
        ):
            await robot.subscribe("odom$")
            await found(operator, robot)
            await operator.command(1)
            assert (await operator.next())["code"] == "no_receiver"
            await robot.subscribe("command$", id="c")
            await operator.put(COMMAND, json.dumps("x" * 400).encode(), encoding="json", seq=1, no_drop=True)
            assert (await operator.next())["code"] == "store_full"
            await operator.command(1)
            assert (await operator.next())["op"] == "ack"
            assert bytes((await robot.next()).payload) == b"1"

    run(story)


def test_a_relay_that_does_not_answer_is_asked_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sender's connection ends, unanswered; it connects, and sends the same again."""

    async def story() -> None:
        (first,) = addresses(1)
        async with meshed(first) as a, client(a.port) as robot:
            await robot.subscribe("command$")
            assert a.hub.others is not None
            answers = [None, 0]

            async def hold(*_: object) -> int | None:
                return answers.pop(0)

            monkeypatch.setattr(a.hub.others, "hold", hold)
            async with client(a.port, session="operator") as operator:
                await operator.command(1)
                with pytest.raises(Exception, match="another relay does not answer"):
                    await operator.next()
            async with client(a.port, session="operator") as operator:
                assert operator.welcome["received"] == 0
                await operator.command(1)
                assert (await operator.next())["op"] == "ack"
            assert (await robot.next()).seq == 1 and await robot.nothing()

    run(story)


def test_with_certificates_only_relays_of_the_authority_share(tmp_path: Path) -> None:
    pytest.importorskip("cryptography", reason="no cryptography here: the extra relay")
    from cryptography import x509
    from test_identity import Authority

    async def story() -> None:
        first, second, third, fourth = addresses(4)
        here = x509.IPAddress(ipaddress.ip_address("127.0.0.1"))
        fleet, other = Authority(tmp_path, "fleet"), Authority(tmp_path, "other")

        def files(authority: Authority, name: str) -> dict[str, str]:
            certificate, key = authority.issue(name, here)
            return {"certificate": certificate, "key": key, "authority": str(fleet.file)}

        async with (
            meshed(Mesh(first, **files(fleet, "a"))) as a,
            meshed(Mesh(second, (first,), **files(fleet, "b"))) as b,
            meshed(Mesh(third, (first,), **files(other, "c"))) as c,
            meshed(Mesh(fourth, (first,))) as d,
            client(a.port) as robot,
            client(b.port) as viewer,
            client(c.port) as stranger,
            client(d.port) as plain,
        ):
            for each in (viewer, stranger, plain):
                await each.subscribe("^/robots/")
            await found(robot, viewer)
            assert await stranger.nothing(1.0) and await plain.nothing()

    run(story)


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ({"listen": "7421"}, "mesh: address '7421': must be HOST:PORT"),
        ({"listen": "a:1", "connect": ("b:x",)}, "mesh: address 'b:x': must be HOST:PORT"),
        ({"listen": "a:1", "key": "k"}, "mesh: certificate, key and authority: must be given together"),
    ],
)
def test_a_mesh_breaks_a_rule(given: dict[str, Any], fault: str) -> None:
    with pytest.raises(BufgymError) as caught:
        Mesh(**given)
    assert str(caught.value) == fault


async def _alone(listen: str) -> None:
    async with meshed(listen) as server:
        print(server.port, flush=True)
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(_alone(sys.argv[1]))
