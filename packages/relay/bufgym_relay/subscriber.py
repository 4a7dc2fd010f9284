"""Messages waiting for one subscriber, in queues under its policy.

A queue that is compiled takes milliseconds to make. So it is made after the first message, one at a time in the whole
relay, and the subscriber's identity has only so many.

A policy that knows topics has one queue for some thirty topics; the default, ``robofleet``, keeps the newest message of
each. Any other policy has a queue for each topic. The queue with the largest priority x wait goes next, as in
Robofleet.
"""

from __future__ import annotations

import asyncio
import zlib
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import TYPE_CHECKING, Any, Final

from bufgym_relay.plain import Latest
from bufgym_relay.policies import PLACES, Rule, new_queue
from bufgym_robot.wire.patterns import Pattern

if TYPE_CHECKING:
    from bufgym_robot.wire.queue import Item, PolicyQueue

MAX_QUEUES: Final = 64  # Limit on the queues of a subscription; further topics share queues


class Lane:
    """A queue, with a flag for a message of it on the connection."""

    def __init__(self, queue: PolicyQueue | Latest, left_bytes: Callable[[], int]) -> None:
        self.queue = queue
        self.served_s = 0.0
        self.carried = False
        queue.left_bytes = lambda: left_bytes() if self.carried else 0

    @property
    def ready(self) -> bool:
        """Whether a message can be sent."""
        return not self.carried and self.queue.in_flight > 0

    def take(self, now_s: float) -> Item | Latest.Item | None:
        """Take the next message."""
        self.carried, self.served_s = True, now_s
        return self.queue.get(0)

    def gone(self) -> None:
        """Note that the message has left."""
        self.queue.gone()
        self.carried = False


@dataclass(eq=False)
class Subscription:
    """One subscriber's request under one id, with its queues."""

    id: str
    pattern: Pattern
    policy: Rule
    capacity: int
    _: KW_ONLY
    priority: float = 1.0
    durable: bool = False
    left_bytes: Callable[[], int] = lambda: 0
    may_grow: Callable[[], bool] = lambda: True
    lanes: list[Lane] = field(init=False, default_factory=list)
    queues: int = field(init=False, default=0)
    """Its queues, made or still to be made."""
    _topics: dict[str, int] = field(init=False, default_factory=dict)
    _early: defaultdict[int, list[tuple[int, Any, int]]] = field(init=False, default_factory=lambda: defaultdict(list))
    """Number of a queue that is still to be made -> its messages: topic, message, bytes."""
    _lost: int = field(init=False, default=0)

    def offer(self, topic: str, message: Any, size_bytes: int) -> None:
        """Put a message into its queue, where the policy decides; until that is made, the newest wait."""
        lane, place = self._place(topic)
        while isinstance(self.policy, type) and self.make():  # plain Python takes no time
            pass
        if lane < len(self.lanes):
            self.lanes[lane].queue.put(message, size_bytes, topic=place)
            return
        self._early[lane].append((place, message, size_bytes))
        if len(self._early[lane]) > self.capacity + 1:
            del self._early[lane][0]
            self._lost += 1

    def _place(self, topic: str) -> tuple[int, int]:
        """Choose the topic's queue, and its place there; without a queue for it, topics share."""
        number, places = self._topics.get(topic), PLACES if self.policy.for_topics else 1
        if number is None:
            if len(self._topics) == self.queues * places and self.queues < MAX_QUEUES:
                self.queues += not self.queues or self.may_grow()
            if len(self._topics) < self.queues * places:
                number = self._topics[topic] = len(self._topics)
            else:
                number = zlib.crc32(topic.encode()) % (self.queues * places)
        return divmod(number, places)

    def make(self) -> bool:
        """Make the next queue, and put its messages there; return whether there was one to make."""
        if len(self.lanes) == self.queues:
            return False
        self.lanes.append(Lane(new_queue(self.policy, self.capacity), self.left_bytes))
        for place, message, size_bytes in self._early.pop(len(self.lanes) - 1, ()):
            self.lanes[-1].queue.put(message, size_bytes, topic=place)
        return True

    @property
    def dropped(self) -> int:
        """Messages dropped so far."""
        return self._lost + sum(lane.queue.dropped for lane in self.lanes)

    def __len__(self) -> int:
        """Messages queued."""
        return sum(map(len, self._early.values())) + sum(len(lane.queue) for lane in self.lanes)


async def make_one(subscriptions: Sequence[Subscription], turn: asyncio.Lock) -> bool:
    """Make one of their queues, in a turn of the event loop of its own; return whether there was one to make."""
    for one in subscriptions:
        if len(one.lanes) < one.queues:
            async with turn:
                made = one.make()
                await asyncio.sleep(0)
            return made
    return False


def next_lane(subscriptions: Collection[Subscription], now_s: float) -> Lane | None:
    """Choose the lane that sends next; None if nothing waits."""
    ready = [(one.priority, lane) for one in subscriptions for lane in one.lanes if lane.ready]
    return max(ready, key=lambda each: each[0] * (now_s - each[1].served_s))[1] if ready else None
