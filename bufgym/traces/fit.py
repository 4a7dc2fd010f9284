"""Fit the parameters of `generate.markov` to recordings: `bufgym trace fit FILES`.

See docs/methods.md, "How links are fitted to recordings".
"""

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from bufgym.traces.formats.faults import StrPath
from bufgym.traces.generate.markov import link_rates
from bufgym.traces.generate.parameters import LOW_QUANTILES, PROBABILITIES, SHOULDER_S, LinkParameters, OutageParameters
from bufgym.traces.trace import Float64Array
from bufgym.utils.errors import BufgymError

Rates: TypeAlias = Sequence[Float64Array]
"""A row for each recording: float64[n], the rate of each second in bytes/s."""

# 4 Mbit/s: the limit that the tables of the recordings use.
LOW_BYTES_PER_S: Final = 500_000.0

LAGS_S: Final = (1, 2, 3, 5, 10, 20, 30, 60)
# Fewer outages than this say too little about their lengths and clusters.
FEW_OUTAGES: Final = 10
LEAST_SECONDS: Final = 60

_LENT: Final = ("length_tail", "length_scale_s", "low_quantiles_bytes_per_s")
_MEMORIES: Final = np.arange(0, 0.96, 0.05)
_STAYS_S: Final = (3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0, 56.0, 80.0, 112.0, 160.0, 224.0)
_PLACES: Final = (0.0, 0.1, 0.2, 0.3, 0.45, 0.6)
_SHARES: Final = np.arange(0, 1.001, 0.05)
_TAILS: Final = (1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0)
_SCALES_S: Final = (0.1, 0.2, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)
_EM_STEPS: Final = 300
_ROUNDS: Final = 3
# Seconds generated to measure the correlation that a fit has.
_TRIAL_S: Final = 40_000


def mode_of(path: StrPath) -> str:
    """The mode in a file's name: of report_car_0002.csv "car", of wifi_office_231114-... "wifi-office".

    Raises:
        BufgymError: the name has no letters before its first digit.
    """
    words = re.findall(r"[a-z]+", re.split(r"[\d.]", Path(path).name.lower())[0])
    words = words[1:] if words[:1] == ["report"] else words
    if not words:
        raise BufgymError(f"{path}: its name does not say the mode: give --mode")
    return "-".join(words)


def fit_links(recordings: Mapping[str, Rates]) -> dict[str, LinkParameters]:
    """Mode -> parameters, from mode -> rates of its recordings, bytes/s.

    Raises:
        BufgymError: no recordings, a mode with under 60 seconds at or above the threshold, a rate not finite or < 0.
    """
    if not recordings:
        raise BufgymError("no recordings: must be at least one")
    fitted = {mode: _fit(mode, rows) for mode, rows in recordings.items()}
    of_all_modes = _fit_outages([row for rows in recordings.values() for row in rows])
    borrowed = {mode: _with_borrowed(link, of_all_modes) for mode, link in fitted.items()}
    return {mode: _with_memory(link, recordings[mode]) for mode, link in borrowed.items()}


def _fit(mode: str, rows: Rates) -> LinkParameters:
    """The parameters without memory."""
    pooled = np.concatenate(rows) if rows else np.zeros(0)
    if not np.isfinite(pooled).all() or (pooled < 0).any():
        raise BufgymError(f"mode {mode}: rates must be finite and >= 0")
    good = pooled[pooled >= LOW_BYTES_PER_S]
    if good.size < LEAST_SECONDS:
        count = f"{good.size} of {pooled.size} s have {LOW_BYTES_PER_S:g} bytes/s or more"
        raise BufgymError(f"mode {mode}: {count}: must be at least {LEAST_SECONDS}")
    far = pooled[np.concatenate([(row >= LOW_BYTES_PER_S) & ~beside_outages(row) for row in rows])]
    quantiles = _rounded_quantiles(far if far.size >= LEAST_SECONDS else good, PROBABILITIES)
    memory = {"place_share": 0.0, "level_share": 0.0, "level_stay_s": _STAYS_S[0], "fast_memory": 0.0}
    return LinkParameters(len(rows), int(pooled.size), quantiles, **memory, outages=_fit_outages(rows))


def _with_borrowed(link: LinkParameters, of_all_modes: OutageParameters | None) -> LinkParameters:
    """The link, with the outages' lengths and rates of all modes if it has too few outages."""
    own = link.outages
    if own is None or of_all_modes is None or own.spells >= FEW_OUTAGES or own.spells == of_all_modes.spells:
        return link
    lent = {name: getattr(of_all_modes, name) for name in _LENT}
    return replace(link, outages=replace(own, **lent, borrowed=True))


def _rounded_quantiles(values: Float64Array, probabilities: Sequence[float]) -> tuple[float, ...]:
    """Quantiles in whole bytes/s."""
    return tuple(float(round(q)) for q in np.quantile(values, probabilities))


def _with_memory(link: LinkParameters, rows: Rates) -> LinkParameters:
    """The link with shares, stay and memory whose generated rates are correlated most like the `rows`."""
    real, pairs = autocorrelation(rows, LAGS_S)
    within = autocorrelation(centred(rows), LAGS_S)[0]
    sets = max(1, _TRIAL_S // link.seconds)
    nearest, best = link, math.inf
    # One recording alone does not show how much recordings differ.
    for place in _PLACES if len(rows) > 1 else _PLACES[:1]:
        target = real
        for _ in range(_ROUNDS):
            level, stay_s, memory = _fit_memory(target, pairs, place)
            trial = replace(link, place_share=place, level_share=level, level_stay_s=stay_s, fast_memory=memory)
            generated = [link_rates(trial, seed, len(row)) for seed, row in enumerate(list(rows) * sets)]
            lacking = real - autocorrelation(generated, LAGS_S)[0]
            error = float((lacking**2 + (within - autocorrelation(centred(generated), LAGS_S)[0]) ** 2) @ pairs)
            # A small margin for what came first, so that rounding does not choose between equals.
            if error < best * (1 - 1e-9):
                nearest, best = trial, error
            target = np.clip(target + lacking, -1, 1)
    return nearest


def _fit_memory(target: Float64Array, pairs: Float64Array, place: float) -> tuple[float, float, float]:
    """Level share, mean stay in s and fast memory whose correlations come nearest to the target, for a place share."""
    lags, level = np.array(LAGS_S), _SHARES[_SHARES <= 1 - place + 1e-9]
    best, chosen = math.inf, (0.0, _STAYS_S[0], 0.0)
    for stay_s, memory in itertools.product(_STAYS_S, _MEMORIES):
        slow, fast = (1 - 1 / stay_s) ** lags, memory**lags
        model = place + level[:, None] * slow + (1 - place - level)[:, None] * fast
        errors = ((model - target) ** 2 * pairs).sum(axis=1)
        k = int(np.argmin(errors))
        if errors[k] < best * (1 - 1e-9):
            best = float(errors[k])
            chosen = (round(float(level[k]), 2), stay_s, round(float(memory), 2))
    return chosen


def _fit_outages(rows: Rates) -> OutageParameters | None:
    lengths_s = outage_lengths(rows)
    if not lengths_s.size:
        return None
    pairs = [spells(row) for row in rows]
    cut = [len(row) - (int(ends[-1]) if len(ends) else 0) for row, (_, ends) in zip(rows, pairs, strict=True)]
    first = [max(1, int(starts[0])) for starts, _ in pairs if len(starts)]
    pooled = np.concatenate(rows)
    tail, scale_s = _fit_lengths(lengths_s)
    share, short_s, long_s = _fit_gaps(outage_gaps(rows), np.array(cut, np.float64), first, len(lengths_s))
    quantiles = _rounded_quantiles(
        pooled[pooled < LOW_BYTES_PER_S], [k / (LOW_QUANTILES - 1) for k in range(LOW_QUANTILES)]
    )
    return OutageParameters(len(lengths_s), share, short_s, long_s, shoulder_of(rows), tail, scale_s, quantiles)


def _fit_lengths(lengths_s: Float64Array) -> tuple[float, float]:
    """Maximum likelihood fit of tail and scale (s) in P(over k) = (1 + k / scale)**-tail."""
    best, chosen = -math.inf, (_TAILS[0], _SCALES_S[0])
    for tail, scale in itertools.product(_TAILS, _SCALES_S):
        chance = (1 + (lengths_s - 1) / scale) ** -tail - (1 + lengths_s / scale) ** -tail
        likelihood = math.fsum(np.log(chance).tolist())
        if likelihood > best + 1e-9:
            best, chosen = likelihood, (tail, scale)
    return chosen


def _fit_gaps(whole: Float64Array, cut: Float64Array, first: list[int], outages: int) -> tuple[float, float, float]:
    """Share of short gaps, mean short and mean long gap in s.

    Args:
        whole: float64[n], from the end of an outage to the start of the next, s.
        cut: float64[m], from the last of a recording to the recording's end, s.
        first: from a recording's start to its first outage, at least 1 s.
        outages: number of outages.
    """
    first_s = float(sum(first))
    exposure_s, events = first_s + whole.sum() + cut.sum(), len(first) + len(whole)
    if outages < FEW_OUTAGES or not len(whole):
        return 0.0, 1.0, _three_digits(max(1.0, exposure_s / events))
    share, short_s = 0.5, max(1.5, float(np.median(whole)) / 2)
    long_s = max(2 * short_s, exposure_s / events)
    for _ in range(_EM_STEPS):
        is_short = _posterior(whole, share, short_s, long_s, is_whole=True)
        # A gap cut off by the recording's end is at least that long; its end being unknown, it adds time but no event.
        cut_short = _posterior(cut, share, short_s, long_s, is_whole=False)
        share = float((is_short.sum() + cut_short.sum()) / (len(whole) + len(cut)))
        short_s = float((is_short @ whole + cut_short @ cut) / max(1e-9, is_short.sum()))
        long_time = (1 - is_short) @ whole + (1 - cut_short) @ cut + first_s
        long_s = float(long_time / max(1e-9, (1 - is_short).sum() + len(first)))
        short_s, long_s = max(1.0001, short_s), max(1.0001, long_s)
    return round(share, 2), _three_digits(short_s), _three_digits(long_s)


def _posterior(lengths_s: Float64Array, share: float, short_s: float, long_s: float, is_whole: bool) -> Float64Array:
    """Chance that a gap of that length (or, if not whole, of at least that length) is a short one."""
    steps = lengths_s - 1 if is_whole else lengths_s
    short = share * (1 - 1 / short_s) ** steps / (short_s if is_whole else 1)
    long = (1 - share) * (1 - 1 / long_s) ** steps / (long_s if is_whole else 1)
    return np.asarray(short / np.maximum(short + long, 1e-300), np.float64)


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")


def centred(rows: Rates) -> list[Float64Array]:
    """Each row minus its own mean."""
    return [row - row.mean() for row in rows]


def autocorrelation(rows: Rates, lags: Sequence[int]) -> tuple[Float64Array, Float64Array]:
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


def outage_lengths(rows: Rates) -> Float64Array:
    """Lengths of the outages, s."""
    return np.concatenate([ends - starts for starts, ends in map(spells, rows)]).astype(np.float64)


def outage_gaps(rows: Rates) -> Float64Array:
    """Times from the end of one outage to the start of the next, s."""
    return np.concatenate([starts[1:] - ends[:-1] for starts, ends in map(spells, rows)]).astype(np.float64)


def beside_outages(row: Float64Array) -> npt.NDArray[np.bool_]:
    """Seconds, bool[n], that are within SHOULDER_S of an outage but not in one."""
    near = np.zeros(row.size, np.bool_)
    for start, end in zip(*spells(row), strict=True):
        near[max(0, start - SHOULDER_S) : end + SHOULDER_S] = True
    return near & (row >= LOW_BYTES_PER_S)


def shoulder_of(rows: Rates) -> float:
    """Mean rate beside outages over the mean rate of other seconds outside outages, at most 1; 1 without any."""
    near = np.concatenate([row[beside_outages(row)] for row in rows])
    far = np.concatenate([row[~beside_outages(row) & (row >= LOW_BYTES_PER_S)] for row in rows])
    return min(1.0, round(float(near.mean() / far.mean()), 2)) if near.size and far.size else 1.0
