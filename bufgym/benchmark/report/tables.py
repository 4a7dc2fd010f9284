"""The tables of the report: the ranking, and the score of every policy in every cell."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from bufgym.benchmark import table
from bufgym.benchmark.folder import Run
from bufgym.benchmark.report import style
from bufgym.benchmark.score import CellScore, Interval, Scores

HEADINGS = ("score", "IQM", "regret")


@dataclass(frozen=True)
class Place:
    """One line of the ranking."""

    rank: int | None
    policy: str
    values: list[tuple[str, str]]
    """(value, interval) as text, a pair for each heading."""
    reason: str
    """Why there is no rank; empty where there is one."""


def headings(scores: Scores) -> list[str]:
    """Titles of the numbers in the ranking."""
    return [*HEADINGS, f"better than {scores.reference}"]


def ranking(run: Run, scores: Scores) -> list[Place]:
    """Ranked policies best first, then the others, with the manifest's reasons."""
    places: list[Place] = []
    for standing in scores.standings:
        known = standing.ranked and not math.isnan(standing.score.value)
        reason = "" if standing.ranked else run.manifest["unranked"][standing.policy]
        numbers: list[tuple[Interval, Callable[[float], str]]] = [
            (standing.score, style.score),
            (standing.iqm, style.score),
            (standing.regret, style.percent),
            (standing.improvement, style.score),
        ]
        if standing.policy == scores.reference:
            numbers[-1] = (Interval(math.nan, math.nan, math.nan), style.score)
        values = [pair(interval, write) for interval, write in numbers]
        places.append(Place(len(places) + 1 if known else None, standing.policy, values, reason))
    return places


def pair(interval: Interval, write: Callable[[float], str]) -> tuple[str, str]:
    """(value, interval in brackets) as text; a dash and nothing where there is no value."""
    if math.isnan(interval.value):
        return "–", ""
    low, high = write(interval.low), write(interval.high)
    return write(interval.value), f"[{low.removesuffix(' %')}, {high.removesuffix(' %')}]"


@dataclass(frozen=True)
class HeatMap:
    """Scores of every policy in every cell."""

    columns: list[tuple[str, list[int]]]
    """(scenario, its capacities)."""
    lines: list[tuple[str, list[CellScore]]]
    """(policy, one cell a column), ranked policies first."""
    inexact: set[tuple[str, int]]
    """Cells whose clairvoyant is but an upper bound."""
    flat: set[tuple[str, int]]
    """Cells that do not bite."""


def heat_map(scores: Scores) -> HeatMap:
    """All cells, in the order of the standings."""
    by_policy: dict[str, list[CellScore]] = {}
    for cell in scores.cells:
        by_policy.setdefault(cell.policy, []).append(cell)
    columns: dict[str, list[int]] = {}
    for cell in next(iter(by_policy.values())):
        columns.setdefault(cell.scenario, []).append(cell.capacity)
    return HeatMap(
        columns=list(columns.items()),
        lines=[(standing.policy, by_policy[standing.policy]) for standing in scores.standings],
        inexact={(cell.scenario, cell.capacity) for cell in scores.cells if not cell.exact},
        flat={(cell.scenario, cell.capacity) for cell in scores.cells if not cell.discriminative},
    )


def plain(run: Run, scores: Scores) -> str:
    """The ranking as aligned text."""
    lines = [["policy", "rank", *headings(scores)]]
    notes = []
    for place in ranking(run, scores):
        values = [" ".join(filter(None, pair)) for pair in place.values]
        lines.append([place.policy, "-" if place.rank is None else str(place.rank), *values])
        if place.reason:
            notes.append(f"{place.policy} has no rank: {place.reason}.")
    return "\n".join([*table.aligned(lines), *notes])


# --- Markdown ---------------------------------------------------------------------------------------------------------


def markdown(run: Run, scores: Scores) -> str:
    """The command, the ranking, then a table of scores for each scenario."""
    names = ["#", "policy", *headings(scores)]
    lines = []
    for place in ranking(run, scores):
        rank = "–" if place.rank is None else str(place.rank)
        values = [" ".join(filter(None, pair)) for pair in place.values]
        lines.append([rank, _plain(place.policy) + (f" ({place.reason})" if place.reason else ""), *values])
    out = ["```", run.manifest["command"], "```", "", *markdown_table(names, lines, left=2)]
    heat = heat_map(scores)
    for scenario, sizes in heat.columns:
        head = ["policy", *(f"L = {size}{_marks(heat, scenario, size)}" for size in sizes)]
        lines = [
            [_plain(policy), *(style.score(cell.score.value) for cell in cells if cell.scenario == scenario)]
            for policy, cells in heat.lines
        ]
        out += ["", f"Score, {_plain(scenario)}:", "", *markdown_table(head, lines, left=1)]
    notes = []
    if heat.flat:
        notes.append("\\* Drop Oldest loses under 1 % there: nothing to be gained, not counted in the ranking.")
    if heat.inexact:
        notes.append("† The clairvoyant is an upper bound there: the true scores lie further from 0.")
    return "\n".join([*out, *(line for note in notes for line in ("", note))]) + "\n"


def _marks(heat: HeatMap, scenario: str, capacity: int) -> str:
    cell = (scenario, capacity)
    return ("\\*" if cell in heat.flat else "") + ("†" if cell in heat.inexact else "")


def _plain(name: str) -> str:
    """A name that Markdown shows as it is written."""
    return style.text(name).replace("|", "\\|").replace("*", "\\*")


def markdown_table(head: Sequence[str], lines: Sequence[Sequence[str]], *, left: int) -> list[str]:
    """Lines of a Markdown table: ``left`` columns to the left, the others to the right."""
    rule = "|" + "---|" * left + "---:|" * (len(head) - left)
    return ["| " + " | ".join(head) + " |", rule, *("| " + " | ".join(line) + " |" for line in lines)]
