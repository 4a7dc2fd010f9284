"""Readers of simple tables: bufgym's CSV, the Belgium log, Mbit/s over time, rates over time."""

from collections.abc import Iterator
from typing import Final

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import Intervals, Knots, Rate, held_rates
from bufgym.traces.formats.text import Line, TextFile, is_header, open_text
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
    with open_text(path) as file:
        for line in after_header(file, CSV_HEADER):
            end_ms, count, length_ms = line.columns(3, ",")
            intervals.add_ending_at(line, end_ms, length_ms, count)
    return intervals.knots(path)


def read_belgium(path: StrPath) -> Knots:
    """Raw log of the Ghent 4G measurements; position and epoch are checked, but not used."""
    intervals = Intervals()
    with open_text(path) as file:
        for line in file.lines():
            epoch, end_ms, latitude, longitude, count, length_ms = line.columns(6)
            line.whole("epoch in ms", epoch, _MAX_EPOCH_MS)
            line.decimal("latitude", latitude, -90, 90)
            line.decimal("longitude", longitude, -180, 180)
            intervals.add_ending_at(line, end_ms, length_ms, count)
    return intervals.knots(path)


def read_mbit(path: StrPath) -> Knots:
    """Seconds and Mbit/s separated by white space, by the rules of `held_rates`."""
    with open_text(path) as file:
        return held_rates(path, (_rate(line, None, "Mbit/s", MAX_MBIT_PER_S, 0.125) for line in file.lines()))


def read_rates(path: StrPath) -> Knots:
    """Header `time_s,bytes_per_s`, by the rules of `held_rates`."""
    with open_text(path) as file:
        lines = after_header(file, RATES_HEADER)
        return held_rates(path, (_rate(line, ",", "bytes_per_s", MAX_BYTES_PER_S, 1e-6) for line in lines))


def after_header(file: TextFile, header: str) -> Iterator[Line]:
    """The lines below the header, which must be there."""
    lines = file.lines()
    first = next(lines, None)
    if first is None:
        raise fault(file.path, f"is empty: must begin with the header {header}")
    if not is_header(first.text, header):
        raise first.error(first.text, f"must be the header {header}")
    return lines


def _rate(line: Line, separator: str | None, field: str, most: float, to_bytes_per_us: float) -> Rate:
    seconds, rate = line.columns(2, separator)
    start_us = round(line.decimal("time in s", seconds, 0, MAX_DURATION_S) * US_PER_S)
    return Rate(line, seconds, start_us, line.decimal(field, rate, 0, most) * to_bytes_per_us)
