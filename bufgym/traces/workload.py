"""What a robot sends: arrival time, size, topic and coordinate x of each message."""

import math
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from bufgym.traces.poses import longest_s
from bufgym.traces.sheet import NONE, Sheet
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S, Float64Array, Int64Array, freeze
from bufgym.utils.errors import BufgymError

MAX_MESSAGES: Final = 10**9  # A month of 400 messages a second; more is a mistake
MAX_MESSAGE_BYTES: Final = 10**10


class TopicSummary(NamedTuple):
    """One topic of a workload."""

    topic: str  # its name
    messages: int  # how many there are
    rate_hz: float  # messages a second between its first and its last; NaN for fewer than two
    total_bytes: int  # of all its messages
    share: float  # its share of the workload's bytes, 0..1


@dataclass(frozen=True, eq=False)
class Workload:
    """Recorded messages, checked when it is made; its arrays are read-only."""

    name: str
    """What to call it in tables."""
    arrival_us: Int64Array
    """int64[n], n >= 1, microseconds, non-decreasing from 0."""
    size_bytes: Int64Array
    """int64[n], at least 1."""
    topic: Int64Array = None  # type: ignore[assignment]
    """int64[n], which of `topics`; by default all 0."""
    topics: tuple[str, ...] = ("",)
    """The topics' names."""
    x: Float64Array | None = None
    """float64[n], coordinate, non-decreasing from 0; None if unknown (then each message's number counts)."""
    source: str = ""
    """Where it comes from, in words."""
    gaps: tuple[tuple[int, int], ...] = ()
    """(start, end) in microseconds of stretches without a pose, across which motion was taken as even."""
    sheet: Sheet = NONE
    """Facts and doubts."""

    def __post_init__(self) -> None:
        arrival, size = np.array(self.arrival_us), np.array(self.size_bytes)
        topic = np.zeros(len(arrival), np.int64) if self.topic is None else np.array(self.topic)
        arrays: dict[str, np.ndarray[Any, Any]] = {"arrival_us": arrival, "size_bytes": size, "topic": topic}
        for field, values in arrays.items():
            if values.dtype != np.int64 or values.ndim != 1 or values.shape != arrival.shape or not values.size:
                raise self._broken(f"{field} must be int64[n], one for each message, with at least one message")
        if arrival.size > MAX_MESSAGES:
            raise self._broken(f"{arrival.size} messages: must be at most {MAX_MESSAGES}")
        if arrival[0] != 0 or (np.diff(arrival) < 0).any() or arrival[-1] > MAX_DURATION_S * US_PER_S:
            raise self._broken(f"arrival_us must begin with 0, not decrease, and end within {MAX_DURATION_S} s")
        if not (1 <= size.min() and size.max() <= MAX_MESSAGE_BYTES):
            raise self._broken(f"size_bytes must lie between 1 and {MAX_MESSAGE_BYTES}")
        if not (0 <= topic.min() and topic.max() < len(self.topics)):
            raise self._broken(f"topic must lie between 0 and {len(self.topics) - 1}")
        if self.x is not None:
            x = np.array(self.x, dtype=np.float64)
            if x.shape != arrival.shape or not np.isfinite(x).all() or x[0] != 0 or (np.diff(x) < 0).any():
                raise self._broken("x must be finite numbers, one for each message, begin with 0 and not decrease")
            arrays["x"] = x
        freeze(self, **arrays)

    def _broken(self, what: str) -> BufgymError:
        return BufgymError(f"workload {self.name!r}: {what}")

    def __len__(self) -> int:
        return len(self.arrival_us)

    @property
    def duration_us(self) -> int:
        """Time of the last message, microseconds."""
        return int(self.arrival_us[-1])

    @property
    def longest_gap_s(self) -> float:
        """The longest stretch in `gaps`, s; 0 if there is none."""
        return longest_s(self.gaps)

    def topic_of(self, message: int) -> str:
        """The name of a message's topic."""
        return self.topics[int(self.topic[message])]

    def summary(self) -> list[TopicSummary]:
        """One entry for each topic that has messages, most bytes first."""
        total = int(self.size_bytes.sum())
        by_topic = np.argsort(self.topic, kind="stable")
        ends = np.cumsum(np.bincount(self.topic, minlength=len(self.topics)))
        topics = []
        for name, chosen in zip(self.topics, np.split(by_topic, ends[:-1]), strict=True):
            times, topic_bytes = self.arrival_us[chosen], int(self.size_bytes[chosen].sum())
            if len(times):
                lasts = times[-1] > times[0]
                rate_hz = (len(times) - 1) / ((times[-1] - times[0]) / US_PER_S) if lasts else math.nan
                topics.append(TopicSummary(name, len(times), float(rate_hz), topic_bytes, topic_bytes / total))
        return sorted(topics, key=lambda topic: (-topic.total_bytes, topic.topic))
