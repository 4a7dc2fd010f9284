"""Scores of a benchmark's rows, from 0 for Drop Oldest to 1 for the clairvoyant, with ranks and intervals.

A *cell* is a scenario with a capacity, and an *episode* of it is a trace with a seed. Every policy meets the same
episodes at every capacity of the scenario, so policies are compared episode by episode.

Every interval is a paired bootstrap over links, and depends neither on the order of the rows nor on other policies
(``bootstrap.links_drawn``, ``bootstrap.interval``). docs/guide/suites.md says what it describes,
and what *share of AFR's regret* and *mean ratio* are: each has one name everywhere.

Interquartile mean and probability of improvement follow Agarwal et al. (NeurIPS 2021) and their library rliable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark import episodes
from bufgym.benchmark.bootstrap import (
    REALS,
    RESAMPLES,
    SEED,
    Interval,
    interval,
    links_drawn,
    links_in,
    ratio,
    stream,
    times_drawn,
)
from bufgym.benchmark.episodes import Arrays, Cell, Numbers
from bufgym.benchmark.table import NOBODY, RunRows, Unranked
from bufgym.oracle.measure import BASELINE, TIE, normalised_score

REFERENCE = "afr"  # Policy that improvements and differences compare with; without its rows they are NaN

DISCRIMINATIVE = 0.01  # A cell is discriminative, and counts, where the baseline's regret is at least this

SHARES = 0.0, 1.0  # Bounds of probabilities and regrets
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
    drawn = links_drawn(table.episodes, RESAMPLES, SEED)
    base = _resampled(table, BASELINE)
    samples = {cell: _Sample.of(table, cell, base[cell], drawn[cell[0]]) for cell in table.cells}
    discriminative = [cell for cell in table.cells if samples[cell].discriminative]
    compared = _resampled(table, REFERENCE) if REFERENCE in table.training_seeds else {}
    cell_scores: list[CellScore] = []
    overall: dict[str, dict[str, Numbers]] = {}
    for policy in table.training_seeds:
        by_cell = {
            cell: _statistics(h, compared.get(cell), samples[cell]) for cell, h in _resampled(table, policy).items()
        }
        if policy in table.unbounded:
            for cell, s in by_cell.items():  # the clairvoyant's L does not bind it
                none = {name: np.full_like(getattr(s, name), np.nan) for name in ("score", "regret", "by_trace")}
                by_cell[cell] = s._replace(**none)
        for cell, s in by_cell.items():
            episodes_of = {cell[0]: table.episodes[cell[0]]}
            drawn_links = links_in(episodes_of)
            qoi, score, more = (interval(numbers, drawn_links) for numbers in (s.qoi, s.score, s.difference))
            regrets = interval(s.regret, drawn_links, within=SHARES)
            counts, exact = samples[cell].discriminative, table.exact[cell]
            met = len(episodes_of[cell[0]])
            cell_scores.append(CellScore(*cell, policy, met, qoi, score, regrets, more, counts, exact))
        overall[policy] = _overall([by_cell[cell] for cell in discriminative], [samples[c] for c in discriminative])
    for values in overall.values():
        lost = overall[REFERENCE]["regret"] if REFERENCE in overall else np.full_like(values["regret"], np.nan)
        values["share"] = ratio(values["regret"], lost, lost > NEGLIGIBLE)
    for values in overall.values() if against else ():
        values["against"] = values["share"] - overall[against]["share"]
    links = links_in({scenario: table.episodes[scenario] for scenario, _ in discriminative})
    standings = []
    for policy, values in overall.items():
        found = {
            key: interval(numbers, links, within=SHARES if key in ("improvement", "regret") else REALS)
            for key, numbers in values.items()
        }
        standings.append(Standing(policy, unranked.get(policy, ""), found))
    cell_scores.sort(key=lambda c: (c.scenario, c.capacity, c.policy))
    standings.sort(key=lambda s: (not s.ranked, math.isnan(s["score"].value), -s["score"].value, s.policy))
    return Scores(standings, cell_scores)


@dataclass(frozen=True)
class _Sample:
    """Drawn episodes of one cell, from which the statistics of every policy are computed."""

    weights: Numbers  # number of draws of each episode, [1 + resamples, episodes]
    starts: NDArray[np.intp]  # first episode of each trace, [traces]
    base: Numbers  # sum of H of the baseline, [1 + resamples, traces]
    best: Numbers  # sum of H of the clairvoyant, same shape; NaN where unknown

    @classmethod
    def of(cls, table: Arrays, cell: Cell, base: Numbers, weights: Numbers) -> _Sample:
        """Make a sample; ``base`` is H of the baseline, [1 or 1 + resamples, episodes]."""
        starts = np.unique([trace for trace, _ in table.episodes[cell[0]]], return_index=True)[1]
        best = table.best[cell][np.newaxis]
        return cls(weights, starts, *(np.add.reduceat(weights * h, starts, axis=1) for h in (base, best)))

    @property
    def discriminative(self) -> bool:
        """Whether the baseline loses enough."""
        return bool(regret(self.base[:1].sum(axis=1), self.best[:1].sum(axis=1))[0] >= DISCRIMINATIVE)

    def sums(self, h: Numbers) -> Numbers:
        """Sum h[1 or 1 + resamples, episodes] over the drawn episodes, to [1 + resamples, traces]."""
        return np.asarray(np.add.reduceat(self.weights * h, self.starts, axis=1))


class _Statistics(NamedTuple):
    """Statistics of one policy in one cell, [1 + resamples] each except ``by_trace``."""

    qoi: Numbers
    score: Numbers
    regret: Numbers
    difference: Numbers
    improvement: Numbers
    by_trace: Numbers  # scores, [1 + resamples, traces]


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
    """Compute score, IQM, regret and improvement over the discriminative cells, [1 + resamples] each."""
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
    values, weights = (np.where(unknown, 0.0, numbers) for numbers in (values, weights))
    order = np.argsort(values, axis=1)
    values, weights = (np.take_along_axis(numbers, order, axis=1) for numbers in (values, weights))
    tasks = np.count_nonzero(weights[0])
    until = np.cumsum(weights, axis=1)
    total = weights.sum(axis=1, keepdims=True)
    cut = total * (tasks // 4) / max(tasks, 1)
    kept = np.clip(np.minimum(until, total - cut) - np.maximum(until - weights, cut), 0, None)
    left = kept.sum(axis=1)
    return ratio((kept * values).sum(axis=1), left, left > 0)


def _resampled(table: Arrays, policy: str) -> dict[Cell, Numbers]:
    """H of each episode by cell, [1, episodes], or its means over drawn training seeds, [1 + resamples, episodes].

    A training seed is the same agent in every cell, so one draw serves all cells.
    """
    trained = len(table.training_seeds[policy])
    if trained == 1:
        return {cell: table.qoi[policy, cell] for cell in table.cells}
    weights = times_drawn(trained, RESAMPLES, stream(SEED, f"training of {policy}")) / trained
    return {cell: weights @ table.qoi[policy, cell] for cell in table.cells}
