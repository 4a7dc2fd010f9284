"""What strangers cannot take from a receiver: its memory, its sockets, its time."""

import asyncio
import contextlib

import pytest
from live_cases import receiving, sending
from loop_cases import until

from bufgym.robot.frames import DATA, GREETING, Frame, header

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


async def test_no_more_peers_than_it_has_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bufgym.robot.receiver.MAX_PEERS", 3)
    async with receiving() as (receiver, port, _), contextlib.AsyncExitStack() as stack:
        for _ in range(5):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            stack.callback(writer.close)
        await until(lambda: len(receiver.faults) == 2)
        assert set(receiver.faults) == {"ConnectionRefusedError: must be at most 3 connections"}
