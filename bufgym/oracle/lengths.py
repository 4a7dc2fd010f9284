"""A policy's regret in one interruption, exact over every length T that the law allows.

Until an arrival, nothing that a policy sees depends on T, so a run through the longest interruption holds all shorter
ones (``by_length``). Some 400 decisions give the mean over T without sampling noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.errors import BufgymError
from bufgym.oracle.interruption import by_length, integer
from bufgym.oracle.online import law
from bufgym.policies import Policy
from bufgym.scenario import Interruption, Scenario
from bufgym.sim import Senders


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
        self._loaded = batch.senders.copy(), batch.log.copy()
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
        batch.senders[:], batch.log[:] = self._loaded
        self._senders.run(policy)
        dropped_us = batch.log["dropped_us"]
        arrival_number = np.rint(dropped_us / self.scenario.period_us).astype(np.int64)
        dropped = np.where(dropped_us < 0, self.scenario.max_messages, arrival_number)
        return np.array([by_length(row, self.scenario.value) for row in dropped])

    def regrets(self, policy: Policy) -> list[float]:
        """1 - mean H / mean H of the best that knows T, for each capacity."""
        pairs = zip(self.qoi(policy), self._best, strict=True)
        return [1 - float(self._law @ h) / best for h, best in pairs]
