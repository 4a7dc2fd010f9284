"""Summary of a benchmark's rows: quantities with intervals for each policy, by cell and over all cells.

A *cell* is a scenario with a capacity. Within a cell a statistic is computed over episodes; over all cells it is the
mean of the cells' values, so a ratio over all cells is a mean of ratios, not a ratio of sums. Every interval is the
paired bootstrap over links that ``score`` describes: one draw serves all policies and all cells.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bufgym.benchmark import episodes
from bufgym.benchmark.bootstrap import (
    REALS,
    RESAMPLES,
    SEED,
    UNKNOWN,
    Interval,
    Range,
    interval,
    links_drawn,
    links_in,
    written,
)
from bufgym.benchmark.episodes import Cell, Numbers
from bufgym.benchmark.score import Scores, Standing
from bufgym.benchmark.table import NOBODY, NONE, RunRows, Unranked, signed
from bufgym.utils.errors import BufgymError
from bufgym.utils.tables import Table


class Quantity(NamedTuple):
    """One number that a summary shows of a policy."""

    key: str  # its name in ``Standing.values``
    title: str  # its heading
    write: Callable[[float], str]  # function that formats a number
    about: str  # definition, for the reader of a report
    interval: bool = True  # whether printed tables show the interval; a report always does
    versus: str = ""  # policy that it compares with, which has no value itself
    total: bool = False  # whether it is summed over cells instead of averaged
    drawn: bool = False  # whether a report draws it beside the ranking
    within: Range = REALS  # what its numbers, and so its intervals, cannot leave


@dataclass(frozen=True)
class Summary:
    quantities: tuple[Quantity, ...]  # quantities shown, in this order
    rank_by: str  # the key of the quantity that orders the policies, largest first
    overall: list[Standing]  # over all cells; ranked policies first, best first
    cells: dict[Cell, list[Standing]]
    """The same in each cell, cells in the order of the rows; empty where ``scores`` holds them."""
    baseline: str  # the policy that the others are measured against
    scores: Scores | None = None  # scores between the baseline and the clairvoyant, where one is known
    notes: tuple[str, ...] = ()  # sentences about single policies, or the links, below the ranking

    @property
    def standings(self) -> dict[str, Standing]:
        return {standing.policy: standing for standing in self.overall}


def difference(title: str, against: str) -> Quantity:
    """Make the quantity of the paired difference of another, ``title``, to the policy ``against``."""
    about = f"paired difference of {title}: both met the same episodes, and a draw of links serves both"
    return Quantity("against", f"{title}, minus {against}'s", signed, about, versus=against)


KEY = ("scenario", "capacity", "policy", "trace", "seed")
Run = tuple[str, int, str, str, int]
"""Values of the columns ``KEY``."""
Statistics = Callable[[Numbers, Numbers, Numbers], dict[str, Numbers]]
"""(a policy's numbers, the baseline's, weights) -> each statistic of the sample and its resamples, [1 + resamples].

The numbers are [episodes, entries] over the same episodes. weights[1 + resamples, episodes] count the draws of each
episode.
"""


def by_run(rows: RunRows, part: str, value: str) -> dict[Run, dict[Any, Mapping[str, Any]]]:
    """Group each run's rows by column ``part``; raise an error for a row without ``value`` or a repeated part."""
    runs: dict[Run, dict[Any, Mapping[str, Any]]] = {}
    for number, row in enumerate(rows):
        for name in (*KEY, part, value):
            if row.get(name) is None:
                raise BufgymError(f"rows[{number}]: no {name}")
        run = runs.setdefault((row["scenario"], row["capacity"], row["policy"], row["trace"], row["seed"]), {})
        if row[part] in run:
            raise BufgymError(f"rows[{number}]: {part} {row[part]!r} of one run has more than one row")
        run[row[part]] = row
    return runs


def summarise(
    runs: Mapping[Run, Sequence[float]],
    statistics: Statistics,
    quantities: tuple[Quantity, ...],
    *,
    rank_by: str,
    baseline: str,
    unranked: Unranked = NOBODY,
    against: str = "",
) -> Summary:
    """Compare every policy with ``baseline``, by cell and over all cells.

    ``runs`` holds the numbers of each run for ``statistics``, with equally many entries within a cell. The quantity
    ``rank_by`` orders the policies; those ``unranked`` come last. ``against`` is as in ``difference``.
    """
    # ``read`` makes sure that all met the same episodes, and orders them.
    rows = [{**dict(zip(KEY, run, strict=True)), "qoi": numbers[0]} for run, numbers in runs.items()]
    table = episodes.read(rows, baseline, against)
    cells = list(dict.fromkeys((scenario, capacity) for scenario, capacity, *_ in runs))
    by_policy = _by_cell(runs, statistics, table, cells, baseline)
    if against:
        (ranking,) = (quantity for quantity in quantities if quantity.key == rank_by)
        quantities = (*quantities, difference(ranking.title, against))
        other = {cell: numbers[rank_by] for cell, numbers in by_policy[against].items()}
        for by_cell in by_policy.values():
            for cell, numbers in by_cell.items():
                numbers["against"] = numbers[rank_by] - other[cell]

    def standings(over: Sequence[Cell]) -> list[Standing]:
        links = links_in({scenario: table.episodes[scenario] for scenario, _ in over})
        entries = [
            Standing(policy, unranked.get(policy, ""), _pooled([by_cell[cell] for cell in over], quantities, links))
            for policy, by_cell in by_policy.items()
        ]
        return sorted(entries, key=lambda s: (not s.ranked, math.isnan(s[rank_by].value), -s[rank_by].value, s.policy))

    return Summary(quantities, rank_by, standings(cells), {cell: standings([cell]) for cell in cells}, baseline)


def _by_cell(
    runs: Mapping[Run, Sequence[float]],
    statistics: Statistics,
    table: episodes.Arrays,
    cells: Sequence[Cell],
    baseline: str,
) -> dict[str, dict[Cell, dict[str, Numbers]]]:
    """Each policy's statistics of each cell: of the sample and its resamples, over the episodes of ``table``."""
    drawn = links_drawn(table.episodes, RESAMPLES, SEED)

    def numbers_of(policy: str, cell: Cell) -> Numbers:
        return np.array([runs[*cell, policy, *episode] for episode in table.episodes[cell[0]]], np.float64)

    return {
        policy: {
            cell: statistics(numbers_of(policy, cell), numbers_of(baseline, cell), drawn[cell[0]]) for cell in cells
        }
        for policy in table.training_seeds
    }


def _pooled(over: Sequence[Mapping[str, Numbers]], quantities: Sequence[Quantity], links: int) -> dict[str, Interval]:
    """A policy's value and interval of each quantity over these cells, drawn from so many ``links``."""
    values = {}
    for quantity in quantities:
        pooled = (np.sum if quantity.total else np.mean)([numbers[quantity.key] for numbers in over], axis=0)
        values[quantity.key] = interval(pooled, links, within=quantity.within)
    return values


class Place(NamedTuple):
    rank: int | None  # 1 for the best; None for a policy that is not ranked
    policy: str
    values: list[tuple[str, str]]  # (value, interval) as text, a pair for each quantity of the summary
    reason: str  # why it is not ranked; empty if it is

    @property
    def place(self) -> str:
        return NONE if self.rank is None else str(self.rank)

    @property
    def texts(self) -> list[str]:
        return [" ".join(filter(None, texts)) for texts in self.values]


def places(summary: Summary, standings: Sequence[Standing] | None = None) -> list[Place]:
    """Ranked policies best first, then the others; by default over all cells."""
    found = []
    for rank, standing in enumerate(summary.overall if standings is None else standings, 1):
        known = standing.ranked and not math.isnan(standing[summary.rank_by].value)
        values = [pair(standing, quantity) for quantity in summary.quantities]
        found.append(Place(rank if known else None, standing.policy, values, standing.unranked_because))
    return found


def pair(standing: Standing, quantity: Quantity) -> tuple[str, str]:
    """Format the policy's value and its interval in brackets; without a value, a dash and nothing."""
    return shown(UNKNOWN if standing.policy == quantity.versus else standing[quantity.key], quantity)


def shown(interval: Interval, quantity: Quantity) -> tuple[str, str]:
    """Format a value and its interval; the interval is empty for a quantity without intervals."""
    value, brackets = written(interval, quantity.write)
    return value, "" if math.isnan(interval.low) and not quantity.interval else brackets


def title(cell: Cell, abouts: Mapping[str, str]) -> str:
    """Describe a cell; ``abouts`` maps each scenario's label to its description."""
    scenario, capacity = cell
    scenario = ": ".join(filter(None, (scenario, abouts.get(scenario, ""))))
    return ", ".join(filter(None, (scenario, f"L = {capacity}")))


def table_of(summary: Summary, abouts: Mapping[str, str] | None = None, notes: Sequence[str] = ()) -> Table:
    """Make a block for each cell, and one over all cells if there are several."""
    blocks = [(title(cell, abouts or {}), standings) for cell, standings in summary.cells.items()]
    if len(blocks) > 1:
        blocks.append((f"mean of these {len(blocks)}", summary.overall))
    return table_over(blocks, summary.quantities)._replace(notes=notes)


def table_over(blocks: Sequence[tuple[str, Sequence[Standing]]], quantities: Sequence[Quantity]) -> Table:
    """Make a table of these quantities with a block for each title and its standings."""

    def line(standing: Standing) -> list[str]:
        pairs = [(pair(standing, quantity), quantity.interval) for quantity in quantities]
        return [standing.policy, *(" ".join(filter(None, texts if both else texts[:1])) for texts, both in pairs)]

    head = ["policy", *(quantity.title for quantity in quantities)]
    return Table(head, [(name, [line(standing) for standing in standings]) for name, standings in blocks])
