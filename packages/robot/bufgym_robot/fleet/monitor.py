"""State of a robot's queue in numbers that fit into a message, computed from its records as they happen."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from bufgym.model import qoi
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym_robot.wire.log import Record

RATE_S: Final = 1.0  # Time before now over which rates are computed
QOI_S: Final = 30.0  # Time before now whose messages count for QoI
_MOST: Final = 10_000  # messages of a topic that are remembered for its QoI


@dataclass(slots=True)
class _Put:
    """A message: its time, its coordinate x and its outcome."""

    put_s: float
    x: float
    topic: int
    size_bytes: int
    left: bool | None = None


class _Counts:
    """Counts of one topic."""

    def __init__(self) -> None:
        self.put = self.left = self.dropped = 0
        self.latest_s: float | None = None  # time at which the latest departed message was put
        self.lately: deque[_Put] = deque(maxlen=_MOST)


class Monitor:
    """Monitor of one robot's queues. Call it with every record; it reports the policy of the latest queue."""

    def __init__(
        self, topics: Sequence[Topic], value: Value | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._topics, self._value, self._clock = tuple(topics), value or qoi.exponential(), clock
        self._counts = [_Counts() for _ in topics]
        self._left: deque[tuple[float, int]] = deque()
        self._queued: dict[tuple[int, int], _Put] = {}
        self._away: dict[tuple[int, int], _Put] = {}
        self._policy, self._capacity = "", 0

    def __call__(self, number: int, record: Record) -> None:
        """Take a record of the ``number``-th queue."""
        event, now_s = record["event"], self._clock()
        if event == "settings":
            self._policy, self._capacity = record["policy"], record["capacity"]
            return
        key = number, record["seq"]
        if event == "put":
            put = self._queued[key] = _Put(now_s, record["x"], record["topic"], record["size_bytes"])
            self._counts[put.topic].put += 1
            self._counts[put.topic].lately.append(put)
        elif event == "dequeued":
            self._away[key] = self._queued.pop(key)
        elif event == "gone":
            put = self._away.pop(key)
            counts = self._counts[put.topic]
            put.left, counts.latest_s = True, put.put_s
            counts.left += 1
            self._left.append((now_s, put.size_bytes))
        else:
            put = self._queued.pop(key)
            put.left = False
            self._counts[put.topic].dropped += 1

    def state(self) -> dict[str, Any]:
        """Return the current state; ``PROTOCOL.md`` lists the fields."""
        now_s = self._clock()
        while self._left and self._left[0][0] < now_s - RATE_S:
            self._left.popleft()
        qois = [self._qoi(k, now_s) for k in range(len(self._topics))]
        weights = [topic.share for topic, part in zip(self._topics, qois, strict=True) if part is not None]
        parts, whole = [part for part in qois if part is not None], sum(weights)
        names = [topic.name for topic in self._topics]
        return {
            "policy": self._policy,
            "capacity": self._capacity,
            "queued": len(self._queued),
            "waiting": [put.topic for put in list(self._queued.values())],
            "away": len(self._away),
            "put": sum(counts.put for counts in self._counts),
            "left": sum(counts.left for counts in self._counts),
            "dropped": sum(counts.dropped for counts in self._counts),
            "rate_bps": round(8 * sum(size for _, size in self._left) / RATE_S),
            "qoi": round(sum(w * p for w, p in zip(weights, parts, strict=True)) / whole, 3) if whole else None,
            "topics": {
                name: {
                    "put": counts.put,
                    "left": counts.left,
                    "dropped": counts.dropped,
                    "age_s": None if counts.latest_s is None else round(now_s - counts.latest_s, 3),
                    "qoi": None if part is None else round(part, 3),
                }
                for name, counts, part in zip(names, self._counts, qois, strict=True)
            },
        }

    def _qoi(self, topic: int, now_s: float) -> float | None:
        """H of departed messages over H of all messages put in the last ``QOI_S``; None without messages."""
        lately = self._counts[topic].lately
        while lately and lately[0].put_s < now_s - QOI_S:
            lately.popleft()
        value = self._topics[topic].value or self._value
        settled = [put for put in list(lately) if put.left is not None]
        if not settled:
            return None
        # A new queue may count x from 0 again: only the sum of rising x is a distance.
        kept = [put for put in settled if put.left]
        most, got = (value.information(_grown([put.x for put in some])) for some in (settled, kept))
        return min(1.0, got / most)


def _grown(xs: list[float]) -> list[float]:
    """Make x continue where it falls because a new queue counts from 0."""
    grown, offset, before = [], 0.0, float("-inf")
    for x in xs:
        if x < before:
            offset += before - x
        grown.append(x + offset)
        before = x
    return grown
