"""Spearman's rank correlation, and how sure of it a few groups make us."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.bootstrap import Interval, percentile_interval, stream
from bufgym.perception.extra import library

RESAMPLES = 1000
CONFIDENCE = 0.95


def spearman(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """In [-1, 1]; NaN where one of them does not vary."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return math.nan
    return float(library("scipy.stats").spearmanr(a, b).statistic)


def spearman_over(a: NDArray[np.float64], b: NDArray[np.float64], group: NDArray[np.int64], label: str) -> Interval:
    """The same with its bootstrap interval: whole groups are drawn, as what is in one was met together."""
    members = [np.flatnonzero(group == g) for g in np.unique(group)]
    rng = stream(0, label)
    numbers = [spearman(a, b)]
    for _ in range(RESAMPLES):
        drawn = np.concatenate([members[k] for k in rng.integers(0, len(members), len(members))])
        numbers.append(spearman(a[drawn], b[drawn]))
    return percentile_interval(np.array(numbers), CONFIDENCE)
