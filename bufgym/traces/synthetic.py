"""Made-up links and motions with the manners of real ones, for those who have no recordings at hand.

Everything is drawn from a seed (numpy's PCG64, uniform doubles only) and rounded to whole bytes or
millionths, so a seed gives the same integers on every machine.

The links are LTE-like. Shape and numbers come from the 30 Belgium 4G logs (J. van der Hooft et al., IEEE
Comm. Letters 20(11), 2016), whose rates over 1 s have a coefficient of variation of 0.26-0.82 (median 0.42)
and a lag-1 autocorrelation of 0.33-0.91 (0.61) that is still 0.16-0.73 (0.46) at 10 s. They fall under a
quarter of their median in 0.4 % (bus) to 14 % (tram) of all samples, mostly for 1-3 s, at worst for 12 s.

Two deviations are on purpose: rates are higher, for a robot that offers 6.9 MB/s (30 frames of 230 kB a
second) needs a link that suits it most of the time; and outages are more frequent and longer, for they are
what a full send buffer is about. One is a shortfall: 10 s apart the made-up rates are correlated by 0.1-0.4,
less than most of the real ones.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from bufgym.errors import BufgymError
from bufgym.traces.motion import DEFAULT_FOV_DEG, DEFAULT_SCENE_SCALE_M, Motion
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S, Float64Array, Trace

LteMode = Literal["walk", "drive", "train"]

MAX_FADE_S: Final = 20


@dataclass(frozen=True)
class LteParameters:
    """A Markov-modulated link, in steps of 1 s.

    The log of the rate is the level of a hidden state (how well the cell suits the place) plus an AR(1)
    process, and now and then the rate breaks down altogether.
    """

    # Levels of the states "good", "fair", "poor": log of the rate relative to "fair".
    levels: tuple[float, float, float]
    # Mean stay in a state, s; it then moves to one of its neighbours.
    stay_s: float
    # Standard deviation of the AR(1) process, log units, and its correlation from one second to the next.
    spread: float
    memory: float
    # Chance a second that a breakdown begins, and its mean length in s (geometric, cut off at MAX_FADE_S).
    fade_chance: float
    fade_mean_s: float
    # Share of breakdowns without any capacity; the others leave this much of the rate.
    outage_share: float = 0.5
    fade_depth: float = 0.06


LTE_MODES: Final[dict[LteMode, LteParameters]] = {
    "walk": LteParameters((0.30, 0.0, -0.45), 30.0, 0.25, 0.6, 1 / 50, 2.0),
    "drive": LteParameters((0.35, 0.0, -0.60), 18.0, 0.33, 0.6, 1 / 35, 3.0),
    "train": LteParameters((0.40, 0.0, -0.80), 12.0, 0.42, 0.6, 1 / 30, 4.5),
}

# No second is better than this many times the "fair" rate, as a cell's best modulation sets a ceiling. It
# comes to 1.6-2.3 times the mean; in the Belgium logs the maximum is 1.5-4.4 times it (median 1.9).
_CEILING: Final = 1.6


def synthetic_lte(
    seed: int,
    duration_s: int = 300,
    mean_bytes_per_s: float = 10e6,
    mode: LteMode = "drive",
) -> Trace:
    """An LTE-like trace with one sample a second, which loops.

    Args:
        seed: >= 0.
        duration_s: whole seconds, 1 to 10**7.
        mean_bytes_per_s: mean of this very trace, breakdowns included (to half a byte), 1 to 10**10.
        mode: one of `LTE_MODES`; the faster, the more restless.

    Raises:
        BufgymError: an argument out of its range.
    """
    if mode not in get_args(LteMode):
        raise BufgymError(f"mode = {mode!r}: must be one of {', '.join(get_args(LteMode))}")
    if not 1 <= duration_s <= MAX_DURATION_S or int(duration_s) != duration_s:
        raise BufgymError(f"duration_s = {duration_s}: must be a whole number from 1 to {MAX_DURATION_S}")
    if not 1 <= mean_bytes_per_s <= 1e10:
        raise BufgymError(f"mean_bytes_per_s = {mean_bytes_per_s}: must be from 1 to 1e10")
    relative = _relative_rates(_random(seed), int(duration_s), LTE_MODES[mode])
    # math.fsum is exact, so the sum does not depend on how numpy splits it among vector lanes.
    unit = mean_bytes_per_s * len(relative) / math.fsum(relative)
    counts = np.array([round(unit * rate) for rate in relative], np.int64)
    return Trace.from_intervals(
        np.full(len(relative), US_PER_S),
        counts,
        name=f"lte-{mode}-{seed}",
        source=f"synthetic_lte(seed={seed}, {duration_s} s, {mean_bytes_per_s:g} bytes/s, {mode})",
    )


def _relative_rates(random: np.random.Generator, count: int, p: LteParameters) -> list[float]:
    """`count` rates in a row, in units of the "fair" state."""
    normal = _nearly_normal(random, count)
    chance = random.random((count, 4)).tolist()
    state, fade_left, fade_rate = 1, 0, 0.0
    deviation = p.spread * normal[0]
    fresh = p.spread * math.sqrt(1 - p.memory**2)
    rates = []
    for second in range(count):
        move, direction, begin, kind = chance[second]
        if second:
            deviation = p.memory * deviation + fresh * normal[second]
        if move < 1 / p.stay_s:
            # From an end only the middle is next; from the middle either end, with equal odds.
            state = 1 if state != 1 else (0 if direction < 0.5 else 2)
        rate = min(math.exp(p.levels[state] + deviation), _CEILING)
        if fade_left == 0 and begin < p.fade_chance:
            # Given that it begins, begin / chance is again uniform and picks the length.
            fade_left = _fade_length(begin / p.fade_chance, p.fade_mean_s)
            fade_rate = 0.0 if kind < p.outage_share else p.fade_depth
        if fade_left:
            fade_left -= 1
            rate *= fade_rate
        rates.append(rate)
    # A trace with nothing in it could not be scaled to any mean; it takes a few seconds of outage and no
    # more.
    return rates if any(rates) else [1.0] * count


def _fade_length(uniform: float, mean_s: float) -> int:
    """A geometric length of 1..MAX_FADE_S seconds by inversion; the cut-off shortens its mean a little."""
    go_on = 1 - 1 / mean_s
    cumulative = [1 - go_on**length for length in range(1, MAX_FADE_S)]
    return 1 + bisect_right(cumulative, uniform)


def outage(
    period_s: float,
    length_s: float,
    bytes_per_s: float,
    *,
    repeats: int = 1,
    outage_bytes_per_s: float = 0.0,
) -> Trace:
    """A steady link that breaks down at the end of each period, by rule and without chance.

    `outage(10, 2, 8e6)` is 8 s at 8 MB/s, then 2 s of nothing, and so on.

    Args:
        period_s: from one breakdown's end to the next one's, s.
        length_s: of the breakdown, s, above 0 and below the period.
        bytes_per_s: otherwise.
        repeats: periods in the trace, >= 1; it loops in any case.
        outage_bytes_per_s: during the breakdown.

    Raises:
        BufgymError: an argument out of its range.
    """
    if not 0 < length_s < period_s:
        raise BufgymError(f"length_s = {length_s}: must be above 0 and below period_s = {period_s}")
    if repeats < 1:
        raise BufgymError(f"repeats = {repeats}: must be >= 1")
    period = [(period_s - length_s, bytes_per_s), (length_s, outage_bytes_per_s)]
    return Trace.steps(period * repeats, name=f"outage-{length_s:g}s-every-{period_s:g}s")


# A small delivery or survey robot. Speeds in m/s, turn rates in degrees/s, times in s, each drawn evenly
# from a range.
CRUISE_M_PER_S: Final = (0.5, 1.5)
CRUISE_TURN_DEG_PER_S: Final = (0.0, 10.0)
CRUISE_S: Final = (4.0, 15.0)
TURN_DEG_PER_S: Final = (30.0, 60.0)
TURN_S: Final = (1.0, 4.0)
STOP_S: Final = (2.0, 8.0)
# What follows a stretch of driving: a turn in place, a stop, or (otherwise) driving on at another speed.
TURN_CHANCE: Final = 0.55
STOP_CHANCE: Final = 0.25

Limits = tuple[float, float]

_MOTION_STEP_US: Final = 100_000


@dataclass(frozen=True)
class Driving:
    """How a robot drives, by default a small delivery or survey robot; a range is (least, greatest).

    Raises:
        BufgymError: a range that is not in order within its limits, chances that are not or sum to over 1.
    """

    cruise_m_per_s: Limits = CRUISE_M_PER_S
    cruise_turn_deg_per_s: Limits = CRUISE_TURN_DEG_PER_S
    cruise_s: Limits = CRUISE_S
    turn_deg_per_s: Limits = TURN_DEG_PER_S
    turn_s: Limits = TURN_S
    stop_s: Limits = STOP_S
    turn_chance: float = TURN_CHANCE
    stop_chance: float = STOP_CHANCE

    def __post_init__(self) -> None:
        for name, most in (("cruise_m_per_s", 100.0), ("cruise_turn_deg_per_s", 1e4), ("turn_deg_per_s", 1e4)):
            self._check(name, 0.0, most)
        for name in ("cruise_s", "turn_s", "stop_s"):
            self._check(name, _MOTION_STEP_US / US_PER_S, 1e6)
        if not (0 <= self.turn_chance <= 1 and 0 <= self.stop_chance <= 1 - self.turn_chance):
            chances = f"turn_chance = {self.turn_chance}, stop_chance = {self.stop_chance}"
            raise BufgymError(f"{chances}: must be >= 0 and at most 1 together")

    def _check(self, name: str, least: float, most: float) -> None:
        low, high = getattr(self, name)
        if not least <= low <= high <= most:
            raise BufgymError(f"{name} = ({low}, {high}): must be in order and from {least:g} to {most:g}")


def drive_motion(seed: int, duration_s: float = 300.0, driving: Driving | None = None) -> Motion:
    """Motion of a robot that cruises, turns in place and stops, 10 samples a second.

    The coordinate is that of `motion.py` with its field of view of 60 degrees and scene scale of 2 m:
    cruising at 1 m/s adds 0.5 a second, turning in place at 45 degrees/s 0.75, stopping nothing. Each
    sample's step is a whole number of millionths. Changes of speed are instant.

    Args:
        seed: >= 0.
        duration_s: rounded to whole tenths; 0.1 to 10**6.
        driving: by default `Driving()`.

    Raises:
        BufgymError: an argument out of its range.
    """
    how = Driving() if driving is None else driving
    if not 0.1 <= duration_s <= 1e6:
        raise BufgymError(f"duration_s = {duration_s}: must be from 0.1 to 1e6")
    random = _random(seed)
    count = round(duration_s * US_PER_S / _MOTION_STEP_US)
    step_s = _MOTION_STEP_US / US_PER_S
    steps: list[int] = []
    act: Callable[[np.random.Generator, Driving], tuple[float, float, float]] = _cruise
    while len(steps) < count:
        speed_m_per_s, turn_deg_per_s, lasts_s = act(random, how)
        per_s = speed_m_per_s / DEFAULT_SCENE_SCALE_M + turn_deg_per_s / DEFAULT_FOV_DEG
        steps += [round(per_s * step_s * 1e6)] * max(1, round(lasts_s / step_s))
        next_act = float(random.random())
        if act is not _cruise or next_act >= how.turn_chance + how.stop_chance:
            act = _cruise
        else:
            act = _turn if next_act < how.turn_chance else _stop
    millionths = np.append(0, np.cumsum(steps[:count]))
    time_us = np.arange(count + 1, dtype=np.int64) * _MOTION_STEP_US
    return Motion(f"drive-{seed}", time_us, millionths / 1e6, f"drive_motion(seed={seed}, {duration_s:g} s)")


def _cruise(random: np.random.Generator, how: Driving) -> tuple[float, float, float]:
    """Speed in m/s, turn rate in degrees/s, length in s."""
    speed, turn = _evenly(random, how.cruise_m_per_s), _evenly(random, how.cruise_turn_deg_per_s)
    return speed, turn, _evenly(random, how.cruise_s)


def _turn(random: np.random.Generator, how: Driving) -> tuple[float, float, float]:
    return 0.0, _evenly(random, how.turn_deg_per_s), _evenly(random, how.turn_s)


def _stop(random: np.random.Generator, how: Driving) -> tuple[float, float, float]:
    return 0.0, 0.0, _evenly(random, how.stop_s)


def _evenly(random: np.random.Generator, limits: Limits) -> float:
    return limits[0] + (limits[1] - limits[0]) * float(random.random())


def _random(seed: int) -> np.random.Generator:
    if seed < 0:
        raise BufgymError(f"seed = {seed}: must be >= 0")
    return np.random.Generator(np.random.PCG64(seed))


def _nearly_normal(random: np.random.Generator, count: int) -> list[float]:
    """`count` values of mean 0 and standard deviation 1: twelve uniforms, summed.

    `Generator.normal` would do as well today, but its stream may change with numpy and its tails with the C
    library.
    """
    uniforms: Float64Array = random.random((count, 12))
    return [math.fsum(row) - 6.0 for row in uniforms.tolist()]
