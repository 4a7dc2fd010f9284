"""Rules of subscribers' queues in plain Python, used as a ``PolicyQueue`` is.

A relay whose subscribers choose no others needs no compiler, and a third of the memory.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

from bufgym_relay.config import SKIP_PENDING


class Latest:
    """The policy ``robofleet`` for topics of equal priorities, message for message.

    It keeps the newest message of each topic. The topic that was sent longest ago goes next.
    """

    name: ClassVar = "robofleet"
    for_topics: ClassVar = True

    class Item(NamedTuple):
        """A message on its way."""

        message: Any

    def __init__(self, capacity: int) -> None:
        self.left_bytes: Callable[[], int | None] = lambda: None  # which no rule here asks
        self.dropped = 0
        self._capacity = capacity
        self._waiting: dict[int, Any] = {}
        """Topic -> its message, in order of arrival."""
        self._turns: dict[int, int] = {}
        """Topic -> when it was last chosen to go."""
        self._turn = 0
        self._going: Any = None
        self.in_flight = 0

    def put(self, message: Any, size_bytes: int, *, topic: int) -> None:
        """Queue a message in place of the last one of its topic, or in a full queue of the oldest."""
        if self.in_flight == 0:
            self._goes(topic, message)
            return
        full = len(self._waiting) >= self._capacity
        if topic in self._waiting or full:
            del self._waiting[topic if topic in self._waiting else next(iter(self._waiting))]
            self.dropped += 1
        self._waiting[topic] = message

    def get(self, timeout_s: float) -> Item:
        """Give the message that goes now."""
        return self.Item(self._going)

    def gone(self) -> None:
        """Note that it has left; the next one goes."""
        self.in_flight, self._going = 0, None
        if self._waiting:
            topic = min(self._waiting, key=lambda each: (self._turns.get(each, 0), each))
            self._goes(topic, self._waiting.pop(topic))

    def _goes(self, topic: int, message: Any) -> None:
        self._turn += 1
        self._turns[topic], self._going, self.in_flight = self._turn, message, 1

    def __len__(self) -> int:
        """Messages queued."""
        return len(self._waiting)


class SkipPending(Latest):
    """Robofleet's server rule (ut-amrl/robofleet_server): queue nothing while a message is on its way."""

    name = SKIP_PENDING
    for_topics = False

    def put(self, message: Any, size_bytes: int, *, topic: int) -> None:
        if self.in_flight:
            self.dropped += 1
        else:
            self._goes(topic, message)


PLAIN = {each.name: each for each in (Latest, SkipPending)}
