"""What the rows of ``bufgym topics`` say: each policy beside the baseline, and one policy topic by topic.

A *cell* is (scenario, capacity). In a cell a share or a mean is computed on sums over its episodes; over all cells it
is the mean of theirs. Every interval is the paired bootstrap over episodes of ``score``: the same draw for all policies
and capacities of a scenario.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bufgym.benchmark import episodes
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
from bufgym.benchmark.episodes import Cell, Numbers
from bufgym.benchmark.table import Column, in_blocks, mean
from bufgym.benchmark.topics import BASELINE
from bufgym.errors import BufgymError

Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Standing:
    """One policy in one cell, or over all."""

    policy: str
    qoi: Interval
    """Mean weighted QoI."""
    relative: Interval
    """The same over the baseline's: sum / sum over the episodes that both met."""
    lost: float
    """Messages of no_drop topics that were dropped, in all episodes together."""
    age_first_s: Interval
    """Mean age of information of the topics with the highest priority, s."""
    age_relative: Interval
    """The same relative to the baseline's: sum / sum over the episodes that both met."""
    age_others_s: Interval
    """Mean age of information of all other topics, s."""
    late: Interval
    """Of the messages delivered on topics with a deadline, the share that came after it."""
    rate_hz: Interval
    """Messages delivered a second, until the last arrival or receipt."""


@dataclass(frozen=True)
class Summary:
    """What ``summary`` makes of the rows; policies best QoI first."""

    overall: list[Standing]
    cells: dict[Cell, list[Standing]]
    """In the order of the rows."""
    baseline: str
    first: tuple[float, ...]
    """The highest priority of each scenario, without repetition."""


class _Run(NamedTuple):
    """The numbers of one run."""

    qoi: float
    lost: float
    age_first: float
    age_others: float
    late: float
    due: float
    """Delivered on topics with a deadline."""
    delivered: float
    seconds: float


def summary(
    rows: Rows,
    baseline: str = BASELINE,
    *,
    unranked: Collection[str] = (),
    resamples: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> Summary:
    """Every policy beside ``baseline``, by cell and over all cells.

    Args:
        rows: of ``bufgym.benchmark.topics``.
        baseline: whose weighted QoI is 1.
        unranked: policies that come last, such as an unbounded queue.
        resamples: of the bootstrap.
        confidence: of the intervals, such as 0.95.
        seed: of the draws.

    Raises:
        BufgymError: for no rows, a cell without the baseline, policies that have not met the same episodes.
    """
    check_resampling(resamples, confidence)
    found, first = _runs(rows)
    # ``read`` makes sure that all met the same episodes, and orders them.
    keys = ("scenario", "capacity", "policy", "trace", "seed")
    table = episodes.read(
        [{**dict(zip(keys, key, strict=True)), "qoi": run.qoi} for key, run in found.items()], baseline
    )
    drawn = {name: times_drawn(len(e), resamples, stream(seed, name)) for name, e in table.episodes.items()}
    statistics: dict[str, dict[Cell, dict[str, Numbers]]] = {}
    cells = list(dict.fromkeys((scenario, capacity) for scenario, capacity, *_ in found))
    for policy in table.training_seeds:
        for cell in cells:
            met = table.episodes[cell[0]]
            runs, theirs = (np.array([found[*cell, who, *episode] for episode in met]).T for who in (policy, baseline))
            statistics.setdefault(policy, {})[cell] = _statistics(_Run(*runs), _Run(*theirs), drawn[cell[0]])

    def standings(over: Sequence[Cell]) -> list[Standing]:
        alone = any(len(table.episodes[scenario]) == 1 for scenario, _ in over)
        made = [
            _standing(policy, [here[cell] for cell in over], confidence, alone) for policy, here in statistics.items()
        ]
        return sorted(
            made, key=lambda s: (s.policy in unranked, math.isnan(s.relative.value), -s.relative.value, s.policy)
        )

    return Summary(standings(cells), {cell: standings([cell]) for cell in cells}, baseline, first)


def _runs(rows: Rows) -> tuple[dict[tuple[Any, ...], _Run], tuple[float, ...]]:
    """The runs by (scenario, capacity, policy, trace, seed), and the highest priorities."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for number, row in enumerate(rows):
        for name in ("scenario", "capacity", "policy", "trace", "seed", "topic", "weighted_qoi"):
            if row.get(name) is None:
                raise BufgymError(f"rows[{number}]: no {name}")
        key = (row["scenario"], row["capacity"], row["policy"], row["trace"], row["seed"])
        group = groups.setdefault(key, [])
        if any(other["topic"] == row["topic"] for other in group):
            raise BufgymError(f"rows[{number}]: topic {row['topic']!r} of one run has more than one row")
        group.append(row)
    highest = dict.fromkeys(max(row["priority"] for row in group) for group in groups.values())
    return {key: _run(group) for key, group in groups.items()}, tuple(highest)


def _run(topics: Rows) -> _Run:
    """The numbers of one run from the rows of its topics."""
    highest = max(row["priority"] for row in topics)
    with_deadline = [row for row in topics if row["deadline_s"] is not None]
    return _Run(
        qoi=topics[0]["weighted_qoi"],
        lost=sum(row["lost"] + row["limited"] for row in topics if row["no_drop"]),
        age_first=mean([row["mean_age_s"] for row in topics if row["priority"] == highest]),
        age_others=mean([row["mean_age_s"] for row in topics if row["priority"] < highest]),
        late=sum(row["late"] for row in with_deadline),
        due=sum(row["delivered"] for row in with_deadline),
        delivered=sum(row["delivered"] for row in topics),
        seconds=topics[0]["seconds"],
    )


def _statistics(runs: Any, base: Any, weights: Numbers) -> dict[str, Numbers]:
    """Each statistic of the sample and its resamples, [1 + resamples], from [episodes] numbers of a policy."""

    def share(above: Numbers, below: Numbers) -> Numbers:
        total = weights @ below
        return ratio(weights @ above, total, total > 0)

    def average(numbers: Numbers) -> Numbers:
        known = ~np.isnan(numbers)
        return share(np.where(known, numbers, 0.0), known.astype(np.float64))

    return {
        "qoi": average(runs.qoi),
        "relative": share(runs.qoi, base.qoi),
        "lost": weights @ runs.lost,
        "age_first_s": average(runs.age_first),
        "age_relative": share(runs.age_first, base.age_first),
        "age_others_s": average(runs.age_others),
        "late": share(runs.late, runs.due),
        "rate_hz": share(runs.delivered, runs.seconds),
    }


def _standing(policy: str, cells: Sequence[Mapping[str, Numbers]], confidence: float, alone: bool) -> Standing:
    """``alone``: a cell has but one episode, so that nothing is known of chance."""
    over = {name: np.mean([cell[name] for cell in cells], axis=0) for name in cells[0] if name != "lost"}
    intervals = {name: percentile_interval(numbers, confidence) for name, numbers in over.items()}
    if alone:
        intervals = {name: without_interval(x) for name, x in intervals.items()}
    return Standing(policy, lost=float(sum(cell["lost"][0] for cell in cells)), **intervals)


# --- as text ---------------------------------------------------------------------------------------------------------


def plain(found: Summary, abouts: Mapping[str, str] | None = None) -> str:
    """The summary as aligned text: a block for each cell, and one over all where there are several.

    ``abouts``: what each scenario is, by its label.
    """
    abouts = abouts or {}
    first = f"priority {found.first[0]:g}" if len(found.first) == 1 else "first"
    head = [
        "policy",
        "QoI",
        f"QoI / {found.baseline}",
        "no_drop lost",
        f"age, {first} (s)",
        f"age / {found.baseline}",
        "age, others (s)",
        "late",
        "msg/s",
    ]
    blocks = [(_title(cell, abouts), standings) for cell, standings in found.cells.items()]
    if len(blocks) > 1:
        blocks.append((f"mean of these {len(blocks)}", found.overall))
    return in_blocks(head, [(title, [_cells(standing) for standing in standings]) for title, standings in blocks])


def _title(cell: Cell, abouts: Mapping[str, str]) -> str:
    scenario, capacity = cell
    about = abouts.get(scenario, "")
    return f"{': '.join(filter(None, (scenario, about)))}{', ' if scenario or about else ''}L = {capacity}"


def _cells(standing: Standing) -> list[str]:
    return [
        standing.policy,
        f"{standing.qoi.value:.1f}",
        written(standing.relative, ".3f"),
        f"{standing.lost:g}",
        "-" if math.isnan(standing.age_first_s.value) else f"{standing.age_first_s.value:.2f}",
        written(standing.age_relative, ".3f"),
        written(standing.age_others_s, ".2f"),
        "-" if math.isnan(standing.late.value) else f"{standing.late.value:.1%}",
        "-" if math.isnan(standing.rate_hz.value) else f"{standing.rate_hz.value:.1f}",
    ]


TOPIC_COLUMNS = (
    Column("topic", "topic", str),
    Column("priority", "priority", "{:g}".format),
    Column("QoI", "qoi", "{:.2f}".format),
    Column("arrived", "arrived", "{:.1f}".format),
    Column("limited", "limited", "{:.1f}".format),
    Column("lost", "lost", "{:.1f}".format),
    Column("delivered", "delivered", "{:.1f}".format),
    Column("late", "late", "{:.1f}".format),
    Column("age mean (s)", "mean_age_s", "{:.3f}".format),
    Column("age peak (s)", "peak_age_s", "{:.3f}".format),
    Column("delay mean (s)", "mean_sojourn_s", "{:.3f}".format),
    Column("delay p95 (s)", "p95_sojourn_s", "{:.3f}".format),
)


def by_topic(rows: Rows, policy: str) -> str:
    """The means over episodes of each topic's outcome under one policy, as aligned text, a block for each cell."""
    mine = [row for row in rows if row["policy"] == policy]
    if not mine:
        raise BufgymError(f"no row of the policy {policy!r}")
    cells = dict.fromkeys((row["scenario"], row["capacity"]) for row in mine)
    blocks = [
        (_title(cell, {}), _topic_lines([row for row in mine if (row["scenario"], row["capacity"]) == cell]))
        for cell in cells
    ]
    return in_blocks([column.title for column in TOPIC_COLUMNS], blocks)


def _topic_lines(rows: Rows) -> list[list[str]]:
    made = []
    for topic in dict.fromkeys(row["topic"] for row in rows):
        its = [row for row in rows if row["topic"] == topic]
        numbers = [mean([row[column.key] for row in its]) for column in TOPIC_COLUMNS[1:]]
        written = [
            "-" if math.isnan(number) else column.write(number)
            for column, number in zip(TOPIC_COLUMNS[1:], numbers, strict=True)
        ]
        made.append([topic, *written])
    return made
