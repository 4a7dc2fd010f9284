"""Intervals that follow each other, each with its length and its bytes: what the readers of measurements share."""

import re
from array import array
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np

from bufgym.traces import plausible
from bufgym.traces.formats.faults import LeftOut, StrPath, fault, warn
from bufgym.traces.formats.text import NUMBER, Line
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S, Int64Array

MAX_INTERVAL_BYTES: Final = 10**12
MAX_MBIT_PER_S: Final = 10**6

# A rate that would have to hold for longer is a gap in the recording, across which nothing is known.
MAX_HOLD_S: Final = 86_400


class Knots(NamedTuple):
    """A capacity as it was read."""

    time_us: Int64Array  # int64[K], microseconds, from 0
    cumulative_bytes: Int64Array  # int64[K], bytes up to each time, from 0
    note: str = ""  # what the trace's `source` should say about the reading; empty for nothing
    start_us: int = 0  # time 0 by the recording's clock, microseconds
    ends: Sequence[tuple[int, str]] = ()  # line and time at each interval's end but the last's, where rates are held


class Intervals:
    """Measurements that follow each other, collected and checked one at a time."""

    def __init__(self) -> None:
        self.us = array("q")  # their lengths
        self._bytes = array("q")
        self._end_us: int | None = None

    def add(self, length_us: int, count: int) -> None:
        """Add an interval of `length_us` > 0 in which `count` >= 0 bytes were transmitted."""
        self.us.append(length_us)
        self._bytes.append(count)

    def add_ending_at(self, line: Line, end_ms: str, length_ms: str, count: str) -> None:
        """Add an interval given as text. It must begin where the one before ended.

        Across a gap the capacity is unknown, and bufgym invents none.
        """
        end_us = line.milliseconds("time in ms", end_ms, MAX_DURATION_S)
        length_us = line.milliseconds("interval in ms", length_ms, MAX_DURATION_S)
        bytes_in_interval = line.whole("bytes", count, MAX_INTERVAL_BYTES)
        start_us = end_us - length_us
        if length_us == 0:
            raise line.error(0, "must be above 0", "interval in ms")
        if start_us < 0:
            raise line.error(f"{length_us / 1000:g}", "must not begin before time 0", "interval in ms")
        if self._end_us is not None and start_us != self._end_us:
            rule = f"must begin where the line above ended ({self._end_us / 1000:.10g} ms)"
            raise line.error(f"{start_us / 1000:.10g}", rule, "start in ms")
        self._end_us = end_us
        self.add(length_us, bytes_in_interval)

    def __len__(self) -> int:
        return len(self.us)

    def knots(self, path: StrPath, note: str = "") -> Knots:
        """The capacity of all intervals together."""
        if not self.us:
            raise fault(path, "holds no measurement: must hold at least one")
        columns = (np.asarray(column, np.int64) for column in (self.us, self._bytes))
        time_us, cumulative = (np.append(0, np.cumsum(column)) for column in columns)
        if time_us[-1] > MAX_DURATION_S * US_PER_S:
            duration_s = f"{time_us[-1] / US_PER_S:g}"
            raise fault(path, f"must be at most {MAX_DURATION_S}", value=duration_s, field="duration in s")
        return Knots(time_us, cumulative, note)


class Rate(NamedTuple):
    """The rate from some time on."""

    line: Line  # where it is stated
    time: str  # its time as it is written in the line
    start_us: int  # its time, microseconds
    bytes_per_us: float  # bytes a microsecond
    unit: str = ""  # of its time, where a name or an option says it; else it must look like seconds


def held_rates(path: StrPath, rates: Iterable[Rate]) -> Knots:
    """The capacity when each rate holds until the next line's time, and the last one for the median interval.

    The first time becomes 0. If several lines have the same time, as in 30 of the Lumos5G files, the last counts, and
    the note or a warning says how many are left out. Each interval's bytes are rounded to a whole number, so the total
    is off by at most half a byte a line.
    """
    intervals = Intervals()
    previous = again = None
    ends: list[tuple[int, str]] = []
    starts_us, lines, total_bytes_per_us = array("q"), array("q"), 0.0
    for rate in rates:
        if previous is not None:
            length_us = rate.start_us - previous.start_us
            above = f"the line above ({previous.time})"
            if length_us < 0:
                raise rate.line.error(rate.time, f"must not be before {above}", "time in s")
            if length_us > MAX_HOLD_S * US_PER_S:
                raise rate.line.error(rate.time, f"must be at most {MAX_HOLD_S} s after {above}", "time in s")
            if length_us == 0:
                again = rate
            else:
                intervals.add(length_us, round(previous.bytes_per_us * length_us))
                ends.append((rate.line.number, rate.time))
        previous = rate
        starts_us.append(rate.start_us)
        lines.append(rate.line.number)
        total_bytes_per_us += rate.bytes_per_us
    if previous is None:
        raise fault(path, "is empty: must hold a line for each sample")
    if not len(intervals):
        line, count = previous.line, len(starts_us)
        if count > 1:
            raise line.error(previous.time, f"must differ from the times above, {count} samples of one time", "time")
        raise line.error(line.text, "must have a second line: how long a single rate holds is unknown")
    length_us = round(float(np.median(np.asarray(intervals.us))))
    if not previous.unit and re.fullmatch(NUMBER, previous.time):
        plausible.check_seconds(path, np.asarray(starts_us) / US_PER_S)
    note = ""
    if again is not None and length_us > plausible.SLOW_S * US_PER_S:
        doubt = (
            f"{again.time} is the time of the line above, where {length_us / US_PER_S:g} s is usual: this one counts"
        )
        warn(path, doubt, line=again.line.number)
    else:
        left_out = LeftOut()
        left_out.add(np.asarray(starts_us, np.int64), np.asarray(lines, np.int64))
        mean = f": the mean of all lines is {total_bytes_per_us / len(starts_us) * 1000:,.6g} KB/s"
        note = left_out.said(path, "lines", effect=mean).removeprefix(", ")
    intervals.add(length_us, round(previous.bytes_per_us * length_us))
    return intervals.knots(path, note)._replace(start_us=starts_us[0], ends=ends)
