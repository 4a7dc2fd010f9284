"""The numbers of a summary as plain entries, for data frames: estimate and interval of each quantity."""

from typing import Any

from bufgym.benchmark.bootstrap import Interval
from bufgym.benchmark.rows import Layout
from bufgym.benchmark.score import CellScore
from bufgym.benchmark.summary import Summary

ESTIMATE: Layout = {
    **{"policy": str, "scenario": str, "capacity": int, "quantity": str},
    **{"estimate": float, "low": float, "high": float},
}
"""Columns of the entries; the capacity of "all" is missing."""
CELL = ("qoi", "score", "regret", "difference")
"""Quantities that a ``CellScore`` has."""
EVERYWHERE = ("all", None)  # Scenario and capacity of what is over all cells


def estimates(summary: Summary) -> list[dict[str, Any]]:
    """An entry for each policy, cell and quantity: estimate, low and high; ``"all"`` cells come first."""
    entries = []
    for standing in summary.overall:
        for quantity in summary.quantities:
            entries.append(_entry(standing.policy, *EVERYWHERE, quantity.key, standing[quantity.key]))
    for (scenario, capacity), standings in summary.cells.items():
        for standing in standings:
            for quantity in summary.quantities:
                entries.append(_entry(standing.policy, scenario, capacity, quantity.key, standing[quantity.key]))
    for cell in summary.scores.cells if summary.scores else ():
        entries += [_of_cell(cell, key) for key in CELL]
    return entries


def _of_cell(cell: CellScore, key: str) -> dict[str, Any]:
    return _entry(cell.policy, cell.scenario, cell.capacity, key, getattr(cell, key))


def _entry(policy: str, scenario: str, capacity: int | None, quantity: str, interval: Interval) -> dict[str, Any]:
    numbers = dict(zip(("estimate", "low", "high"), map(float, interval), strict=True))
    return {"policy": policy, "scenario": scenario, "capacity": capacity, "quantity": quantity, **numbers}
