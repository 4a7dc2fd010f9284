"""LTE-like links from a seed, for users without recordings: docs/methods.md, "LTE-like links from a seed"."""

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from bufgym.traces.generate.draws import NORMAL_UNIFORMS, checked, stream, whole_seconds
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S, Float64Array, Trace
from bufgym.utils.errors import BufgymError

LteMode = Literal["walk", "drive", "train"]

MAX_FADE_S: Final = 20


@dataclass(frozen=True)
class LteParameters:
    """A Markov-modulated link, in steps of 1 s.

    The log of the rate is the level of a hidden state (the coverage) plus an AR(1) process. At times it breaks down.
    """

    levels: tuple[float, float, float]
    """Levels of the states "good", "fair", "poor": log of the rate relative to "fair"."""
    stay_s: float  # mean stay in a state, s; the next state is one of its neighbours
    spread: float  # standard deviation of the AR(1) process, log units
    memory: float  # correlation of the AR(1) process from one second to the next
    fade_chance: float  # chance a second that a breakdown begins
    fade_mean_s: float  # mean length of a breakdown, s; geometric, cut off at MAX_FADE_S
    outage_share: float = 0.5  # share of breakdowns without any capacity
    fade_depth: float = 0.06  # what the other breakdowns leave of the rate


LTE_MODES: Final[dict[LteMode, LteParameters]] = {
    "walk": LteParameters((0.30, 0.0, -0.45), 30.0, 0.25, 0.6, 1 / 50, 2.0),
    "drive": LteParameters((0.35, 0.0, -0.60), 18.0, 0.33, 0.6, 1 / 35, 3.0),
    "train": LteParameters((0.40, 0.0, -0.80), 12.0, 0.42, 0.6, 1 / 30, 4.5),
}

# No second is better than this many times the "fair" rate, because the best modulation sets a ceiling. It comes to
# 1.6-2.3 times the mean; in the Belgium logs the maximum is 1.5-4.4 times the mean (median 1.9).
CEILING: Final = 1.6


def synthetic_lte(seed: int, duration_s: int = 300, mean_bytes_per_s: float = 10e6, mode: LteMode = "drive") -> Trace:
    """An LTE-like trace with one sample a second, which loops.

    Args:
        seed: from 0 up.
        duration_s: whole seconds, 1 to 10**7.
        mean_bytes_per_s: mean of this very trace, breakdowns included (to half a byte), 1 to 10**10.
        mode: one of `LTE_MODES`; the faster, the more variable.
    """
    if mode not in get_args(LteMode):
        raise BufgymError(f"mode = {mode!r}: must be one of {', '.join(get_args(LteMode))}")
    whole_seconds(duration_s, MAX_DURATION_S)
    checked("mean_bytes_per_s", mean_bytes_per_s, 1, 1e10)
    relative = _relative_rates(stream(seed), int(duration_s), LTE_MODES[mode])
    # math.fsum is exact, so the sum does not depend on how numpy splits it between vector lanes.
    unit = mean_bytes_per_s * len(relative) / math.fsum(relative)
    counts = np.array([round(unit * rate) for rate in relative], np.int64)
    return Trace.from_intervals(
        np.full(len(relative), US_PER_S),
        counts,
        name=f"lte-{mode}-{seed}",
        source=f"synthetic_lte(seed={seed}, {duration_s} s, {mean_bytes_per_s:g} bytes/s, {mode})",
    )


def _relative_rates(random: np.random.Generator, count: int, p: LteParameters) -> list[float]:
    """`count` consecutive rates, in units of the "fair" state."""
    normal = _nearly_normal(random, count)
    chance = random.random((count, 4)).tolist()
    state, fade_left_s, fade_rate = 1, 0, 0.0
    deviation = p.spread * normal[0]
    fresh = p.spread * math.sqrt(1 - p.memory**2)
    rates = []
    for second in range(count):
        move, direction, begin, kind = chance[second]
        if second:
            deviation = p.memory * deviation + fresh * normal[second]
        if move < 1 / p.stay_s:
            # From an end the middle is next; from the middle either end, with equal odds.
            state = 1 if state != 1 else (0 if direction < 0.5 else 2)
        rate = min(math.exp(p.levels[state] + deviation), CEILING)
        if fade_left_s == 0 and begin < p.fade_chance:
            # Given that it begins, begin / chance is again uniform and gives the length.
            fade_left_s = _fade_length(begin / p.fade_chance, p.fade_mean_s)
            fade_rate = 0.0 if kind < p.outage_share else p.fade_depth
        if fade_left_s:
            fade_left_s -= 1
            rate *= fade_rate
        rates.append(rate)
    # A trace of a few seconds may be all outage, and could not be scaled to any mean.
    return rates if any(rates) else [1.0] * count


def _fade_length(uniform: float, mean_s: float) -> int:
    """A geometric length of 1..MAX_FADE_S seconds by inversion; the cut-off lowers its mean a little."""
    go_on = 1 - 1 / mean_s
    cumulative = [1 - go_on**length for length in range(1, MAX_FADE_S)]
    return 1 + bisect_right(cumulative, uniform)


def _nearly_normal(random: np.random.Generator, count: int) -> list[float]:
    """`count` values of mean 0 and standard deviation 1: sums of twelve uniforms, by another sum than in `draws`.

    `Generator.normal` would do as well today, but its stream may change with numpy and its tails with the C library.
    """
    uniforms: Float64Array = random.random((count, NORMAL_UNIFORMS))
    return [math.fsum(row) - 6.0 for row in uniforms.tolist()]
