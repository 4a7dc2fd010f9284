"""The table of ``bufgym bench``, and how its numbers are written."""

import itertools
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

from bufgym.oracle.measure import BASELINE
from bufgym.policies import Policy
from bufgym.utils.tables import Table as Table

RunRows = Sequence[Mapping[str, Any]]
Unranked = Mapping[str, str]
"""Policies that do not compete, with the reasons, see ``unranked_among``."""
NOBODY: Unranked = MappingProxyType({})
NONE = "–"  # No number


def decimal(number: float, digits: int, unit: str = "") -> str:
    """Format with a true minus sign, but none before a zero; NaN is ``NONE``."""
    if math.isnan(number):
        return NONE
    text = f"{abs(number):.{digits}f}"
    return ("\N{MINUS SIGN}" if number < 0 and float(text) else "") + text + unit


def score(number: float) -> str:
    """Format a score as 0.713."""
    return decimal(number, 3)


def signed(number: float) -> str:
    """Format a difference as +0.713."""
    return ("+" if number >= 0 else "") + score(number)


def percent(number: float) -> str:
    """Format with three digits: 12.3 %, 1.23 %, 0.123 %."""
    size = float(f"{abs(number * 100):.3g}")  # rounded first: 9.999 % is 10.0 %
    return decimal(number * 100, 1 if size >= 10 else 2 if size >= 1 else 3, " %")


def mean(numbers: Sequence[float | None]) -> float:
    """Mean without None and NaN; NaN if nothing is left."""
    known = [number for number in numbers if number is not None and not math.isnan(number)]
    return math.fsum(known) / len(known) if known else math.nan


def invalid(rows: RunRows) -> list[str]:
    """Write a note for each policy that made invalid decisions; ``rows`` has one row per sender."""
    counts: dict[str, int] = {}
    for row in rows:
        if row.get("invalid"):
            counts[row["policy"]] = counts.get(row["policy"], 0) + row["invalid"]
    return [f"note: {policy} gave {count} invalid decisions" for policy, count in counts.items()]


class Column(NamedTuple):
    title: str
    key: str  # column of the rows that it averages
    write: Callable[[float], str]


COLUMNS = (
    Column("policy", "policy", str),
    Column("L", "capacity", str),
    Column("QoI", "qoi", score),
    Column("regret", "regret", percent),
    Column("delivered", "delivered", partial(decimal, digits=1)),
    Column("dropped", "dropped", partial(decimal, digits=1)),
    Column("longest gap (x)", "longest_gap", score),
    Column("longest gap (s)", "longest_gap_s", score),
    Column("sojourn mean (s)", "mean_sojourn_s", score),
    Column("sojourn p95 (s)", "p95_sojourn_s", score),
    Column("age mean (s)", "mean_age_s", score),
    Column("age peak (s)", "peak_age_s", score),
)


SCORE = (
    "score: 0 is Drop Oldest, the rule of ROS; 1 is the clairvoyant, which knows the whole link beforehand;"
    " regret = 1 - QoI / the clairvoyant's"
)
"""The line below a table with scores."""
BRACKETS = "in brackets: 95 % intervals, for fresh links, or for fresh episodes of one link"
REGRET_AT_MOST = "regret, at most"  # Title of regrets if some rest on an uncertified bound
UPPER_BOUND = "regret rests on an upper bound of the best QoI, which is not exact here: it is at most this"
"""The note below them."""


def means(rows: RunRows, unranked: Collection[str] = ()) -> list[dict[str, Any]]:
    """Average the rows of each policy and capacity, sorted by capacity ascending, then QoI descending.

    Policies in ``unranked``, which do not compete, come last within a capacity. None and NaN count as missing, and a
    mean of missing numbers is NaN.
    """
    groups: dict[tuple[int, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["capacity"], row["policy"]), []).append(row)
    entries: list[dict[str, Any]] = [
        {
            "policy": policy,
            "capacity": capacity,
            **{c.key: mean([row.get(c.key) for row in group]) for c in COLUMNS[2:]},
            "regret": _regret(group),
        }
        for (capacity, policy), group in groups.items()
    ]
    return sorted(entries, key=lambda e: (e["capacity"], e["policy"] in unranked, -e["qoi"], e["policy"]))


def _regret(rows: RunRows) -> float:
    """Regret over all rows together, as ``score.regret`` has it; NaN where none is known."""
    known = [row for row in rows if row.get("regret") is not None and not math.isnan(row["regret"])]
    best = math.fsum(row["clairvoyant"] for row in known)
    return math.fsum(row["regret"] * row["clairvoyant"] for row in known) / best if best > 0 else math.nan


def with_equal_rows(rows: RunRows, unranked: Collection[str] = ()) -> dict[str, list[str]]:
    """Group policies with equal rows: map the first, or Drop Oldest if it is among them, to the others.

    An ``unranked`` policy is never grouped with one that competes.
    """
    rows_of: dict[str, list[str]] = {}
    for row in rows:
        rows_of.setdefault(row["policy"], []).append(repr({**row, "policy": ""}))
    groups: dict[tuple[Any, ...], list[str]] = {}
    for name in sorted(rows_of, key=lambda name: name != BASELINE):
        groups.setdefault((name in unranked, *sorted(rows_of[name])), []).append(name)
    return {first: others for first, *others in groups.values() if others}


def equal_rows_notes(alike: Mapping[str, Sequence[str]]) -> list[str]:
    """Write a note for each group of ``with_equal_rows``."""
    return [f"note: {', '.join(others)}: the same rows here as {first}" for first, others in alike.items()]


def unranked_among(policies: Iterable[Policy]) -> dict[str, str]:
    """The policies that do not compete, with the reasons."""
    return {policy.name: policy.unranked_because for policy in policies if not policy.ranked}


def means_table(
    rows: RunRows,
    unranked: Unranked = NOBODY,
    scores: Mapping[tuple[int, str], str] = MappingProxyType({}),
    hidden: str = "",
) -> Table:
    """Make the table of ``means``, with one line for policies that have equal rows.

    ``scores`` has the text of each known score at (L, policy). Score and regret are left out if no line has them. The
    policy ``hidden`` gets no line.
    """
    shown = [row for row in rows if row["policy"] != hidden]
    alike = with_equal_rows(shown, unranked)
    without_line = {hidden, *(name for names in alike.values() for name in names)}
    entries = [entry for entry in means(rows, unranked) if entry["policy"] not in without_line]
    columns = [c for c in COLUMNS if c.key != "regret" or any(not math.isnan(entry["regret"]) for entry in entries)]
    scored = any((entry["capacity"], entry["policy"]) in scores for entry in entries)
    inexact = any(row.get("certified") is False and row.get("regret") is not None for row in shown)
    titles = [REGRET_AT_MOST if c.key == "regret" and inexact else c.title for c in columns]
    by_capacity = [list(block) for _, block in itertools.groupby(entries, lambda entry: entry["capacity"])]

    def written(entry: Mapping[str, Any]) -> list[str]:
        texts = [c.write(entry[c.key]) for c in columns]
        return [*texts[:2], *[scores.get((entry["capacity"], entry["policy"]), NONE)] * scored, *texts[2:]]

    titles[2:2] = ["score"] * scored
    blocks = [("", [written(entry) for entry in block]) for block in by_capacity]
    notes = [f"note: {policy} does not compete: {reason}" for policy, reason in unranked.items()]
    notes += [*equal_rows_notes(alike), *([f"note: {UPPER_BOUND}"] if inexact else []), *invalid(shown)]
    return Table(titles, blocks, notes)
