"""Bandwidth traces from files, in the formats that public data sets come in.

| format | a line | where found |
|---|---|---|
| `mahimahi` | ms, one 1500-byte packet each | mahimahi (`mahimahi.py` says how packets become capacity) |
| `csv` | `t_ms,bytes,interval_ms` under that header; t_ms ENDS the interval | bufgym's own; Belgium 4G |
| `mbit` | seconds and Mbit/s between white space | Pensieve-cooked Norway HSDPA, Lumos5G, Solis WiFi |
| `belgium` | epoch ms, ms since start, latitude, longitude, bytes, interval ms | raw Belgium 4G logs |
| `rates` | `time_s,bytes_per_s` under that header; the rate holds until the next line | anybody's |
| `ucc` | under a header with Timestamp, DL_bitrate and UL_bitrate, kbit/s | UCC 4G and 5G data sets |
| `nyu` | `0.57,Mbits/sec`, a line a second | NYU-METS |
| `sabre` | JSON: `[{"duration_ms": 1000, "bandwidth_kbps": 33809}, ...]` | Sabre |

Any of them may be gzip'd, or a zip's member (`archive.zip:member`; `archive.zip` if it has just one). The format is
told from the first line that is not blank, and stated in the trace's `source`; a line that two formats fit is an
error. Blank lines are skipped; every other line must follow its format to the letter, for a wrong capacity is worse
than none.

Limits, beyond which a number is taken for a mistake: 10**7 s in all, 86,400 s from one rate to the next, 10**12 bytes
in an interval, 10**6 Mbit/s; `files.py` has those of the text.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bufgym.errors import BufgymError, TraceError, where
from bufgym.traces.files import StrPath, TextFile
from bufgym.traces.mahimahi import read_mahimahi
from bufgym.traces.readers_intervals import Knots
from bufgym.traces.readers_logs import UCC_COLUMNS, fits_nyu, fits_sabre, fits_ucc, read_nyu, read_sabre, read_ucc
from bufgym.traces.readers_text import (
    CSV_HEADER,
    RATES_HEADER,
    has_header,
    numbers,
    read_belgium,
    read_csv,
    read_mbit,
    read_rates,
)
from bufgym.traces.trace import After, Trace

_SUFFIXES: Final = (".csv", ".log", ".txt", ".dat", ".json")


@dataclass(frozen=True)
class Format:
    """How to recognise a format by its first line, and how to read its knots.

    Attributes:
        layout: what a line looks like, in words.
        fits: whether a first line is one of this format.
        read: the file's knots.
        columns: the columns among which a reader may choose, the default first; empty where there is no choice.
        read_column: the knots by such a column.
    """

    layout: str
    fits: Callable[[str], bool]
    read: Callable[[StrPath], Knots]
    columns: tuple[str, ...] = ()
    read_column: Callable[[StrPath, str], Knots] | None = None


FORMATS: Final[dict[str, Format]] = {
    "mahimahi": Format("one number, the ms of a packet", numbers(1), read_mahimahi),
    "csv": Format(f"header {CSV_HEADER}", has_header(CSV_HEADER), read_csv),
    "mbit": Format("two numbers, s and Mbit/s", numbers(2), read_mbit),
    "belgium": Format("six numbers", numbers(6), read_belgium),
    "rates": Format(f"header {RATES_HEADER}", has_header(RATES_HEADER), read_rates),
    "ucc": Format("header with Timestamp, DL_bitrate, UL_bitrate", fits_ucc, read_ucc, UCC_COLUMNS, read_ucc),
    "nyu": Format("number,unit with a unit such as Mbits/sec", fits_nyu, read_nyu),
    "sabre": Format("JSON list", fits_sabre, read_sabre),
}


def read_trace(path: StrPath, format: str | None = None, after: After = "loop", *, column: str | None = None) -> Trace:
    """Read a bandwidth trace.

    Args:
        path: the file, plain, gzip'd or zipped; `archive.zip:member` is a member of a zip.
        format: one of `FORMATS`; by default it is detected from the content.
        after: what follows the end of the trace (see `Trace`).
        column: where a format has several columns of rates (`ucc`: DL_bitrate, the default, or UL_bitrate), the one
            to read.

    Returns:
        The trace, named after the file; `source` states the file, the format, and what else is to be said.

    Raises:
        TraceError: the file is missing, empty, damaged, of no known format, of two, or breaks a rule of its format.
            The message names the file, the line, the value and the rule.
        BufgymError: an unknown `format`, `after` or `column`.
    """
    told = "as told"
    if format is None:
        format, told = detect_format(path), "detected"
    elif format not in FORMATS:
        raise BufgymError(f"format = {format!r}: must be one of {', '.join(FORMATS)}")
    time_us, cumulative_bytes, note = _read(path, format, column)
    source = f"{path} (format {format}, {told}{', ' if note else ''}{note})"
    try:
        return Trace(trace_name(path), time_us, cumulative_bytes, after, source)
    except BufgymError as error:
        raise TraceError(f"{path}: {error}") from error


def _read(path: StrPath, format: str, column: str | None) -> Knots:
    known = FORMATS[format]
    if column is None:
        return known.read(path)
    if known.read_column is None:
        raise BufgymError(f"column = {column!r}: format {format} has no columns to choose from")
    if column not in known.columns:
        raise BufgymError(f"column = {column!r}: must be one of {', '.join(known.columns)}")
    return known.read_column(path, column)


def detect_format(path: StrPath) -> str:
    """The one format that the file's first line fits.

    Raises:
        TraceError: it fits none, or several (then `read_trace` needs its `format` argument), or cannot be
            read.
    """
    with TextFile(path) as file:
        line = file.first()
    if line is None:
        raise TraceError(where(path, None, None, "is empty: must hold a trace"))
    found = [name for name, format in FORMATS.items() if format.fits(line.text)]
    if len(found) > 1:
        rule = f"fits more than one format ({', '.join(found)}): say which with format=... (command line: --format)"
        raise line.error(line.text, rule)
    if not found:
        layouts = "; ".join(f"{name}: {format.layout}" for name, format in FORMATS.items())
        raise line.error(line.text, f"must fit a known format ({layouts})")
    return found[0]


def trace_name(path: StrPath) -> str:
    """The file's name without `.gz`, `.zip` and the usual endings: "TMobile-LTE-short.down", "report_car_0002"."""
    name = Path(path).name.rpartition(".zip:")[2].removesuffix(".gz").removesuffix(".zip")
    for suffix in _SUFFIXES:
        name = name.removesuffix(suffix)
    return name
