"""Bandwidth traces from files, in the formats that public data sets come in.

docs/guide/recordings.md has a table of them. Any may be gzip'd. The format is recognised by the first line that is not
blank, and stated in the trace's `source`; a line that fits two formats is an error. Blank lines are skipped. Every
other line must follow its format exactly, because a wrong capacity is worse than none.

Limits beyond which a number counts as a mistake: 10**7 s in all, 86,400 s from one rate to the next, 10**12 bytes in an
interval, 10**6 Mbit/s. `text.py` has the limits of text files.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, get_args

from bufgym.traces import plausible
from bufgym.traces.formats import tables
from bufgym.traces.formats.faults import StrPath, fault, heard
from bufgym.traces.formats.intervals import Knots
from bufgym.traces.formats.iperf3 import DIRECTIONS, read_iperf3
from bufgym.traces.formats.logs import RULER, RUN, RUNS, UCC_COLUMNS, fits_ucc, read_runs, read_sabre, read_ucc
from bufgym.traces.formats.mahimahi import read_mahimahi
from bufgym.traces.formats.recipes import Recipe, read_link, recipes
from bufgym.traces.formats.splits import refuse_recording
from bufgym.traces.formats.text import NUMBER, open_text
from bufgym.traces.sheet import Sheet, time_facts
from bufgym.traces.trace import US_PER_S, After, Holes, Trace
from bufgym.utils.errors import BufgymError, TraceError

_DIRECTION: Final = re.compile("DL_|UL_|download|upload")  # in the note of a format
_SIDES: Final = {"dl": "download", "do": "download", "ul": "upload", "up": "upload"}
_SUFFIXES: Final = (".csv", ".log", ".txt", ".dat", ".json", ".list", ".out")


@dataclass(frozen=True)
class Format:
    """How to recognise a format by its first line, and how to read its knots."""

    layout: str  # what a line looks like, in words
    fits: Callable[[str], object]  # whether a first line is one of this format
    read: Callable[..., Knots]  # reads a file's knots; with `columns`, the one to read is its second argument
    columns: tuple[str, ...] = ()  # the columns to choose from, the default first; empty where there is no choice


def _cells(*patterns: str, between: str = r"\s+") -> Callable[[str], object]:
    """Whether a line is cells of these patterns."""
    # Compiled at its first use: most lines fit one of the first formats.
    return lambda text: re.fullmatch(between.join(patterns), text)


def _by_recipe(recipe: Recipe) -> Format:
    """The format of another tool."""
    return Format(
        recipe.about, recipe.first.fullmatch, lambda path, *column: read_link(path, recipe, *column), recipe.columns
    )


FORMATS: Final[dict[str, Format]] = {
    "mahimahi": Format("one number, the ms of a packet", _cells(NUMBER), read_mahimahi),
    "mbit": Format(
        "two numbers, s and Mbit/s",
        _cells(NUMBER, NUMBER),
        lambda path: tables.read_table(path, tables.Columns("1", "2", "Mbit/s")),
    ),
    "rates": Format(f"header {tables.RATES_HEADER} or time,mbps", tables.fits_rates, tables.read_table),
    "ucc": Format("header with Timestamp, DL_bitrate, UL_bitrate", fits_ucc, read_ucc, UCC_COLUMNS),
    "sabre": Format("JSON list", _cells(r"\["), read_sabre),
    "iperf3": Format("JSON objects", _cells(r"\{"), read_iperf3, DIRECTIONS),
    "runs": Format("Run 1, or ###", lambda text: RUN.fullmatch(text) or RULER.fullmatch(text), read_runs, RUNS),
    **{name: _by_recipe(recipe) for name, recipe in recipes("links").items() if not recipe.says},
}


def read_trace(
    path: StrPath,
    format: str | None = None,
    after: After = "loop",
    *,
    column: str | None = None,
    columns: tables.Columns | None = None,
    holes: Holes = "hold",
) -> Trace:
    """Read a bandwidth trace.

    Args:
        path: the file, plain or gzip'd.
        format: one of `FORMATS`; by default it is detected from the content.
        after: as in `Trace`.
        column: the one to read, where a format has several (`ucc`: DL_bitrate, the default, or UL_bitrate; `runs`:
            run 1, the default, run 2, ...; `iperf3 --bidir`: upload, the default, or download).
        columns: of any other table, which columns hold time and rate; without `format` and `column`.
        holes: in a stretch without samples (`plausible.holes`) "hold" the rate before it, send nothing ("zero"), or
            "refuse" the file.

    Returns:
        The trace, named after the file; `source` states the file, the format, and anything notable about the reading.
    """
    if holes not in get_args(Holes):
        raise BufgymError(f"holes = {holes!r}: must be one of {', '.join(get_args(Holes))}")
    refuse_recording(path, "must be a bandwidth trace")
    with heard() as doubts:
        about, (time_us, cumulative_bytes, note, start_us, ends) = _knots(path, format, column, columns)
        source = f"{path} ({about}{', ' if note else ''}{note})"
        try:
            trace = Trace(trace_name(path), time_us, cumulative_bytes, after, source)
        except BufgymError as error:
            raise TraceError(f"{path}: {error}") from error
        if ends:
            trace = plausible.over_holes(path, trace, ends, time_us[:-1], holes)
    facts = time_facts("samples", time_us if about.startswith("format mahimahi") else time_us[:-1], start_us)
    side = _DIRECTION.search(note)
    facts += (("direction", _SIDES[side[0][:2].lower()] if side else "not said in the file"),)
    if trace.holes:
        lost_s = sum(end - start for start, end in trace.holes) / US_PER_S
        facts += (("holes", f"{len(trace.holes)}, {lost_s:,.6g} s in all: {holes}"),)
    return replace(trace, sheet=Sheet(facts, tuple(doubts)))


def _knots(path: StrPath, format: str | None, column: str | None, columns: tables.Columns | None) -> tuple[str, Knots]:
    """How the file is read, in words, and what it holds."""
    if columns is not None:
        if format is not None or column is not None:
            raise BufgymError("columns of a table go without format and column")
        about = f"columns {columns.time} and {columns.rate} in {columns.unit}"
        return about, tables.read_table(path, columns)
    origin = "requested"
    if format is None:
        format, origin = detect_format(path), "detected"
    elif format not in FORMATS:
        raise BufgymError(f"format = {format!r}: must be one of {', '.join(FORMATS)}")
    choices = FORMATS[format].columns
    if column is not None and column not in choices:
        rule = f"must be one of {', '.join(choices)}" if choices else f"format {format} has no columns to choose from"
        raise BufgymError(f"column = {column!r}: {rule}")
    return f"format {format}, {origin}", FORMATS[format].read(path, *filter(None, [column]))


def detect_format(path: StrPath) -> str:
    """The one format that the file's first line fits."""
    with open_text(path) as file:
        line = file.first()
    if line is None:
        raise fault(path, "is empty: must hold a trace")
    names = [name for name, format in FORMATS.items() if format.fits(line.text)]
    if len(names) > 1:
        rule = f"fits more than one format ({', '.join(names)}): say which with format=... (trace convert --format)"
        raise line.error(line.text, rule)
    for recipe in recipes("links").values():
        if recipe.says and recipe.first.fullmatch(line.text):
            raise fault(path, recipe.says)
    if not names:
        layouts = "; ".join(f"{name}: {format.layout}" for name, format in FORMATS.items())
        raise line.misfit(f"must fit a known format ({layouts}), or name its columns: {tables.NAMED}")
    return names[0]


def trace_name(path: StrPath) -> str:
    """The file's name without `.gz` and the usual endings: "TMobile-LTE-short.down", "report_car_0002"."""
    name = Path(path).name.removesuffix(".gz")
    for suffix in _SUFFIXES:
        name = name.removesuffix(suffix)
    return name
