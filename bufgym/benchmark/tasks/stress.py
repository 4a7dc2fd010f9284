"""One queue under stress, where policies are ranked by their worst cell."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from bufgym.benchmark.bootstrap import UNKNOWN, Interval
from bufgym.benchmark.episodes import Cell
from bufgym.benchmark.rows import Row
from bufgym.benchmark.score import REFERENCE, Scores
from bufgym.benchmark.summary import Quantity, Summary
from bufgym.benchmark.table import NOBODY, Unranked, mean
from bufgym.benchmark.tasks.queue import QueueTask
from bufgym.oracle.measure import BASELINE
from bufgym.policies import Policy
from bufgym.scenario.suites import Setting

LEAST_REGRET = 0.001  # Least regret of the better microbenchmark for a cell to count; below it a ratio means nothing


class Ratios(NamedTuple):
    """Ratios, cell by cell, of a policy's regret to the lower regret of Drop Oldest and AFR."""

    worst: float  # largest ratio; NaN if no cell counts
    cell: Cell | None  # cell of the largest ratio
    mean: float  # mean ratio
    cells: int  # number of cells that count


def ratios(scored: Scores) -> dict[str, Ratios]:
    """Compute the ratios of each policy; empty if the reference did not run."""
    regrets = {(c.policy, (c.scenario, c.capacity)): c.regret.value for c in scored.cells}
    cells = dict.fromkeys(cell for _, cell in regrets)
    microbenchmarks = {
        cell: min(regrets.get((name, cell), math.nan) for name in (REFERENCE, BASELINE)) for cell in cells
    }
    found = {}
    for policy in dict.fromkeys(policy for policy, _ in regrets):
        by_cell = {
            cell: regrets[policy, cell] / least for cell, least in microbenchmarks.items() if least > LEAST_REGRET
        }
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

    def quantities(self) -> tuple[Quantity, ...]:
        return (*_ratios(), *super().quantities())

    def summary(self, rows: Sequence[Row], unranked: Unranked = NOBODY, against: str = "") -> Summary:
        """Rank by the worst cell, smallest ratio first; the notes name that cell."""
        summary = QueueTask().summary(rows, unranked, against)
        assert summary.scores is not None
        found = ratios(summary.scores)

        def place(standing: Any) -> tuple[Any, ...]:
            worst = found[standing.policy].worst
            return not standing.ranked, math.isnan(worst), worst, standing.policy

        overall, notes = [], []
        for s in sorted(summary.overall, key=place):
            worst, cell, average, cells = found[s.policy]
            overall.append(replace(s, values={**s.values, "worst": _alone(worst), "ratio": _alone(average)}))
            if s.ranked and cell is not None:
                notes.append(f"{s.policy} is worst in {cell[0]} at L = {cell[1]}: {worst:.3f}, of {cells} cells")
        scored = replace(summary.scores, standings=sorted(summary.scores.standings, key=place))
        quantities = (*_ratios(), *summary.quantities)
        return replace(
            summary, quantities=quantities, rank_by="worst", overall=overall, scores=scored, notes=tuple(notes)
        )

    def example(
        self, policies: Sequence[Policy], rows: Sequence[Row], setting_of: Callable[[Row], Setting]
    ) -> dict[str, Any] | None:
        """Choose an example as for one queue, without a byte limit."""
        firsts = {row["scenario"]: row for row in reversed(rows)}
        free = {label for label, row in firsts.items() if setting_of(row).max_bytes is None}
        return super().example(policies, [row for row in rows if row["scenario"] in free], setting_of)


def _ratios() -> tuple[Quantity, ...]:
    over = (
        f"regret over the regret of the better of {REFERENCE} and Drop Oldest, where theirs is over {LEAST_REGRET:.1%}"
    )
    return (
        Quantity("worst", "worst cell", "{:.3f}".format, f"the largest {over}", interval=False),
        Quantity("ratio", "mean ratio", "{:.3f}".format, f"mean of the {over}", interval=False),
    )


def _alone(value: float) -> Interval:
    """Make a number without an interval, because a bootstrap of few episodes gives none for a maximum."""
    return UNKNOWN if math.isnan(value) else Interval(value, math.nan, math.nan)
