"""Relays that share topics over NATS: robots at one, viewers at another; commands arrive once."""

import asyncio
import itertools
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest
from nats_cases import SHARED, nats, nats_server, needs_server, shared
from relay_cases import client, nothing, relay, settings, until, wait

from bufgym.utils.errors import BufgymError
from bufgym_relay import Rule, Server, StoreLimits, bus
from bufgym_robot.wire.messages import Message, RefusedError, encode
from bufgym_robot.wire.sockets import free_port

pytestmark = needs_server
_NUMBERS = itertools.count()


@pytest.fixture(scope="module")
async def relays(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[list[Server]]:
    """The second has little room, the third few rights."""
    port, folder = free_port("127.0.0.1"), tmp_path_factory.mktemp("nats")
    narrow = (Rule(address="127.0.0.1", send=True, receive=True, topic="/robots/[^/]*/odom"), SHARED)
    async with (
        nats_server(port, folder / "nats"),
        shared(port, "a", folder=folder / "a") as a,
        shared(port, "b", folder=folder / "b", store=StoreLimits(bytes=400)) as b,
        shared(port, "c", rules=narrow) as c,
    ):
        yield [a, b, c]


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


async def test_who_sent_a_command_is_told_why_the_relay_of_its_robot_refuses_it(
    relays: list[Server], robot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stop that the sender's relay has not heard of yet."""
    a, b, _ = relays

    def stopped(*words: Any) -> Any:
        raise RefusedError("stopped", "it was stopped by ann")

    monkeypatch.setattr(b.hub.orders, "dated", stopped)
    name = robot.rpartition("/")[2]
    async with client(a.port, session=f"{name}-o") as operator, client(b.port, session=name, robot=name):
        await operator.command(1, f"{robot}/command")
        told = {"op": "delivered", "seq": 1, "receivers": 1, "lost": 0, "why": "it was stopped by ann"}
        said = [await operator.next() for _ in range(2)]  # its answer may be quicker than NATS's
        assert told in said and {"op": "ack", "seq": 1} in said


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
            assert await operator.next() == {"op": "delivered", "seq": 1, "receivers": 1, "lost": 0}
        await operator.acked(command, 2)  # the robot is away: its relay holds it
        assert a.hub.store.held_bytes == 0

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
        frame_bytes = 32 + 10 + len(command) + len("raw") + len("127.0.0.1") + 2**20
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


async def test_a_command_that_is_refused_reaches_no_other_relay(relays: list[Server], robot: str) -> None:
    """Relay b has no room for the second beside the first, which its robot has not acked."""
    a, b, _ = relays
    command, large = f"{robot}/command", b'"%s"' % (b"x" * 200)
    async with client(b.port) as operator, client(b.port) as one, client(a.port) as viewer:
        for receiver in (one, viewer):
            await receiver.subscribe(f"^{command}$")
        for code in (None, "store_full"):
            await operator.put(command, large, encoding="json", seq=2 if code else 1, no_drop=True)
            assert (await operator.next()).get("code") == code
        for receiver in (one, viewer):
            await receiver.came(1, payload=large)
            await receiver.say("ack", seq=1)
        assert await operator.next() == {"op": "delivered", "seq": 1, "receivers": 1, "lost": 0}  # at its own relay
        await until("both acks to be kept", lambda: a.hub.store.held_bytes == b.hub.store.held_bytes == 0)
        await operator.acked(command, 2)
        for receiver in (one, viewer):
            await receiver.came(2)


async def test_what_comes_from_the_bus_is_doubted(relays: list[Server], robot: str) -> None:
    """An untrusted client on the bus sends rubbish: it is audited, nobody's connection ends, and commands go on."""
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
        for why in ("without the headers Nats", "headers Relay and Put", "payload must be JSON", "frame of 8 bytes"):
            assert why in said
    await bus.close()


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


async def test_a_second_relay_of_a_name_is_refused(relays: list[Server]) -> None:
    """Both would take from one place, each some of the commands."""
    a, _, _ = relays
    with pytest.raises(BufgymError, match="nats: name = 'a': another relay has it; each needs its own"):
        async with relay(settings(nats=a.config.nats)):
            pass


async def test_messages_wait_for_no_answer_of_nats_up_to_some_bytes(
    relays: list[Server], robot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 100 kB each the first two may be on their way, and the third fills it up: the fourth waits in its queue."""
    a, b, _ = relays
    assert a.hub.peers is not None and a.hub.peers._bus is not None
    nats_client, answered = a.hub.peers._bus._client, asyncio.Event()

    async def flush(timeout_s: float) -> None:
        await answered.wait()

    async with client(a.port) as sender, client(b.port) as viewer:
        await viewer.subscribe(f"^{robot}/")
        monkeypatch.setattr(nats_client, "flush", flush)
        for seq in range(1, 5):
            await sender.put(f"{robot}/odom", bytes(100_000), seq=seq)
            if seq < 4:
                assert (await viewer.next()).seq == seq
        assert await nothing(sender, viewer)
        answered.set()
        assert (await viewer.next()).seq == 4


async def test_a_relay_behind_a_slow_link_takes_few_messages_at_a_time(
    relays: list[Server], robot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 4 at most: the first is late, so 2 come; the last of these is late, so 1; then 2 and 4 in time, then all."""
    monkeypatch.setattr(bus, "MANY", 4)
    a, seen, heard = relays[0], list[int](), list[str]()
    assert a.config.nats is not None
    port = int(a.config.nats.url.rpartition(":")[2])

    class Late:
        def extra_s(self, delay_s: float, now_s: float) -> float:
            heard.append("late" if len(heard) in (0, 2) else "in time")
            return 9.0 if heard[-1] == "late" else 0.0

    async with shared(port, "slow") as slow, client(a.port) as sender:
        peers: Any = slow.hub.peers
        taking = peers._bus
        await until("each relay to have said its time", lambda: len(peers._delays) == len(relays))
        monkeypatch.setattr(peers, "_delays", {"a": Late()})

        async def send(k: int) -> None:
            before = taking._messages
            await sender.put(f"{robot}/odom", b"1")
            await until("it", lambda: len(heard) == k)
            if k in (1, 3, 4, 6, 10):
                await until("the next turn", lambda: taking._messages is not before)
                await taking._client.flush()
            seen.append(taking.most)

        for k in range(1, 13):
            await send(k)
    assert seen == [2, 2, 1, 2, 2, 4, 4, 4, 4, 0, 0, 0]
