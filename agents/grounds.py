"""Grounds: one cell (scenario, V, L) with its bounds, on which a policy's regret is found again and again.

A *sampled* ground rolls out episodes that stay the same (common random numbers). One of interruptions is *exact*: a run
through the longest interruption holds all shorter ones (``oracle.by_length``), so some 400 decisions give the mean over
every T that the law allows, without noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from agents.worlds import Cell
from bufgym import policies
from bufgym.benchmark import sweep
from bufgym.benchmark.run import best, draw, regret
from bufgym.benchmark.score import BASELINE
from bufgym.oracle import by_length, integer, law
from bufgym.policies import Policy
from bufgym.scenario import Episode, Interruption, Uplink
from bufgym.sim import Senders

AT_LEAST = 0.003
"""A cell where AFR's regret is smaller counts as if it were this: there is next to nothing to be gained."""
WORST = 3.0
"""No ratio counts for more."""
EPISODES = 40
"""Sampled episodes a suite, spread evenly over its cells; at least one a cell."""


class Ground(Protocol):
    """What a policy is tried on."""

    cell: Cell
    exact: bool
    senders: Senders

    def regret(self, policy: Policy) -> float:
        """1 - sum of H / sum of H of the clairvoyant."""


class Lengths:
    """One interruption at every length that its law allows, weighted by their probabilities."""

    exact = True

    def __init__(self, cell: Cell) -> None:
        scenario = cell.scenario
        assert isinstance(scenario, Interruption)
        self.cell, self.scenario = cell, scenario
        self.law = law(scenario)
        self.senders = Senders(1, cell.capacity, scenario.value, max_messages=scenario.max_messages)
        lengths = range(scenario.t_max + 1)
        self.best = float(self.law @ [1 + integer(cell.capacity, T, scenario.value) for T in lengths])

    def regret(self, policy: Policy) -> float:
        return self.regret_of(self.qoi(policy))

    def regret_of(self, h: NDArray[np.float64]) -> float:
        """The regret of who reaches these H by T."""
        return regret(float(self.law @ h), self.best)

    def qoi(self, policy: Policy) -> NDArray[np.float64]:
        """H by T, float64[t_max + 1]."""
        self.senders.load(0, self.longest())
        self.senders.run(policy)
        return self.by_length(self.senders.batch.log["dropped_us"][0])

    def longest(self) -> Episode:
        """The interruption that holds all others."""
        return self.scenario.episode(self.scenario.t_max)

    def by_length(self, dropped_us: NDArray[np.int64]) -> NDArray[np.float64]:
        """H by T of who dropped the messages of ``longest`` at these times (< 0: never)."""
        with_arrival = np.rint(dropped_us / self.scenario.period_us).astype(np.int64)
        never = self.scenario.max_messages
        return by_length(np.where(dropped_us < 0, never, with_arrival), self.scenario.value)


class SideBySide:
    """Interruptions of one V and law at many L as rows of one batch: one call of compiled code for all of them."""

    def __init__(self, given: Sequence[Lengths]) -> None:
        first, self.grounds = given[0].scenario, list(given)
        widest = max(ground.cell.capacity for ground in given)
        self.senders = Senders(len(given), widest, first.value, max_messages=first.max_messages)
        for i, ground in enumerate(given):
            self.senders.capacity = ground.cell.capacity
            self.senders.load(i, ground.longest())
        self.senders.capacity = widest
        batch = self.senders.batch
        self._begun = batch.senders.copy(), batch.log.copy()

    def regrets(self, policy: Policy) -> list[float]:
        """By ground."""
        batch = self.senders.batch
        batch.senders[:], batch.log[:] = self._begun
        self.senders.run(policy)
        dropped_us = batch.log["dropped_us"]
        return [ground.regret_of(ground.by_length(row)) for ground, row in zip(self.grounds, dropped_us, strict=True)]


class Sampled:
    """Episodes of one cell."""

    exact = False

    def __init__(self, cell: Cell, drawn: Sequence[tuple[int, int]]) -> None:
        """The episodes of these (trace, seed)."""
        self.cell, scenario = cell, cell.scenario
        self.episodes = [draw(sweep.cell(scenario, trace), seed) for trace, seed in drawn]
        self.senders = Senders(len(drawn), cell.capacity, scenario.value, max_messages=scenario.max_messages)
        self.best = sum(best(episode, cell.capacity, scenario).qoi for episode in self.episodes)

    def regret(self, policy: Policy) -> float:
        for i, episode in enumerate(self.episodes):
            self.senders.load(i, episode)
        self.senders.run(policy)
        delivered = self.senders.batch.senders
        return regret(float((delivered["delivered_gain"] + (delivered["transmitted"] > 0)).sum()), self.best)


def grounds(given: Sequence[Cell], seed: int, episodes: int = EPISODES) -> list[Ground]:
    """The cells of a suite with so many sampled episodes in all; if they are fewer than cells, on that many cells.

    Traces are taken in turn, cell after cell.
    """
    rng = np.random.default_rng(seed)
    exact: list[Ground] = [Lengths(cell) for cell in given if isinstance(cell.scenario, Interruption)]
    links = [(cell, cell.scenario) for cell in given if isinstance(cell.scenario, Uplink)]
    if episodes < len(links):
        links = [links[k] for k in sorted(rng.permutation(len(links))[:episodes])]
    each = max(1, round(episodes / max(1, len(links))))
    sampled: list[Ground] = []
    waiting: list[int] = []
    for cell, uplink in links:
        while len(waiting) < each:
            waiting += rng.permutation(len(uplink.traces)).tolist()
        traces, waiting = waiting[:each], waiting[each:]
        sampled.append(Sampled(cell, [(trace, int(rng.integers(10**6))) for trace in traces]))
    return exact + sampled


class Yard:
    """The grounds of one suite, and what is to be beaten there: on each the better of AFR and Drop Oldest.

    They may come in parts, each a small sample of the suite: where candidates are tried may then change from generation
    to generation, so that many episodes cost no more than a few.
    """

    def __init__(self, *parts: Sequence[Ground]) -> None:
        self.grounds = [ground for part in parts for ground in part]
        ends = np.cumsum([len(part) for part in parts]).tolist()
        self._parts = [range(end - len(part), end) for part, end in zip(parts, ends, strict=True)]
        known = [policies.get(name) for name in ("afr", BASELINE)]
        self.rivals = np.array([max(AT_LEAST, min(g.regret(p) for p in known)) for g in self.grounds])
        # Ratios of single sampled cells would be noise: those of one L and V are pooled. Exact ones each count.
        keys = [(g.cell.capacity, g.cell.scenario.value.name) for g in self.grounds]
        kinds = list(dict.fromkeys(keys))
        self._pool = np.array([kinds.index(key) for key in keys])
        self._rival = np.array([self.rivals[self._pool == k].mean() for k in range(len(kinds))])
        exact = [g for g in self.grounds if isinstance(g, Lengths)]
        laws = dict.fromkeys((g.scenario.value, g.scenario.lengths, g.scenario.t_max) for g in exact)
        self._rows = [
            SideBySide([g for g in exact if (g.scenario.value, g.scenario.lengths, g.scenario.t_max) == wanted])
            for wanted in laws
        ]

    @property
    def exact(self) -> bool:
        """Whether every ground is."""
        return all(g.exact for g in self.grounds)

    def decisions(self, part: int | None = None) -> int:
        """Arrivals that one policy is asked about."""
        return sum(int(self.grounds[i].senders.batch.senders["arrivals"].sum()) for i in self._chosen(part))

    def over_rivals(self, policy: Policy, part: int | None = None) -> float:
        """Regret over the rival's: root mean square over the cells, so that the worst ones count most.

        ``part``: on this one alone (they are taken in turn), but over the rival's regret on all of them.
        """
        chosen = np.array(self._chosen(part))
        found, pool = self._regrets(policy, chosen), self._pool[chosen]
        ratios = [min(WORST, found[pool == k].mean() / self._rival[k]) for k in np.unique(pool)]
        return float(np.sqrt(np.mean(np.square(ratios))))

    def _chosen(self, part: int | None) -> Sequence[int]:
        return range(len(self.grounds)) if part is None else self._parts[part % len(self._parts)]

    def _regrets(self, policy: Policy, chosen: NDArray[np.int64]) -> NDArray[np.float64]:
        if self.exact:
            known = {g.cell: r for rows in self._rows for g, r in zip(rows.grounds, rows.regrets(policy), strict=True)}
            return np.array([known[self.grounds[i].cell] for i in chosen])
        return np.array([self.grounds[i].regret(policy) for i in chosen])
