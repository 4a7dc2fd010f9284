"""Messages waiting for one subscriber, in queues under its policy that are made at the first message.

A policy that knows topics has one queue for some thirty topics; the default, ``robofleet``, keeps the newest message of
each. Any other policy has a queue for each topic. The queue with the largest priority x wait goes next, as in
Robofleet.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import TYPE_CHECKING, Any, Final

from bufgym_live.relay.patterns import Pattern
from bufgym_live.relay.plain import Latest
from bufgym_live.relay.policies import PLACES, Rule, new_queue

if TYPE_CHECKING:
    from bufgym_live.robot import Item, PolicyQueue

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
    lanes: list[Lane] = field(init=False, default_factory=list)
    _topics: dict[str, int] = field(init=False, default_factory=dict)

    def offer(self, topic: str, frame: Any, size_bytes: int) -> None:
        """Put a message into its queue, where the policy decides."""
        number = self._topics.get(topic)
        if number is None:
            places = MAX_QUEUES * (PLACES if self.policy.for_topics else 1)
            if len(self._topics) < places:
                number = self._topics[topic] = len(self._topics)
            else:
                number = zlib.crc32(topic.encode()) % places
        lane, place = divmod(number, PLACES) if self.policy.for_topics else (number, 0)
        while lane >= len(self.lanes):
            self.lanes.append(Lane(new_queue(self.policy, self.capacity), self.left_bytes))
        self.lanes[lane].queue.put(frame, size_bytes, topic=place)

    @property
    def dropped(self) -> int:
        """Messages dropped so far."""
        return sum(lane.queue.dropped for lane in self.lanes)

    def __len__(self) -> int:
        """Messages queued."""
        return sum(len(lane.queue) for lane in self.lanes)


def next_lane(subscriptions: Sequence[Subscription], now_s: float) -> Lane | None:
    """Choose the lane that sends next; None if nothing waits."""
    ready = [(one.priority, lane) for one in subscriptions for lane in one.lanes if lane.ready]
    return max(ready, key=lambda each: each[0] * (now_s - each[1].served_s))[1] if ready else None
