"""Bandwidth traces from files, in the formats that public data sets come in.

| format | a line | where found |
|---|---|---|
| `mahimahi` | ms, one 1500-byte packet each | mahimahi (`mahimahi.py` says how packets become capacity) |
| `csv` | `t_ms,bytes,interval_ms` under that header; t_ms ENDS the interval | bufgym's own; Belgium 4G |
| `mbit` | seconds and Mbit/s between white space | Pensieve-cooked Norway HSDPA, Lumos5G, Solis WiFi |
| `belgium` | epoch ms, ms since start, latitude, longitude, bytes, interval ms | raw Belgium 4G logs |

Any of them may be gzip'd. The format is told from the first line that is not blank. Blank lines are skipped;
every other line must follow its format to the letter, for a wrong capacity is worse than none.

Limits, beyond which a number is taken for a mistake: 10**7 s, 10**12 bytes in an interval, 10**6 Mbit/s,
4096 characters a line, 4 GiB of text.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from bufgym.errors import BufgymError, TraceError, where
from bufgym.traces.files import Line, StrPath, TextFile, is_number
from bufgym.traces.mahimahi import read_mahimahi
from bufgym.traces.trace import MAX_DURATION_S, PRODUCT_LIMIT, US_PER_S, After, Int64Array, Trace

CSV_HEADER: Final = "t_ms,bytes,interval_ms"
MAX_INTERVAL_BYTES: Final = 10**12
MAX_MBIT_PER_S: Final = 10**6

# 2286-11-20, the last epoch in ms with 13 digits.
_MAX_EPOCH_MS: Final = 10**13
_SUFFIXES: Final = (".csv", ".log", ".txt", ".dat")

Knots = tuple[Int64Array, Int64Array]


@dataclass(frozen=True)
class Format:
    """How to recognise a format by its first line, and how to read its knots (int64[K] us and bytes)."""

    layout: str
    fits: Callable[[str], bool]
    read: Callable[[StrPath], Knots]


def read_trace(path: StrPath, format: str | None = None, after: After = "loop") -> Trace:
    """Read a bandwidth trace.

    Args:
        path: the file, plain or gzip'd.
        format: one of `FORMATS`; by default it is detected from the content.
        after: what follows the end of the trace (see `Trace`).

    Returns:
        The trace, named after the file; `source` states the file and the format.

    Raises:
        TraceError: the file is missing, empty, damaged, of no known format, or breaks a rule of its format.
            The message names the file, the line, the value and the rule.
        BufgymError: an unknown `format` or `after`.
    """
    told = "as told"
    if format is None:
        format, told = detect_format(path), "detected"
    elif format not in FORMATS:
        raise BufgymError(f"format = {format!r}: must be one of {', '.join(FORMATS)}")
    time_us, cumulative_bytes = FORMATS[format].read(path)
    try:
        return Trace(trace_name(path), time_us, cumulative_bytes, after, f"{path} (format {format}, {told})")
    except BufgymError as error:
        raise TraceError(f"{path}: {error}") from error


def detect_format(path: StrPath) -> str:
    """The one format that the file's first line fits.

    Raises:
        TraceError: it fits none, or several (then `read_trace` needs its `format` argument), or cannot be
            read.
    """
    with TextFile(path) as file:
        line = next(file.lines(), None)
    if line is None:
        raise TraceError(where(path, None, None, "is empty: must hold a trace"))
    found = [name for name, format in FORMATS.items() if format.fits(line.text)]
    if len(found) > 1:
        raise line.error(line.text, f"fits more than one format ({', '.join(found)}): say which with format=...")
    if not found:
        layouts = "; ".join(f"{name}: {format.layout}" for name, format in FORMATS.items())
        raise line.error(line.text, f"must fit a known format ({layouts})")
    return found[0]


def trace_name(path: StrPath) -> str:
    """The file's name without `.gz` and the usual endings: "TMobile-LTE-short.down", "report_car_0002"."""
    name = Path(path).name.removesuffix(".gz")
    for suffix in _SUFFIXES:
        name = name.removesuffix(suffix)
    return name


class _Intervals:
    """Measurements in a row, collected and checked one at a time."""

    def __init__(self) -> None:
        self._us = array("q")
        self._bytes = array("q")
        self._end_us: int | None = None

    def add(self, line: Line, length_us: int, count: int) -> None:
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
        return round(float(np.median(np.asarray(self._us))))

    def __len__(self) -> int:
        return len(self._us)

    def knots(self, path: StrPath) -> Knots:
        if not self._us:
            raise TraceError(where(path, None, None, "holds no measurement: must hold at least one"))
        time_us, cumulative = (np.append(0, np.cumsum(np.asarray(v, np.int64))) for v in (self._us, self._bytes))
        if time_us[-1] > MAX_DURATION_S * US_PER_S:
            raise TraceError(where(path, None, f"{time_us[-1] / US_PER_S:g}", f"must be at most {MAX_DURATION_S}"))
        return time_us, cumulative


def _read_csv(path: StrPath) -> Knots:
    """Header `t_ms,bytes,interval_ms`; times in ms with up to 3 decimals, so that microseconds survive."""
    intervals = _Intervals()
    with TextFile(path) as file:
        lines = file.lines()
        header = next(lines, None)
        if header is None:
            raise TraceError(where(path, None, None, f"is empty: must begin with the header {CSV_HEADER}"))
        if not _fits_csv(header.text):
            raise header.error(header.text, f"must be the header {CSV_HEADER}")
        for line in lines:
            t_ms, count, interval_ms = line.columns(3, ",")
            intervals.add_ending_at(
                line,
                line.milliseconds("t_ms", t_ms, MAX_DURATION_S),
                line.milliseconds("interval_ms", interval_ms, MAX_DURATION_S),
                line.whole("bytes", count, MAX_INTERVAL_BYTES),
            )
    return intervals.knots(path)


def _read_belgium(path: StrPath) -> Knots:
    """Raw log of the Ghent 4G measurements; position and epoch are checked and then left aside."""
    intervals = _Intervals()
    with TextFile(path) as file:
        for line in file.lines():
            epoch, since_start, latitude, longitude, count, interval = line.columns(6)
            line.whole("epoch in ms", epoch, _MAX_EPOCH_MS)
            line.decimal("latitude", latitude, -90, 90)
            line.decimal("longitude", longitude, -180, 180)
            intervals.add_ending_at(
                line,
                line.milliseconds("ms since start", since_start, MAX_DURATION_S),
                line.milliseconds("interval in ms", interval, MAX_DURATION_S),
                line.whole("bytes", count, MAX_INTERVAL_BYTES),
            )
    return intervals.knots(path)


def _read_mbit(path: StrPath) -> Knots:
    """Each rate holds until the next line's time; the last for the median interval. The first time becomes 0.

    Of lines with one and the same time (30 of the Lumos5G files have some) the last counts.

    Each interval's bytes are rounded to a whole number, so the total is off by half a byte a line at most.
    """
    intervals = _Intervals()
    with TextFile(path) as file:
        waiting: tuple[Line, int, float] | None = None
        for line in file.lines():
            seconds, mbit = line.columns(2)
            start_us = round(line.decimal("time in s", seconds, 0, MAX_DURATION_S) * US_PER_S)
            rate = line.decimal("Mbit/s", mbit, 0, MAX_MBIT_PER_S)
            if waiting is not None:
                since_us = waiting[1]
                if start_us < since_us:
                    rule = f"must not be before the line above ({since_us / US_PER_S:.10g})"
                    raise line.error(seconds, rule, "time in s")
                if start_us > since_us:
                    _add_rate(intervals, waiting[0], start_us - since_us, waiting[2])
            waiting = (line, start_us, rate)
    if waiting is None:
        raise TraceError(where(path, None, None, "is empty: must hold a line for each sample"))
    if not len(intervals):
        raise waiting[0].error(waiting[0].text, "must have a second line: how long a single rate holds is unknown")
    _add_rate(intervals, waiting[0], intervals.median_us(), waiting[2])
    return intervals.knots(path)


def _add_rate(intervals: _Intervals, line: Line, length_us: int, mbit_per_s: float) -> None:
    # Mbit/s times microseconds is bits.
    intervals.add(line, length_us, round(mbit_per_s * length_us / 8))


def _fits_csv(text: str) -> bool:
    return ",".join(cell.strip() for cell in text.split(",")) == CSV_HEADER


def _numbers(count: int) -> Callable[[str], bool]:
    def fits(text: str) -> bool:
        cells = text.split()
        return len(cells) == count and all(map(is_number, cells))

    return fits


FORMATS: Final[dict[str, Format]] = {
    "mahimahi": Format("one number, the ms of a packet", _numbers(1), read_mahimahi),
    "csv": Format(f"header {CSV_HEADER}", _fits_csv, _read_csv),
    "mbit": Format("two numbers, s and Mbit/s", _numbers(2), _read_mbit),
    "belgium": Format("six numbers", _numbers(6), _read_belgium),
}
