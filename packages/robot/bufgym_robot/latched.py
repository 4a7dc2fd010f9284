"""Latched state: the last message of each publisher of a topic, which is owed to the receiver until it has acked it.

It stands beside the queue. A policy never drops it, and a newer message of the same publisher takes its place.
"""

import asyncio
import threading
from collections.abc import Collection
from dataclasses import dataclass


@dataclass
class State:
    """The last message of one publisher."""

    number: int
    """Index among all that were put; acks have it."""
    topic: int
    source: int
    """The publisher's number, the same as long as it lives."""
    message: bytes
    at_us: int
    """Time of its publication."""
    acked: bool = False


class Latched:
    """States by topic and publisher, for any thread that puts and one ``Sender`` that sends them."""

    def __init__(self) -> None:
        self._states: dict[tuple[int, int], State] = {}  # in the order of their numbers
        self.number = 0
        """Number of the state that is put next."""
        self._lock = threading.Lock()
        self._waiting: tuple[asyncio.AbstractEventLoop, asyncio.Event] | None = None

    def put(self, topic: int, source: int, message: bytes, at_us: int) -> None:
        """Put a publisher's new state; the same publication once more changes nothing."""
        with self._lock:
            before = self._states.get((topic, source))
            if before is None or (before.at_us, before.message) != (at_us, message):
                self._renew(State(0, topic, source, message, at_us))

    def sources(self, topic: int) -> list[int]:
        """Publishers of the topic that have a state."""
        with self._lock:
            return [source for number, source in self._states if number == topic]

    def count(self, topic: int) -> tuple[int, int]:
        """Count the topic's states, and those of them that are owed."""
        with self._lock:
            owed = [not state.acked for state in self._states.values() if state.topic == topic]
        return len(owed), sum(owed)

    def keep(self, topic: int, living: Collection[int]) -> None:
        """Forget states of the topic's publishers that live no more.

        The others are owed again: a receiver keeps the latest, as many as there are publishers.
        """
        with self._lock:
            own = [state for state in self._states.values() if state.topic == topic]
            gone = [state for state in own if state.source not in living]
            for state in gone:
                del self._states[topic, state.source]
            for state in own if gone else []:
                if state.source in living:
                    self._renew(state)

    def owe_all(self) -> None:
        """Owe every state again, because the receiver is another one."""
        with self._lock:
            for state in self._states.values():
                state.acked = False

    def ack(self, number: int) -> None:
        """Owe the state of this number no more; nothing happens if a newer one has taken its place."""
        with self._lock:
            for state in self._states.values():
                state.acked |= state.number == number

    def owed(self, after: int = -1) -> State | None:
        """Find the oldest state owed whose number is greater than ``after``."""
        with self._lock:
            return self._owed(after)

    async def next(self, after: int) -> State:
        """Wait for ``owed``."""
        while True:
            with self._lock:
                if (state := self._owed(after)) is not None:
                    return state
                changed = asyncio.Event()
                self._waiting = asyncio.get_running_loop(), changed
            await changed.wait()

    def _owed(self, after: int) -> State | None:
        return next((one for one in self._states.values() if one.number > after and not one.acked), None)

    def _renew(self, state: State) -> None:
        self._states.pop((state.topic, state.source), None)
        self._states[state.topic, state.source] = state
        state.number, state.acked = self.number, False
        self.number += 1
        if self._waiting is not None:
            loop, changed = self._waiting
            self._waiting = None
            loop.call_soon_threadsafe(changed.set)
