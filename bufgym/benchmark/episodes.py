"""Rows of a benchmark as arrays, checked that every policy met the same episodes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.oracle.measure import TIE
from bufgym.utils.errors import BufgymError

Numbers = NDArray[np.float64]
Cell = tuple[str, int]
"""(scenario, capacity)."""
Episode = tuple[str, int]
"""(trace, seed)."""
Run = tuple[int | None, Episode]
"""(training seed, episode)."""


@dataclass(frozen=True)
class Arrays:
    """Rows as arrays in sorted order."""

    cells: list[Cell]  # every (scenario, capacity)
    episodes: dict[str, list[Episode]]  # episodes of each scenario
    training_seeds: dict[str, list[int | None]]  # training seeds of each policy; [None] for an untrained one
    qoi: dict[tuple[str, Cell], Numbers]  # H[training seeds, episodes] by policy and cell
    best: dict[Cell, Numbers]  # clairvoyant H[episodes]; NaN where unknown
    exact: dict[Cell, bool]  # whether every clairvoyant H of the cell is certified
    unbounded: set[str]  # policies that the clairvoyant's H does not bound; their rows have no regret


def _by_run(rows: Sequence[Mapping[str, Any]]) -> dict[tuple[str, Cell], dict[Run, Mapping[str, Any]]]:
    if not rows:
        raise BufgymError("no rows to score")
    groups: dict[tuple[str, Cell], dict[Run, Mapping[str, Any]]] = {}
    for number, row in enumerate(rows):
        for key in ("scenario", "trace", "seed", "capacity", "policy", "qoi"):
            if row.get(key) is None:
                raise BufgymError(f"rows[{number}]: no {key}")
        if not math.isfinite(row["qoi"]):
            raise BufgymError(f"rows[{number}]: qoi = {row['qoi']}: must be a finite number")
        cell, episode = (row["scenario"], row["capacity"]), (row["trace"], row["seed"])
        runs = groups.setdefault((row["policy"], cell), {})
        run = (row.get("training_seed"), episode)
        if run in runs:
            raise BufgymError(f"{_place(row['policy'], cell, run)}: more than one row")
        runs[run] = row
    return groups


def read(rows: Sequence[Mapping[str, Any]], baseline: str, against: str = "") -> Arrays:
    """Make arrays of the rows.

    Rows that are incomplete or duplicate, a cell without the baseline, and policies that met different episodes or
    disagree on the clairvoyant are errors; so is ``against`` without rows.
    """
    groups = _by_run(rows)
    cells = sorted({cell for _, cell in groups})
    met: dict[str, set[Episode]] = {scenario: set() for scenario, _ in cells}
    seeds: dict[str, set[int | None]] = {policy: set() for policy, _ in sorted(groups)}
    for (policy, (scenario, _)), runs in groups.items():
        met[scenario].update(episode for _, episode in runs)
        seeds[policy].update(training_seed for training_seed, _ in runs)
    episodes = {scenario: sorted(numbers) for scenario, numbers in met.items()}
    training_seeds = {
        policy: sorted(numbers, key=lambda s: -1 if s is None else s) for policy, numbers in seeds.items()
    }
    if against and against not in seeds:
        raise BufgymError(f"no row of {against}, with which the others are to be compared")
    for cell in cells:
        if (baseline, cell) not in groups:
            raise BufgymError(f"{cell[0]}, L = {cell[1]}: no row of the baseline {baseline!r}")
    for (policy, trained), cell in product(training_seeds.items(), cells):
        runs = groups.get((policy, cell), {})
        for run in product(trained, episodes[cell[0]]):
            if run not in runs:
                raise BufgymError(f"{_place(policy, cell, run)}: no row; every policy must meet the same episodes")
    unbounded = {row["policy"] for row in rows if row.get("clairvoyant") is not None and row.get("regret", 0.0) is None}
    table = Arrays(cells, episodes, training_seeds, {}, {}, {}, unbounded)
    for cell in cells:
        truth = {episode: groups[baseline, cell][training_seeds[baseline][0], episode] for episode in episodes[cell[0]]}
        best = {episode: _clairvoyant(row) for episode, row in truth.items()}
        table.best[cell] = np.array(list(best.values()))
        table.exact[cell] = all(bool(row.get("certified")) for row in truth.values())
        for policy, trained in training_seeds.items():
            runs = groups[policy, cell]
            for run, row in runs.items():
                if abs(_clairvoyant(row) - best[run[1]]) > TIE * abs(best[run[1]]):
                    what = f"clairvoyant = {_clairvoyant(row)}, but {best[run[1]]} for {baseline}: not the same episode"
                    raise BufgymError(f"{_place(policy, cell, run)}: {what}")
            table.qoi[policy, cell] = np.array([[runs[s, e]["qoi"] for e in best] for s in trained], np.float64)
    return table


def _clairvoyant(row: Mapping[str, Any]) -> float:
    """Clairvoyant H of the row's episode, NaN where unknown."""
    best = row.get("clairvoyant")
    return math.nan if best is None else float(best)


def _place(policy: str, cell: Cell, run: Run) -> str:
    training_seed, (trace, seed) = run
    trained = "" if training_seed is None else f", training seed {training_seed}"
    return f"{policy}{trained} at {cell[0]}, L = {cell[1]}, trace {trace}, seed {seed}"
