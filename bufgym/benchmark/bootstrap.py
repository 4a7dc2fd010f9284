"""The paired percentile bootstrap over episodes (Efron and Tibshirani 1993, chapter 13), as ``score`` describes it.

A statistic is computed for the sample and for each of its resamples at once: row 0 is always the sample itself.
"""

from __future__ import annotations

import math
import zlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.episodes import Numbers
from bufgym.errors import BufgymError


class Interval(NamedTuple):
    """A statistic and its bootstrap interval; all NaN where it is undefined, the interval where no sample tells it."""

    value: float
    low: float
    high: float


def stream(seed: int, label: str) -> np.random.Generator:
    """The chance by which what is called ``label`` is resampled, whatever else is."""
    return np.random.default_rng([seed, zlib.crc32(label.encode())])


def times_drawn(n: int, resamples: int, rng: np.random.Generator) -> Numbers:
    """[1 + resamples, n]: 1 each, then how often each of n is drawn in n draws with replacement."""
    drawn = rng.multinomial(n, np.full(n, 1 / n), size=resamples)
    return np.vstack([np.ones((1, n)), drawn])


def percentile_interval(numbers: Numbers, confidence: float) -> Interval:
    """The interval of [1 + resamples] numbers; resamples in which the statistic is undefined (NaN) are left out."""
    drawn = numbers[1:][~np.isnan(numbers[1:])]
    if np.isnan(numbers[0]) or not len(drawn):
        return Interval(math.nan, math.nan, math.nan)
    low, high = np.percentile(drawn, [50 * (1 - confidence), 50 * (1 + confidence)]).tolist()
    return Interval(float(numbers[0]), low, high)


def without_interval(x: Interval) -> Interval:
    """The statistic alone: each resample of a single episode is that episode, which says nothing of its chance."""
    return Interval(x.value, math.nan, math.nan)


def written(x: Interval, form: str) -> str:
    """``x`` as text, such as 1.03 [1.01, 1.05]; 1.03 [-] without an interval, - where it is undefined."""
    if math.isnan(x.value):
        return "-"
    return f"{x.value:{form}} " + ("[-]" if math.isnan(x.low) else f"[{x.low:{form}}, {x.high:{form}}]")


def ratio(above: Numbers, below: Numbers, defined: NDArray[np.bool_]) -> Numbers:
    """above / below where that is defined, NaN elsewhere."""
    made: Numbers = np.divide(above, below, out=np.full(below.shape, np.nan), where=defined)
    return made


def check_resampling(resamples: int, confidence: float) -> None:
    """An error for numbers that no interval can be made with."""
    if resamples < 1:
        raise BufgymError(f"resamples = {resamples}: must be >= 1")
    if not 0 < confidence < 1:
        raise BufgymError(f"confidence = {confidence}: must be above 0 and below 1")
