"""Rates over time in tables: under a header that names them, in Mbit/s, or in columns that are chosen."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain, takewhile
from typing import Final, NamedTuple

import numpy as np

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import MAX_MBIT_PER_S, Knots, Rate, held_rates
from bufgym.traces.formats.recipes import field_of, unit_named
from bufgym.traces.formats.text import NUMBER, Line, open_text, split_cells
from bufgym.traces.formats.units import UNIT_S
from bufgym.traces.trace import US_PER_S, Float64Array
from bufgym.utils.errors import BufgymError
from bufgym.utils.units import RATES

RATES_HEADER: Final = "time_s,bytes_per_s"
NAMED: Final = "--time COL --rate COL --unit kB/s (read_trace(columns=Columns(...)))"
_RATE_NAMES: Final = {name.lower() for name in RATES}

_MAX_EPOCH_S: Final = 10**10
_ROWS: Final = 1000  # Lines by which a table is known


@dataclass(frozen=True)
class Columns:
    """Which columns of a table hold what: each by its name in the header, or by its number from 1."""

    time: str
    rate: str = ""
    unit: str = "bit/s"
    """Of the rate: B/s, kB/s, Mbit/s, ..."""
    time_unit: str = ""
    """s, ms, us or ns; by default that in the time's name, else s, or by the steps of poses."""
    pose: tuple[str, ...] = ()
    """x, y[, z[, qx, qy, qz, qw]], or latitude, longitude[, altitude]."""
    bytes: str = ""
    """Of messages, with their topic or without."""
    topic: str = ""

    def named(self, *fields: str) -> dict[str, str]:
        """The columns of those of these fields that are chosen, which the first two must be."""
        if missing := [field for field in fields[:2] if not getattr(self, field)]:
            raise BufgymError(f"columns must name {' and '.join(missing)}")
        return {field: getattr(self, field) for field in fields if getattr(self, field)}


class Head(NamedTuple):
    """The first lines of a table."""

    first: Line | None  # that is no remark
    remarks: list[str]  # above it
    header: Line | None  # the last line above the first with a number; it may be a remark
    names: list[str]  # of the columns, by the header; none where they are not as many
    rows: list[tuple[Line, list[str]]]  # with as many cells as the first with a number

    @property
    def separator(self) -> str:
        """What stands between the cells of a line."""
        return separator_of(self.rows[0][0].text)

    def numbers(self, place: int) -> tuple[Float64Array, int]:
        """The numbers of a column until the first cell that is none, and how many decimals they have at most."""
        cells = list(takewhile(is_number, (cells[place] for _, cells in self.rows)))
        return np.array(cells, np.float64), max((len(cell.partition(".")[2]) for cell in cells), default=0)


def head_of(path: StrPath) -> Head:
    """The first lines of a file."""
    first, header, remarks, names, rows = None, None, list[str](), list[str](), list[tuple[Line, list[str]]]()
    with open_text(path) as file:
        for line in file.lines():
            is_remark = line.text.startswith("#")
            cells = cells_of(line.text.lstrip("#"), separator_of(line.text))
            if first is None:
                remarks += [line.text] * is_remark
                first = None if is_remark else line
            if not rows and (is_remark or not any(map(is_number, cells))):
                header, names = line, cells
            elif not is_remark and (not rows or len(cells) == len(rows[0][1])):
                rows.append((line, cells))
            if len(rows) == _ROWS:
                break
    return Head(first, remarks, header, names if rows and len(names) == len(rows[0][1]) else [], rows)


def is_number(text: str) -> bool:
    """Whether a cell is a plain number."""
    return re.fullmatch(NUMBER, text) is not None


def fits_rates(text: str) -> Columns | None:
    """The columns of a header that names one time and one rate, as `time_s,bytes_per_s` and `time,mbps` do."""
    names = split_cells(text)
    times = [name for name in names if field_of(name) == "time"]
    rates = [name for name in names if name.lower() in _RATE_NAMES]
    return Columns(times[0], rates[0], rates[0]) if len(times) == len(rates) == 1 else None


def read_table(path: StrPath, columns: Columns | None = None) -> Knots:
    """Times and rates by the rules of `held_rates`, in columns that are chosen or that a header names (`fits_rates`).

    Cells lie between commas, semicolons or blanks; times are numbers or ISO dates.
    """
    with open_text(path) as file:
        fits = fits_rates if columns is None else bool
        first, lines = file.below_header(f"the header {RATES_HEADER} or time,mbps", fits)
        columns = columns or fits_rates(first.text)
        assert columns is not None
        if columns.unit not in RATES:
            rule = "b is a bit and B a byte: must be as Mbps or MBps"
            raise fault(path, rule, value=columns.unit, field="unit of the rate")
        return held_rates(path, _rates(chain([first], lines), columns, RATES[columns.unit] / US_PER_S))


def _rates(lines: Iterator[Line], columns: Columns, unit: float) -> Iterator[Rate]:
    """The rate of each line; ``unit`` is bytes per microsecond of theirs."""
    for line, (time, rate), names in table_cells(lines, list(columns.named("time", "rate").values())):
        named, start_us = time_unit(columns, names[0]), date_us(time)
        if start_us is None:
            unit_s = UNIT_S[named or "s"]
            start_us = round(
                line.decimal(f"time in {named or 's'}", time, 0, _MAX_EPOCH_S / unit_s) * unit_s * US_PER_S
            )
        value = line.decimal(columns.unit, rate, 0, MAX_MBIT_PER_S * 0.125 / unit)
        yield Rate(line, time, start_us, value * unit, named)


def table_cells(lines: Iterator[Line], wanted: Sequence[str]) -> Iterator[tuple[Line, list[str], list[str]]]:
    """Each line of a table with its cells in these columns, and the columns' names."""
    places, names, count, separator = list[int](), list[str](), 0, ""
    for line in lines:
        if not count:
            separator = separator_of(line.text)
            header = cells_of(line.text.lstrip("#"), separator)
            count = len(header)
            places = [place_of(line, header, name) for name in wanted]
            names = [header[k] for k in places]
            if not all(is_number(header[k]) or date_us(header[k]) for k in places):
                continue
        if line.text.startswith("#"):
            continue
        cells = cells_of(line.text, separator, count)
        if len(cells) != count:
            raise line.misfit(f"must have {count} columns, has {len(cells)}")
        yield line, [cells[k] for k in places], names


def time_unit(columns: Columns | None, name: str) -> str:
    """The unit of times as chosen, or as their column's name ends with it; empty where neither says it."""
    unit = columns.time_unit if columns else ""
    if unit not in ("", *UNIT_S):
        raise BufgymError(f"time_unit = {unit!r}: must be one of {', '.join(UNIT_S)}")
    # A column named time_s may hold anything.
    return unit or unit_named(name).removesuffix("s" if name == "time_s" else "?")


def separator_of(text: str) -> str:
    """What stands between the cells of a line; empty for blanks."""
    return next((mark for mark in ";,\t" if mark in text), "")


def cells_of(text: str, separator: str, count: int = 1) -> list[str]:
    """The cells of a line, without quotes; between semicolons, commas are decimal points.

    A separator at the end begins no cell beyond ``count``.
    """
    if separator == ";":
        text = text.replace(",", ".")  # decimal commas
    cells = [cell.strip().strip('"') for cell in text.split(separator or None)]
    return cells[:-1] if separator and len(cells) > count and not cells[-1] else cells


def place_of(line: Line, header: list[str], name: str) -> int:
    """The place of a column that is numbered from 1, or named."""
    if name.isdecimal() and 1 <= int(name[:6]) <= len(header):
        return int(name) - 1
    if name in header:
        return header.index(name)
    raise line.error(None, f"has no column {name!r}: must be one of {', '.join(header)[:300]}, or a number from 1")


def date_us(text: str) -> int | None:
    """Microseconds since 1970 of an ISO date, in UTC where it names no zone; None for other text."""
    try:
        date = datetime.fromisoformat(text if "-" in text else "")
    except ValueError:
        return None
    return round(date.replace(tzinfo=date.tzinfo or UTC).timestamp() * US_PER_S)
