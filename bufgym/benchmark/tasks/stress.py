"""One queue under stress: as one queue, but policies are ordered by their worst cell."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from bufgym.benchmark.bootstrap import UNKNOWN, Interval
from bufgym.benchmark.episodes import Cell
from bufgym.benchmark.rows import Row
from bufgym.benchmark.score import Scores
from bufgym.benchmark.summary import Quantity, Standing, Summary
from bufgym.benchmark.table import mean
from bufgym.benchmark.tasks.queue import QueueTask
from bufgym.policies import Policy
from bufgym.scenario.suites import Setting

LEAST_REGRET = 0.001
"""Where the better of the two yardsticks loses less, a ratio says nothing, and the cell is not counted."""


class Ratios(NamedTuple):
    """A policy's regret over that of the better of the baseline (Drop Oldest) and the reference (AFR), cell by cell."""

    worst: float
    """The largest; NaN where no cell counts."""
    cell: Cell | None
    """Where that is."""
    mean: float
    """Mean of all."""
    cells: int
    """How many cells count."""


def ratios(scored: Scores) -> dict[str, Ratios]:
    """By policy. Where the reference did not run, there are none."""
    regrets = {(c.policy, (c.scenario, c.capacity)): c.regret.value for c in scored.cells}
    cells = dict.fromkeys(cell for _, cell in regrets)
    yardsticks = {
        cell: min(regrets.get((name, cell), math.nan) for name in (scored.reference, scored.baseline)) for cell in cells
    }
    found = {}
    for policy in dict.fromkeys(policy for policy, _ in regrets):
        by_cell = {cell: regrets[policy, cell] / least for cell, least in yardsticks.items() if least > LEAST_REGRET}
        by_cell = {cell: ratio for cell, ratio in by_cell.items() if not math.isnan(ratio)}
        where = max(by_cell, key=lambda cell: by_cell[cell], default=None)
        worst = math.nan if where is None else by_cell[where]
        found[policy] = Ratios(worst, where, mean(list(by_cell.values())), len(by_cell))
    return found


@dataclass(frozen=True)
class StressTask(QueueTask):
    """One camera's messages in one queue, under conditions of every kind."""

    kind = "stress"
    listed = ("worst", "ratio", "regret")

    def quantities(self, reference: str = "afr") -> tuple[Quantity, ...]:
        return (*_ratios(reference), *super().quantities(reference))

    def summary(self, rows: Sequence[Row], unranked: Collection[str] = (), **options: Any) -> Summary:
        """Ranked by the worst cell, the smallest first; the notes say where it is."""
        summary = QueueTask().summary(rows, unranked, **options)
        assert summary.scores is not None
        found = ratios(summary.scores)

        def place(standing: Any) -> tuple[Any, ...]:
            worst = found[standing.policy].worst
            return not standing.ranked, math.isnan(worst), worst, standing.policy

        overall = [
            Standing(
                s.policy,
                s.ranked,
                {**s.values, "worst": _alone(found[s.policy].worst), "ratio": _alone(found[s.policy].mean)},
            )
            for s in sorted(summary.overall, key=place)
        ]
        notes = tuple(
            f"{s.policy} is worst in {cell[0]} at L = {cell[1]}: {found[s.policy].worst:.3f}, of "
            f"{found[s.policy].cells} cells"
            for s in overall
            if s.ranked and (cell := found[s.policy].cell) is not None
        )
        scored = replace(summary.scores, standings=sorted(summary.scores.standings, key=place))
        quantities = (*_ratios(scored.reference), *summary.quantities)
        return replace(summary, quantities=quantities, rank_by="worst", overall=overall, scores=scored, notes=notes)

    def example(
        self, policies: Sequence[Policy], rows: Sequence[Row], setting_of: Callable[[Row], Setting]
    ) -> dict[str, Any] | None:
        """As of one queue; an episode under a byte limit is not shown."""
        firsts = {row["scenario"]: row for row in reversed(rows)}
        free = {label for label, row in firsts.items() if setting_of(row).max_bytes is None}
        return super().example(policies, [row for row in rows if row["scenario"] in free], setting_of)


def _ratios(reference: str) -> tuple[Quantity, ...]:
    over = (
        f"regret over the regret of the better of {reference} and Drop Oldest, where theirs is over {LEAST_REGRET:.1%}"
    )
    return (
        Quantity("worst", "worst cell", "{:.3f}".format, f"the largest {over}", interval=False),
        Quantity("ratio", "mean ratio", "{:.3f}".format, f"mean of the {over}", interval=False),
    )


def _alone(value: float) -> Interval:
    """A number without an interval: the largest of many has none that a bootstrap of few episodes could give."""
    return UNKNOWN if math.isnan(value) else Interval(value, math.nan, math.nan)
