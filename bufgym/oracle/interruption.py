"""The best possible QoI in one interruption whose length T is known (AFR [wang2022afr], Sec. III-C).

Message 0 was sent before and message T + 1 is sent after; L of the T messages between can be kept. This makes L + 1
gaps that add up to T + 1. V is concave, so equal gaps are best. ``ideal`` and ``integer`` count the information gained
after message 0, as the paper does: compare them with H - 1 of a run.

``EveryLength`` scores a policy for every T at once. Until an arrival, nothing that a policy sees depends on T. So the
longest interruption holds all shorter ones, and some 400 decisions give the mean over T without sampling noise.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import Floats, Ints, kernel
from bufgym.model.qoi import Value, value
from bufgym.policies import Policy
from bufgym.scenario import Interruption, Scenario
from bufgym.sim import Senders
from bufgym.utils.errors import BufgymError


def _check(capacity: int, T: int) -> None:
    if capacity < 1 or T < 0:
        raise BufgymError(f"oracle: L = {capacity}, T = {T}: need L >= 1 and T >= 0")


def ideal(capacity: int, T: int, v: Value) -> float:
    """``oracle-ideal``: (L + 1) V((T + 1) / (L + 1)) with real-numbered gaps; for T <= L, T + 1 gaps of 1."""
    _check(capacity, T)
    gaps = min(capacity, T) + 1
    return gaps * v((T + 1) / gaps)


def integer(capacity: int, T: int, v: Value) -> float:
    """``oracle``: the best whole-numbered gaps, as equal as possible, some of q and the others of q + 1."""
    _check(capacity, T)
    gaps = min(capacity, T) + 1
    q, longer = divmod(T + 1, gaps)
    return longer * v(q + 1) + (gaps - longer) * v(q)


def evenly_kept(capacity: int, T: int) -> NDArray[np.int64]:
    """Messages of 1..T that ``integer`` keeps; empty if there is no room for any."""
    gaps = min(capacity, T) + 1
    kept: NDArray[np.int64] = np.arange(1, gaps) * (T + 1) // gaps
    return kept


def law(scenario: Interruption) -> NDArray[np.float64]:
    """P(T = t) for t = 0..t_max, float64[t_max + 1], exactly as ``scenario.draw_length`` draws T."""
    if not isinstance(scenario, Interruption):
        raise BufgymError(f"law: {scenario!r} is not an Interruption")
    t_min, t_max = scenario.t_min, scenario.t_max
    p = np.zeros(t_max + 1)
    t = np.arange(t_min, t_max + 1)
    if scenario.law == "fixed":
        p[t_max] = 1.0
    elif scenario.law == "uniform":
        p[t] = 1 / len(t)
    elif scenario.law == "log-uniform":
        p[t] = np.log1p(1 / t) / math.log((t_max + 1) / t_min)
    else:
        stays = 1 - 1 / (scenario.t_mean - t_min + 1)
        p[t] = (1 - stays) * stays ** (t - t_min)
        p[t_max] = stays ** (t_max - t_min)  # every longer T is cut off to t_max
    if scenario.lengths:
        p[[T for T in range(t_max + 1) if T not in scenario.lengths]] = 0.0
        p /= p.sum()
    return p


@kernel
def by_length(dropped: Ints, v: Floats, kept: Ints, h: Floats) -> None:
    """Add to ``h``, float64[t_max + 1], the gain of each interruption of T = 0..t_max messages, all from one run.

    ``dropped``, int64[t_max + 2], tells for each message 0..t_max + 1 of the longest at which arrival it was dropped (1
    = the first of the interruption). A number after t_max means never. ``kept``, int64[t_max + 2], is work space.
    """
    held = 0
    for T in range(len(h)):
        if T > 0:
            remaining = 0
            for k in range(held):
                if dropped[kept[k]] > T:
                    kept[remaining] = kept[k]
                    remaining += 1
            if dropped[T] > T:
                kept[remaining] = T
                remaining += 1
            held = remaining
        before = 0
        for k in range(held):
            h[T] += value(v, float(kept[k] - before))
            before = kept[k]
        h[T] += value(v, float(T + 1 - before))


class EveryLength:
    """One law of T and one V at several capacities, which run side by side as rows of one batch.

    Args:
        scenario: the interruption; its ``lengths`` or ``t_max`` give the law of T.
        capacities: L, messages, one row each.
    """

    def __init__(self, scenario: Scenario, capacities: Sequence[int]) -> None:
        if not isinstance(scenario, Interruption):
            raise BufgymError(f"{type(scenario).__name__}: must be an Interruption, whose law of T is known")
        self.scenario, self._law = scenario, law(scenario)
        self._senders = Senders(len(capacities), max(capacities), scenario.value, max_messages=scenario.max_messages)
        longest = scenario.episode(scenario.t_max)
        self._senders.load_all([(row, longest, None) for row in range(len(capacities))])
        batch = self._senders.batch
        batch.senders["capacity"] = capacities
        self._loaded = batch.senders.copy()
        lengths = range(scenario.t_max + 1)
        self._best = [
            float(self._law @ [1 + integer(capacity, T, scenario.value) for T in lengths]) for capacity in capacities
        ]

    @property
    def decisions(self) -> int:
        """Arrivals that a policy decides about, over all rows."""
        return int(self._senders.batch.senders["arrivals"].sum())

    def qoi(self, policy: Policy) -> NDArray[np.float64]:
        """H for each row and T, float64[capacities, t_max + 1]."""
        batch = self._senders.batch
        batch.senders[:] = self._loaded
        self._senders.run(policy)
        dropped_us = batch.log["dropped_us"]
        arrival_number = np.rint(dropped_us / self.scenario.period_us).astype(np.int64)
        dropped = np.where(dropped_us < 0, self.scenario.max_messages, arrival_number)
        h, kept = np.ones((len(dropped), self.scenario.t_max + 1)), np.zeros(dropped.shape[1], np.int64)
        for row, gains in zip(dropped, h, strict=True):
            by_length(row, self.scenario.value.array, kept, gains)
        return h

    def regrets(self, policy: Policy) -> list[float]:
        """1 - mean H / mean H of the best that knows T, for each capacity."""
        pairs = zip(self.qoi(policy), self._best, strict=True)
        return [1 - float(self._law @ h) / best for h, best in pairs]
