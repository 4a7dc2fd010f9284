"""Are generated links like the recordings? Each statistic of the recordings against its law under the model.

For a mode, a *set* is as many generated traces as there are recordings, each as long as its counterpart. A
statistic of the recordings is compared with the same statistic of many sets: the p-value is twice the smaller share
of sets at or beyond it (a Monte Carlo test; A. C. Davison and D. V. Hinkley, "Bootstrap Methods and their
Application", 1997, sec. 4.2). Generated traces are correlated in time as the model says, so no assumption of
independent seconds enters, as a table of the Kolmogorov-Smirnov statistic would need.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from bufgym.traces.generate.fit import LOW_BYTES_PER_S, autocorrelation, centred, fit_links, shoulder_of, spells
from bufgym.traces.generate.markov import link_rates
from bufgym.traces.generate.parameters import LinkParameters
from bufgym.traces.trace import Float64Array

Rows = Sequence[Float64Array]

SETS: Final = 199
KS_DISTANCE: Final = "KS distance"
# Beyond the seeds that a fit uses for its trials.
_FIRST_SEED: Final = 1_000_000

_KBPS: Final = 1e-3


@dataclass(frozen=True)
class Row:
    """One statistic: of the recordings, and median and 2.5 to 97.5 % of the sets; p-value, two-sided."""

    name: str
    real: float
    median: float
    low: float
    high: float
    p: float


@dataclass(frozen=True)
class HeldOut:
    """Each recording against links fitted to the others of its mode (halves against each other if there is but one).

    Attributes:
        parts: how many recordings (or halves).
        distance: median of their Kolmogorov-Smirnov distances from what those links generate.
        usual: median distance of a single generated trace.
        beyond: recordings farther off than 95 % of single generated traces.
    """

    parts: int
    distance: float
    usual: float
    beyond: int


def generated_sets(link: LinkParameters, rows: Rows, sets: int) -> list[list[Float64Array]]:
    """`sets` times a generated trace for each recording, as long as it."""
    n = len(rows)
    return [[link_rates(link, _FIRST_SEED + k * n + i, len(row)) for i, row in enumerate(rows)] for k in range(sets)]


def compare(link: LinkParameters, rows: Rows, sets: int = SETS) -> list[Row]:
    """A row for each statistic of `STATISTICS`, and one for the distance of the whole distribution."""
    made = generated_sets(link, rows, sets)
    compared = []
    for name, statistic in STATISTICS.items():
        compared.append(_row(name, statistic(rows), [statistic(each) for each in made]))
    everything = np.sort(np.concatenate([row for each in made for row in each]))
    distances = [ks_distance(np.concatenate(each), everything) for each in made]
    real = ks_distance(np.concatenate(rows), everything)
    beyond = (1 + sum(d >= real for d in distances)) / (sets + 1)
    low, median, high = np.quantile(distances, [0.025, 0.5, 0.975])
    return [*compared, Row(KS_DISTANCE, real, float(median), float(low), float(high), beyond)]


def held_out(mode: str, rows: Rows, sets: int = SETS) -> HeldOut:
    """How far recordings are from links that have not seen them."""
    parts = list(rows) if len(rows) > 1 else [np.array(half) for half in np.array_split(rows[0], 2)]
    distances, usual, beyond = [], [], 0
    for k, part in enumerate(parts):
        link = fit_links({mode: parts[:k] + parts[k + 1 :]})[mode]
        made = [each[0] for each in generated_sets(link, [part], sets)]
        everything = np.sort(np.concatenate(made))
        single = [ks_distance(one, everything) for one in made]
        distances.append(ks_distance(part, everything))
        usual += single
        beyond += bool(distances[-1] > np.quantile(single, 0.95))
    return HeldOut(len(parts), float(np.median(distances)), float(np.median(usual)), beyond)


def ks_distance(values: Float64Array, others: Float64Array) -> float:
    """Greatest distance of two samples' cumulative distributions; `others` float64[m] is sorted."""
    own = np.sort(values)
    # Between two of its own values the one stands still and the other only grows: they are farthest at, or just
    # before, one of them.
    return max(_distance_at(own, others, "left"), _distance_at(own, others, "right"))


def _distance_at(own: Float64Array, others: Float64Array, side: Literal["left", "right"]) -> float:
    here = np.searchsorted(own, own, side=side) / own.size
    there = np.searchsorted(others, own, side=side) / others.size
    return float(np.abs(here - there).max())


def _row(name: str, real: float, made: Sequence[float]) -> Row:
    """NaN (no outages, say) is left out of the sets; a real one has no p-value."""
    values = np.array([value for value in made if not np.isnan(value)])
    if np.isnan(real) or not values.size:
        middle = np.quantile(values, [0.025, 0.5, 0.975]) if values.size else [np.nan] * 3
        return Row(name, real, float(middle[1]), float(middle[0]), float(middle[2]), np.nan)
    # A hair's breadth: a sum in another order is no difference.
    hair = 1e-9 * max(1.0, abs(real))
    at_most, at_least = int((values <= real + hair).sum()), int((values >= real - hair).sum())
    p = min(1.0, 2 * (1 + min(at_most, at_least)) / (values.size + 1))
    low, median, high = np.quantile(values, [0.025, 0.5, 0.975])
    return Row(name, real, float(median), float(low), float(high), p)


# --- statistics ------------------------------------------------------------------------------------------------------


def _quantile(q: float) -> Callable[[Rows], float]:
    return lambda rows: float(np.quantile(np.concatenate(rows), q)) * _KBPS


def _correlation(lag_s: int) -> Callable[[Rows], float]:
    return lambda rows: float(autocorrelation(rows, (lag_s,))[0][0])


def _mean_of_recordings(rows: Rows) -> Float64Array:
    return np.array([row.mean() for row in rows]) * _KBPS


def _spread_of_means(rows: Rows) -> float:
    return float(_mean_of_recordings(rows).std(ddof=1)) if len(rows) > 1 else float("nan")


def outage_lengths(rows: Rows) -> Float64Array:
    """Seconds in a row under 500 KB/s, s."""
    pairs = [spells(row < LOW_BYTES_PER_S) for row in rows]
    return np.concatenate([ends - starts for starts, ends in pairs]).astype(np.float64)


def outage_gaps(rows: Rows) -> Float64Array:
    """From one outage's end to the next one's start, s."""
    pairs = [spells(row < LOW_BYTES_PER_S) for row in rows]
    return np.concatenate([starts[1:] - ends[:-1] for starts, ends in pairs]).astype(np.float64)


def _of_some(values: Float64Array, take: Callable[[Float64Array], float]) -> float:
    return float(take(values)) if values.size else float("nan")


STATISTICS: Final[Mapping[str, Callable[[Rows], float]]] = {
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
    "autocorrelation at 5 s within a recording": lambda rows: float(autocorrelation(centred(rows), (5,))[0][0]),
    "autocorrelation at 30 s within a recording": lambda rows: float(autocorrelation(centred(rows), (30,))[0][0]),
    "seconds under 500 KB/s, %": lambda rows: 100 * float((np.concatenate(rows) < LOW_BYTES_PER_S).mean()),
    "outages an hour": lambda rows: 3600 * len(outage_lengths(rows)) / sum(map(len, rows)),
    "rate within 5 s of an outage, % of the others'": lambda rows: 100 * shoulder_of(rows, LOW_BYTES_PER_S),
    "mean outage, s": lambda rows: _of_some(outage_lengths(rows), np.mean),
    "longest outage, s": lambda rows: _of_some(outage_lengths(rows), np.max),
    "mean spacing of outages, s": lambda rows: _of_some(outage_gaps(rows), np.mean),
    "median spacing of outages, s": lambda rows: _of_some(outage_gaps(rows), np.median),
}
