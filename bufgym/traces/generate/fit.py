"""Fit the parameters of `markov.py` to recordings: `bufgym trace fit FILES`.

Everything is found on grids or by a fixed number of steps and rounded, so the same recordings give the same file.

- Rates: quantiles of the seconds that are neither of an outage nor beside one (of all at or above the threshold, if
  those are under 60 s), all recordings of a mode together.
- Memory: rates are correlated at lags of 1 to 60 s (pairs within a recording, about the mean of all). For each of
  some place shares, level and fast part are the least squares fit to that, weighted by the numbers of pairs; then to
  what was found plus what generated links lack of it, for outages and the law of the rates take some correlation away
  (indirect inference: C. Gourieroux, A. Monfort, E. Renault, J. of Applied Econometrics 8(S1), 1993). What counts in
  the end is whose links come nearest, about the mean of all and about each recording's own.
- Lengths of outages: greatest likelihood of a discrete Lomax law.
- Gaps between outages: expectation-maximisation for two geometric laws. What is cut off by a recording's end
  counts as "at least as long"; what precedes its first outage, as a long gap.

With under 10 outages, their lengths and rates are those of all modes together, and gaps are of one law.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from bufgym.errors import BufgymError
from bufgym.traces.generate.markov import link_rates
from bufgym.traces.generate.parameters import LOW_QUANTILES, PROBABILITIES, SHOULDER_S, LinkParameters, OutageParameters
from bufgym.traces.readers import read_trace
from bufgym.traces.trace import US_PER_S, Float64Array

# 4 Mbit/s: the limit that the tables of the recordings use.
LOW_BYTES_PER_S: Final = 500_000.0
LAGS_S: Final = (1, 2, 3, 5, 10, 20, 30, 60)
# Fewer outages than this say too little about their lengths and clusters.
FEW_SPELLS: Final = 10
LEAST_SECONDS: Final = 60

_MEMORIES: Final = np.arange(0, 0.96, 0.05)
_STAYS_S: Final = (3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0, 56.0, 80.0, 112.0, 160.0, 224.0)
_PLACES: Final = (0.0, 0.1, 0.2, 0.3, 0.45, 0.6)
_SHARES: Final = np.arange(0, 1.001, 0.05)
_TAILS: Final = (1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0)
_SCALES_S: Final = (0.1, 0.2, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)
_EM_STEPS: Final = 300
_ROUNDS: Final = 3
# Seconds that are generated to see what correlation a fit has.
_TRIAL_S: Final = 40_000


@dataclass(frozen=True)
class Gaps:
    """Times between outages, s: seen whole, cut off by a recording's end, and before its first outage."""

    whole: list[int]
    cut: list[int]
    first: list[int]


def rates_of(path: str | Path) -> Float64Array:
    """float64[n], bytes/s of a recording's seconds."""
    return read_trace(path).samples(US_PER_S)[1]


def mode_of(path: str | Path) -> str:
    """The way of moving in a file's name: report_car_0002.csv is "car", wifi_office_231114-... "wifi-office".

    Raises:
        BufgymError: the name has no letters before its first digit.
    """
    words = re.findall(r"[a-z]+", re.split(r"[\d.]", Path(path).name.lower())[0])
    words = words[1:] if words[:1] == ["report"] else words
    if not words:
        raise BufgymError(f"{path}: its name does not say the mode: give --mode")
    return "-".join(words)


def fit_links(
    recordings: Mapping[str, Sequence[Float64Array]], low_bytes_per_s: float = LOW_BYTES_PER_S
) -> dict[str, LinkParameters]:
    """Parameters by mode.

    Args:
        recordings: by mode, rates in bytes/s of one second each, a row float64[n] a recording.
        low_bytes_per_s: seconds below it are outages.

    Raises:
        BufgymError: none, a mode without 60 seconds at or above the threshold, a rate that is negative or not finite.
    """
    if not recordings:
        raise BufgymError("no recordings: must be at least one")
    if not (math.isfinite(low_bytes_per_s) and low_bytes_per_s > 0):
        raise BufgymError(f"low_bytes_per_s = {low_bytes_per_s}: must be above 0")
    fitted = {mode: _fit(mode, rows, low_bytes_per_s) for mode, rows in recordings.items()}
    everything = [row for rows in recordings.values() for row in rows]
    together = _fit_outages(everything, low_bytes_per_s)
    borrowed = {mode: _with_borrowed(link, together) for mode, link in fitted.items()}
    return {mode: _with_memory(link, recordings[mode]) for mode, link in borrowed.items()}


def _fit(mode: str, rows: Sequence[Float64Array], low: float) -> LinkParameters:
    pooled = np.concatenate(rows) if rows else np.zeros(0)
    if not np.isfinite(pooled).all() or (pooled < 0).any():
        raise BufgymError(f"mode {mode}: rates must be finite and >= 0")
    good = pooled[pooled >= low]
    if good.size < LEAST_SECONDS:
        found = f"{good.size} of {pooled.size} s have {low:g} bytes/s or more"
        raise BufgymError(f"mode {mode}: {found}: must be at least {LEAST_SECONDS}")
    far = pooled[np.concatenate([(row >= low) & ~beside_outages(row < low) for row in rows])]
    return LinkParameters(
        recordings=len(rows),
        seconds=int(pooled.size),
        quantiles_bytes_per_s=_rounded_quantiles(far if far.size >= LEAST_SECONDS else good, PROBABILITIES),
        place_share=0.0,  # memory comes last
        level_share=0.0,
        level_stay_s=_STAYS_S[0],
        fast_memory=0.0,
        outages=_fit_outages(rows, low),
    )


def _with_borrowed(link: LinkParameters, together: OutageParameters | None) -> LinkParameters:
    own = link.outages
    if own is None or together is None or own.spells >= FEW_SPELLS or own.spells == together.spells:
        return link
    shape = replace(
        own,
        length_tail=together.length_tail,
        length_scale_s=together.length_scale_s,
        low_quantiles_bytes_per_s=together.low_quantiles_bytes_per_s,
        borrowed=True,
    )
    return replace(link, outages=shape)


def _rounded_quantiles(values: Float64Array, at: Sequence[float]) -> tuple[float, ...]:
    """Whole bytes/s."""
    return tuple(float(round(q)) for q in np.quantile(values, at))


# --- memory ----------------------------------------------------------------------------------------------------------


def _with_memory(link: LinkParameters, rows: Sequence[Float64Array]) -> LinkParameters:
    """The link with the shares, stay and memory whose generated rates are correlated most like those of `rows`."""
    found, pairs = autocorrelation(rows, LAGS_S)
    within = autocorrelation(centred(rows), LAGS_S)[0]
    sets = max(1, _TRIAL_S // link.seconds)
    nearest, best = link, math.inf
    # One recording alone does not tell how much recordings differ.
    for place in _PLACES if len(rows) > 1 else _PLACES[:1]:
        target = found
        for _ in range(_ROUNDS):
            level, stay_s, memory = _fit_memory(target, pairs, place)
            tried = replace(link, place_share=place, level_share=level, level_stay_s=stay_s, fast_memory=memory)
            made = [link_rates(tried, seed, len(row)) for seed, row in enumerate(list(rows) * sets)]
            lacking = found - autocorrelation(made, LAGS_S)[0]
            error = float((lacking**2 + (within - autocorrelation(centred(made), LAGS_S)[0]) ** 2) @ pairs)
            # A hair's breadth in favour of what came first keeps rounding from choosing between equals.
            if error < best * (1 - 1e-9):
                nearest, best = tried, error
            target = np.clip(target + lacking, -1, 1)
    return nearest


def centred(rows: Sequence[Float64Array]) -> list[Float64Array]:
    """Each row less its own mean."""
    return [row - row.mean() for row in rows]


def autocorrelation(rows: Sequence[Float64Array], lags: Sequence[int]) -> tuple[Float64Array, Float64Array]:
    """Correlation at each lag about the mean of all rows, and the number of pairs it comes from."""
    pooled = np.concatenate(rows)
    mean, variance = float(pooled.mean()), float(pooled.var())
    found, pairs = [], []
    for lag in lags:
        products = np.concatenate([(row[lag:] - mean) * (row[:-lag] - mean) for row in rows])
        pairs.append(float(products.size))
        found.append(float(products.mean()) / variance if products.size and variance > 0 else 0.0)
    return np.array(found), np.array(pairs)


def _fit_memory(found: Float64Array, pairs: Float64Array, place: float) -> tuple[float, float, float]:
    """Level share, mean stay in s and fast memory whose correlations come nearest to those found, for a place share."""
    lags, level = np.array(LAGS_S), _SHARES[_SHARES <= 1 - place + 1e-9]
    best, chosen = math.inf, (0.0, _STAYS_S[0], 0.0)
    for stay_s, memory in itertools.product(_STAYS_S, _MEMORIES):
        slow, fast = (1 - 1 / stay_s) ** lags, memory**lags
        model = place + level[:, None] * slow + (1 - place - level)[:, None] * fast
        errors = ((model - found) ** 2 * pairs).sum(axis=1)
        k = int(np.argmin(errors))
        if errors[k] < best * (1 - 1e-9):
            best = float(errors[k])
            chosen = (round(float(level[k]), 2), stay_s, round(float(memory), 2))
    return chosen


# --- outages ---------------------------------------------------------------------------------------------------------


def spells(low: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """First seconds of the runs in bool[n], and the seconds after their last."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], low.astype(np.int8), [0]))))
    return edges[::2], edges[1::2]


def _fit_outages(rows: Sequence[Float64Array], low: float) -> OutageParameters | None:
    lengths: list[int] = []
    gaps = Gaps([], [], [])
    for row in rows:
        starts, ends = spells(row < low)
        lengths += (ends - starts).tolist()
        gaps.whole.extend((starts[1:] - ends[:-1]).tolist())
        if len(starts):
            gaps.first.append(max(1, int(starts[0])))
        gaps.cut.append(len(row) - (int(ends[-1]) if len(ends) else 0))
    if not lengths:
        return None
    pooled = np.concatenate(rows)
    tail, scale_s = _fit_lengths(np.array(lengths))
    share, short_s, long_s = _fit_gaps(gaps, clusters=len(lengths) >= FEW_SPELLS)
    quantiles = _rounded_quantiles(pooled[pooled < low], [k / (LOW_QUANTILES - 1) for k in range(LOW_QUANTILES)])
    return OutageParameters(len(lengths), share, short_s, long_s, shoulder_of(rows, low), tail, scale_s, quantiles)


def beside_outages(low: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """bool[n]: seconds within SHOULDER_S of an outage, but not of one."""
    near = np.zeros(low.size, np.bool_)
    for start, end in zip(*spells(low), strict=True):
        near[max(0, start - SHOULDER_S) : end + SHOULDER_S] = True
    return near & ~low


def shoulder_of(rows: Sequence[Float64Array], low_bytes_per_s: float) -> float:
    """Mean rate beside outages over that of other seconds outside of them, at most 1; 1 if either is missing."""
    near = np.concatenate([row[beside_outages(row < low_bytes_per_s)] for row in rows])
    far = np.concatenate([row[~beside_outages(row < low_bytes_per_s) & (row >= low_bytes_per_s)] for row in rows])
    return min(1.0, round(float(near.mean() / far.mean()), 2)) if near.size and far.size else 1.0


def _fit_lengths(lengths: npt.NDArray[np.int64]) -> tuple[float, float]:
    """Tail and scale in s of greatest likelihood: P(over k) = (1 + k / scale)**-tail."""
    best, chosen = -math.inf, (_TAILS[0], _SCALES_S[0])
    for tail, scale in itertools.product(_TAILS, _SCALES_S):
        chance = (1 + (lengths - 1) / scale) ** -tail - (1 + lengths / scale) ** -tail
        likelihood = math.fsum(np.log(chance).tolist())
        if likelihood > best + 1e-9:
            best, chosen = likelihood, (tail, scale)
    return chosen


def _fit_gaps(gaps: Gaps, clusters: bool) -> tuple[float, float, float]:
    """Share of short gaps, mean short and mean long gap in s."""
    whole, cut = np.array(gaps.whole, np.float64), np.array(gaps.cut, np.float64)
    first_s = float(sum(gaps.first))
    exposure_s, events = first_s + whole.sum() + cut.sum(), len(gaps.first) + len(whole)
    if not clusters or not len(whole):
        return 0.0, 1.0, _three_digits(max(1.0, exposure_s / events))
    share, short_s = 0.5, max(1.5, float(np.median(whole)) / 2)
    long_s = max(2 * short_s, exposure_s / events)
    for _ in range(_EM_STEPS):
        is_short = _posterior(whole, share, short_s, long_s, seen=True)
        # A gap cut off by the end is at least so long; without a known end, it adds time but no event.
        cut_short = _posterior(cut, share, short_s, long_s, seen=False)
        share = float((is_short.sum() + cut_short.sum()) / (len(whole) + len(cut)))
        short_s = float((is_short @ whole + cut_short @ cut) / max(1e-9, is_short.sum()))
        long_time = (1 - is_short) @ whole + (1 - cut_short) @ cut + first_s
        long_s = float(long_time / max(1e-9, (1 - is_short).sum() + len(gaps.first)))
        short_s, long_s = max(1.0001, short_s), max(1.0001, long_s)
    return round(share, 2), _three_digits(short_s), _three_digits(long_s)


def _posterior(lengths: Float64Array, share: float, short_s: float, long_s: float, seen: bool) -> Float64Array:
    """Chance that a gap of that length (seen whole, or at least so long) is of the short kind."""
    steps = lengths - 1 if seen else lengths
    short = share * (1 - 1 / short_s) ** steps / (short_s if seen else 1)
    long = (1 - share) * (1 - 1 / long_s) ** steps / (long_s if seen else 1)
    return np.asarray(short / np.maximum(short + long, 1e-300), np.float64)


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")
