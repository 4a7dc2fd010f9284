"""What strangers cannot take from a receiver: its memory, its sockets, its time."""

import asyncio
import contextlib

import pytest
from live_cases import receiving, sending
from loop_cases import until

from bufgym.robot.frames import DATA, GREETING, Frame, header
from bufgym.robot.receiver import Received

HALF = header(Frame(GREETING, 0, body=bytes(16))) + bytes(range(16)) + header(Frame(DATA, 0, body=bytes(60)))
"""A greeting, and the header of a message of 60 bytes that never comes."""


async def test_strangers_share_the_room_and_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """There is room for 100 bytes: of two that announce 60 one is hung up on, the other idles too long."""
    monkeypatch.setattr("bufgym.robot.receiver.MAX_ARRIVING_BYTES", 100)
    monkeypatch.setattr("bufgym.robot.receiver.IDLE_S", 0.2)
    async with receiving(max_body_bytes=80) as (receiver, port, came), contextlib.AsyncExitStack() as stack:
        for name in (b"a", b"b"):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            stack.callback(writer.close)
            writer.write(HALF.replace(bytes(range(16)), name * 16))
        await until(lambda: len(receiver.faults) == 2)
        first, second = receiver.faults
        assert first == "FrameError: body of 60 bytes: must wait, 40 are left for all senders"
        assert second.startswith("TimeoutError")
        async with sending(port) as (queue, _):
            queue.put(bytes(60), 60)
            await until(lambda: len(came) == 1)


async def test_one_connection_of_a_sender_at_a_time() -> None:
    """A sender comes back twice while its message is still being taken: it is never taken twice at once."""
    over, taking, most = asyncio.Event(), 0, 0

    async def take(message: Received) -> None:
        nonlocal taking, most
        taking += 1
        most = max(most, taking)
        try:
            await asyncio.Event().wait()
        finally:  # the connection has been given up, for both that follow
            while not over.is_set():
                with contextlib.suppress(asyncio.CancelledError):
                    await over.wait()
            taking -= 1

    async with receiving(take=take) as (receiver, port, came), contextlib.AsyncExitStack() as stack:
        for peers in (1, 2, 3):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            stack.callback(writer.close)
            writer.write(header(Frame(GREETING, 0, body=bytes(16))) + bytes(16) + header(Frame(DATA, 0)))
            await until(lambda peers=peers: came and receiver._peers == peers)
        await asyncio.sleep(0.01)  # time in which both ask for the first one's end
        over.set()
        await until(lambda: receiver._peers == 1 and taking == 1)
        assert most == 1


async def test_no_more_peers_than_it_has_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bufgym.robot.receiver.MAX_PEERS", 3)
    async with receiving() as (receiver, port, _), contextlib.AsyncExitStack() as stack:
        for _ in range(5):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            stack.callback(writer.close)
        await until(lambda: len(receiver.faults) == 2)
        assert set(receiver.faults) == {"ConnectionRefusedError: must be at most 3 connections"}
