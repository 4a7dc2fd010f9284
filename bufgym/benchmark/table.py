"""The table of ``bufgym bench``: means over traces and seeds, best QoI first, as plain text or Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

Rows = Sequence[Mapping[str, Any]]


class Column(NamedTuple):
    """One column: what it is called, which entry of the rows it averages, how its mean is written."""

    title: str
    key: str
    write: Callable[[float], str]


def _whole(number: float) -> str:
    return f"{number:.1f}"


def _fine(number: float) -> str:
    return f"{number:.3f}"


def _percent(number: float) -> str:
    return f"{number:.2%}"


COLUMNS = (
    Column("policy", "policy", str),
    Column("L", "capacity", str),
    Column("QoI", "qoi", _fine),
    Column("regret", "regret", _percent),
    Column("delivered", "delivered", _whole),
    Column("dropped", "dropped", _whole),
    Column("longest gap (x)", "longest_gap", _fine),
    Column("longest gap (s)", "longest_gap_s", _fine),
    Column("sojourn mean (s)", "mean_sojourn_s", _fine),
    Column("sojourn p95 (s)", "p95_sojourn_s", _fine),
    Column("age mean (s)", "mean_age_s", _fine),
    Column("age peak (s)", "peak_age_s", _fine),
)

_KEYS = ("policy", "capacity")


def means(rows: Rows) -> list[dict[str, Any]]:
    """One entry for each (policy, capacity): means over its rows; capacity ascending, then QoI descending.

    None and NaN count as missing; a mean over nothing but missing numbers is NaN.
    """
    groups: dict[tuple[int, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["capacity"], row["policy"]), []).append(row)
    made = []
    for (capacity, policy), group in groups.items():
        entry: dict[str, Any] = {"policy": policy, "capacity": capacity}
        for column in COLUMNS:
            if column.key not in _KEYS:
                entry[column.key] = mean([row.get(column.key) for row in group])
        made.append(entry)
    return sorted(made, key=lambda entry: (entry["capacity"], -entry["qoi"], entry["policy"]))


def mean(numbers: Sequence[float | None]) -> float:
    """Over what is known: None and NaN are left out; NaN for nothing."""
    known = [number for number in numbers if number is not None and not math.isnan(number)]
    return math.fsum(known) / len(known) if known else math.nan


def plain(rows: Rows) -> str:
    """Aligned text, an empty line between capacities."""
    cells = _cells(rows)
    out = []
    for k, line in enumerate(aligned(cells)):
        if k > 1 and cells[k][1] != cells[k - 1][1]:
            out.append("")
        out.append(line)
    return "\n".join([*out, *invalid(rows)])


def aligned(lines: Sequence[Sequence[str]]) -> list[str]:
    """Rows of cells as lines of text: the first column to the left, the others to the right."""
    widths = [max(len(line[c]) for line in lines) for c in range(len(lines[0]))]
    out = []
    for line in lines:
        padded = [cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)]
        out.append("  ".join([line[0].ljust(widths[0]), *padded]).rstrip())
    return out


def markdown(rows: Rows) -> str:
    """A Markdown table; numbers to the right."""
    head, *body = _cells(rows)
    lines = ["| " + " | ".join(line) + " |" for line in body]
    rule = "|---|" + "---:|" * (len(head) - 1)
    notes = invalid(rows)
    return "\n".join(["| " + " | ".join(head) + " |", rule, *lines, *(["", *notes] if notes else [])])


def _cells(rows: Rows) -> list[list[str]]:
    """Titles, then a line for each entry of ``means``; no regret where no row has one."""
    entries = means(rows)
    shown = [c for c in COLUMNS if c.key != "regret" or any(not math.isnan(entry["regret"]) for entry in entries)]
    lines = [[column.title for column in shown]]
    for entry in entries:
        cells = []
        for column in shown:
            given = entry[column.key]
            cells.append("-" if isinstance(given, float) and math.isnan(given) else column.write(given))
        lines.append(cells)
    return lines


def invalid(rows: Rows) -> list[str]:
    """What the reader of the means should know: decisions that could not be carried out; one row a run."""
    counts: dict[str, int] = {}
    for row in rows:
        if row.get("invalid"):
            counts[row["policy"]] = counts.get(row["policy"], 0) + row["invalid"]
    return [f"note: {policy} gave {count} invalid decisions" for policy, count in counts.items()]


def in_blocks(head: list[str], blocks: Sequence[tuple[str, list[list[str]]]]) -> str:
    """Titled blocks of lines under one head, all in the same columns."""
    lines = aligned([head, *(line for _, block in blocks for line in block)])
    out, at = [lines[0]], 1
    for title, block in blocks:
        out += ["", title, *lines[at : at + len(block)]]
        at += len(block)
    return "\n".join(out)
