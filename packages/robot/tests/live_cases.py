"""A queue on a link of a test's own, where every time is an argument; and which transports there are here."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from loop_cases import beside
from needs import needs

from bufgym_robot import PolicyQueue
from bufgym_robot.channels import TRANSPORTS
from bufgym_robot.frames import DATA, GREETING, Frame
from bufgym_robot.receiver import Received, Receiver
from bufgym_robot.sender import Sender
from bufgym_robot.wire.log import Record

LIBRARIES = {"websocket": "websockets", "zenoh": "zenoh", "mqtt": "paho.mqtt"}

VALIDATE = [
    *("-mbufgym", "live", "validate", "--trace", "lte-synthetic-3", "--scale", "0.4"),
    *("--duration", "4", "--policies", "min-motion-gap", "--transport"),
]
"""One short run in real time, over what stands behind it."""


def as_simulated(folder: Path) -> bool:
    """Whether the run in this folder, over ROS and in real time, is close to the simulator's; quiet: within 3 %."""
    [seen] = json.loads((folder / "runs.json").read_text())["runs"]
    print(seen["live_qoi"], seen["simulated_qoi"], seen["live_delivered"], seen["simulated_delivered"])
    return all(abs(seen[f"live_{name}"] / seen[f"simulated_{name}"] - 1) < 0.3 for name in ("qoi", "delivered"))


def meeting_port(transport: str, request: pytest.FixtureRequest) -> int:
    """Where a receiver listens: any port, or over MQTT the broker's; skips what is not installed."""
    if transport in LIBRARIES:
        pytest.importorskip(LIBRARIES[transport], reason=needs("extras", LIBRARIES[transport]))
    return int(request.getfixturevalue("broker_port")) if transport == "mqtt" else 0


def in_order(came: list[Received]) -> bool:
    """Whether each came once, in order."""
    return [message.number for message in came] == list(range(len(came)))


@contextlib.asynccontextmanager
async def receiving(
    port: int = 0,
    transport: str = "tcp",
    take: Callable[[Received], Awaitable[None] | None] | None = None,
    **given: Any,
) -> AsyncIterator[tuple[Receiver, int, list[Received]]]:
    """A receiver, its port, and what has come; ``take`` is called with each message too."""
    came: list[Received] = []

    def on_message(message: Received) -> Awaitable[None] | None:
        came.append(message)
        return None if take is None else take(message)

    receiver = Receiver(on_message, **given)
    port = await receiver.listen(port, transport=transport)
    try:
        yield receiver, port, came
    finally:
        await receiver.close()


@contextlib.asynccontextmanager
async def sending(
    port: int, transport: str = "tcp", leaves: Any = "acked", policy: str = "drop-oldest", **given: Any
) -> AsyncIterator[tuple[PolicyQueue, Sender]]:
    """A queue of four and its sender, which in the end sends all that is queued."""
    queue = PolicyQueue(policy, 4, **given)
    sender = Sender(queue, lambda: TRANSPORTS[transport]("127.0.0.1", port), leaves)
    async with beside(sender.run()) as (task,):
        yield queue, sender
        queue.close()
        await task


def put(queue: PolicyQueue, messages: int, size_bytes: int = 50_000) -> None:
    """At once; no more than four are ever queued."""
    for _ in range(messages):
        queue.put(bytes(size_bytes), size_bytes)
        assert len(queue) <= 4


class Channel:
    """A channel whose system wants more when told so, and whose receiver acks when told so."""

    def __init__(self, hidden: bool = False) -> None:
        self.answers: asyncio.Queue[Frame] = asyncio.Queue()
        self.wanted = asyncio.Semaphore(0)
        self.sent: list[int] = []
        self.hidden = hidden

    async def send(self, frame: Frame) -> None:
        if frame.kind == GREETING:
            self.answers.put_nowait(Frame(GREETING, 0, 1000))
        elif frame.kind == DATA:
            self.sent.append(frame.number)

    async def receive(self) -> Frame:
        return await self.answers.get()

    async def until_wanted(self) -> bool:
        if not self.hidden:
            await self.wanted.acquire()
        return not self.hidden

    def left_bytes(self) -> int | None:
        return None

    def tcp(self) -> None:
        return None

    def close(self) -> None:
        pass


class Bench:
    """A queue whose clock is ``us`` and whose log is ``records``."""

    def __init__(self, policy: Any = "afr", capacity: int = 3, **settings: Any) -> None:
        self.us = 0
        self.left = 0
        self.records: list[Record] = []
        self.queue = PolicyQueue(
            policy, capacity, log=self.records.append, clock=lambda: self.us / 1e6, **{"seed": 0, **settings}
        )
        self.queue.left_bytes = lambda: self.left

    def put(self, at_us: int, size_bytes: int = 1000, **settings: Any) -> int:
        self.us = at_us
        return self.queue.put(f"message at {at_us}", size_bytes, at_us=at_us, **settings)

    def take(self) -> Any:
        """The message that the socket has dequeued, None if there is none now."""
        with contextlib.suppress(TimeoutError):
            return self.queue.get(timeout_s=0)

    def gone(self, at_us: int) -> Any:
        """What is in transmission has left; the message that follows it."""
        self.us = at_us
        self.queue.gone()
        return self.take()

    def events(self, event: str) -> list[Record]:
        return [record for record in self.records if record["event"] == event]
