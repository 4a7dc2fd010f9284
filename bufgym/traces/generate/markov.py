"""A mobile link whose rate follows a hidden Markov process, with outages; one set of parameters for each mode.

See docs/methods.md, "Mobile links with outages".
"""

import math
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from bufgym.traces.generate.draws import NORMAL_UNIFORMS, ar1, checked, nearly_normal, stream, whole_seconds
from bufgym.traces.generate.parameters import DEVIATIONS, SHOULDER_S, LinkParameters, OutageParameters, fitted_links
from bufgym.traces.trace import US_PER_S, Float64Array, Trace
from bufgym.utils.errors import BufgymError

MAX_LINK_S: Final = 10**6
# No outage is longer; the longest of the recordings lasted 13 s.
MAX_OUTAGE_S: Final = 120


def markov_link(
    mode: str,
    seed: int,
    duration_s: int = 300,
    *,
    mean_bytes_per_s: float | None = None,
    links: Mapping[str, LinkParameters] | None = None,
) -> Trace:
    """A trace with one sample a second, which loops. A longer one begins as the shorter one with the same seed.

    Args:
        mode: one of `links`: foot, bicycle, bus, tram, train, car; wifi-cafe, wifi-campus, wifi-office,
            wifi-restr; uplink-5g, uplink-wifi, uplink-mmwave.
        seed: from 0 up. Modes with the same seed share their uniform draws, so they are good and bad at the same times.
        duration_s: whole seconds, 1 to 10**6.
        mean_bytes_per_s: scale this very trace to that mean, 1 to 10**10; by default rates are the recordings', and the
            mean differs from seed to seed as it does between recordings.
        links: by default `fitted_links()`.
    """
    links = fitted_links() if links is None else links
    if mode not in links:
        raise BufgymError(f"mode = {mode!r}: must be one of {', '.join(links)}")
    whole_seconds(duration_s, MAX_LINK_S)
    rates = link_rates(links[mode], seed, int(duration_s))
    if mean_bytes_per_s is not None:
        checked("mean_bytes_per_s", mean_bytes_per_s, 1, 1e10)
        # math.fsum is exact, so the sum does not depend on how numpy splits it between vector lanes.
        rates = rates * (mean_bytes_per_s * len(rates) / math.fsum(rates.tolist()))
    counts = np.rint(rates).astype(np.int64)
    source = f"markov_link({mode}, seed={seed}, {duration_s:g} s)"
    return Trace.from_intervals(np.full(len(counts), US_PER_S), counts, name=f"{mode}-{seed}", source=source)


def link_rates(link: LinkParameters, seed: int, count: int) -> Float64Array:
    """Rate of each second: float64[count], bytes/s."""
    scores = _scores(link, stream(seed), count)
    rates = _interpolated(scores, DEVIATIONS, link.quantiles_bytes_per_s)
    if link.outages is None:
        return rates
    # Outages just beyond the end lower the last seconds, as they would in a longer trace.
    # Their draws come from the same generator 2**127 draws ahead, so they never overlap those of the scores.
    random = np.random.Generator(np.random.PCG64(seed).jumped())
    outages = list(_outages(link.outages, random, count + SHOULDER_S))
    beside = np.zeros(count, np.bool_)
    for start, low in outages:
        beside[max(0, start - SHOULDER_S) : start + len(low) + SHOULDER_S] = True
    rates[beside] = np.maximum(rates[beside] * link.outages.shoulder, link.quantiles_bytes_per_s[0])
    for start, low in outages:
        rates[start : start + len(low)] = low[: max(0, count - start)]
    return rates


def _scores(link: LinkParameters, random: np.random.Generator, count: int) -> Float64Array:
    """Nearly normal scores of the seconds: float64[count]."""
    place = float(nearly_normal(random.random((1, NORMAL_UNIFORMS)))[0])
    # A row for each second, so that a longer trace begins as a shorter one.
    uniforms = random.random((count, 2 * NORMAL_UNIFORMS + 1))
    second = np.arange(count)
    redrawn = (uniforms[:, -1] < 1 / link.level_stay_s) | (second == 0)
    level = nearly_normal(uniforms[:, :NORMAL_UNIFORMS])[np.maximum.accumulate(np.where(redrawn, second, 0))]
    fast = np.array(ar1(nearly_normal(uniforms[:, NORMAL_UNIFORMS:-1]).tolist(), link.fast_memory))
    fast_share = max(0.0, 1 - link.place_share - link.level_share)
    slow = math.sqrt(link.place_share) * place + math.sqrt(link.level_share) * level
    return np.asarray(slow + math.sqrt(fast_share) * fast, np.float64)


def _outages(p: OutageParameters, random: np.random.Generator, count: int) -> Iterator[tuple[int, Float64Array]]:
    """Each outage as its first second and its rates. The first follows a long gap."""
    quarters = tuple(k / 4 for k in range(5))
    end, is_soon = 0, False
    while True:
        start = end + _geometric(float(random.random()), p.short_gap_s if is_soon else p.long_gap_s)
        if start >= count:
            return
        length = _outage_length(float(random.random()), p)
        yield start, _interpolated(random.random(length), quarters, p.low_quantiles_bytes_per_s)
        end, is_soon = start + length, float(random.random()) < p.short_gap_share


def _geometric(uniform: float, mean: float) -> int:
    """A geometric number 1, 2, ... of that mean, by inversion."""
    if mean <= 1:
        return 1
    return 1 + math.floor(math.log1p(-uniform) / math.log1p(-1 / mean))


def _outage_length(uniform: float, p: OutageParameters) -> int:
    """A length in s of a discrete Lomax distribution, by inversion, cut off at MAX_OUTAGE_S."""
    excess_s: float = p.length_scale_s * ((1 - uniform) ** (-1 / p.length_tail) - 1)
    return 1 + math.floor(min(excess_s, MAX_OUTAGE_S - 1))


def _interpolated(at: Float64Array, x: tuple[float, ...], y: tuple[float, ...]) -> Float64Array:
    """Linear between (x, y), held beyond; step by step, because `np.interp` may fuse a product and a sum."""
    knots, values = np.array(x), np.array(y)
    inside = np.minimum(np.maximum(at, knots[0]), knots[-1])
    k = np.minimum(np.searchsorted(knots, inside, side="right") - 1, len(knots) - 2)
    share = (inside - knots[k]) / (knots[k + 1] - knots[k])
    return np.asarray(values[k] + share * (values[k + 1] - values[k]), np.float64)
