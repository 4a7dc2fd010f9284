"""What a robot sent: arrival time, size, topic and coordinate x of each message, from a recording or a CSV file.

A CSV file begins with the header ``time_s,bytes``, then optionally ``,topic`` and ``,x``; one message a line, in order
of arrival. Times are in s (whole microseconds count), x is how far the scene has moved on (see `motion.py`), and where
there is no x, a message's number takes its place. `recordings.py` makes workloads of robots' recordings.
"""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from bufgym.errors import BufgymError, TraceError, where
from bufgym.traces.files import Line, StrPath, TextFile, write_text
from bufgym.traces.motion import MAX_COORDINATE
from bufgym.traces.poses import seconds
from bufgym.traces.readers import trace_name
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S, Float64Array, Int64Array

WORKLOAD_HEADERS: Final = ("time_s,bytes", "time_s,bytes,topic", "time_s,bytes,x", "time_s,bytes,topic,x")
MAX_MESSAGES: Final = 10**7
MAX_MESSAGE_BYTES: Final = 10**10


class TopicSummary(NamedTuple):
    """One topic of a workload."""

    topic: str
    messages: int
    rate_hz: float
    """Messages a second between its first and its last; NaN for fewer than two."""
    total_bytes: int
    share: float
    """Of the workload's bytes."""


@dataclass(frozen=True, eq=False)
class Workload:
    """Recorded messages, checked when it is made; its arrays are read-only.

    Attributes:
        name: what to call it in tables.
        arrival_us: int64[n], n >= 1, microseconds, non-decreasing from 0.
        size_bytes: int64[n], at least 1.
        topic: int64[n], which of ``topics``; by default all 0.
        topics: names.
        x: float64[n], coordinate, non-decreasing from 0; None where unknown (then a message's number counts).
        source: where it comes from, in words.
        gaps: (start, end) in microseconds of stretches without a pose, across which motion was taken as even.

    Raises:
        BufgymError: an array breaks one of these rules.
    """

    name: str
    arrival_us: Int64Array
    size_bytes: Int64Array
    topic: Int64Array | None = None
    topics: tuple[str, ...] = ("",)
    x: Float64Array | None = None
    source: str = ""
    gaps: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        arrival, size = np.array(self.arrival_us), np.array(self.size_bytes)
        topic = np.zeros(len(arrival), np.int64) if self.topic is None else np.array(self.topic)
        for what, whole in (("arrival_us", arrival), ("size_bytes", size), ("topic", topic)):
            if whole.dtype != np.int64 or whole.ndim != 1 or whole.shape != arrival.shape or not 1 <= whole.size:
                raise self._broken(f"{what} must be int64[n], as many as there are messages, and one at least")
        if arrival.size > MAX_MESSAGES:
            raise self._broken(f"{arrival.size} messages: must be at most {MAX_MESSAGES}")
        if arrival[0] != 0 or (np.diff(arrival) < 0).any() or arrival[-1] > MAX_DURATION_S * US_PER_S:
            raise self._broken(f"arrival_us must begin with 0, not decrease, and end within {MAX_DURATION_S} s")
        if not (1 <= size.min() and size.max() <= MAX_MESSAGE_BYTES):
            raise self._broken(f"size_bytes must lie between 1 and {MAX_MESSAGE_BYTES}")
        if not (0 <= topic.min() and topic.max() < len(self.topics)):
            raise self._broken(f"topic must lie between 0 and {len(self.topics) - 1}")
        arrays: dict[str, Int64Array | Float64Array] = {"arrival_us": arrival, "size_bytes": size, "topic": topic}
        if self.x is not None:
            x = np.array(self.x, dtype=np.float64)
            if x.shape != arrival.shape or not np.isfinite(x).all() or x[0] != 0 or (np.diff(x) < 0).any():
                raise self._broken("x must be finite numbers, one a message, begin with 0 and not decrease")
            arrays["x"] = x
        for field, values in arrays.items():
            values.flags.writeable = False
            object.__setattr__(self, field, values)

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
        """The longest stretch in `gaps`, s; 0 where there is none."""
        return max((end - start for start, end in self.gaps), default=0) / US_PER_S

    def topic_of(self, message: int) -> str:
        """The name of a message's topic."""
        assert self.topic is not None
        return self.topics[int(self.topic[message])]

    def summary(self) -> list[TopicSummary]:
        """One line a topic that has messages, most bytes first."""
        total = int(self.size_bytes.sum())
        made = []
        for k, name in enumerate(self.topics):
            of_it = self.topic == k
            times, bytes_ = self.arrival_us[of_it], int(self.size_bytes[of_it].sum())
            if len(times):
                long = len(times) > 1 and times[-1] > times[0]
                rate = (len(times) - 1) / ((times[-1] - times[0]) / US_PER_S) if long else math.nan
                made.append(TopicSummary(name, len(times), float(rate), bytes_, bytes_ / total))
        return sorted(made, key=lambda line: (-line.total_bytes, line.topic))


# --- CSV -------------------------------------------------------------------------------------------------------------


def read_workload_csv(path: StrPath) -> Workload:
    """Read `time_s,bytes[,topic][,x]`, plain or gzip'd; the first time and the first x become 0.

    Raises:
        TraceError: the file cannot be read, or a line breaks a rule: another header, times or x that go back, sizes
            that are no whole numbers from 1 to 10**10, an empty topic, more than 10**7 messages. The message names
            the file, the line, the value and the rule.
    """
    with TextFile(path) as file:
        lines = file.lines()
        header = next(lines, None)
        if header is None:
            raise TraceError(where(path, None, None, f"is empty: must begin with the header {WORKLOAD_HEADERS[0]}"))
        titles = [cell.strip() for cell in header.text.split(",")]
        if ",".join(titles) not in WORKLOAD_HEADERS:
            raise header.error(header.text, "must be the header time_s,bytes[,topic][,x]")
        times, sizes, numbers, xs = array("q"), array("q"), array("q"), array("d")
        topics: dict[str, int] = {}
        for line in lines:
            cells = dict(zip(titles, line.columns(len(titles), ","), strict=True))
            if len(times) >= MAX_MESSAGES:
                raise line.error(None, f"must be one of at most {MAX_MESSAGES} messages")
            time_us = seconds(line, cells["time_s"])
            if times and time_us < times[-1]:
                raise line.error(cells["time_s"], "must not be before the line above", "time_s")
            if times and time_us - times[0] > MAX_DURATION_S * US_PER_S:
                raise line.error(cells["time_s"], f"must be at most {MAX_DURATION_S} s after the first", "time_s")
            times.append(time_us)
            sizes.append(_size(line, cells["bytes"]))
            name = cells.get("topic", "")
            if "topic" in cells and not name:
                raise line.error(name, "must not be empty", "topic")
            numbers.append(topics.setdefault(name, len(topics)))
            if "x" in cells:
                x = line.decimal("x", cells["x"], 0, MAX_COORDINATE)
                if xs and x < xs[-1]:
                    raise line.error(cells["x"], f"must not be below the line above ({xs[-1]!r})", "x")
                xs.append(x)
    if not times:
        raise TraceError(where(path, None, None, "holds no message: must hold one at least"))
    arrival_us = np.array(times, np.int64)
    moved = np.array(xs, np.float64)
    return Workload(
        trace_name(path),
        arrival_us - arrival_us[0],
        np.array(sizes, np.int64),
        np.array(numbers, np.int64),
        tuple(topics),
        moved - moved[0] if "x" in titles else None,
        f"{path} ({','.join(titles)})",
    )


def _size(line: Line, text: str) -> int:
    size = line.whole("bytes", text, MAX_MESSAGE_BYTES)
    if size < 1:
        raise line.error(text, "must be at least 1", "bytes")
    return size


def write_workload_csv(workload: Workload, path: StrPath) -> None:
    """Write `time_s,bytes[,topic][,x]`; `read_workload_csv` gives back the same messages, bit for bit.

    The column topic is left out where the only one has no name, and x where it is unknown. A name with a comma, or
    with blanks at its ends, is refused.

    Raises:
        BufgymError: such a name.
        TraceError: the file cannot be written.
    """
    for name in workload.topics:
        if workload.topics != ("",) and (not name or name != name.strip() or "," in name or not name.isprintable()):
            raise BufgymError(f"topic {name!r}: a name in a CSV file must be printable, without commas, and not empty")
    assert workload.topic is not None
    titles = ["time_s", "bytes"]
    columns = [[f"{t // US_PER_S}.{t % US_PER_S:06d}" for t in workload.arrival_us.tolist()]]
    columns.append([str(size) for size in workload.size_bytes.tolist()])
    if workload.topics != ("",):
        titles.append("topic")
        columns.append([workload.topics[k] for k in workload.topic.tolist()])
    if workload.x is not None:
        titles.append("x")
        columns.append([repr(x) for x in workload.x.tolist()])
    write_text(path, (",".join(row) + "\n" for row in [titles, *zip(*columns, strict=True)]))
