"""Futures of a made-up link and of a drive, drawn from their laws given what a robot has seen so far.

The laws stand in the generators ``synthetic_lte`` and ``drive_motion``. A robot sees no hidden state. It sees how
many bytes left its socket between two arrivals, and how far the scene has moved.

**The link** keeps its rate for a second of the trace, so the first arrivals of a second tell that second's rate, and a
change of the rate tells where the seconds begin. A particle filter knows the rest: the mode, the rate of "fair"
coverage, the state of the coverage, the deviation from it, and whether a breakdown goes on (Gordon, Salmond and Smith
1993). Where a rate is seen, the deviation follows from it, so a particle is weighted by the density of its deviation.
The trace loops, from a random offset on: each second is its last with chance 1 / its seconds.

**The drive** keeps its pace for a phase. The pace tells which phase it may be, and its age how long it may go on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.traces import MotionSettings
from bufgym.traces.generate.driving import PHASES, STOP_CHANCE, TURN_CHANCE
from bufgym.traces.generate.lte import CEILING, LTE_MODES, MAX_FADE_S, LteMode

Reals = NDArray[np.float64]

Links = Sequence[tuple[LteMode, float]]
"""(Mode, mean in bytes/s) of the links that an episode may have, each as likely as the others."""

TRACE_S = 300
"""Seconds of a trace."""
PARTICLES = 2000
PRIOR = 20_000
"""Hidden states drawn from the law, from which a filter begins."""
SAME = 2e-4
"""Largest relative difference of rates of one second, measured over whole microseconds and bytes."""
JITTER = 0.01
"""Standard deviation of the noise on the log of a particle's "fair" rate after each second, until it is known."""
LEAST_US = 5_000  # Time of transmission from which on a rate is measured, us
_TOP = math.log(CEILING)


class Hidden(NamedTuple):
    """Hidden states of n links, float64[n] or int64[n] each."""

    mode: NDArray[np.int64]  # number of the mode in LTE_MODES
    unit: Reals  # log of the rate in "fair" coverage, bytes/s
    state: NDArray[np.int64]  # 0 good, 1 fair, 2 poor
    deviation: Reals  # of the log rate from the state's level
    fade_s: NDArray[np.int64]  # seconds that a breakdown still lasts
    fade: Reals  # the part of the rate that it leaves

    def take(self, chosen: NDArray[np.int64]) -> Hidden:
        """These rows."""
        rows: list[NDArray[Any]] = [column[chosen] for column in self]
        return Hidden(*rows)


_MODES = list(LTE_MODES.values())
_LEVELS = np.array([mode.levels for mode in _MODES])
_STAY_S, _SPREAD, _MEMORY, _CHANCE, _FADE_S, _OUTAGE, _DEPTH = (
    np.array([getattr(mode, name) for mode in _MODES])
    for name in ("stay_s", "spread", "memory", "fade_chance", "fade_mean_s", "outage_share", "fade_depth")
)


def level(hidden: Hidden) -> Reals:
    """Log of the rate in the state of each, relative to "fair" coverage."""
    return np.asarray(_LEVELS[hidden.mode, hidden.state])


def rates(hidden: Hidden) -> Reals:
    """The rate of each in its second, bytes/s."""
    relative = np.exp(hidden.unit + np.minimum(level(hidden) + hidden.deviation, _TOP))
    return np.asarray(relative * np.where(hidden.fade_s > 0, hidden.fade, 1.0))


def begun(mode: NDArray[np.int64], rng: np.random.Generator) -> Hidden:
    """The state before the first second of a trace, for each of the modes; the unit is 1 byte/s."""
    n = len(mode)
    deviation = _SPREAD[mode] * rng.standard_normal(n)
    return Hidden(mode, np.zeros(n), np.ones(n, np.int64), deviation, np.zeros(n, np.int64), np.ones(n))


def next_second(old: Hidden, rng: np.random.Generator, *, first: bool = False) -> Hidden:
    """The hidden state a second later; ``first``: the first of a trace, whose deviation stays as it is."""
    n, mode = len(old.mode), old.mode
    move, direction, begins, length, kind = rng.random((5, n))
    fresh = _SPREAD[mode] * np.sqrt(1 - _MEMORY[mode] ** 2) * rng.standard_normal(n)
    deviation = old.deviation if first else _MEMORY[mode] * old.deviation + fresh
    neighbour = np.where(old.state != 1, 1, np.where(direction < 0.5, 0, 2))
    state = np.where(move < 1 / _STAY_S[mode], neighbour, old.state)
    left_s = np.maximum(old.fade_s - 1, 0)
    new = (left_s == 0) & (begins < _CHANCE[mode])
    lasts_s = 1 + np.floor(np.log1p(-length) / np.log1p(-1 / _FADE_S[mode])).astype(np.int64)
    fade_s = np.where(new, np.minimum(lasts_s, MAX_FADE_S), left_s)
    fade = np.where(new, np.where(kind < _OUTAGE[mode], 0.0, _DEPTH[mode]), old.fade)
    return Hidden(mode, old.unit, state, deviation, fade_s, fade)


def looped(hidden: Hidden, rng: np.random.Generator) -> Hidden:
    """The same, some of which begin their trace again."""
    ends = rng.random(len(hidden.mode)) < 1 / TRACE_S
    if not ends.any():
        return hidden
    again = begun(hidden.mode, rng)._replace(unit=hidden.unit)
    return Hidden(*(np.where(ends, new, old) for new, old in zip(again, hidden, strict=True)))


def prior(links: Links, rng: np.random.Generator, count: int = PRIOR) -> Hidden:
    """Hidden states at a random second of ``count`` traces, which are scaled to their means as ``synthetic_lte`` is."""
    chosen = rng.integers(len(links), size=count)
    mode = np.array([list(LTE_MODES).index(name) for name, _ in links])[chosen]
    mean = np.array([mean for _, mean in links])[chosen]
    at, total, kept = rng.integers(TRACE_S, size=count), np.zeros(count), begun(mode, rng)
    hidden = kept
    for second in range(TRACE_S):
        hidden = next_second(hidden, rng, first=second == 0)
        total += rates(hidden)
        kept = Hidden(*(np.where(at == second, new, old) for new, old in zip(hidden, kept, strict=True)))
    return kept._replace(unit=np.log(mean * TRACE_S / total))


class Belief:
    """What the rates of past seconds tell about the hidden state of the present one."""

    def __init__(self, before: Hidden, rng: np.random.Generator) -> None:
        self._before, self._rng = before, rng
        self._begin()
        self._highest, self._known = 0.0, False

    def _begin(self) -> None:
        self._hidden = self._before.take(self._rng.integers(len(self._before.mode), size=PARTICLES))
        self._first = True

    def second(self, rate: float | None) -> None:
        """Go on to the next second, whose rate is ``rate``, bytes/s, or None if it was not seen."""
        rng, old, first = self._rng, self._hidden, self._first
        if rate and abs(rate - self._highest) <= SAME * rate:
            # No two seconds have the same rate but at the ceiling.
            self._known = True
            old = old._replace(unit=np.full(PARTICLES, math.log(rate / CEILING)))
        self._highest = max(self._highest, rate or 0.0)
        old = looped(old, rng)
        new = old if first else next_second(old, rng)
        self._first = False
        if rate is None:
            self._hidden = new
            return
        fade = np.where(new.fade_s > 0, new.fade, 1.0)
        weight = (fade == 0.0).astype(float)
        if rate > 0:
            mean = 0.0 if first else _MEMORY[new.mode] * old.deviation
            sd = _SPREAD[new.mode] * (1.0 if first else np.sqrt(1 - _MEMORY[new.mode] ** 2))
            above = math.log(rate) - new.unit - np.log(np.maximum(fade, 1e-9))
            top = np.abs(above - _TOP) <= 2 * SAME if self._known else np.zeros(PARTICLES, np.bool_)
            deviation = np.where(top, new.deviation, above - level(new))
            likely = np.exp(-0.5 * ((deviation - mean) / sd) ** 2) / sd
            weight = np.where(top, level(new) + deviation >= _TOP, likely * (above <= _TOP + SAME)) * (fade > 0)
            new = new._replace(deviation=deviation)
        if weight.sum() <= 0:  # The filter lost the link: it begins again.
            if not first:
                self._begin()
                self.second(rate)
            return
        chosen = drawn(weight, PARTICLES, rng)
        noise = 0.0 if self._known else JITTER * rng.standard_normal(PARTICLES)
        self._hidden = new.take(chosen)
        # The rate stays as seen: what the noise adds to the unit, the deviation loses.
        moved = noise if rate > 0 else 0.0
        self._hidden = self._hidden._replace(unit=self._hidden.unit + noise, deviation=self._hidden.deviation - moved)

    def futures(self, count: int, seconds: int) -> Reals:
        """float64[count, seconds]: rates of the present second and of those that may follow it, bytes/s."""
        hidden = self._hidden.take(drawn(np.ones(PARTICLES), count, self._rng))
        found = np.empty((count, seconds))
        found[:, 0] = rates(hidden)
        for second in range(1, seconds):
            hidden = next_second(looped(hidden, self._rng), self._rng)
            found[:, second] = rates(hidden)
        return found


def drawn(weight: Reals, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """int64[count]: rows drawn by these weights, evenly spread (systematic resampling), in random order."""
    at = (rng.random() + np.arange(count)) / count * weight.sum()
    rows = np.minimum(np.searchsorted(np.cumsum(weight), at, side="right"), len(weight) - 1)
    return np.asarray(rng.permutation(rows))


class LinkSeen:
    """A robot's record of its link: the second that it is in, that second's rate, and the belief about the rest."""

    def __init__(self, before: Hidden, rng: np.random.Generator) -> None:
        self._belief, self._rng = Belief(before, rng), rng
        self._rate: float | None = None  # of the present second, bytes/s, once seen
        self._ends_us: float | None = None  # when that second ends, once a change was seen
        self._mixed: tuple[float, float, float, float] | None = None  # start, end, rate and earlier rate of a change
        self._counted = False  # whether the belief is at the present second

    def arrival(self, from_us: int, now_us: int, sent_bytes: int, busy_us: int) -> bool:
        """Record what left the socket between two arrivals; whether this told anything new."""
        while self._ends_us is not None and self._ends_us <= now_us:
            if not self._counted:
                self._belief.second(None)
            self._ends_us, self._rate, self._counted = self._ends_us + 1e6, None, False
        if busy_us < LEAST_US or (self._ends_us is not None and from_us < self._ends_us - 1e6 - 500):
            return False  # nothing seen, or the rates of two seconds
        rate = 1e6 * sent_bytes / busy_us
        if self._rate is None:
            self._rate, self._counted = rate, True
            if self._mixed is not None:
                start, end, both, earlier = self._mixed
                part = (both - rate) / (earlier - rate) if earlier != rate else 1.0
                self._ends_us = start + min(max(part, 0.0), 1.0) * (end - start) + 1e6
                self._mixed = None
            self._belief.second(rate)
            return True
        if abs(rate - self._rate) <= 2e-3 * max(rate, self._rate):
            return False
        self._mixed = float(from_us), float(now_us), rate, self._rate
        self._rate, self._ends_us, self._counted = None, now_us + 1e6, False
        return False

    def carried(self, now_us: int, times_us: Reals, count: int) -> NDArray[np.int64]:
        """int64[count, times]: bytes that the link carries from now until each of these times, in futures of it."""
        seconds, behind = 3 + int((times_us[-1] - now_us) // 1e6), int(self._ends_us is not None and not self._counted)
        found = self._belief.futures(count, seconds + behind)[:, behind:]
        if self._rate is not None:
            found[:, 0] = self._rate
        if self._ends_us is not None:
            left_us = np.full(count, self._ends_us - now_us)
        else:
            left_us = self._rng.random(count) * (1e6 - now_us if now_us < 1e6 else 1e6)
        knots = np.concatenate([np.zeros((count, 1)), left_us[:, None] + 1e6 * np.arange(seconds)], axis=1)
        total = np.concatenate([np.zeros((count, 1)), np.cumsum(found * np.diff(knots) / 1e6, axis=1)], axis=1)
        after_us = times_us - now_us
        return np.array([np.interp(after_us, *row) for row in zip(knots, total, strict=True)]).astype(np.int64)


# Kinds of phases, their ranges of motion per second, and of their lengths, s.
_SCALE = MotionSettings()
_KINDS = list(PHASES)
_PACES = [
    tuple(speed / _SCALE.scene_scale_m + turn / _SCALE.fov_deg for speed, turn in zip(speeds, turns, strict=True))
    for speeds, turns, _ in PHASES.values()
]
_LENGTHS = [lengths for _, _, lengths in PHASES.values()]


class DriveSeen:
    """A robot's record of its own motion: the pace of the present phase and since when it has had it."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._pace, self._before = 0.0, -1.0  # motion per second in this phase, and in the one before (-1: unknown)
        self._since_us = 0.0

    def arrival(self, from_us: int, now_us: int, moved: float) -> bool:
        """Record how far the scene moved between two arrivals; whether its pace changed."""
        if now_us <= from_us:
            return False
        pace = 1e6 * moved / (now_us - from_us)
        if abs(pace - self._pace) <= 1e-3:
            return False
        if now_us - self._since_us > 150_000:
            self._before, self._since_us = (self._pace, float(from_us)) if from_us > 0 else (-1.0, 0.0)
        self._pace = pace
        return True

    def _kind(self) -> int:
        """The number of a kind that the present phase may have."""
        if self._pace < 1e-6:
            return _KINDS.index("stop")
        cruise, turn = _KINDS.index("cruise"), _KINDS.index("turn")
        if self._before == 0.0 or not _PACES[turn][0] <= self._pace <= _PACES[turn][1]:
            return cruise
        if self._pace > _PACES[cruise][1]:
            return turn
        return turn if self._rng.random() < TURN_CHANCE / (1 - STOP_CHANCE) else cruise

    def moved(self, now_us: int, times_us: Reals, count: int) -> Reals:
        """float64[count, times]: motion from now until each of these times, in futures of the drive."""
        return np.array([np.interp(times_us, *self._future(now_us, times_us[-1])) for _ in range(count)])

    def _future(self, now_us: int, until_us: float) -> tuple[list[float], list[float]]:
        """Times, us, and motion since now at the ends of phases."""
        rng, kind = self._rng, self._kind()
        least, most = (1e6 * s for s in _LENGTHS[kind])
        age_us = now_us - self._since_us
        if self._before < 0:  # It began before the episode, nobody knows when.
            age_us += rng.random() * max(0.0, most - age_us)
        lasts_us = max(least, age_us) + rng.random() * max(0.0, most - max(least, age_us))
        knots, x = [float(now_us), now_us + max(lasts_us - age_us, 5e4)], [0.0]
        x.append(self._pace * (knots[-1] - now_us) / 1e6)
        while knots[-1] < until_us:
            uniform, cruises = rng.random(), _KINDS[kind] == "cruise"
            following = "turn" if uniform < TURN_CHANCE else "stop" if uniform < TURN_CHANCE + STOP_CHANCE else ""
            kind = _KINDS.index(following if cruises and following else "cruise")
            speeds, turns, lengths = (low + (high - low) * rng.random() for low, high in PHASES[_KINDS[kind]])
            knots.append(knots[-1] + 1e6 * lengths)
            x.append(x[-1] + lengths * (speeds / _SCALE.scene_scale_m + turns / _SCALE.fov_deg))
        return knots, x
