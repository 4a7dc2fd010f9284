"""Topics: the streams that a robot publishes side by side over one uplink, with the operator's rules for each.

The terms come from Robofleet [sikand2021robofleet]: a topic has a priority, may have a rate limit, and may be
``no_drop``. Beyond Robofleet, every topic has a weight and a V of its own, so H is the sum of weight x H over topics.
A topic may also have a deadline, after which its messages count as late.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, records
from bufgym.model.buffer import MAX_CAPACITY, TOPIC
from bufgym.model.checks import is_number, whole
from bufgym.model.qoi import Value
from bufgym.utils.errors import BufgymError

MAX_TOPICS = 256
MAX_NUMBER = 1e12  # The largest priority, weight, rate limit (Hz) and deadline (s)
NO_DEADLINE_US = 2**62
MAX_ACK_DELAY_US = NO_DEADLINE_US // 2 - 1


@dataclass(frozen=True)
class Topic:
    """One topic of a client's configuration."""

    name: str
    """Unique among the topics of a client."""
    priority: float = 1.0
    """p of Robofleet's schedulers. Of two topics that wait equally long, the one of higher priority is sent first; a
    topic of priority 0 goes when nothing else waits."""
    rate_limit_hz: float | None = None
    """Rate limit, Hz; None for no limit. A message less than 1 / rate after the last one kept is dropped, even on a
    no_drop topic."""
    no_drop: bool = False
    """Whether messages that passed the rate limit may never be dropped."""
    limit: int | None = None
    """Most messages of the topic in the buffer (a publisher's queue size); None for as many as the buffer holds."""
    weight: float | None = None
    """Factor of the topic's H in the weighted sum; None for its priority."""
    value: Value | None = None
    """V over the topic's coordinate x; None for the scenario's V."""
    deadline_s: float | None = None
    """Age at which a message arrives late at the server, s; None for never."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise BufgymError(f"topic {self.name!r}: a name must be a non-empty text")
        for name in ("priority", "weight", "rate_limit_hz", "deadline_s"):
            number, zero = getattr(self, name), name in ("priority", "weight")
            if number is None and name != "priority":
                continue
            if not is_number(number) or not 0 <= number <= MAX_NUMBER or (number == 0 and not zero):
                raise self._wrong(name, f"must be a number {'>= 0' if zero else '> 0'}, at most {MAX_NUMBER:g}")
        if not isinstance(self.no_drop, bool):
            raise self._wrong("no_drop", "must be true or false")
        if self.limit is not None:
            whole(f"topic {self.name!r}: limit", self.limit, 1, MAX_CAPACITY)
        if self.value is not None and not isinstance(self.value, Value):
            raise self._wrong("value", "must be a V of bufgym.model.qoi")
        if self.no_drop and self.limit is not None:
            raise self._wrong("limit", "a no_drop topic can't have a limit, which drops messages")

    def _wrong(self, name: str, rule: str) -> BufgymError:
        return BufgymError(f"topic {self.name!r}: {name} = {getattr(self, name)!r}: {rule}")

    @property
    def period_us(self) -> int:
        """Least time between two kept messages, us; 0 without a rate limit.

        Rounded down, so that a publisher exactly at the rate limit loses no message.
        """
        return int(min(1e6 / self.rate_limit_hz, NO_DEADLINE_US)) if self.rate_limit_hz else 0

    @property
    def share(self) -> float:
        """Factor of the topic's H in the weighted sum."""
        return self.priority if self.weight is None else self.weight


def check_topics(topics: Sequence[Topic]) -> tuple[Topic, ...]:
    """Check that these are Topics with unique names; return them as a tuple."""
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
    """The topics of a client that sends one copy to each consumer; the total weight stays the same."""
    return [
        replace(topic, name=f"{topic.name} to {c + 1}", weight=topic.share / consumers)
        for c in range(consumers)
        for topic in topics
    ]


def topic_table(topics: Sequence[Topic], capacity: int, v: Value) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """The topics' settings as TOPIC[topics], and all their V in one array; no topics give one row without limits."""
    # A single topic with rules gets a companion without messages: one row means "no rules, whatever the topic number".
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
        table["priority"][len(topics) :] = table["weight"][len(topics) :] = 0.0  # the companion weighs nothing
    table["highest_priority"], table["largest_weight"] = table["priority"].max(), table["weight"].max()
    values = v.array if len(arrays) == 1 else np.concatenate(arrays)
    values.flags.writeable = False
    return table, values


@kernel
def age_between(newest_us: float, from_us: float, until_us: float) -> float:
    """Age of information at the server integrated over a time in which nothing is received, s^2.

    The newest message received so far arrived at ``newest_us``.
    """
    from_s, until_s = (from_us - newest_us) / 1e6, (until_us - newest_us) / 1e6
    return (from_s + until_s) / 2 * (until_s - from_s)
