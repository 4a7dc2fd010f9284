"""Readers of the logs of measuring tools: UCC's 4G and 5G CSV (G-NetTrack Pro), NYU-METS (iPerf), Sabre's JSON.

Sources: UCC's 4G and 5G logs [raca2018beyond], [raca2020beyond]; NYU-METS, L. Mei et al., "Realtime Mobile Bandwidth
Prediction using LSTM Neural Networks", PAM 2019 (extended: [mei2020realtime]); K. Spiteri et al., "From Theory to
Practice: Improving Bitrate Adaptation in the DASH Reference Player", MMSys 2018.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from datetime import datetime
from typing import Final, NoReturn

from bufgym.ground.errors import TraceError
from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import Intervals, Knots
from bufgym.traces.formats.tables import MAX_MBIT_PER_S
from bufgym.traces.formats.text import Line, is_number, open_text, split_cells
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S

UCC_COLUMNS: Final = ("DL_bitrate", "UL_bitrate")

# Samples about 1 s apart with stamps of whole seconds: two may share one, and the next may be some seconds later.
MIN_UCC_STEP_S: Final = -2
MAX_UCC_STEP_S: Final = 5

_MAX_KBIT_PER_S: Final = MAX_MBIT_PER_S * 1000
_UCC_TIME: Final = "Timestamp"
_UCC_TIME_FORMAT: Final = "%Y.%m.%d_%H.%M.%S"
_NYU_BITS: Final = {"bits/sec": 1, "Kbits/sec": 10**3, "Mbits/sec": 10**6, "Gbits/sec": 10**9}
_SABRE_FIELDS: Final = {"duration_ms": MAX_DURATION_S * 1000, "bandwidth_kbps": _MAX_KBIT_PER_S}
_SHOWN_CHARACTERS: Final = 40
_MARK: Final = re.compile(r"[ \t\n\r]*([\[\],]?)[ \t\n\r]*")


def fits_ucc(text: str) -> bool:
    """A header with a time and both bitrates among its columns."""
    return {_UCC_TIME, *UCC_COLUMNS} <= set(split_cells(text))


def read_ucc(path: StrPath, column: str = "DL_bitrate") -> Knots:
    """Each line counts for 1 s at its rate in kbit/s, as in the data set's own figures.

    The stamps have whole seconds only, and two lines often share one. By the stamps a recording lasts up to a tenth
    longer than by its number of lines; the note says how long. A stamp more than 2 s before the latest above, or 5 s
    after the line above, counts as a gap and is refused; so is a file that ends before it begins.
    """
    intervals = Intervals()
    with open_text(path) as file:
        lines = file.lines()
        header = next(lines, None)
        columns = ", ".join((_UCC_TIME, *UCC_COLUMNS))
        if header is None or not fits_ucc(header.text):
            raise fault(path, f"must begin with a header that names {columns}", line=header and header.number)
        names = split_cells(header.text)
        time_at, rate_at = names.index(_UCC_TIME), names.index(column)
        first = previous = latest = None
        for line in lines:
            cells = line.columns(len(names), ",")
            time = _stamp(line, cells[time_at])
            if previous is not None and latest is not None:
                # Measured from the latest, so that a file in reverse is not taken for one step back after the other.
                if (time - latest).total_seconds() < MIN_UCC_STEP_S:
                    rule = f"must be at most {-MIN_UCC_STEP_S} s before the latest above"
                    raise line.error(cells[time_at], rule, _UCC_TIME)
                if (time - previous).total_seconds() > MAX_UCC_STEP_S:
                    rule = f"must be at most {MAX_UCC_STEP_S} s after the line above"
                    raise line.error(cells[time_at], rule, _UCC_TIME)
            first, previous, latest = first or time, time, max(latest or time, time)
            kbit_per_s = line.decimal(column, cells[rate_at], 0, _MAX_KBIT_PER_S)
            intervals.add(line, US_PER_S, round(kbit_per_s * 125))
    if first is not None and previous is not None and previous < first:
        raise fault(path, "ends before it begins: must be in order of time", field=_UCC_TIME)
    clock_s = 0 if first is None or previous is None else (previous - first).total_seconds()
    return intervals.knots(path, f"column {column}, 1 s a line, {clock_s:g} s by its clock")


def _stamp(line: Line, text: str) -> datetime:
    try:
        return datetime.strptime(text, _UCC_TIME_FORMAT)
    except ValueError:
        raise line.error(text, "must be a time as 2019.12.16_13.40.04", _UCC_TIME) from None


def fits_nyu(text: str) -> bool:
    """A number and one of iPerf's units."""
    cells = split_cells(text)
    return len(cells) == 2 and is_number(cells[0]) and cells[1] in _NYU_BITS


def read_nyu(path: StrPath) -> Knots:
    """Each line is the rate of 1 s with its unit; bytes are rounded to whole numbers."""
    intervals = Intervals()
    with open_text(path) as file:
        for line in file.lines():
            value, unit = line.columns(2, ",")
            if unit not in _NYU_BITS:
                raise line.error(unit, f"must be one of {', '.join(_NYU_BITS)}", "unit")
            most = MAX_MBIT_PER_S * 10**6 / _NYU_BITS[unit]
            intervals.add(line, US_PER_S, round(line.decimal(unit, value, 0, most) * _NYU_BITS[unit] / 8))
    return intervals.knots(path)


def fits_sabre(text: str) -> bool:
    """The opening bracket of a list."""
    return text.startswith("[")


def read_sabre(path: StrPath) -> Knots:
    """A JSON list of objects with `duration_ms` and `bandwidth_kbps` (1000 bit/s); their other members are ignored.

    Samples are parsed one by one, so that an error names the line of its sample and only one is held as objects.
    """
    with open_text(path) as file:
        text = file.text()
    intervals = Intervals()
    for line, sample in json_items(path, text):
        _add_sample(intervals, line, sample)
    return intervals.knots(path)


def json_items(path: StrPath, text: str, start: int = 0) -> Iterator[tuple[Line, object]]:
    """The items of the list that begins at `start`, each with its line; a list from 0 on must be all of the text."""
    decoder = json.JSONDecoder(parse_constant=_no_constant)
    number, counted = 1, 0  # the line number of the place `counted`
    mark = _mark(path, text, start, "[")
    if text.startswith("]", mark.end()):
        mark = _mark(path, text, mark.end(), "]")
    while mark[1] != "]":
        place = mark.end()
        number, counted = number + text.count("\n", counted, place), place
        try:
            item, end = decoder.raw_decode(text, place)
        except (ValueError, RecursionError) as error:
            raise json_error(path, text, number, error) from error
        yield Line(path, number, text[place : min(end, place + _SHOWN_CHARACTERS)]), item
        mark = _mark(path, text, end, ",]")
    if start == 0 and mark.end() < len(text):
        raise _error_at(path, text, mark.end(), "must be nothing after the list")


def _mark(path: StrPath, text: str, place: int, marks: str) -> re.Match[str]:
    """The mark that comes next, with the white space around it; it must be one of `marks`."""
    match = _MARK.match(text, place)
    assert match is not None  # it may match nothing at all
    if not match[1] or match[1] not in marks:
        raise _error_at(path, text, match.start(1), f"must be {marks[0]!r}, for a list of objects")
    return match


def _add_sample(intervals: Intervals, line: Line, sample: object) -> None:
    if not isinstance(sample, dict):
        raise line.error(line.text, "must be an object with duration_ms and bandwidth_kbps")
    values: list[float] = []
    for field, most in _SABRE_FIELDS.items():
        if field not in sample:
            raise line.error(line.text, f"must hold {field}")
        value = sample[field]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise line.error(line.text, f"{field} must be a number")
        if not 0 <= value <= most:
            raise line.error(value, f"must be from 0 to {most:g}", field)
        values.append(value)
    length_us = round(values[0] * 1000)
    if length_us == 0:
        raise line.error(values[0], "must be above 0", "duration_ms")
    # kbit/s times microseconds is thousandths of a bit.
    intervals.add(line, length_us, round(values[1] * length_us / 8000))


def _error_at(path: StrPath, text: str, place: int, rule: str) -> TraceError:
    value = text[place : place + _SHOWN_CHARACTERS] or None
    return fault(path, rule, line=1 + text.count("\n", 0, place), value=value)


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a finite number")


def json_error(path: StrPath, text: str, number: int, error: Exception) -> TraceError:
    """What to raise about text that is no JSON; `number`: the line, where the error does not know it."""
    if isinstance(error, json.JSONDecodeError):
        value = text[error.pos : error.pos + _SHOWN_CHARACTERS]
        return fault(path, f"must be JSON ({error.msg})", line=error.lineno, value=value)
    reason = "nested too deep" if isinstance(error, RecursionError) else str(error).partition(";")[0]
    return fault(path, f"must be JSON ({reason})", line=number)
