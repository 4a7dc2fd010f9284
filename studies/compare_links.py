"""Are generated links like the recordings? Each statistic of the recordings against its distribution under the model.

For a mode, a *set* is as many generated traces as there are recordings, each as long as its counterpart. A statistic of
the recordings is compared with the same statistic of many sets: the p-value is twice the smaller share of sets at or
beyond it (a Monte Carlo test; A. C. Davison and D. V. Hinkley, "Bootstrap Methods and their Application", 1997, sec.
4.2). Generated traces are correlated in time as the model says, so the test does not assume independent seconds, as a
table of the Kolmogorov-Smirnov statistic would.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from bufgym.traces.fit import (
    LOW_BYTES_PER_S,
    Rates,
    autocorrelation,
    centred,
    fit_links,
    outage_gaps,
    outage_lengths,
    shoulder_of,
)
from bufgym.traces.generate.markov import link_rates
from bufgym.traces.generate.parameters import LinkParameters
from bufgym.traces.trace import Float64Array

SETS: Final = 199
KS_DISTANCE: Final = "KS distance"
_KBPS: Final = 1e-3
# Beyond the seeds that a fit uses for its trials.
_FIRST_SEED: Final = 1_000_000


def _quantile(q: float) -> Callable[[Rates], float]:
    return lambda rows: float(np.quantile(np.concatenate(rows), q)) * _KBPS


def _correlation(lag_s: int) -> Callable[[Rates], float]:
    return lambda rows: float(autocorrelation(rows, (lag_s,))[0][0])


def _spread_of_means(rows: Rates) -> float:
    means = np.array([row.mean() for row in rows]) * _KBPS
    return float(means.std(ddof=1)) if len(rows) > 1 else float("nan")


def _of_any(values: Float64Array, statistic: Callable[[Float64Array], float]) -> float:
    """The statistic, NaN of no values."""
    return float(statistic(values)) if values.size else float("nan")


STATISTICS: Final[Mapping[str, Callable[[Rates], float]]] = {
    "mean, KB/s": lambda rows: float(np.concatenate(rows).mean()) * _KBPS,
    "standard deviation, KB/s": lambda rows: float(np.concatenate(rows).std()) * _KBPS,
    "standard deviation of the recordings' means, KB/s": _spread_of_means,
    "5 % quantile, KB/s": _quantile(0.05),
    "25 % quantile, KB/s": _quantile(0.25),
    "median, KB/s": _quantile(0.5),
    "75 % quantile, KB/s": _quantile(0.75),
    "95 % quantile, KB/s": _quantile(0.95),
    "autocorrelation at 1 s": _correlation(1),
    "autocorrelation at 5 s": _correlation(5),
    "autocorrelation at 30 s": _correlation(30),
    "autocorrelation at 5 s within a recording": lambda rows: _correlation(5)(centred(rows)),
    "autocorrelation at 30 s within a recording": lambda rows: _correlation(30)(centred(rows)),
    "seconds under 500 KB/s, %": lambda rows: 100 * float((np.concatenate(rows) < LOW_BYTES_PER_S).mean()),
    "outages an hour": lambda rows: 3600 * len(outage_lengths(rows)) / sum(map(len, rows)),
    "rate within 5 s of an outage, % of the others'": lambda rows: 100 * shoulder_of(rows),
    "mean outage, s": lambda rows: _of_any(outage_lengths(rows), np.mean),
    "longest outage, s": lambda rows: _of_any(outage_lengths(rows), np.max),
    "mean spacing of outages, s": lambda rows: _of_any(outage_gaps(rows), np.mean),
    "median spacing of outages, s": lambda rows: _of_any(outage_gaps(rows), np.median),
}
"""Name -> statistic of the recordings of one mode; NaN if undefined."""


@dataclass(frozen=True)
class Row:
    """One statistic, compared."""

    name: str
    """What it is, with its unit."""
    real: float
    """Its value for the recordings; NaN if not defined."""
    median: float
    """Median of the sets."""
    low: float
    """2.5 % quantile of the sets."""
    high: float
    """97.5 % quantile of the sets."""
    p: float
    """p-value, two-sided; for the KS distance, one-sided."""


@dataclass(frozen=True)
class HeldOut:
    """Each recording against links fitted to the others of its mode; of a single recording, its halves."""

    parts: int
    """How many recordings (or halves) were held out."""
    distance: float
    """Median of their Kolmogorov-Smirnov distances from what those links generate."""
    usual: float
    """Median distance of a single generated trace."""
    beyond: int
    """Recordings farther off than 95 % of single generated traces."""


def generated_sets(link: LinkParameters, rows: Rates, sets: int) -> list[list[Float64Array]]:
    """`sets` times a generated trace for each recording, as long as the recording."""
    n = len(rows)
    return [[link_rates(link, _FIRST_SEED + k * n + i, len(row)) for i, row in enumerate(rows)] for k in range(sets)]


def compare(link: LinkParameters, rows: Rates, sets: int = SETS) -> list[Row]:
    """A row for each of `STATISTICS`, and one for the distance of the whole distribution."""
    generated = generated_sets(link, rows, sets)
    compared = []
    for name, statistic in STATISTICS.items():
        compared.append(_row(name, statistic(rows), [statistic(traces) for traces in generated]))
    pooled = np.sort(np.concatenate([row for traces in generated for row in traces]))
    distances = [ks_distance(np.concatenate(traces), pooled) for traces in generated]
    real = ks_distance(np.concatenate(rows), pooled)
    p = (1 + sum(distance >= real for distance in distances)) / (sets + 1)
    return [*compared, Row(KS_DISTANCE, real, *_middle(distances), p)]


def held_out(mode: str, rows: Rates, sets: int = SETS, most: int | None = None) -> HeldOut:
    """How far recordings are from links that were fitted without them; of more than `most`, so many evenly spaced."""
    parts = list(rows) if len(rows) > 1 else [np.array(half) for half in np.array_split(rows[0], 2)]
    count = len(parts) if most is None else min(most, len(parts))
    distances, usual, beyond = [], [], 0
    for k in (len(parts) * i // count for i in range(count)):
        link = fit_links({mode: parts[:k] + parts[k + 1 :]})[mode]
        generated = [traces[0] for traces in generated_sets(link, [parts[k]], sets)]
        pooled = np.sort(np.concatenate(generated))
        single = [ks_distance(trace, pooled) for trace in generated]
        distances.append(ks_distance(parts[k], pooled))
        usual += single
        beyond += bool(distances[-1] > np.quantile(single, 0.95))
    return HeldOut(count, float(np.median(distances)), float(np.median(usual)), beyond)


def ks_distance(values: Float64Array, others: Float64Array) -> float:
    """Greatest distance between the cumulative distributions of two samples; `others` float64[m] is sorted."""
    ordered = np.sort(values)
    # Between two of `values` their distribution is flat and the other only grows, so the greatest distance is at one of
    # them or just before it.
    return max(_distance_at(ordered, others, "left"), _distance_at(ordered, others, "right"))


def _distance_at(ordered: Float64Array, others: Float64Array, side: Literal["left", "right"]) -> float:
    share = np.searchsorted(ordered, ordered, side=side) / ordered.size
    other_share = np.searchsorted(others, ordered, side=side) / others.size
    return float(np.abs(share - other_share).max())


def _row(name: str, real: float, generated: Sequence[float]) -> Row:
    """Sets where the statistic is NaN (no outages, say) are left out; a NaN of the recordings has no p-value."""
    values = np.array([value for value in generated if not np.isnan(value)])
    if np.isnan(real) or not values.size:
        return Row(name, real, *_middle(values), np.nan)
    # A difference in the last digits, from adding in another order, is none.
    tolerance = 1e-9 * max(1.0, abs(real))
    at_most, at_least = int((values <= real + tolerance).sum()), int((values >= real - tolerance).sum())
    return Row(name, real, *_middle(values), min(1.0, 2 * (1 + min(at_most, at_least)) / (values.size + 1)))


def _middle(values: Float64Array | list[float]) -> tuple[float, float, float]:
    """Median, 2.5 % and 97.5 % quantile; NaN of no values."""
    if not len(values):
        return np.nan, np.nan, np.nan
    low, median, high = np.quantile(values, [0.025, 0.5, 0.975])
    return float(median), float(low), float(high)
