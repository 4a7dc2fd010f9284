"""Readers of UCC's 4G and 5G CSV (G-NetTrack Pro), Sabre's JSON, and lists of speed tests, several runs in a file.

Sources: UCC's 4G and 5G logs [raca2018beyond], [raca2020beyond]; K. Spiteri et al., "From Theory to
Practice: Improving Bitrate Adaptation in the DASH Reference Player", MMSys 2018; lists: M. Ghoshal
et al., "An In-Depth Study of Uplink Performance of 5G mmWave Networks", 5G-MeMU 2022.
"""

import json
import re
from collections.abc import Callable, Iterator
from datetime import datetime
from typing import Any, Final

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import MAX_MBIT_PER_S, Intervals, Knots, Rate, held_rates
from bufgym.traces.formats.text import Line, open_text, split_cells
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S
from bufgym.utils import strict_json

UCC_COLUMNS: Final = ("DL_bitrate", "UL_bitrate")

# Samples about 1 s apart with stamps of whole seconds: two may share one, and the next may be some seconds later.
MIN_UCC_STEP_S: Final = -2
MAX_UCC_STEP_S: Final = 5

_MAX_KBIT_PER_S: Final = MAX_MBIT_PER_S * 1000
_UCC_TIME: Final = "Timestamp"
_UCC_TIME_FORMAT: Final = "%Y.%m.%d_%H.%M.%S"
_SHOWN_CHARACTERS: Final = 40
_BLANKS: Final = re.compile(r"\s*")
MAX_RUNS: Final = 16
RUNS: Final = tuple(f"run {number}" for number in range(1, MAX_RUNS + 1))  # Values of `column`
RUN_STEP_S: Final = 0.1  # Time between the samples of a run without times, s; runs with times have this step
RUN: Final = re.compile(r"Run ([0-9]{1,3})")
RULER: Final = re.compile(r"#{3,}")


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
        header, lines = file.below_header(f"a header that names {_UCC_TIME}, {', '.join(UCC_COLUMNS)}", fits_ucc)
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
            intervals.add(US_PER_S, round(kbit_per_s * 125))
    if first is not None and previous is not None and previous < first:
        raise fault(path, "ends before it begins: must be in order of time", field=_UCC_TIME)
    clock_s = 0 if first is None or previous is None else (previous - first).total_seconds()
    return intervals.knots(path, f"column {column}, 1 s a line, {clock_s:g} s by its clock")


def _stamp(line: Line, text: str) -> datetime:
    try:
        return datetime.strptime(text, _UCC_TIME_FORMAT)
    except ValueError:
        raise line.error(text, "must be a time as 2019.12.16_13.40.04", _UCC_TIME) from None


def read_sabre(path: StrPath) -> Knots:
    """A JSON list of objects with `duration_ms` and `bandwidth_kbps` (1000 bit/s); their other members are ignored."""
    samples = read_json(path)
    if not isinstance(samples, list):
        raise fault(path, "must be a list of objects")
    intervals = Intervals()
    for line, sample in json_items(path, samples):
        length_us = round(json_number(line, sample, "duration_ms", MAX_DURATION_S * 1000) * 1000)
        kbit_per_s = json_number(line, sample, "bandwidth_kbps", _MAX_KBIT_PER_S)
        if length_us == 0:
            raise line.error(0, "must be above 0", "duration_ms")
        # kbit/s times microseconds is thousandths of a bit.
        intervals.add(length_us, round(kbit_per_s * length_us / 8000))
    return intervals.knots(path)


def read_json(path: StrPath) -> Any:
    """The file's JSON, whose numbers are finite."""
    values = read_json_values(path)
    if len(values) != 1:
        raise fault(path, f"must be JSON (holds {len(values)} values: must hold one)")
    return values[0]


def _once(members: list[tuple[str, Any]]) -> dict[str, Any]:
    """The object with these members, each of which has a name of its own."""
    item = dict(members)
    if len(item) < len(members):
        twice = next(name for k, (name, _) in enumerate(members) if name in dict(members[:k]))
        raise ValueError(f"an object holds {twice!r} twice: must hold it once")
    return item


def read_json_values(path: StrPath, pairs: Callable[[list[tuple[str, Any]]], dict[str, Any]] = _once) -> list[Any]:
    """The values of JSON that follow each other in the file, whose numbers are finite; see `strict_json.Decoder`."""
    with open_text(path) as file:
        text = file.text()
    decoder, values = strict_json.Decoder(pairs), []
    at = len(text) - len(text.lstrip())
    try:
        while at < len(text):
            value, end = decoder.raw_decode(text, at)
            values.append(value)
            at = _BLANKS.match(text, end).end()  # type: ignore[union-attr]  # matches anywhere
        return values
    except json.JSONDecodeError as error:
        value = text[error.pos : error.pos + _SHOWN_CHARACTERS] or None
        sound = f"; the {len(values)} values above are sound" if values else ""
        raise fault(path, f"must be JSON ({error.msg}){sound}", line=error.lineno, value=value) from error
    except (ValueError, RecursionError) as error:
        reason = "nested too deep" if isinstance(error, RecursionError) else str(error).partition(";")[0]
        raise fault(path, f"must be JSON ({reason})") from error


def json_items(path: StrPath, items: list[Any]) -> Iterator[tuple[Line, Any]]:
    """Each item of a list with a `Line` that names it in error messages, counted from 1."""
    for number, item in enumerate(items, 1):
        yield Line(f"{path}, item {number}", 0, json.dumps(item)), item


def json_number(line: Line, item: Any, name: str, most: float) -> float:
    """The member of that name, a number from 0 to `most`."""
    value = item.get(name) if isinstance(item, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise line.error(line.text if value is None else value, f"must hold {name}, a number")
    if not 0 <= value <= most:
        raise line.error(value, f"must be from 0 to {most:g}", name)
    return value


def read_runs(path: StrPath, column: str = RUNS[0]) -> Knots:
    """One run of a file that has several: under its heading `Run N` a line of Mbit/s, or first one of times in s.

    Lines hold a whole run, so the file is read at once. Without times the samples are `RUN_STEP_S` apart. Where a run
    has further pairs of lines, of another network at the same time, the first is read; the note counts them.
    """
    runs = runs_of(path)
    if column not in runs:
        raise fault(path, f"has no {column}: must be one of {', '.join(runs) or 'none'}")
    lines = runs[column]
    if not lines:
        raise fault(path, f"{column} must have a line of Mbit/s")
    if len(lines) > 1 and len(lines) % 2:
        raise lines[-1].error(None, f"{column} must have one line, or pairs of them: times in s, Mbit/s")
    rates = lines[min(1, len(lines) - 1)]
    cells = split_cells(rates.text)
    times = split_cells(lines[0].text) if len(lines) > 1 else [f"{RUN_STEP_S * k:.1f}" for k in range(len(cells))]
    if len(times) != len(cells):
        raise rates.error(len(cells), f"must be as many as times in the line above ({len(times)})", "samples")
    steps = "times as stated" if len(lines) > 1 else f"a sample each {RUN_STEP_S:g} s"
    note = f"{column} of {len(runs)}, {steps}" + (f", the first of {len(lines) // 2} pairs" if len(lines) > 2 else "")
    knots = held_rates(path, _rates(lines[0], times, rates, cells))
    return knots._replace(note=", ".join(filter(None, (note, knots.note))))


def runs_of(path: StrPath) -> dict[str, list[Line]]:
    """The runs of a file with their lines, in its order; their numbers may have another."""
    with open_text(path) as file:
        text = file.text()
    runs: dict[str, list[Line]] = {}
    for number, content in enumerate(text.split("\n"), 1):
        line = Line(path, number, content.strip())
        match = RUN.fullmatch(line.text)
        if match is not None:
            name = f"run {int(match[1])}"
            if name not in RUNS or name in runs:
                raise line.error(match[1], f"must be from 1 to {MAX_RUNS}, and no run's above", "Run")
            runs[name] = []
        elif line.text and not RULER.fullmatch(line.text):
            if not runs:
                raise line.error(line.text, "must come under a heading, Run 1")
            runs[next(reversed(runs))].append(line)
    return runs


def _rates(timed: Line, times: list[str], line: Line, cells: list[str]) -> Iterator[Rate]:
    for time, cell in zip(times, cells, strict=True):
        start_us = round(timed.decimal("time in s", time, 0, MAX_DURATION_S) * US_PER_S)
        yield Rate(line, time, start_us, line.decimal("Mbit/s", cell, 0, MAX_MBIT_PER_S) * 0.125)
