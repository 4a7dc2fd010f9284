"""The paired bootstrap over links, and the one kind of interval that everything prints.

A statistic is computed for the sample and for each of its resamples at once: row 0 is always the sample itself. How
often its intervals cover is simulated by ``studies.coverage``.
"""

import functools
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.episodes import Episode, Numbers
from bufgym.benchmark.table import NONE

RESAMPLES, CONFIDENCE, SEED = 2000, 0.95, 0  # Resamples, confidence of the intervals and seed of the draws
Range = tuple[float, float]
REALS: Range = (-math.inf, math.inf)
NOT_NEGATIVE: Range = (0.0, math.inf)
SHARES: Range = (0.0, 1.0)  # Of probabilities, regrets and all that counts a part of something
ROUNDING = 1e-12  # Numbers up to this size are 0: sums of the same terms in another order


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
        places = places_of(met)
        n = max(places) + 1
        draws.setdefault(n, times_drawn(n, resamples, stream(seed, f"{n} links")))
        # In the order of ``times_drawn``, so that sums over row 0 round as they do there.
        counts[scenario] = np.ascontiguousarray(draws[n][:, places])
    return counts


def places_of(met: Sequence[Episode]) -> list[int]:
    """Which of the drawn links each episode belongs to, counted from 0 in the order of their names."""
    links = _links(met)
    place = {link: k for k, link in enumerate(sorted(set(links)))}
    return [place[link] for link in links]


def carriers(losses: Numbers) -> int:
    """How few links carry half of the loss; ``losses`` has that of each link."""
    most = np.cumsum(np.sort(losses.clip(0))[::-1])
    return int(np.searchsorted(most, most[-1] / 2 * (1 - ROUNDING))) + 1


def remark(losses: Numbers, loser: str, drawn: str) -> list[str]:
    """A note where one or two of those ``drawn``, a quarter of all at most, carry half of what ``loser`` loses.

    What such rare links do decides about all sums, and a sample that has none of them shows nothing of it: no interval
    made of the sample alone can know. ``studies.coverage --rare`` simulates it.
    """
    few = carriers(losses)
    if few > 2 or 4 * few > len(losses):
        return []
    carry = "carries" if few == 1 else "carry"
    what = f"{few} of {len(losses)} {drawn} {carry} half of what {loser} loses"
    return [f"note: {what}: intervals over so few may hold the true number far less often than 95 %"]


def _links(met: Sequence[Episode]) -> list[Any]:
    """The link of each episode; where all are on one trace, or on none, the episode itself."""
    alone = len({trace for trace, _ in met}) == 1
    return [episode if alone else episode[0] for episode in met]


def links_in(episodes: Mapping[str, Sequence[Episode]]) -> int:
    """How many links ``links_drawn`` draws, in the scenario that has the fewest; 0 without scenarios."""
    return min((len(set(_links(met))) for met in episodes.values()), default=0)


@functools.cache
def students_t(confidence: float, freedom: int) -> float:
    """How many standard errors an interval of this confidence reaches to either side, with so many degrees of freedom.

    For whole degrees the distribution is a finite sum (Abramowitz and Stegun 1964, 26.7.3 and 26.7.4) in the angle
    theta = atan(t / sqrt(freedom)), which bisection solves to the last digits.
    """
    odd = freedom % 2
    k = np.arange(1, (freedom - 1 - odd) // 2 + 1)
    factors = np.cumprod(np.concatenate([[1.0], (2 * k - 1 + odd) / (2 * k + odd)]))
    powers = 2 * np.arange(len(factors)) + odd

    def within(theta: float) -> float:
        """Probability of -t to t."""
        terms = math.sin(theta) * float(factors @ math.cos(theta) ** powers)
        return 2 / math.pi * (theta + terms * (freedom > 1)) if odd else terms

    low, high = 0.0, math.pi / 2
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if within(middle) < confidence else (low, middle)
    return math.sqrt(freedom) * math.tan(low)


def interval(numbers: Numbers, links: int, confidence: float = CONFIDENCE, within: Range = REALS) -> Interval:
    """Compute the interval of a statistic from its [1 + resamples] numbers; NaN, an undefined one, is left out.

    It is the wider of two, both made for few ``links``. One is the bootstrap's standard error times a quantile of
    Student's t, which holds for few links. The other is the percentile bootstrap at a widened level, which holds for
    skewed ratios (Hesterberg 2015, "What teachers should know about the bootstrap", The American Statistician 69). No
    bound leaves ``within``, and a single link has no interval.
    """
    numbers = np.where(np.abs(numbers) < ROUNDING, 0.0, numbers)
    value, drawn = float(numbers[0]), numbers[1:][~np.isnan(numbers[1:])]
    if math.isnan(value) or not len(drawn):
        return UNKNOWN
    if links < 2:
        return Interval(value, math.nan, math.nan)
    errors = math.sqrt(links / (links - 1)) * students_t(confidence, links - 1)
    reach = errors * float(np.std(drawn))
    level = NormalDist().cdf(-errors)
    low, high = np.quantile(drawn, [level, 1 - level]).tolist()
    return _kept(Interval(value, min(low, value - reach), max(high, value + reach)), within)


def _kept(found: Interval, within: Range) -> Interval:
    """The interval, of which no bound leaves ``within``."""
    value, low, high = found
    return Interval(value, min(max(low, within[0]), value), max(min(high, within[1]), value))


def together(levels: Sequence[tuple[Numbers, int]], within: Range = REALS) -> Interval:
    """Compute the interval of a statistic over independent levels of chance, such as links and training seeds.

    Each level has the numbers found by drawing it alone, [1 + resamples], and how many units were drawn, so that it
    has degrees of freedom of its own. One that the statistic does not depend on has the sample's number alone.

    To either side the reaches of the levels' intervals add as squares (Zou and Donner 2008, "Construction of confidence
    limits about effect measures: a general approach", Statistics in Medicine 27). For two normal means this holds the
    true value at least as often as each level's interval does, however few units each level has (Banerjee 1961,
    Sankhya 23). Chance that both levels see, such as how well one agent does on one link, counts twice.
    """
    value, low, high = interval(*levels[0])
    others = [interval(numbers, units) for numbers, units in levels[1:] if len(numbers) > 1]
    if others:
        low = value - math.hypot(value - low, *(other.value - other.low for other in others))
        high = value + math.hypot(high - value, *(other.high - other.value for other in others))
    return _kept(Interval(value, low, high), within)


def ratio(above: Numbers, below: Numbers, defined: NDArray[np.bool_]) -> Numbers:
    """Divide ``above`` by ``below`` where ``defined``; NaN elsewhere."""
    shape = np.broadcast_shapes(above.shape, below.shape)
    quotient: Numbers = np.divide(above, below, out=np.full(shape, np.nan), where=defined)
    return quotient
