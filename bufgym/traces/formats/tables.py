"""Readers of simple tables: bufgym's CSV, the Belgium log, Mbit/s over time, rates over time."""

from datetime import UTC, datetime
from typing import Final, Literal

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import Intervals, Knots, Rate, held_rates
from bufgym.traces.formats.text import Line, is_header, open_text, split_cells
from bufgym.traces.formats.units import TIME_COLUMNS, UNIT_S
from bufgym.traces.trace import US_PER_S
from bufgym.utils.units import RATES

CSV_HEADER: Final = "t_ms,bytes,interval_ms"
RATES_HEADER: Final = "time_s,bytes_per_s"
MAX_MBIT_PER_S: Final = 10**6
_TIME_COLUMNS: Final = {"time_s": "", "time": "", "timestamp": "", "date": ""} | TIME_COLUMNS
_RATE_NAMES: Final = {name.lower() for name in RATES}

# 2286-11-20, the last epoch in ms with 13 digits.
_MAX_EPOCH_MS: Final = 10**13
_MAX_EPOCH_S: Final = 10**10


def read_csv(path: StrPath) -> Knots:
    """Header `t_ms,bytes,interval_ms`; times in ms with up to 3 decimals, so that microseconds survive."""
    intervals = Intervals()
    with open_text(path) as file:
        for line in file.below_header(f"the header {CSV_HEADER}", lambda text: is_header(text, CSV_HEADER))[1]:
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
    """Seconds, since any time, and Mbit/s separated by white space, by the rules of `held_rates`."""
    with open_text(path) as file:
        return held_rates(path, (_rate(line, None, "Mbit/s", 0.125) for line in file.lines()))


def fits_rates(text: str) -> bool:
    """Whether a header names a time and a rate, as `time_s,bytes_per_s` and `time,mbps` do."""
    time, *rate = split_cells(text.lower())
    return time in _TIME_COLUMNS and len(rate) == 1 and rate[0] in _RATE_NAMES


def read_rates(path: StrPath) -> Knots:
    """Times in seconds or as ISO dates, and rates, under a header that `fits_rates`, by the rules of `held_rates`."""
    with open_text(path) as file:
        header, lines = file.below_header(f"the header {RATES_HEADER} or time,mbps", fits_rates)
        time, column = split_cells(header)
        unit = _TIME_COLUMNS[time.lower()]
        if column not in RATES:
            rule = "b is a bit and B a byte: must be as Mbps or MBps"
            raise fault(path, rule, value=column, field="unit of the rate")
        rates = (_rate(line, ",", column, RATES[column] / US_PER_S, unit or "s") for line in lines)
        return held_rates(path, rates, unit=unit)


def _rate(line: Line, separator: Literal[","] | None, field: str, unit: float, time_unit: str = "s") -> Rate:
    """The rate that a line states; ``unit`` is bytes per microsecond of the field's unit."""
    time, rate = line.columns(2, separator)
    start_us = _date_us(time) if separator else None
    if start_us is None:
        unit_s = UNIT_S[time_unit]
        start_us = round(line.decimal(f"time in {time_unit}", time, 0, _MAX_EPOCH_S / unit_s) * unit_s * US_PER_S)
    return Rate(line, time, start_us, line.decimal(field, rate, 0, MAX_MBIT_PER_S * 0.125 / unit) * unit)


def _date_us(text: str) -> int | None:
    """Microseconds since 1970 of an ISO date, in UTC where it names no zone; None for other text."""
    try:
        date = datetime.fromisoformat(text if "-" in text else "")
    except ValueError:
        return None
    return round(date.replace(tzinfo=date.tzinfo or UTC).timestamp() * US_PER_S)
