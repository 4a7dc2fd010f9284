"""Topics: what a robot publishes side by side over one uplink, and what its operator asks for each.

The terms are Robofleet's (github ut-amrl/robofleet_client): a topic has a priority, may have a rate limit, and may be
``no_drop``. Beyond it, every topic has a weight and a V of its own, so that H = sum of weight x H of the topic, and a
deadline for those who count late messages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.errors import BufgymError
from bufgym.kernel import records
from bufgym.model.buffer import MAX_CAPACITY, TOPIC
from bufgym.model.qoi import Value

MAX_TOPICS = 256
MAX_WINDOW = 10**6
MAX_NUMBER = 1e12
NO_DEADLINE_US = 2**62


@dataclass(frozen=True)
class Topic:
    """One topic of a client's configuration."""

    name: str
    priority: float = 1.0
    """p of Robofleet's schedulers; the higher, the sooner."""
    rate_limit_hz: float | None = None
    """Messages that come sooner than 1 / rate after the last one kept are dropped; None for no limit."""
    no_drop: bool = False
    """Whether its messages may not be dropped."""
    limit: int | None = None
    """Messages of it in the buffer at most (a publisher's queue size); None for as many as the buffer holds."""
    weight: float | None = None
    """Of its H in the weighted sum; None for its priority."""
    value: Value | None = None
    """V over its coordinate; None for that of the scenario."""
    deadline_s: float | None = None
    """A message older than this when it reaches the server is late; None for never."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise BufgymError(f"topic {self.name!r}: a name must be a non-empty text")
        self._number("priority", self.priority, zero=False)
        self._number("weight", self.weight, zero=True)
        self._number("rate_limit_hz", self.rate_limit_hz, zero=False)
        self._number("deadline_s", self.deadline_s, zero=False)
        if not isinstance(self.no_drop, bool):
            raise self._wrong("no_drop", self.no_drop, "must be true or false")
        if self.limit is not None and (
            isinstance(self.limit, bool) or not isinstance(self.limit, int) or not 1 <= self.limit <= MAX_CAPACITY
        ):
            raise self._wrong("limit", self.limit, f"must be a whole number from 1 to {MAX_CAPACITY}, or none")
        if self.value is not None and not isinstance(self.value, Value):
            raise self._wrong("value", self.value, "must be a V of bufgym.model.qoi")
        if self.no_drop and self.rate_limit_hz is not None:
            raise self._wrong("rate_limit_hz", self.rate_limit_hz, "a no_drop topic can't have a rate limit: it drops")
        if self.no_drop and self.limit is not None:
            raise self._wrong("limit", self.limit, "a no_drop topic can't have a limit: it drops")

    def _number(self, name: str, number: Any, *, zero: bool) -> None:
        if number is None and name != "priority":
            return
        usable = isinstance(number, int | float) and not isinstance(number, bool) and 0 <= number <= MAX_NUMBER
        if not usable or (number == 0 and not zero):
            raise self._wrong(name, number, f"must be a number {'>= 0' if zero else '> 0'}, at most {MAX_NUMBER:g}")

    def _wrong(self, name: str, given: Any, rule: str) -> BufgymError:
        return BufgymError(f"topic {self.name!r}: {name} = {given!r}: {rule}")

    @property
    def period_us(self) -> int:
        """Least time between two messages that are kept, us, rounded down: who keeps to the limit loses none.

        0 without a rate limit.
        """
        return int(min(1e6 / self.rate_limit_hz, NO_DEADLINE_US)) if self.rate_limit_hz else 0

    @property
    def share(self) -> float:
        """Its weight in the sum of H."""
        return self.priority if self.weight is None else self.weight


def check_topics(topics: Sequence[Topic]) -> tuple[Topic, ...]:
    """These topics, or an error: each a ``Topic``, names unique."""
    known: set[str] = set()
    for topic in topics:
        if not isinstance(topic, Topic):
            raise BufgymError(f"topics: {topic!r} is not a bufgym.model.topics.Topic")
        if topic.name in known:
            raise BufgymError(f"topic {topic.name!r}: two topics have this name")
        known.add(topic.name)
    if len(topics) > MAX_TOPICS:
        raise BufgymError(f"{len(topics)} topics: must be at most {MAX_TOPICS}")
    return tuple(topics)


def copies_of(topics: Sequence[Topic], consumers: int) -> list[Topic]:
    """The topics of a client that sends one copy to each consumer; together they weigh as much as before."""
    return [
        replace(topic, name=f"{topic.name} to {c + 1}", weight=topic.share / consumers)
        for c in range(consumers)
        for topic in topics
    ]


def check_window(window: Any) -> int:
    """n_T, or an error."""
    if isinstance(window, bool) or not isinstance(window, int | np.integer) or not 1 <= window <= MAX_WINDOW:
        raise BufgymError(f"window = {window!r}: n_T must be a whole number from 1 to {MAX_WINDOW}")
    return int(window)


def check_ack_delay(ack_delay_us: Any) -> int:
    """The time from a message's crossing to its pong, us, or an error."""
    if (
        isinstance(ack_delay_us, bool)
        or not isinstance(ack_delay_us, int | np.integer)
        or not 0 <= ack_delay_us < NO_DEADLINE_US // 2
    ):
        raise BufgymError(f"ack_delay_us = {ack_delay_us!r}: must be a whole number >= 0, us")
    return int(ack_delay_us)


def topic_table(topics: Sequence[Topic], capacity: int, v: Value) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """(TOPIC[topics] with their settings, all their V in one array); without topics, one that sets no limits."""
    # A single topic with rules gets a silent companion: one row means "no rules, whatever the messages' topics".
    table = records(max(2, len(topics)) if topics else 1, TOPIC)
    arrays: list[NDArray[np.float64]] = [v.array]
    starts = {id(v): 0}
    table["priority"], table["weight"], table["limit"], table["deadline_us"] = 1.0, 1.0, capacity, NO_DEADLINE_US
    table["kept_us"] = -1  # nothing yet
    for k, topic in enumerate(topics):
        own = topic.value or v
        if id(own) not in starts:
            starts[id(own)] = sum(len(array) for array in arrays)
            arrays.append(own.array)
        row = table[k : k + 1]
        row["priority"], row["weight"], row["period_us"] = topic.priority, topic.share, topic.period_us
        row["limit"] = capacity if topic.limit is None else min(topic.limit, capacity)
        row["no_drop"], row["v_start"] = topic.no_drop, starts[id(own)]
        if topic.deadline_s is not None:
            row["deadline_us"] = round(topic.deadline_s * 1e6)
    if topics:
        table["priority"][len(topics) :] = table["weight"][len(topics) :] = 0.0  # the companion counts for nothing
    values = v.array if len(arrays) == 1 else np.concatenate(arrays)
    values.flags.writeable = False
    return table, values
