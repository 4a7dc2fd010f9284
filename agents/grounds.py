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
from bufgym.benchmark import campaign
from bufgym.benchmark.run import best, draw, regret
from bufgym.benchmark.score import BASELINE
from bufgym.oracle import by_length, integer, law
from bufgym.policies import Policy
from bufgym.scenario import Interruption, Uplink
from bufgym.sender import Senders

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
        return regret(float(self.law @ self.qoi(policy)), self.best)

    def qoi(self, policy: Policy) -> NDArray[np.float64]:
        """H by T, float64[t_max + 1]."""
        self.senders.load(0, self.scenario.episode(self.scenario.t_max))
        self.senders.run(policy)
        dropped_us = self.senders.batch.fates["dropped_us"][0]
        with_arrival = np.rint(dropped_us / self.scenario.period_us).astype(np.int64)
        return by_length(np.where(dropped_us < 0, self.scenario.max_messages, with_arrival), self.scenario.value)


class Sampled:
    """Episodes of one cell."""

    exact = False

    def __init__(self, cell: Cell, drawn: Sequence[tuple[int, int]]) -> None:
        """The episodes of these (trace, seed)."""
        self.cell, scenario = cell, cell.scenario
        self.episodes = [draw(campaign.cell(scenario, trace), seed) for trace, seed in drawn]
        self.senders = Senders(len(drawn), cell.capacity, scenario.value, max_messages=scenario.max_messages)
        self.best = sum(best(episode, cell.capacity, scenario).qoi for episode in self.episodes)

    def regret(self, policy: Policy) -> float:
        for i, episode in enumerate(self.episodes):
            self.senders.load(i, episode)
        self.senders.run(policy)
        delivered = self.senders.batch.senders
        return regret(float((delivered["delivered_gain"] + (delivered["crossed"] > 0)).sum()), self.best)


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
    """The grounds of one suite, and what is to be beaten there: on each the better of AFR and Drop Oldest."""

    def __init__(self, grounds: Sequence[Ground]) -> None:
        self.grounds = list(grounds)
        known = [policies.get(name) for name in ("afr", BASELINE)]
        self.rivals = np.array([max(AT_LEAST, min(g.regret(p) for p in known)) for g in self.grounds])
        # Ratios of single sampled cells would be noise: those of one L and V are pooled. Exact ones each count.
        keys = [(g.cell.capacity, g.cell.scenario.value.name) for g in self.grounds]
        self._pools = [[i for i, key in enumerate(keys) if key == wanted] for wanted in dict.fromkeys(keys)]

    @property
    def exact(self) -> bool:
        """Whether every ground is."""
        return all(g.exact for g in self.grounds)

    @property
    def decisions(self) -> int:
        """Arrivals that one policy is asked about."""
        return sum(int(g.senders.batch.senders["arrivals"].sum()) for g in self.grounds)

    def over_rivals(self, policy: Policy) -> float:
        """Regret over the rival's: a power mean over the cells, so that the worst ones count most."""
        found = np.array([g.regret(policy) for g in self.grounds])
        ratios = [min(WORST, found[pool].sum() / self.rivals[pool].sum()) for pool in self._pools]
        power = 4 if self.exact else 2  # where the worst cell is sampled it may be bad luck
        return float(np.mean(np.power(ratios, power)) ** (1 / power))
