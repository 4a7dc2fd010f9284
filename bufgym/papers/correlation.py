"""Spearman's rank correlation with a bootstrap interval over groups."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.bootstrap import Interval, percentile_interval, stream
from bufgym.papers.extra import library

RESAMPLES = 1000
CONFIDENCE = 0.95


def spearman(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Correlate two samples; the result is in [-1, 1], or NaN if one sample does not vary."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return math.nan
    return float(library("scipy.stats").spearmanr(a, b).statistic)


def spearman_over(a: NDArray[np.float64], b: NDArray[np.float64], group: NDArray[np.int64], label: str) -> Interval:
    """Correlate with a bootstrap interval that draws whole groups, because members of a group are dependent."""
    members = [np.flatnonzero(group == g) for g in np.unique(group)]
    rng = stream(0, label)
    numbers = [spearman(a, b)]
    for _ in range(RESAMPLES):
        drawn = np.concatenate([members[k] for k in rng.integers(0, len(members), len(members))])
        numbers.append(spearman(a[drawn], b[drawn]))
    return percentile_interval(np.array(numbers), CONFIDENCE)
