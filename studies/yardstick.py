"""Which episodes separate the best rule from constant actions: the table of docs/guide/suites.md.

python -m studies.yardstick --suites lte-v1 sustained-v1 generated-v1 outage-v1 switching-v1 --seeds 1

An agent that is level with a constant action may have learned nothing. So episodes say something of learning where the
best rule is above the better constant action, in the share of AFR's regret that each leaves, by more than its interval.
``--capacities`` are those of the default environment, on the episodes that ``train.py`` tests on.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from agents.constants import CONSTANT, UNTAUGHT
from agents.evaluation import EvaluationSet
from agents.held_out import FixedEpisodes
from agents.tasks import Environment
from bufgym import policies
from bufgym.benchmark.rows import Row
from bufgym.benchmark.score import scores
from bufgym.benchmark.sweep import Sweep
from bufgym.benchmark.table import decimal
from bufgym.oracle.measure import BASELINE
from studies.page import command, table, written

RULES = ("target-gap", "gap-price")
BESIDE = (BASELINE, "afr")


def of_environment(capacity: int, episodes: int) -> list[Row]:
    """Rows of the default environment at this L."""
    test = FixedEpisodes(Environment(capacity=capacity), "test", episodes)
    fixed = [*UNTAUGHT, *map(policies.get, (*BESIDE, *RULES))]
    return test.rows({policy.name: test.play(policy) for policy in fixed})


def of_suite(name: str, seeds: int | None) -> list[Row]:
    """Rows of the suite's test split, with so many seeds of each link."""
    with tempfile.TemporaryDirectory() as scratch:
        evaluation = EvaluationSet(Sweep(name, (*BESIDE, *RULES), seeds=seeds), Path(scratch) / "rows")
        rows = [{**row, "training_seed": None} for row in evaluation.rows]
        for policy in UNTAUGHT:
            rows += evaluation.benchmark_rows(evaluation.play(policy), policy.name, None)
    return rows


def line(label: str, rows: Sequence[Row]) -> list[str]:
    """A line of the table: scores of constant actions, chance, AFR and the best rule; then how far apart they are."""
    of = {standing.policy: standing["score"].value for standing in scores(rows).standings}
    better = max((policy.name for policy in CONSTANT), key=lambda name: of[name])
    best = max(RULES, key=lambda name: of[name])
    found = scores(rows, against=better)
    apart = next(standing["against"] for standing in found.standings if standing.policy == best)
    verdict = "yes" if apart.high < 0 else "no"
    known = [decimal(of[name], 3) for name in (*(policy.name for policy in UNTAUGHT), "afr", best)]
    return [label, *known, best, written(apart, "+.2f"), verdict]


def page(
    suites: Sequence[str] = (), capacities: Sequence[int] = (5, 8, 16), seeds: int | None = None, episodes: int = 200
) -> None:
    """Play them all, and print the table."""
    lines = [line(f"Uplink-v1, L = {capacity}", of_environment(capacity, episodes)) for capacity in capacities]
    lines += [line(name, of_suite(name, seeds)) for name in suites]
    head = ["episodes", *(policy.name for policy in UNTAUGHT), "AFR", "best rule", "which"]
    print(*table([*head, "share, less the better constant's [95 %]", "separates"], lines), sep="\n")


if __name__ == "__main__":
    command(page)
