"""Statistics of recorded links: their correlation, their outages, and the table by which links are compared."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from bufgym.traces.generate.parameters import SHOULDER_S
from bufgym.traces.trace import Float64Array

Rows: TypeAlias = Sequence[Float64Array]
"""A row for each recording: float64[n], the rate of each second in bytes/s."""

# 4 Mbit/s: the limit that the tables of the recordings use.
LOW_BYTES_PER_S: Final = 500_000.0

_KBPS: Final = 1e-3


def centred(rows: Rows) -> list[Float64Array]:
    """Each row minus its own mean."""
    return [row - row.mean() for row in rows]


def autocorrelation(rows: Rows, lags: Sequence[int]) -> tuple[Float64Array, Float64Array]:
    """Correlation at each lag about the mean of all rows, and the number of pairs it comes from."""
    pooled = np.concatenate(rows)
    mean, variance = float(pooled.mean()), float(pooled.var())
    correlations, pairs = [], []
    for lag in lags:
        products = np.concatenate([(row[lag:] - mean) * (row[:-lag] - mean) for row in rows])
        pairs.append(float(products.size))
        correlations.append(float(products.mean()) / variance if products.size and variance > 0 else 0.0)
    return np.array(correlations), np.array(pairs)


def spells(row: Float64Array) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """First seconds of the outages, the runs of seconds below LOW_BYTES_PER_S, and the seconds after their last."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], (row < LOW_BYTES_PER_S).astype(np.int8), [0]))))
    return edges[::2], edges[1::2]


def outage_lengths(rows: Rows) -> Float64Array:
    """Lengths of the outages, s."""
    return np.concatenate([ends - starts for starts, ends in map(spells, rows)]).astype(np.float64)


def outage_gaps(rows: Rows) -> Float64Array:
    """Times from the end of one outage to the start of the next, s."""
    return np.concatenate([starts[1:] - ends[:-1] for starts, ends in map(spells, rows)]).astype(np.float64)


def beside_outages(row: Float64Array) -> npt.NDArray[np.bool_]:
    """Seconds, bool[n], that are within SHOULDER_S of an outage but not in one."""
    near = np.zeros(row.size, np.bool_)
    for start, end in zip(*spells(row), strict=True):
        near[max(0, start - SHOULDER_S) : end + SHOULDER_S] = True
    return near & (row >= LOW_BYTES_PER_S)


def shoulder_of(rows: Rows) -> float:
    """Mean rate beside outages over the mean rate of other seconds outside outages, at most 1; 1 without any."""
    near = np.concatenate([row[beside_outages(row)] for row in rows])
    far = np.concatenate([row[~beside_outages(row) & (row >= LOW_BYTES_PER_S)] for row in rows])
    return min(1.0, round(float(near.mean() / far.mean()), 2)) if near.size and far.size else 1.0


def _quantile(q: float) -> Callable[[Rows], float]:
    return lambda rows: float(np.quantile(np.concatenate(rows), q)) * _KBPS


def _correlation(lag_s: int) -> Callable[[Rows], float]:
    return lambda rows: float(autocorrelation(rows, (lag_s,))[0][0])


def _spread_of_means(rows: Rows) -> float:
    means = np.array([row.mean() for row in rows]) * _KBPS
    return float(means.std(ddof=1)) if len(rows) > 1 else float("nan")


def _of_any(values: Float64Array, statistic: Callable[[Float64Array], float]) -> float:
    """The statistic, NaN of no values."""
    return float(statistic(values)) if values.size else float("nan")


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
