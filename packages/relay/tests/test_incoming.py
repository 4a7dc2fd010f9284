"""Bytes that have come and are not taken: each identity and address has its share, and nobody else's is less."""

import asyncio
import contextlib
import socket
import struct
from functools import partial
from typing import Any

import pytest
from refusal_cases import refuse
from relay_cases import Client, client, relay, settings, until, wait

from bufgym.utils.errors import BufgymError
from bufgym_relay import admission
from bufgym_relay.config import Limits
from bufgym_relay.plain import SkipPending
from bufgym_relay.quota import Quota, Quotas
from bufgym_relay.rules import Identity
from bufgym_relay.subscriber import Subscription
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import Message
from bufgym_robot.wire.patterns import pattern

LIMITS = Limits(message_bytes=10**6, incoming_bytes=2 * 10**6, messages_per_s=10**6)
_BINARY, _MORE, _PING, _FIN, _MASKED = 0x02, 0x00, 0x89, 0x80, 0x80


def header(kind: int, size: int) -> bytes:
    """A client's frame begins so, with a mask of zeros."""
    return bytes([kind, _MASKED | 127]) + struct.pack("!Q", size) + bytes(4)


def one_frame() -> bytes:
    """A message of 900 kB."""
    frame = wire.encode(Message("/a", bytes(900_000), "raw"))
    return header(_FIN | _BINARY, len(frame)) + frame


def pieces() -> bytes:
    """A message of 3 kB in pieces of one byte, which take 257 bytes each in the relay."""
    frame = wire.encode(Message("/a", bytes(3_000), "raw"))
    more = b"".join(header(_MORE, 1) + frame[k : k + 1] for k in range(1, len(frame) - 1))
    return header(_BINARY, 1) + frame[:1] + more + header(_FIN | _MORE, 1) + frame[-1:]


async def begun(stack: contextlib.AsyncExitStack, server: Any, data: bytes, **who: Any) -> tuple[Client, Any]:
    """A client that has sent all but the last byte, and its connection in the relay, which has as much."""
    one = await stack.enter_async_context(client(server.port, **who))
    port = one.socket.local_address[1]
    accepted = next(each for each in server._admission.open if each.remote_address[1] == port)
    one.socket.transport.write(data[:-1])
    await until("the bytes", lambda: accepted._held_bytes > 700_000)
    return one, accepted


@pytest.mark.parametrize("data", [one_frame(), pieces()], ids=["one frame", "pieces"])
async def test_of_too_many_unfinished_messages_the_oldest_ends(data: bytes) -> None:
    """2 MB are two such messages. Of five clients of an address the first three end; one of another goes on."""
    async with relay(settings(limits=LIMITS)) as server, contextlib.AsyncExitStack() as stack:
        viewer = await stack.enter_async_context(client(server.port, local="127.0.0.3"))
        await viewer.subscribe("^/a$", capacity=100, policy="drop-oldest")
        other, other_held = await begun(stack, server, data, local="127.0.0.2")
        mine = [await begun(stack, server, data) for _ in range(5)]
        assert max(server._admission.incoming.bytes.values()) <= 2 * 10**6
        held = {one: one._held_bytes for one in server._admission.open if not one.ended}
        assert sum(held.values()) - held[other_held] <= 2 * 10**6 and len(held) == 4
        for one, _ in mine[:3]:
            await wait("its end", one.socket.wait_closed())
            assert one.socket.close_code == 1008 and "2000000 bytes" in str(one.socket.close_reason)
        for one in (other, mine[3][0], mine[4][0]):
            one.socket.transport.write(data[-1:])
            assert (await viewer.next()).topic == "/a"
        await until("no bytes", lambda: not server._admission.incoming.bytes)


async def test_a_flood_of_small_frames_is_read_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """All 2,000 pings come at once, and are read 4 kB a turn; the 1,001st within a second ends the connection.

    A message of 300 kB before them is read in one piece, with 4 kB of them. Meanwhile nothing else is received.
    """
    monkeypatch.setattr(admission, "_TURN_S", 0.0001)
    async with (
        relay(settings(limits=Limits(messages_per_s=1_000))) as server,
        client(server.port) as one,
        client(server.port, local="127.0.0.2") as viewer,
    ):
        await viewer.subscribe("^/a$")
        read = list[int]()
        (accepted,) = (each for each in server._admission.open if each.address == "127.0.0.1")
        receive = accepted.protocol.receive_data
        monkeypatch.setattr(accepted.protocol, "receive_data", lambda data: (read.append(len(data)), receive(data)))
        for _ in range(2):  # what a client says in a row comes whole, whatever the turns
            await one.put("/a", bytes(300_000))
            assert len((await viewer.next()).payload) == 300_000
        read.clear()
        frame = wire.encode(Message("/a", bytes(300_000), "raw"))
        accepted.data_received(header(_FIN | _BINARY, len(frame)) + frame + 2_000 * bytes([_PING, _MASKED, 0, 0, 0, 0]))
        accepted.recv_messages.resume()
        assert not accepted.transport.is_reading()
        assert len((await viewer.next()).payload) == 300_000
        await wait("its end", one.socket.wait_closed())
        assert one.socket.close_code == 1008 and "1000 pings" in str(one.socket.close_reason)
        assert read[:2] == [4_096, 14 + len(frame)] and 4_096 <= max(read[2:]) <= 4_101
        server.hub.audit.flush()
        assert server.hub.audit.refusals == {"too_fast": 1}


async def test_identities_of_one_address_have_a_share_together() -> None:
    """An address has 4 times an identity's: the ninth message of 900 kB ends the first, whosever it is."""
    async with relay(settings(limits=LIMITS)) as server, contextlib.AsyncExitStack() as stack:
        opened = list[Any]()
        for k in range(9):
            one, accepted = await begun(stack, server, one_frame())
            opened.append(one)
            accepted.is_of(Identity("127.0.0.1", f"{k}@x.org"))
        await wait("its end", opened[0].socket.wait_closed())
        assert "8000000 bytes" in str(opened[0].socket.close_reason)
        assert not any(one.socket.close_code for one in opened[1:])


async def test_a_message_must_become_whole_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """60 s after its beginning. Neither more bytes nor pings between the pieces prolong it; the next whole one does."""
    monkeypatch.setattr("bufgym_relay.server.TICK_S", 0.01)
    async with relay(settings()) as server, contextlib.AsyncExitStack() as stack:
        now_s = 0.0
        server.hub.clock = lambda: now_s
        slow, dripping = await begun(stack, server, pieces()[:-14])  # the last piece is missing
        busy, flowing = await begun(stack, server, pieces())
        now_s, before, held = 59.0, server.hub.received, dripping._held_bytes
        slow.socket.transport.write(header(_PING, 1) + b"x" + header(_MORE, 1) + b"x")
        busy.socket.transport.write(pieces()[-1:] + pieces()[:-1])
        await until("all of it", lambda: server.hub.received > before and dripping._held_bytes > held)
        now_s = 61.0
        await wait("its end", slow.socket.wait_closed())
        assert "not whole within 60 s" in str(slow.socket.close_reason) and not flowing.ended


def test_two_messages_must_fit() -> None:
    with pytest.raises(BufgymError, match="incoming_bytes = 10: must be at least 20, two messages"):
        Limits(message_bytes=10, incoming_bytes=10)


def test_a_robot_that_renames_its_topics_uses_up_its_own_share() -> None:
    """Of six places it has had all; a sibling gets three of them, and neither gets a fourth of the other's."""
    quota = Quota(Limits(topics=6), 0.0)
    for k in range(6):
        quota.topic(f"/{k}", "renames")
    refuse("topic /6: must be at most 6 topics", quota.topic, "/6", "renames")
    for k in range(3):
        quota.topic(f"/sibling/{k}", "sibling")
    refuse("topic /sibling/3: must be at most 6", quota.topic, "/sibling/3", "sibling")
    refuse("topic /0: must be at most 6", quota.topic, "/0", "renames")
    assert {session: list(topics) for session, topics in quota.topics.items()} == {
        "renames": ["/3", "/4", "/5"],
        "sibling": ["/sibling/0", "/sibling/1", "/sibling/2"],
    }


async def test_localhost_is_both_addresses() -> None:
    async with relay(settings(host="localhost")) as server:
        assert len(list(server._server.sockets)) == 1 + socket.has_dualstack_ipv6()  # type: ignore[union-attr]
        for one in server._server.sockets:  # type: ignore[union-attr]
            assert one.getsockname()[1] == server.port
            _, writer = await asyncio.open_connection(one.getsockname()[0], server.port)
            writer.close()


def test_identities_of_one_address_have_a_share_of_queues_together() -> None:
    """Two each, and twice that at an address: a third there has its first alone, and one elsewhere has both."""
    quotas, places = Quotas(Limits(queues=2, identities=2), lambda: 0.0), {"a": "x", "b": "x", "c": "x", "d": "y"}
    queues = list[int]()
    with contextlib.ExitStack() as stack:
        for who, address in places.items():
            one = Subscription("a", pattern(""), SkipPending, 10)
            stack.enter_context(quotas.connection(who, {"a": one}, address))
            one.may_grow = partial(quotas.may_have_queue, who, address)
            for k in range(4):
                one.offer(f"/{k}", k, 10)
            queues.append(one.queues)
    assert queues == [2, 2, 1, 2]
