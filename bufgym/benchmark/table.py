"""Tables as text: numbers, aligned columns, Markdown, and the table of ``bufgym bench``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from bufgym import policies
from bufgym.ground.errors import BufgymError, printable
from bufgym.oracle.measure import BASELINE, normalised_score

Rows = Sequence[Mapping[str, Any]]

# --- numbers ---------------------------------------------------------------------------------------------------------


def decimal(number: float, digits: int) -> str:
    """Format with a true minus sign, but none before a zero; NaN is a dash."""
    if math.isnan(number):
        return "–"
    text = f"{abs(number):.{digits}f}"
    return f"\N{MINUS SIGN}{text}" if number < 0 and float(text) else text


def score(number: float) -> str:
    """Format a score as 0.713, or NaN as a dash."""
    return decimal(number, 3)


def percent(number: float) -> str:
    """Format with three digits: 12.3 %, 1.23 %, 0.123 %."""
    size = float(f"{abs(number * 100):.3g}")  # rounded first: 9.999 % is 10.0 %
    return decimal(number * 100, 1 if size >= 10 else 2 if size >= 1 else 3) + ("" if math.isnan(number) else " %")


def mean(numbers: Sequence[float | None]) -> float:
    """Mean without None and NaN; NaN if nothing is left."""
    known = [number for number in numbers if number is not None and not math.isnan(number)]
    return math.fsum(known) / len(known) if known else math.nan


# --- lines -----------------------------------------------------------------------------------------------------------


def aligned(lines: Sequence[Sequence[str]]) -> list[str]:
    """Align rows of cells as lines of text: the first column to the left, the others to the right."""
    lines = [list(map(printable, line)) for line in lines]
    widths = [max(len(line[c]) for line in lines) for c in range(len(lines[0]))]
    out = []
    for line in lines:
        padded = [cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)]
        out.append("  ".join([line[0].ljust(widths[0]), *padded]).rstrip())
    return out


def in_blocks(head: list[str], blocks: Sequence[tuple[str, list[list[str]]]]) -> str:
    """Titled blocks of lines under one head, all in the same columns."""
    lines = aligned([head, *(line for _, block in blocks for line in block)])
    out, at = [lines[0]], 1
    for title, block in blocks:
        out += ["", printable(title), *lines[at : at + len(block)]]
        at += len(block)
    return "\n".join(out)


def markdown_table(head: Sequence[str], lines: Sequence[Sequence[str]], *, left: int = 1) -> list[str]:
    """Lines of a Markdown table: ``left`` columns to the left, the others to the right."""
    lines = [[printable(cell).replace("|", "\\|") for cell in line] for line in lines]
    rule = "|" + "---|" * left + "---:|" * (len(head) - left)
    return ["| " + " | ".join(head) + " |", rule, *("| " + " | ".join(line) + " |" for line in lines)]


def invalid(rows: Rows) -> list[str]:
    """Write a note for each policy that made invalid decisions; ``rows`` has one row per sender."""
    counts: dict[str, int] = {}
    for row in rows:
        if row.get("invalid"):
            counts[row["policy"]] = counts.get(row["policy"], 0) + row["invalid"]
    return [f"note: {policy} gave {count} invalid decisions" for policy, count in counts.items()]


# --- means by policy and capacity ------------------------------------------------------------------------------------


class Column(NamedTuple):
    """One column of a table of means."""

    title: str
    """Its heading."""
    key: str
    """Column of the rows that it averages."""
    write: Callable[[float], str]
    """Function that formats the mean."""


COLUMNS = (
    Column("policy", "policy", str),
    Column("L", "capacity", str),
    Column("score", "score", score),
    Column("QoI", "qoi", "{:.3f}".format),
    Column("regret", "regret", "{:.2%}".format),
    Column("delivered", "delivered", "{:.1f}".format),
    Column("dropped", "dropped", "{:.1f}".format),
    Column("longest gap (x)", "longest_gap", "{:.3f}".format),
    Column("longest gap (s)", "longest_gap_s", "{:.3f}".format),
    Column("sojourn mean (s)", "mean_sojourn_s", "{:.3f}".format),
    Column("sojourn p95 (s)", "p95_sojourn_s", "{:.3f}".format),
    Column("age mean (s)", "mean_age_s", "{:.3f}".format),
    Column("age peak (s)", "peak_age_s", "{:.3f}".format),
)


REGRET_AT_MOST = "regret, at most"
"""Title of regrets if some rest on an uncertified bound."""
UPPER_BOUND = "regret rests on an upper bound of the best QoI, which is not exact here: it is at most this"
"""The note below them."""


def means(rows: Rows, floor: Rows = ()) -> list[dict[str, Any]]:
    """Average the rows of each policy and capacity, sorted by capacity ascending, then QoI descending.

    Policies that do not compete, see ``unranked``, come last within a capacity. None and NaN count as missing, and a
    mean of missing numbers is NaN. ``measure.normalised_score`` computes the score on sums; it is NaN without a
    clairvoyant's H. ``floor`` holds rows of Drop Oldest on the same episodes if it is not among ``rows``.
    """
    groups: dict[tuple[int, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["capacity"], row["policy"]), []).append(row)
    base = {_episode(row): row["qoi"] for row in (*floor, *rows) if row["policy"] == BASELINE}
    entries: list[dict[str, Any]] = [
        {
            "policy": policy,
            "capacity": capacity,
            **{c.key: mean([row.get(c.key) for row in group]) for c in COLUMNS[2:]},
            "score": _score(group, base),
        }
        for (capacity, policy), group in groups.items()
    ]
    apart = unranked(rows)
    return sorted(entries, key=lambda e: (e["capacity"], e["policy"] in apart, -e["qoi"], e["policy"]))


def _episode(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(row.get(name) for name in ("scenario", "trace", "seed", "capacity"))


def _score(group: Rows, base: Mapping[tuple[Any, ...], float]) -> float:
    """Score of one policy at one capacity; NaN if one of the three sums is unknown or L does not bind the policy."""
    if any(row.get("regret") is None or _episode(row) not in base for row in group):
        return math.nan
    sums = [
        math.fsum(h)
        for h in zip(*((row["qoi"], base[_episode(row)], row["clairvoyant"]) for row in group), strict=True)
    ]
    return float(normalised_score(*sums))


def same(rows: Rows) -> dict[str, list[str]]:
    """Group policies with equal rows: map the first, or Drop Oldest if it is among them, to the others."""
    fates: dict[str, list[str]] = {}
    for row in rows:
        fates.setdefault(row["policy"], []).append(repr({**row, "policy": ""}))
    apart = unranked(rows)
    groups: dict[tuple[Any, ...], list[str]] = {}
    for name in sorted(fates, key=lambda name: name != BASELINE):
        groups.setdefault((name in apart, *sorted(fates[name])), []).append(name)
    return {first: others for first, *others in groups.values() if others}


def told_once(alike: Mapping[str, Sequence[str]]) -> list[str]:
    """Write a note for each line that stands for several policies, see ``same``."""
    return [f"note: {', '.join(others)}: the same rows here as {first}" for first, others in alike.items()]


def unranked(rows: Rows) -> dict[str, str]:
    """Find the policies that do not compete, with the reasons."""
    reasons = {}
    for name in dict.fromkeys(row["policy"] for row in rows):
        try:
            reason = policies.get(name).unranked_because
        except BufgymError:
            continue  # a run's agent that is not registered
        if reason:
            reasons[name] = reason
    return reasons


def plain(rows: Rows, floor: Rows = ()) -> str:
    """Write aligned text with an empty line between capacities; ``floor`` as in ``means``."""
    cells = _cells(rows, floor)
    out = []
    for k, line in enumerate(aligned(cells)):
        if k > 1 and cells[k][1] != cells[k - 1][1]:
            out.append("")
        out.append(line)
    return "\n".join([*out, *notes(rows)])


def markdown(rows: Rows, floor: Rows = ()) -> str:
    """Write a Markdown table with numbers to the right; ``floor`` as in ``means``."""
    head, *body = _cells(rows, floor)
    lines = notes(rows)
    return "\n".join([*markdown_table(head, body), *(["", *lines] if lines else [])])


def notes(rows: Rows) -> list[str]:
    """Write notes that a reader of the means needs."""
    apart = [f"note: {policy} does not compete: {reason}" for policy, reason in unranked(rows).items()]
    return [*apart, *told_once(same(rows)), *([f"note: {UPPER_BOUND}"] if _inexact(rows) else []), *invalid(rows)]


def _inexact(rows: Rows) -> bool:
    """Whether a regret rests on an uncertified bound."""
    return any(row.get("certified") is False and row.get("regret") is not None for row in rows)


def _cells(rows: Rows, floor: Rows) -> list[list[str]]:
    """Make titles and a line for each entry of ``means``, with one line for policies that are the ``same``. Score and
    regret are left out if no row has them."""
    others = {name for alike in same(rows).values() for name in alike}
    entries = [entry for entry in means(rows, floor) if entry["policy"] not in others]
    bounded = {key for key in ("score", "regret") if any(not math.isnan(entry[key]) for entry in entries)}
    columns = [c for c in COLUMNS if c.key in bounded or c.key not in ("score", "regret")]
    titles = [REGRET_AT_MOST if c.key == "regret" and _inexact(rows) else c.title for c in columns]
    return [titles, *([written(entry[c.key], c) for c in columns] for entry in entries)]


def written(number: Any, column: Column) -> str:
    """Format an entry; an unknown one is a hyphen."""
    return "-" if isinstance(number, float) and math.isnan(number) else column.write(number)
