"""What the readers of measurements share: intervals in a row, each with its length and its bytes."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np

from bufgym.errors import TraceError, where
from bufgym.traces.files import Line, StrPath
from bufgym.traces.trace import MAX_DURATION_S, PRODUCT_LIMIT, US_PER_S, Int64Array

MAX_INTERVAL_BYTES: Final = 10**12

# A rate that is said to hold for longer is a gap in the recording, across which nothing is known.
MAX_HOLD_S: Final = 86_400


class Knots(NamedTuple):
    """A capacity as it was read: int64[K] us and int64[K] bytes, both from 0, and what is to be said of it."""

    time_us: Int64Array
    cumulative_bytes: Int64Array
    note: str = ""


class Intervals:
    """Measurements in a row, collected and checked one at a time."""

    def __init__(self) -> None:
        self._us = array("q")
        self._bytes = array("q")
        self._end_us: int | None = None

    def add(self, line: Line, length_us: int, count: int) -> None:
        """An interval of `length_us` > 0 in which `count` >= 0 bytes crossed."""
        if count > MAX_INTERVAL_BYTES:
            raise line.error(count, f"must be at most {MAX_INTERVAL_BYTES} in an interval", "bytes")
        if length_us * count >= PRODUCT_LIMIT:
            raise line.error(length_us * count, "must be below 2**62", "bytes x microseconds of the interval")
        self._us.append(length_us)
        self._bytes.append(count)

    def add_ending_at(self, line: Line, end_us: int, length_us: int, count: int) -> None:
        """An interval with its own clock time, which must begin where the one before ended.

        Across a gap the capacity is unknown, and bufgym invents none.
        """
        start_us = end_us - length_us
        if length_us == 0:
            raise line.error(0, "must be above 0", "interval in ms")
        if start_us < 0:
            raise line.error(f"{length_us / 1000:g}", "must not begin before time 0", "interval in ms")
        if self._end_us is not None and start_us != self._end_us:
            rule = f"must begin where the line above ended ({self._end_us / 1000:.10g} ms)"
            raise line.error(f"{start_us / 1000:.10g}", rule, "start in ms")
        self._end_us = end_us
        self.add(line, length_us, count)

    def median_us(self) -> int:
        """The median length."""
        return round(float(np.median(np.asarray(self._us))))

    def __len__(self) -> int:
        return len(self._us)

    def knots(self, path: StrPath, note: str = "") -> Knots:
        """The capacity of all intervals together.

        Raises:
            TraceError: there is none, or they last beyond MAX_DURATION_S.
        """
        if not self._us:
            raise TraceError(where(path, None, None, "holds no measurement: must hold at least one"))
        time_us, cumulative = (np.append(0, np.cumsum(np.asarray(v, np.int64))) for v in (self._us, self._bytes))
        if time_us[-1] > MAX_DURATION_S * US_PER_S:
            shown = f"{time_us[-1] / US_PER_S:g}"
            raise TraceError(where(path, None, shown, f"must be at most {MAX_DURATION_S}", field="duration in s"))
        return Knots(time_us, cumulative, note)


class Rate(NamedTuple):
    """A line that says: from `start_us` on, as written in `time`, the rate is this."""

    line: Line
    time: str
    start_us: int
    bytes_per_us: float


def held_rates(path: StrPath, rates: Iterable[Rate]) -> Knots:
    """Each rate holds until the next line's time; the last for the median interval. The first time becomes 0.

    Of lines with one and the same time (30 of the Lumos5G files have some) the last counts.

    Each interval's bytes are rounded to a whole number, so the total is off by half a byte a line at most.
    """
    intervals = Intervals()
    waiting: Rate | None = None
    for rate in rates:
        if waiting is not None:
            length_us = rate.start_us - waiting.start_us
            if length_us < 0:
                rule = f"must not be before the line above ({waiting.start_us / US_PER_S:.10g})"
                raise rate.line.error(rate.time, rule, "time in s")
            if length_us > MAX_HOLD_S * US_PER_S:
                rule = f"must be at most {MAX_HOLD_S} s after the line above ({waiting.start_us / US_PER_S:.10g})"
                raise rate.line.error(rate.time, rule, "time in s")
            if length_us > 0:
                intervals.add(waiting.line, length_us, round(waiting.bytes_per_us * length_us))
        waiting = rate
    if waiting is None:
        raise TraceError(where(path, None, None, "is empty: must hold a line for each sample"))
    if not len(intervals):
        raise waiting.line.error(waiting.line.text, "must have a second line: how long a single rate holds is unknown")
    length_us = intervals.median_us()
    intervals.add(waiting.line, length_us, round(waiting.bytes_per_us * length_us))
    return intervals.knots(path)
