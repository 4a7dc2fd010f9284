"""The paired percentile bootstrap over links (Efron and Tibshirani 1993, chapter 13), as ``score`` describes it.

A statistic is computed for the sample and for each of its resamples at once: row 0 is always the sample itself.
"""

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.episodes import Episode, Numbers
from bufgym.benchmark.table import NONE

RESAMPLES, CONFIDENCE, SEED = 2000, 0.95, 0  # Resamples, confidence of the intervals and seed of the draws


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
        return NONE, ""
    if math.isnan(interval.low):
        return write(interval.value), f"[{NONE}]"
    low, high = (write(bound).removesuffix(" %") for bound in (interval.low, interval.high))
    return write(interval.value), f"[{low}, {high}]"


def stream(seed: int, label: str) -> np.random.Generator:
    """Make the random generator for resampling ``label``, independent of all other resampling."""
    return np.random.default_rng([seed, zlib.crc32(label.encode())])


def times_drawn(n: int, resamples: int, rng: np.random.Generator) -> Numbers:
    """Draw n of n with replacement; return row 0 of ones, then counts for each resample, [1 + resamples, n]."""
    drawn = rng.multinomial(n, np.full(n, 1 / n), size=resamples)
    return np.vstack([np.ones((1, n)), drawn])


def links_drawn(
    episodes: Mapping[str, Sequence[Episode]], resamples: int = RESAMPLES, seed: int = SEED
) -> dict[str, Numbers]:
    """Draw links with replacement, jointly in all scenarios; return the counts of each scenario's episodes,
    [1 + resamples, episodes], where row 0 is ones.

    A link is a trace. A drawn link brings its episodes of all seeds, because they depend on it. Where all episodes of a
    scenario are on one trace, or on none, the episodes themselves are drawn. Scenarios with equally many links share a
    draw, the k-th link of one with the k-th of the other, sorted by name: the scenarios of a suite have the same links,
    or links made of the same seeds. For links that have nothing in common the interval is as wide on average.
    """
    draws: dict[int, Numbers] = {}
    counts = {}
    for scenario, met in episodes.items():
        alone = len({trace for trace, _ in met}) == 1
        links: list[Any] = [episode if alone else episode[0] for episode in met]
        place = {link: k for k, link in enumerate(sorted(set(links)))}
        n = len(place)
        draws.setdefault(n, times_drawn(n, resamples, stream(seed, f"{n} links")))
        # In the order of ``times_drawn``, so that sums over row 0 round as they do there.
        counts[scenario] = np.ascontiguousarray(draws[n][:, [place[link] for link in links]])
    return counts


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
