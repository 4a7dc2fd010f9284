"""Scores of a benchmark's rows, from 0 for Drop Oldest to 1 for the clairvoyant, with ranks and intervals.

A *cell* is a scenario with a capacity, and an *episode* of it is a trace with a seed. Every policy meets the same
episodes at every capacity of the scenario, so policies are compared episode by episode.

Every interval is a paired bootstrap over links, and depends neither on the order of the rows nor on other policies
(``bootstrap.links_drawn``, ``bootstrap.interval``). That of an agent with several training seeds joins a bootstrap over
these, drawn apart (``bootstrap.together``). docs/guide/suites.md says what it describes,
and what *share of AFR's regret* and *mean ratio* are: each has one name everywhere.

Interquartile mean and probability of improvement follow Agarwal et al. (NeurIPS 2021) and their library rliable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark import episodes
from bufgym.benchmark.bootstrap import (
    NOT_NEGATIVE,
    REALS,
    RESAMPLES,
    SEED,
    SHARES,
    Interval,
    Range,
    links_drawn,
    links_in,
    places_of,
    ratio,
    remark,
    stream,
    times_drawn,
    together,
)
from bufgym.benchmark.episodes import Arrays, Cell, Numbers
from bufgym.benchmark.table import NOBODY, RunRows, Unranked
from bufgym.oracle.measure import BASELINE, TIE, normalised_score

REFERENCE = "afr"  # Policy that improvements and differences compare with; without its rows they are NaN

DISCRIMINATIVE = 0.01  # A cell is discriminative, and counts, where the baseline's regret is at least this

AT_MOST_1: Range = (-math.inf, 1.0)
RANGES: Mapping[str, Range] = {
    **{"score": AT_MOST_1, "iqm": AT_MOST_1, "regret": SHARES, "improvement": SHARES, "share": NOT_NEGATIVE},
    "qoi": NOT_NEGATIVE,
}
"""Range of each statistic; any other has none."""
NEGLIGIBLE = 1e-9  # Mean regret up to which a ratio to it says nothing


@dataclass(frozen=True)
class CellScore:
    scenario: str
    capacity: int  # L, messages
    policy: str
    episodes: int  # number of episodes met
    qoi: Interval  # mean H
    score: Interval  # see ``normalised_score``; NaN where a clairvoyant H is missing or no better than the baseline
    regret: Interval  # see ``regret``; NaN where a clairvoyant H is missing
    difference: Interval  # mean H minus the reference's, paired; NaN without a reference
    discriminative: bool  # whether the cell counts in the standings
    exact: bool  # whether every clairvoyant H is certified to be exact, not just a bound


@dataclass(frozen=True)
class Standing:
    """One policy in one cell, or over all."""

    policy: str
    unranked_because: str  # reason why it does not compete with the others; empty if it does
    values: Mapping[str, Interval]  # by the key of a ``summary.Quantity``

    @property
    def ranked(self) -> bool:
        return not self.unranked_because

    def __getitem__(self, key: str) -> Interval:
        return self.values[key]


@dataclass(frozen=True)
class Scores:
    """Scores of every policy, in each cell and over all discriminative cells.

    ``standings`` have these values, NaN without discriminative cells. Resampling does not choose cells anew.

    * ``score``, ``regret``: mean of the policy's scores and regrets in the discriminative cells.
    * ``iqm``: interquartile mean of its scores on (discriminative cell, trace), each computed on sums over seeds. Pairs
      without possible gain have no score and are left out. In a resample a pair is weighted by its number of draws.
    * ``improvement``: paired probability of improvement over ``REFERENCE``, mean over the discriminative cells: the
      share of episodes with H above the reference's, plus half the share with the same H.
    * ``share``: share of ``REFERENCE``'s regret, a ratio of sums; NaN where the reference loses nothing.
    * ``against``: ``share`` minus the share of the policy ``against``, paired; only where one is named.
    """

    standings: list[Standing]  # ranked policies first, best score first
    cells: list[CellScore]  # by scenario, capacity, policy
    remarks: tuple[str, ...] = ()  # on the sample of links

    @property
    def counted(self) -> int:
        return len({(cell.scenario, cell.capacity) for cell in self.cells if cell.discriminative})

    @property
    def exact(self) -> bool:
        """Whether the clairvoyant is exact in every cell; if not, regrets are upper bounds."""
        return all(cell.exact for cell in self.cells)


def regret(h: Numbers, best: Numbers) -> Numbers:
    """Compute 1 - sum H / sum H_clairvoyant from the two sums; NaN if the clairvoyant's is 0 or unknown."""
    return 1 - ratio(h, best, best > 0)


def scores(rows: RunRows, unranked: Unranked = NOBODY, against: str = "") -> Scores:
    """Scores of every policy in every cell, and the standings over the discriminative cells.

    Rows of a trained agent may have a "training_seed"; the H of an episode is then the mean over training seeds. Every
    policy is compared with ``against`` by its share of ``REFERENCE``'s regret. See ``episodes.read`` for errors.
    """
    table = episodes.read(rows, BASELINE, against)
    discriminative = [cell for cell in table.cells if _Sample.met(table, cell).discriminative]
    several = {policy: len(seeds) for policy, seeds in table.training_seeds.items() if len(seeds) > 1}
    by_links, *by_training = (_level(table, discriminative, trained, against) for trained in ("", *several))
    levels = dict(zip(several, by_training, strict=True))

    def joined(policy: str, key: str, links: int, cell: Cell | None = None) -> Interval:
        on = [name for name in dict.fromkeys((policy, REFERENCE, against)) if name in several]
        drawn = [(by_links.of(policy, key, cell), links)]
        drawn += [(levels[name].of(policy, key, cell), several[name]) for name in on]
        return together(drawn, RANGES.get(key, REALS))

    cell_scores: list[CellScore] = []
    for policy, cell in product(table.training_seeds, table.cells):
        met = table.episodes[cell[0]]
        links = links_in({cell[0]: met})
        of = {key: joined(policy, key, links, cell) for key in ("qoi", "score", "regret", "difference")}
        counts, exact = cell in discriminative, table.exact[cell]
        known = of["qoi"], of["score"], of["regret"], of["difference"]
        cell_scores.append(CellScore(*cell, policy, len(met), *known, counts, exact))
    links = links_in({scenario: table.episodes[scenario] for scenario, _ in discriminative})
    standings = []
    for policy, values in by_links.overall.items():
        intervals = {key: joined(policy, key, links) for key in values}
        standings.append(Standing(policy, unranked.get(policy, ""), intervals))
    cell_scores.sort(key=lambda c: (c.scenario, c.capacity, c.policy))
    standings.sort(key=lambda s: (not s.ranked, math.isnan(s["score"].value), -s["score"].value, s.policy))
    return Scores(standings, cell_scores, tuple(_remarks(table, discriminative)))


def _remarks(table: Arrays, discriminative: Sequence[Cell]) -> list[str]:
    """Remark on links that carry half of the reference's regret, where all scenarios have the same links."""
    loser = REFERENCE if REFERENCE in table.training_seeds else BASELINE
    losses = []
    for cell in discriminative:
        lost = (table.best[cell] - table.qoi[loser, cell].mean(axis=0)) / table.best[cell].sum()
        losses.append(np.bincount(places_of(table.episodes[cell[0]]), lost))
    if len({len(of_cell) for of_cell in losses}) != 1 or np.sum(losses) <= NEGLIGIBLE:
        return []
    traces = {trace for scenario, _ in discriminative for trace, _ in table.episodes[scenario]}
    return remark(np.sum(losses, axis=0), loser, "links" if len(traces) > 1 else "episodes")


class _Level(NamedTuple):
    """Statistics of every policy, [1 + resamples] or, where nothing was drawn that they depend on, [1]."""

    cells: Mapping[tuple[str, Cell], _Statistics]
    overall: Mapping[str, dict[str, Numbers]]  # over the discriminative cells

    def of(self, policy: str, key: str, cell: Cell | None) -> Numbers:
        """One statistic in a cell, or over all."""
        if cell is None:
            return self.overall[policy][key]
        numbers: Numbers = getattr(self.cells[policy, cell], key)
        return numbers


def _level(table: Arrays, discriminative: Sequence[Cell], trained: str, against: str) -> _Level:
    """Draw the links, or the training seeds of the policy ``trained`` if it is one."""
    once = {scenario: np.ones((1, len(met))) for scenario, met in table.episodes.items()}
    drawn = once if trained else links_drawn(table.episodes, RESAMPLES, SEED)
    h = {policy: _qoi(table, policy, policy == trained) for policy in table.training_seeds}
    samples = {cell: _Sample.of(table, cell, h[BASELINE][cell], drawn[cell[0]]) for cell in table.cells}
    compared = h.get(REFERENCE, {})
    cells: dict[tuple[str, Cell], _Statistics] = {}
    overall: dict[str, dict[str, Numbers]] = {}
    for policy in table.training_seeds:
        for cell, qoi in h[policy].items():
            found = _statistics(qoi, compared.get(cell), samples[cell])
            if policy in table.unbounded:  # the clairvoyant's L does not bind it
                none = {name: np.full_like(getattr(found, name), np.nan) for name in ("score", "regret", "by_trace")}
                found = found._replace(**none)
            cells[policy, cell] = found
        overall[policy] = _overall([cells[policy, c] for c in discriminative], [samples[c] for c in discriminative])
    for values in overall.values():
        lost = overall[REFERENCE]["regret"] if REFERENCE in overall else np.full_like(values["regret"], np.nan)
        values["share"] = ratio(values["regret"], lost, lost > NEGLIGIBLE)
    for values in overall.values() if against else ():
        values["against"] = values["share"] - overall[against]["share"]
    return _Level(cells, overall)


@dataclass(frozen=True)
class _Sample:
    """Drawn episodes of one cell, from which the statistics of every policy are computed."""

    weights: Numbers  # number of draws of each episode, [1 or 1 + resamples, episodes]
    starts: NDArray[np.intp]  # first episode of each trace, [traces]
    base: Numbers  # sum of H of the baseline, [1 or 1 + resamples, traces]
    best: Numbers  # sum of H of the clairvoyant, same shape; NaN where unknown

    @classmethod
    def of(cls, table: Arrays, cell: Cell, base: Numbers, weights: Numbers) -> _Sample:
        """Make a sample; ``base`` is H of the baseline, [1 or 1 + resamples, episodes]."""
        starts = np.unique([trace for trace, _ in table.episodes[cell[0]]], return_index=True)[1]
        best = table.best[cell][np.newaxis]
        return cls(weights, starts, *(np.add.reduceat(weights * h, starts, axis=1) for h in (base, best)))

    @classmethod
    def met(cls, table: Arrays, cell: Cell) -> _Sample:
        """The cell's own episodes, once each."""
        base = table.qoi[BASELINE, cell].mean(axis=0, keepdims=True)
        return cls.of(table, cell, base, np.ones((1, len(table.episodes[cell[0]]))))

    @property
    def discriminative(self) -> bool:
        """Whether the baseline loses enough."""
        return bool(regret(self.base[:1].sum(axis=1), self.best[:1].sum(axis=1))[0] >= DISCRIMINATIVE)

    def sums(self, h: Numbers) -> Numbers:
        """Sum h[1 or 1 + resamples, episodes] over the drawn episodes, to [1 or 1 + resamples, traces]."""
        return np.asarray(np.add.reduceat(self.weights * h, self.starts, axis=1))


class _Statistics(NamedTuple):
    """Statistics of one policy in one cell, [1 or 1 + resamples] each except ``by_trace``."""

    qoi: Numbers
    score: Numbers
    regret: Numbers
    difference: Numbers
    improvement: Numbers
    by_trace: Numbers  # scores, [1 or 1 + resamples, traces]


def _statistics(h: Numbers, h_ref: Numbers | None, sample: _Sample) -> _Statistics:
    sums = sample.sums(h)
    total, base, best = sums.sum(axis=1), sample.base.sum(axis=1), sample.best.sum(axis=1)
    episodes = sample.weights.sum(axis=1)
    difference = improvement = np.full(len(total), np.nan)
    if h_ref is not None:
        minus = h - h_ref
        tied = np.abs(minus) <= TIE * np.abs(h_ref)
        better = np.where(tied, 0.5, minus > 0)
        difference, improvement = (sample.sums(numbers).sum(axis=1) / episodes for numbers in (minus, better))
    score, by_trace = normalised_score(total, base, best), normalised_score(sums, sample.base, sample.best)
    return _Statistics(total / episodes, score, regret(total, best), difference, improvement, by_trace)


def _overall(cells: Sequence[_Statistics], samples: Sequence[_Sample]) -> dict[str, Numbers]:
    """Compute score, IQM, regret and improvement over the discriminative cells."""
    if not cells:
        return dict.fromkeys(("score", "iqm", "regret", "improvement"), np.full(1, np.nan))
    values = np.hstack([cell.by_trace for cell in cells])
    weights = np.hstack([np.add.reduceat(sample.weights, sample.starts, axis=1) for sample in samples])
    means = {name: np.mean([getattr(c, name) for c in cells], axis=0) for name in ("score", "regret", "improvement")}
    return {**means, "iqm": _interquartile_means(values, weights / weights[0])}


def _interquartile_means(values: Numbers, weights: Numbers) -> Numbers:
    """Interquartile mean of each row of [n, tasks], a task counting ``weights`` times. Row 0 sets the share that is cut
    off at either end; NaN weighs nothing."""
    unknown = np.isnan(values)
    values, weights = (np.where(unknown, 0.0, numbers) for numbers in np.broadcast_arrays(values, weights))
    order = np.argsort(values, axis=1)
    values, weights = (np.take_along_axis(numbers, order, axis=1) for numbers in (values, weights))
    tasks = np.count_nonzero(weights[0])
    until = np.cumsum(weights, axis=1)
    total = weights.sum(axis=1, keepdims=True)
    cut = total * (tasks // 4) / max(tasks, 1)
    kept = np.clip(np.minimum(until, total - cut) - np.maximum(until - weights, cut), 0, None)
    left = kept.sum(axis=1)
    return ratio((kept * values).sum(axis=1), left, left > 0)


def _qoi(table: Arrays, policy: str, drawn: bool) -> dict[Cell, Numbers]:
    """Mean H of each episode over training seeds by cell, [1, episodes], or over ``drawn`` ones, [1 + resamples, ...].

    A training seed is the same agent in every cell, so one draw serves all cells.
    """
    n = len(table.training_seeds[policy])
    weights = times_drawn(n, RESAMPLES, stream(SEED, f"training of {policy}")) / n if drawn else np.full((1, n), 1 / n)
    return {cell: weights @ table.qoi[policy, cell] for cell in table.cells}
