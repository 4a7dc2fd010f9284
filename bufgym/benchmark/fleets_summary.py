"""What the rows of ``bufgym fleet`` say: each policy's team beside the baseline's, robot by robot.

A *cell* of results is (scenario, capacity). The robots of one episode share a link, so they are no independent sample:
every interval is the paired bootstrap over episodes of ``score``, never over robots; the same draw for all policies and
capacities of a scenario.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym.benchmark.bootstrap import (
    Interval,
    check_resampling,
    percentile_interval,
    ratio,
    stream,
    times_drawn,
    without_interval,
    written,
)
from bufgym.benchmark.episodes import TIE, Cell, Numbers
from bufgym.benchmark.fleets import BASELINE
from bufgym.benchmark.table import in_blocks
from bufgym.errors import BufgymError


@dataclass(frozen=True)
class Standing:
    """One policy in one cell (scenario, L), or over all: means over episodes, with intervals over these."""

    policy: str
    team: Interval
    """Team QoI: the mean over robots of H."""
    gain: Interval
    """The same minus the baseline's on the same episodes."""
    above: Interval
    """Share of robots whose H is above that of the same robot under the baseline."""
    below: Interval
    """Share of those where it is below; the rest are equal, as on a link that carries everything."""
    worst: Interval
    """H of the robot that fares worst."""
    fairness: Interval
    """Jain's index of the robots' H, (sum H)^2 / (N sum H^2): 1 if all are equal, 1/N if one has everything (Jain, Chiu
    and Hawe 1984)."""


@dataclass(frozen=True)
class Summary:
    """What ``summary`` makes of the rows; policies with the largest gain first."""

    overall: list[Standing]
    """Means over the cells."""
    cells: dict[Cell, list[Standing]]
    """In the order of the rows."""
    baseline: str


def summary(
    rows: Sequence[Mapping[str, Any]],
    baseline: str = BASELINE,
    *,
    unranked: Collection[str] = (),
    resamples: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> Summary:
    """Every policy beside ``baseline``, by cell and over all cells.

    Args:
        rows: of ``run_parts``.
        baseline: whom the others are compared with, robot by robot.
        unranked: policies that come last, such as an unbounded queue.
        resamples: of the bootstrap; one draw serves all policies and capacities of a scenario.
        confidence: of the intervals, such as 0.95.
        seed: of the draws.

    Raises:
        BufgymError: for no rows, a cell without the baseline, policies or robots that have not met the same episodes.
    """
    check_resampling(resamples, confidence)
    found = _by_policy(rows)
    statistics: dict[str, dict[Cell, dict[str, Numbers]]] = {}
    episodes: dict[str, int] = {}
    for (scenario, capacity), by_policy in found.items():
        if baseline not in by_policy:
            raise BufgymError(f"{scenario}, L = {capacity}: no row of the baseline {baseline!r}")
        theirs = by_policy[baseline]
        episodes[scenario] = len({run[:2] for run in theirs})
        drawn = times_drawn(episodes[scenario], resamples, stream(seed, scenario))
        for policy, mine in by_policy.items():
            if mine.keys() != theirs.keys():
                trace, number, robot = sorted(mine.keys() ^ theirs.keys())[0]
                what = f"robot {robot} of trace {trace}, seed {number}, met by one of both alone"
                raise BufgymError(f"{policy} and {baseline} at {scenario}, L = {capacity}: {what}")
            pair = _by_episode(mine), _by_episode(theirs)
            statistics.setdefault(policy, {})[scenario, capacity] = _statistics(*pair, drawn)
    for policy, here in statistics.items():
        if lacks := [cell for cell in found if cell not in here]:
            raise BufgymError(f"{policy}: no row at {lacks[0][0]}, L = {lacks[0][1]}")

    def standings(over: Sequence[Cell]) -> list[Standing]:
        alone = any(episodes[scenario] == 1 for scenario, _ in over)
        made = [
            _standing(policy, [here[cell] for cell in over], confidence, alone) for policy, here in statistics.items()
        ]
        return sorted(made, key=lambda s: (s.policy in unranked, -s.gain.value, s.policy))

    return Summary(standings(list(found)), {cell: standings([cell]) for cell in found}, baseline)


_Robot = tuple[str, int, int]
"""(trace, seed, robot)."""


def _by_policy(rows: Sequence[Mapping[str, Any]]) -> dict[Cell, dict[str, dict[_Robot, float]]]:
    """H by cell, policy and robot of an episode."""
    if not rows:
        raise BufgymError("no rows to summarise")
    found: dict[Cell, dict[str, dict[_Robot, float]]] = {}
    for number, row in enumerate(rows):
        for key in ("scenario", "capacity", "policy", "trace", "seed", "robot", "qoi"):
            if row.get(key) is None:
                raise BufgymError(f"rows[{number}]: no {key}")
        runs = found.setdefault((row["scenario"], row["capacity"]), {}).setdefault(row["policy"], {})
        run = (row["trace"], row["seed"], row["robot"])
        if run in runs:
            raise BufgymError(f"rows[{number}]: robot {run[2]} of one run has more than one row")
        runs[run] = row["qoi"]
    return found


def _by_episode(runs: Mapping[_Robot, float]) -> Numbers:
    """H[episodes, robots], everything in sorted order."""
    robots = len({robot for *_, robot in runs})
    if len(runs) != robots * len({run[:2] for run in runs}):
        raise BufgymError("rows: not every episode has the same robots")
    return np.array([runs[run] for run in sorted(runs)]).reshape(-1, robots)


def _statistics(h: Numbers, base: Numbers, weights: Numbers) -> dict[str, Numbers]:
    """Each statistic of the sample and its resamples, [1 + resamples], from H[episodes, robots]."""
    square = h.shape[1] * np.square(h).sum(1)
    by_episode = {
        "team": h.mean(1),
        "gain": (h - base).mean(1),
        "above": (h - base > TIE * base).mean(1),
        "below": (base - h > TIE * base).mean(1),
        "worst": h.min(1),
        # Where nobody got anything all are equal.
        "fairness": np.where(square > 0, ratio(np.square(h.sum(1)), square, square > 0), 1.0),
    }
    return {name: weights @ numbers / len(h) for name, numbers in by_episode.items()}


def _standing(policy: str, over: Sequence[Mapping[str, Numbers]], confidence: float, alone: bool) -> Standing:
    """``alone``: a cell has but one episode, so that nothing is known of chance."""
    means = {name: np.mean([cell[name] for cell in over], axis=0) for name in over[0]}
    intervals = {name: percentile_interval(numbers, confidence) for name, numbers in means.items()}
    if alone:
        intervals = {name: without_interval(x) for name, x in intervals.items()}
    return Standing(policy, **intervals)


def plain(found: Summary, abouts: Mapping[str, str] | None = None) -> str:
    """The summary as aligned text, a block for each cell and one for all; ``abouts``: what each scenario is."""
    given = found.baseline
    head = ["policy", "team QoI", f"- {given}'s [95 %]", f"robots above {given}'s", "below", "worst robot", "fairness"]
    blocks = [(_title(cell, abouts or {}), standings) for cell, standings in found.cells.items()]
    if len(blocks) > 1:
        blocks.append((f"mean of these {len(blocks)}", found.overall))
    return in_blocks(head, [(title, [_cells(one, given) for one in standings]) for title, standings in blocks])


def _title(cell: Cell, abouts: Mapping[str, str]) -> str:
    scenario, capacity = cell
    return f"{': '.join(filter(None, (scenario, abouts.get(scenario, ''))))}, L = {capacity}"


def _cells(standing: Standing, baseline: str) -> list[str]:
    own = standing.policy == baseline
    return [
        standing.policy,
        f"{standing.team.value:.3f}",
        "" if own else written(standing.gain, "+.3f"),
        "" if own else written(standing.above, ".1%"),
        "" if own else f"{standing.below.value:.1%}",
        f"{standing.worst.value:.3f}",
        f"{standing.fairness.value:.4f}",
    ]
