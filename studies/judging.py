"""Agents and rules on the families of ``studies.families``: shares of AFR's regret, and paired intervals over links.

A *row* is a family, or its runs at one L. The runs of a link, of all its seeds and scenarios, are drawn together, so
seeds add nothing but accuracy: the interval is for other links. Policies meet the same runs and the same resamples.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.evaluation import Numbers
from agents.families import Family, Run
from bufgym import policies
from bufgym.benchmark.bootstrap import NOT_NEGATIVE, RESAMPLES, SEED, Interval, interval, stream, times_drawn
from bufgym.policies import Policy
from studies import families
from studies.causal_planner import LAWS, NAME, Planning, qoi_of
from studies.futures import prior
from studies.page import table, written

RULES = ("target-gap", "price-dp", "gap-price")
BY_CAPACITY = ("frames", "fresh")
"""Families each L of which is a row of its own. Of the others all L together are, and the parts stand below."""


@dataclass(frozen=True)
class Row:
    """Shares of AFR's regret on some runs."""

    name: str
    runs: int
    links: int
    shares: Mapping[str, Numbers]
    """Policy -> float64[1 + resamples], of the sample itself first."""

    def share(self, policy: str) -> Interval:
        """A policy's share."""
        return interval(self.shares[policy], self.links, within=NOT_NEGATIVE)

    def above(self, policy: str, other: str) -> Interval:
        """How far a policy's share lies above another's."""
        return interval(self.shares[policy] - self.shares[other], self.links)

    @property
    def best_rule(self) -> str:
        """The rule that leaves least on these very runs."""
        return min(RULES, key=lambda rule: float(self.shares[rule][0]))


Say = Callable[[str], None]


class Judged(NamedTuple):
    """The rows of a family."""

    rows: list[Row]
    """What counts: the family, or each L of it."""
    parts: list[Row]
    """Each L of a family that is one row, if there are several."""


def judged(name: str, runs: Sequence[Run], rivals: Mapping[str, Policy]) -> Judged:
    """The rows of one family; ``rivals`` are policies by the names that they have in the tables."""
    family = Family(name, runs)
    weights = times_drawn(family.links, RESAMPLES, stream(SEED, name))
    h = {rival: family.play(policy) for rival, policy in rivals.items()}

    def row(title: str, part: NDArray[np.bool_]) -> Row:
        shares = {rival: family.shares(own, weights, part) for rival, own in h.items()}
        return Row(title, int(part.sum()), family.links, shares)

    every = np.unique(family.capacity).tolist() if name != "random" else []
    parts = [row(f"{name}, L = {L}", family.capacity == L) for L in every]
    if name in BY_CAPACITY:
        return Judged(parts, [])
    return Judged([row(name, np.ones(len(runs), bool))], parts if len(parts) > 1 else [])


TOLD = ("task", "frames", "lte", "generated")
"""Families on which an agent plays again, told when its stream ends."""
_TOLD = "told the end"


def told(makers: Mapping[str, families.Maker], folder: Path, agent: Policy) -> list[Row]:
    """What an agent leaves on some families, as it was and told when each stream ends."""
    rows = []
    for name in filter(makers.__contains__, TOLD):
        runs = families.bounded(name, makers[name], folder)
        ends = [replace(run["episode"], ends_us=round(1e6 * run["scenario"].duration_s)) for run in runs]
        family, known = (
            Family(name, some)
            for some in (runs, [{**run, "episode": episode} for run, episode in zip(runs, ends, strict=True)])
        )
        weights = times_drawn(family.links, RESAMPLES, stream(SEED, name))
        shares = {"": family.shares(family.play(agent), weights), _TOLD: known.shares(known.play(agent), weights)}
        rows.append(Row(name, len(runs), family.links, shares))
    return rows


def told_table(rows: Sequence[Row]) -> str:
    """How much less is left where the end is told, paired."""
    lines = [[row.name, _share(row, ""), _share(row, _TOLD), written(row.above(_TOLD, ""), "+.3f")] for row in rows]
    return "\n".join(table(["", "not told", _TOLD, "difference"], lines))


def mean_of(rows: Sequence[Row]) -> Row:
    """The mean of the rows; as many links as the row that has fewest make its interval."""
    shares = {name: np.mean([row.shares[name] for row in rows], axis=0) for name in rows[0].shares}
    return Row("mean", sum(row.runs for row in rows), min(row.links for row in rows), shares)


SAID = 16
"""Runs of the planner from one line of progress to the next."""


class Plan(NamedTuple):
    """Runs that the planner plays: on the first ``links`` links of a family, the first seeds of each, at one L."""

    family: str
    planning: Planning
    links: int
    seeds: int
    capacity: int


PLANS = {
    "task, told the end": Plan("task", Planning(32, 20.0, True), 16, 2, 8),
    "task": Plan("task", Planning(32, 20.0, False), 16, 2, 8),
    "lte, L = 5": Plan("lte", Planning(32, 8.0, False), 12, 1, 5),
}
"""Futures, how far they reach, and whether the end is told."""


def planned(
    runs: Mapping[str, Sequence[Run]], folder: Path, rivals: Mapping[str, Policy], say: Say = print
) -> Iterator[Row]:
    """A row for each plan whose family is among ``runs``; the planner's H of a run is kept in ``folder``."""
    for title, plan in PLANS.items():
        if plan.family not in runs:
            continue
        seeds = families.FAMILIES[plan.family].seeds
        near = set(list(dict.fromkeys(run["link"] for run in runs[plan.family]))[: plan.links])
        first = [run for k, run in enumerate(runs[plan.family]) if k % seeds < plan.seeds]
        chosen = [run for run in first if run["link"] in near and run["capacity"] == plan.capacity]
        links = prior(LAWS[plan.family], np.random.default_rng(0))

        h = np.empty(len(chosen))
        for k, run in enumerate(chosen):
            file = folder / f"planner-{families.digest([run], plan.planning, k)}.npy"
            find = functools.partial(qoi_of, run, plan.planning, links, k)
            h[k] = families.kept(file, lambda find=find: np.array(find()))  # type: ignore[misc]
            if (k + 1) % SAID == 0:
                say(f"planner on {title}: {k + 1} of {len(chosen)} runs")
        family = Family(title, chosen)
        weights = times_drawn(family.links, RESAMPLES, stream(SEED, title))
        shares = {NAME: family.shares(h, weights)}
        shares |= {name: family.shares(family.play(policy), weights) for name, policy in rivals.items()}
        yield Row(title, len(chosen), family.links, shares)


def rules() -> dict[str, Policy]:
    """The rules by name."""
    return {name: policies.get(name) for name in RULES}


def shares_table(rows: Sequence[Row], columns: Sequence[str], shown: str) -> str:
    """Shares, that of the policy ``shown`` with its interval."""
    lines = [
        [
            row.name,
            row.runs,
            row.links,
            *(written(row.share(c), ".3f") if c == shown else _share(row, c) for c in columns),
        ]
        for row in rows
    ]
    return "\n".join(table(["", "runs", "links", *columns], lines))


def above_table(rows: Sequence[Row], policy: str, others: Sequence[str]) -> str:
    """How far a policy lies above the best rule of each row, and above others."""
    lines = [
        [
            row.name,
            row.best_rule,
            written(row.above(policy, row.best_rule), "+.3f"),
            *(written(row.above(policy, other), "+.3f") for other in others),
        ]
        for row in rows
    ]
    return "\n".join(table(["", "best rule", "above it", *(f"above {other}" for other in others)], lines))


def _share(row: Row, policy: str) -> str:
    return f"{row.shares[policy][0]:.3f}"


def judged_all(
    makers: Mapping[str, families.Maker], folder: Path, rivals: Mapping[str, Policy], say: Say = print
) -> tuple[list[Row], list[Row], dict[str, list[Run]]]:
    """All rows, the parts of rows, and the runs that the planner may play; each row is said when it is known."""
    rows, parts, kept = list[Row](), list[Row](), dict[str, list[Run]]()
    began = time.monotonic()
    for name, maker in makers.items():
        runs = families.bounded(name, maker, folder, say)
        found = judged(name, runs, rivals)
        rows, parts = [*rows, *found.rows], [*parts, *found.parts]
        if name in LAWS:
            kept[name] = runs
        for row in found.rows:
            shares = ", ".join(f"{rival} {_share(row, rival)}" for rival in rivals)
            say(f"{time.monotonic() - began:.0f} s: {row.name}: {row.runs} runs on {row.links} links: {shares}")
    return rows, parts, kept
