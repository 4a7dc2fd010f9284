"""A queue on a link of a test's own, where every time is an argument; and which transports there are here."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from bufgym.live import PolicyQueue
from bufgym.live.channels import TRANSPORTS
from bufgym.live.log import Record
from bufgym.live.receiver import Received

LIBRARIES = {"websocket": "websockets", "zenoh": "zenoh", "mqtt": "paho.mqtt", "dds": "cyclonedds"}
OVER_TCP = [transport for transport in TRANSPORTS if transport != "dds"]
"""What goes through a shaped link."""

VALIDATE = [
    *("-mbufgym", "live", "validate", "--trace", "lte-synthetic-3", "--scale", "0.4"),
    *("--duration", "4", "--policies", "min-motion-gap", "--transport"),
]
"""One short run in real time, over what stands behind it."""


def as_simulated(seen: dict[str, Any]) -> bool:
    """Whether a run over ROS is close to the simulator's; of a busy machine more is not asked."""
    near = abs(seen["live_qoi"] / seen["simulated_qoi"] - 1) < 0.1
    return near and abs(seen["live_delivered"] - seen["simulated_delivered"]) <= 0.15 * seen["simulated_delivered"]


def meeting_port(transport: str, request: pytest.FixtureRequest) -> int:
    """Where a receiver listens: any port, or over MQTT the broker's; skips what is not installed."""
    if transport in LIBRARIES:
        pytest.importorskip(LIBRARIES[transport], reason=f"no {LIBRARIES[transport]} here")
    return int(request.getfixturevalue("broker_port")) if transport == "mqtt" else 0


def slowly(came: list[Received]) -> Callable[[Received], Awaitable[None]]:
    """What a receiver that takes 50 ms for each message hands it to; they end in ``came``."""

    async def take(message: Received) -> None:
        came.append(message)
        await asyncio.sleep(0.05)

    return take


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
        try:
            return self.queue.get(timeout_s=0)
        except TimeoutError:
            return None

    def gone(self, at_us: int) -> Any:
        """What is in transmission has left; the message that follows it."""
        self.us = at_us
        self.queue.gone()
        return self.take()

    def events(self, event: str) -> list[Record]:
        return [record for record in self.records if record["event"] == event]
