"""A queue on a link of a test's own: every time is an argument."""

from __future__ import annotations

from typing import Any

from bufgym.live import PolicyQueue
from bufgym.live.log import Record


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
