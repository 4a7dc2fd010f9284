"""Leaderboard: results of each policy on each suite, with the command that repeats and checks them."""

import hashlib
import io
import math
import re
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bufgym.benchmark import bootstrap, folder, score
from bufgym.benchmark.bootstrap import Interval
from bufgym.benchmark.rows import Layout, Row, parsed, write_rows
from bufgym.benchmark.sources import made_of
from bufgym.benchmark.summary import places, shown, summarise
from bufgym.benchmark.sweep import Sweep, run_sweep
from bufgym.benchmark.table import NONE, Table
from bufgym.benchmark.tasks import task_of
from bufgym.jit.fingerprint import fingerprint
from bufgym.scenario import suites
from bufgym.utils import __version__
from bufgym.utils.errors import BufgymError, where
from bufgym.utils.files import read_utf8, write_text

__all__ = ["of_folder", "write"]

COLUMNS: Layout = {
    **{"suite": str, "policy": str, "rank": int, "cells": int, "quantity": str},
    **{"value": float, "low": float, "high": float, "bufgym": str, "made_of": str},
    "command": str,
}
"""Columns of the file, which has one line for each quantity of an entry."""

UNKNOWN = "unknown"
"""What a row says that was made before rows said what their policy is made of."""

MAX_BYTES = 16 * 2**20  # Size limit of the file; each line has some 200 bytes

_ROUNDING = 1e-9


@dataclass(frozen=True)
class Entry:
    suite: str
    policy: str  # as ``bufgym bench --policies`` takes it
    rank: int  # 1 for the best; 0 for a policy that is not ranked
    cells: int  # number of cells that the values are over; for one queue only discriminative cells count
    values: Mapping[str, Interval]  # the quantities that the suite's task lists, by key
    bufgym: str  # version that made it
    made_of: str = UNKNOWN  # what the policy was made of, see ``made_of``

    @property
    def name(self) -> str:
        return f"{self.suite}/{self.policy}"

    @property
    def command(self) -> str:
        suite = suites.get(self.suite)
        needs = " --data DIR" if suite.needs else ""
        return f"bufgym bench --suite {suite.source or suite.name} --policies {self.policy}{needs}"


STATISTICS = (
    *(bootstrap.interval, bootstrap.together, bootstrap.links_drawn, bootstrap.students_t.__wrapped__),
    *(score.scores, score._Sample.of.__func__, score._Sample.sums, summarise),  # type: ignore[attr-defined]
)
"""Functions that make the intervals and shares of all pages; what they call counts, too."""
_STAMP = re.compile(r"<!-- statistics (\S+) -->\n?")
_BRACKETS = re.compile(r"\[[-+−]?\d*\.?\d+, [-+−]?\d*\.?\d+\]")


def statistics() -> str:
    """Hash of how intervals and shares are computed, of the kind of ``made_of``."""
    parts = repr([fingerprint(function) for function in STATISTICS])
    return f"{sys.implementation.cache_tag}-{hashlib.sha256(parts.encode()).hexdigest()[:12]}"


def stamped(text: str) -> str:
    """A page of results that was just made, with a comment at its end that says by which statistics."""
    return f"{_STAMP.sub('', text).rstrip()}\n\n<!-- statistics {statistics()} -->\n"


def statistics_of(text: str) -> str | None:
    """By which statistics a page says it was made; ``UNKNOWN`` if it has intervals alone, None without any."""
    found = _STAMP.search(text)
    return found[1] if found else UNKNOWN if _BRACKETS.search(text) else None


def stale_pages(pages: Mapping[Path, str]) -> list[Path]:
    """Those pages, by their text, that say they were made by other statistics than today's, as far as they compare."""
    here, now = f"{sys.implementation.cache_tag}-", statistics()
    return [
        page for page, text in pages.items() if (made := statistics_of(text) or "").startswith(here) and made != now
    ]


def stale(board: Mapping[str, Entry]) -> list[str]:
    """Names of the rows whose policy is made of something else today, as far as they say what it was made of here."""
    here = f"{sys.implementation.cache_tag}-"
    comparable = {name: entry for name, entry in board.items() if entry.made_of.startswith(here)}
    now = {policy: made_of(policy) for policy in {entry.policy for entry in comparable.values()}}
    return [name for name, entry in comparable.items() if entry.made_of != now[entry.policy]]


def entries(rows: Sequence[Row], suite: str, unranked: Mapping[str, str]) -> list[Entry]:
    """Make one entry for each policy of a suite's rows, best first."""
    task = task_of(suite)
    summary = task.summary(rows, unranked)
    cells = len(summary.cells) if summary.scores is None else summary.scores.counted
    return [
        Entry(
            *(suite, s.policy, place.rank or 0, cells, {key: s[key] for key in task.listed}, __version__),
            made_of(s.policy),
        )
        for place, s in zip(places(summary), summary.overall, strict=True)
    ]


def make(path: Path, specs: Mapping[str, Sequence[str]], **options: Any) -> list[Entry]:
    """Run suites with their policies (``specs``, by suite) and write the file, whole or not at all."""
    board = [entry for suite, specs_of_suite in specs.items() for entry in _run(suite, specs_of_suite, **options)]
    write(board, path)
    return board


def _run(suite: str, specs: Sequence[str], data: str | None = None, jobs: int | None = None) -> list[Entry]:
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "run"
        run_sweep(Sweep(suite, tuple(specs), data=data), out, jobs=jobs)
        return of_folder(out)


def of_folder(out: Path) -> list[Entry]:
    """Make one entry for each policy of a run of ``bufgym bench --suite --out``, best first."""
    run = folder.read(out)
    return entries(run.rows, run.manifest["suite"], run.manifest["unranked"])


def validate(entry: Entry, **options: Any) -> Entry:
    """Make the entry anew; raise an error if a value or an interval of the file differs.

    The file's value is not checked against the file's own interval, whose width a row could choose freely.
    """
    specs = dict.fromkeys([entry.policy, task_of(entry.suite).reference])
    (again,) = (e for e in _run(entry.suite, list(specs), **options) if e.policy == entry.policy)
    for key, stated in entry.values.items():
        now = again.values[key]
        if not _agree(stated, now):
            raise BufgymError(f"{entry.name}: {key} is {_in_full(now)}, but the file states {_in_full(stated)}")
    return again


def _agree(stated: Interval, now: Interval) -> bool:
    """Whether the value lies in the new interval, and the two intervals agree within a tenth of the width."""
    if math.isnan(now.value):
        return math.isnan(stated.value)
    if math.isnan(now.low):
        return math.isnan(stated.low) and abs(stated.value - now.value) <= _ROUNDING
    ends = abs(stated.low - now.low), abs(stated.high - now.high)
    inside = now.low - _ROUNDING <= stated.value <= now.high + _ROUNDING
    return inside and all(end <= (now.high - now.low) / 10 + _ROUNDING for end in ends)


def _in_full(interval: Interval) -> str:
    return f"{interval.value:.6f} [{interval.low:.6f}, {interval.high:.6f}]"


def write(board: Sequence[Entry], path: Path) -> None:
    """Write a CSV file, and beside it the same as Markdown."""
    if path.suffix != ".csv":
        raise BufgymError(f"{path}: a leaderboard is written to a .csv file")
    lines = []
    for entry in board:
        for key, interval in entry.values.items():
            cells = {"quantity": key, **interval._asdict()}
            lines.append({name: cells[name] if name in cells else getattr(entry, name) for name in COLUMNS})
    write_rows(lines, path, COLUMNS)
    write_text(path.with_suffix(".md"), markdown(board))


def read(path: Path) -> dict[str, Entry]:
    """Read the entries by name; an error names the file, the line and the unreadable value."""
    text = read_utf8(path, MAX_BYTES)
    if text.partition("\n")[0].rstrip("\r") != ",".join(COLUMNS):
        raise BufgymError(where(path, 1, None, f"must have the columns {', '.join(COLUMNS)}"))
    board: dict[str, Entry] = {}
    for number, row in parsed(path, io.StringIO(text, newline=""), COLUMNS):
        if None in row.values():
            raise BufgymError(where(path, number, None, "must have no empty cell"))
        if row["suite"] not in suites.SUITES:
            raise BufgymError(where(path, number, row["suite"], "must be a suite", field="suite"))
        if row["quantity"] not in (listed := task_of(row["suite"]).listed):
            rule = f"must be one of {', '.join(listed)}"
            raise BufgymError(where(path, number, row["quantity"], rule, field="quantity"))
        entry = Entry(row["suite"], row["policy"], row["rank"], row["cells"], {}, row["bufgym"], row["made_of"])
        values = board.get(entry.name, entry).values
        interval = Interval(row["value"], row["low"], row["high"])
        board[entry.name] = replace(entry, values={**values, row["quantity"]: interval})
    return board


def find(path: Path, name: str) -> Entry:
    board = read(path)
    if name not in board:
        raise BufgymError(f"{path}: no row {name!r}; rows are named suite/policy, such as {next(iter(board), 'none')}")
    return board[name]


def markdown(board: Sequence[Entry]) -> str:
    """Write a table for each suite."""
    out = [
        "# Leaderboard",
        "",
        "Made by `bufgym leaderboard`. `bufgym validate SUITE/POLICY` checks a row. Brackets hold 95 % bootstrap",
        "intervals over the test links, which are drawn jointly for all cells.",
    ]
    for suite in dict.fromkeys(entry.suite for entry in board):
        group = [entry for entry in board if entry.suite == suite]
        task = task_of(suite)
        quantities = [quantity for quantity in task.quantities() if quantity.key in task.listed]
        lines = []
        for entry in group:
            values = [" ".join(filter(None, shown(entry.values[q.key], q))) for q in quantities]
            lines.append([str(entry.rank or NONE), entry.policy, *values])
        head = ["#", "policy", *(quantity.title for quantity in quantities)]
        about = suites.get(suite).about
        command = replace(group[0], policy="POLICY").command
        out += ["", f"## {suite}", "", f"{about[0].upper()}{about[1:]}. `{command}` makes a row again.", ""]
        out += [*(f"- {quantity.title}: {quantity.about}." for quantity in quantities), ""]
        out.append(Table(head, [("", lines)], left=2).markdown())
    return "\n".join(out) + "\n"
