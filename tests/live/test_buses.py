"""Zenoh, MQTT and DDS: libraries that hide their sockets, held to one message at a time by the receiver's acks."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

import pytest
from live_cases import meeting_port, slowly

from bufgym.cli import live as command
from bufgym.live import PolicyQueue
from bufgym.live import sender as sending
from bufgym.live.bus_channel import BusChannel
from bufgym.live.buses import BUSES
from bufgym.live.channels import TRANSPORTS
from bufgym.live.frames import DATA, Frame
from bufgym.live.receiver import Received, Receiver
from bufgym.live.sender import Sender

BODY = bytes(50_000)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sending, "RETRY_S", 0.05)


def within(work: Coroutine[Any, Any, None]) -> None:
    """Run it; a deadlock is an error."""
    asyncio.run(asyncio.wait_for(work, 40))


def numbers(came: list[Received]) -> list[int]:
    return [message.number for message in came]


def test_the_command_knows_every_transport() -> None:
    assert tuple(TRANSPORTS) == command.TRANSPORTS


@pytest.mark.parametrize("transport", BUSES)
def test_a_slow_receiver_and_what_the_policy_drops(transport: str, request: pytest.FixtureRequest) -> None:
    """A message every 10 ms, taken in 50: without a window the library would hold most of the 60, and none is dropped.

    With one ack at a time the queue does: of 60 at most 4 lie there, about 12 + 4 come in time.
    """
    meeting = meeting_port(transport, request)

    async def story() -> None:
        came: list[Received] = []
        receiver = Receiver(slowly(came))
        port = await receiver.listen(meeting, transport=transport)
        queue = PolicyQueue("drop-oldest", 4)
        sender = Sender(queue, lambda: TRANSPORTS[transport]("127.0.0.1", port))
        task = asyncio.create_task(sender.run())
        await sender.connected.wait()
        for _ in range(60):
            queue.put(BODY, len(BODY))
            await asyncio.sleep(0.01)
        queue.close()
        await task
        await receiver.close()
        assert numbers(came) == list(range(len(came))) and came[-1].seq == 59
        assert len(came) + queue.dropped == 60 and queue.dropped > 15
        assert all(bytes(message.body) == BODY for message in came)
        assert not sender.faults and not receiver.faults

    within(story())


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_receiver_that_goes_and_comes_back(transport: str, request: pytest.FixtureRequest) -> None:
    """The sender, idle, sees it go, and is there for the next one: which knows of no message 0, and expects none."""
    meeting = meeting_port(transport, request)

    async def story() -> None:
        first: list[Received] = []
        second: list[Received] = []
        receiver = Receiver(first.append)
        port = await receiver.listen(meeting, transport=transport)
        queue = PolicyQueue("drop-oldest", 4)
        sender = Sender(queue, lambda: TRANSPORTS[transport]("127.0.0.1", port))
        task = asyncio.create_task(sender.run())
        await sender.connected.wait()
        queue.put(BODY, len(BODY))
        while not first:
            await asyncio.sleep(0.01)
        await receiver.close()
        while not sender.faults:
            await asyncio.sleep(0.01)
        queue.put(BODY, len(BODY))
        receiver = Receiver(second.append)
        await receiver.listen(port, transport=transport)
        queue.close()
        await task
        await receiver.close()
        assert numbers(first) == [0] and numbers(second)[-1] == 1

    within(story())


@pytest.mark.parametrize("transport", BUSES)
def test_who_does_not_greet_is_hung_up_on(transport: str, request: pytest.FixtureRequest) -> None:
    meeting = meeting_port(transport, request)

    async def story() -> None:
        receiver = Receiver(lambda message: None)
        port = await receiver.listen(meeting, transport=transport)
        channel = await BusChannel.connect(BUSES[transport], "127.0.0.1", port)
        await channel.send(Frame(DATA, 0))
        with pytest.raises(ConnectionResetError):
            await channel.receive()
        channel.close()
        await receiver.close()
        assert "must be a greeting first" in receiver.faults[0]

    within(story())


@pytest.mark.parametrize("transport", ["zenoh", "mqtt"])
def test_nobody_there_is_tried_again(transport: str, request: pytest.FixtureRequest) -> None:
    meeting_port(transport, request)

    async def story() -> None:
        sender = Sender(PolicyQueue("afr", 4), lambda: TRANSPORTS[transport]("127.0.0.1", 1))
        task = asyncio.create_task(sender.run())
        while len(sender.faults) < 2:
            await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    within(story())
