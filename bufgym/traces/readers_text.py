"""Readers of tables without a story of their own: bufgym's CSV, rates over time, the Belgium log."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

from bufgym.errors import TraceError, where
from bufgym.traces.files import Line, StrPath, TextFile, is_number
from bufgym.traces.readers_intervals import MAX_INTERVAL_BYTES, Intervals, Knots, Rate, held_rates
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S

CSV_HEADER: Final = "t_ms,bytes,interval_ms"
RATES_HEADER: Final = "time_s,bytes_per_s"
MAX_MBIT_PER_S: Final = 10**6
MAX_BYTES_PER_S: Final = MAX_MBIT_PER_S * 125_000

# 2286-11-20, the last epoch in ms with 13 digits.
_MAX_EPOCH_MS: Final = 10**13


def read_csv(path: StrPath) -> Knots:
    """Header `t_ms,bytes,interval_ms`; times in ms with up to 3 decimals, so that microseconds survive."""
    intervals = Intervals()
    with TextFile(path) as file:
        for line in after_header(file, CSV_HEADER):
            t_ms, count, interval_ms = line.columns(3, ",")
            intervals.add_ending_at(
                line,
                line.milliseconds("t_ms", t_ms, MAX_DURATION_S),
                line.milliseconds("interval_ms", interval_ms, MAX_DURATION_S),
                line.whole("bytes", count, MAX_INTERVAL_BYTES),
            )
    return intervals.knots(path)


def read_belgium(path: StrPath) -> Knots:
    """Raw log of the Ghent 4G measurements; position and epoch are checked and then left aside."""
    intervals = Intervals()
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


def read_mbit(path: StrPath) -> Knots:
    """Seconds and Mbit/s between white space, by the rules of `held_rates`."""
    with TextFile(path) as file:
        return held_rates(path, (_rate(line, None, "Mbit/s", MAX_MBIT_PER_S, 0.125) for line in file.lines()))


def read_rates(path: StrPath) -> Knots:
    """Header `time_s,bytes_per_s`, by the rules of `held_rates`."""
    with TextFile(path) as file:
        lines = after_header(file, RATES_HEADER)
        return held_rates(path, (_rate(line, ",", "bytes_per_s", MAX_BYTES_PER_S, 1e-6) for line in lines))


def after_header(file: TextFile, header: str) -> Iterator[Line]:
    """The lines below the header, which must be there."""
    lines = file.lines()
    first = next(lines, None)
    if first is None:
        raise TraceError(where(file.path, None, None, f"is empty: must begin with the header {header}"))
    if not has_header(header)(first.text):
        raise first.error(first.text, f"must be the header {header}")
    return lines


def has_header(header: str) -> Callable[[str], bool]:
    """Whether a line is that header, whatever blanks are between its cells."""
    return lambda text: ",".join(cell.strip() for cell in text.split(",")) == header


def numbers(count: int) -> Callable[[str], bool]:
    """Whether a line is so many numbers between white space."""

    def fits(text: str) -> bool:
        cells = text.split()
        return len(cells) == count and all(map(is_number, cells))

    return fits


def _rate(line: Line, separator: str | None, field: str, most: float, to_bytes_per_us: float) -> Rate:
    seconds, rate = line.columns(2, separator)
    start_us = round(line.decimal("time in s", seconds, 0, MAX_DURATION_S) * US_PER_S)
    return Rate(line, seconds, start_us, line.decimal(field, rate, 0, most) * to_bytes_per_us)
