"""The paired percentile bootstrap over episodes (Efron and Tibshirani 1993, chapter 13), as ``score`` describes it.

A statistic is computed for the sample and for each of its resamples at once: row 0 is always the sample itself.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.episodes import Numbers

RESAMPLES, CONFIDENCE, SEED = 2000, 0.95, 0
"""Resamples, confidence of the intervals and seed of the draws."""


class Interval(NamedTuple):
    """A statistic and its bootstrap interval. All are NaN if it is undefined; the bounds are if no interval is
    known."""

    value: float  # statistic of the sample
    low: float  # lower bound of the interval
    high: float  # upper bound of the interval


UNKNOWN = Interval(math.nan, math.nan, math.nan)


def written(interval: Interval, write: Callable[[float], str]) -> tuple[str, str]:
    """Format the value and its interval, as in 1.03 and [1.01, 1.05]; without a value, a dash and nothing."""
    if math.isnan(interval.value):
        return "–", ""
    if math.isnan(interval.low):
        return write(interval.value), "[–]"
    low, high = (write(bound).removesuffix(" %") for bound in (interval.low, interval.high))
    return write(interval.value), f"[{low}, {high}]"


def stream(seed: int, label: str) -> np.random.Generator:
    """Make the random generator for resampling ``label``, independent of all other resampling."""
    return np.random.default_rng([seed, zlib.crc32(label.encode())])


def times_drawn(n: int, resamples: int, rng: np.random.Generator) -> Numbers:
    """Draw n of n with replacement; return row 0 of ones, then counts for each resample, [1 + resamples, n]."""
    drawn = rng.multinomial(n, np.full(n, 1 / n), size=resamples)
    return np.vstack([np.ones((1, n)), drawn])


def percentile_interval(numbers: Numbers, confidence: float = CONFIDENCE) -> Interval:
    """Compute the interval of [1 + resamples] numbers; resamples with an undefined statistic, NaN, are left out."""
    drawn = numbers[1:][~np.isnan(numbers[1:])]
    if np.isnan(numbers[0]) or not len(drawn):
        return UNKNOWN
    low, high = np.percentile(drawn, [50 * (1 - confidence), 50 * (1 + confidence)]).tolist()
    return Interval(float(numbers[0]), low, high)


def ratio(above: Numbers, below: Numbers, defined: NDArray[np.bool_]) -> Numbers:
    """Divide ``above`` by ``below`` where ``defined``; NaN elsewhere."""
    quotient: Numbers = np.divide(above, below, out=np.full(below.shape, np.nan), where=defined)
    return quotient
