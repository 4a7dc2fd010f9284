"""The link: a capacity trace turned into delivery times, exactly, in whole microseconds and bytes.

A trace gives the bytes C(t) that the link could have carried up to time t, linear between its knots. The socket is
serial and work-conserving: a message that starts at byte position u (u = C(t) for an idle link, else where the one
before it ended) has crossed at the first microsecond t with C(t) >= u + bytes. Positions, not times, are carried
from message to message, so nothing is lost to rounding however many follow each other.

After the trace's end the link may *loop* (the trace begins again), *hold* (the last segment's rate goes on) or
*stop* (nothing crosses any more).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bufgym.errors import BufgymError
from bufgym.kernel import kernel
from bufgym.traces.trace import Trace

FOREVER = 2**62
"""A time that never comes, us."""

LOOP, HOLD, STOP = 0, 1, 2
_AFTER = {"loop": LOOP, "hold": HOLD, "stop": STOP}


@dataclass(frozen=True)
class Link:
    """One sender's link: ``trace`` from ``offset_us`` on; each message reaches the server ``propagation_us`` later."""

    trace: Trace
    offset_us: int = 0
    propagation_us: int = 0

    def __post_init__(self) -> None:
        for name in ("offset_us", "propagation_us"):
            if getattr(self, name) < 0:
                raise BufgymError(f"link on {self.trace.name}: {name} = {getattr(self, name)}: must be >= 0")

    def carried_by(self, t_us: NDArray[np.int64]) -> NDArray[np.int64]:
        """C at each of these times, which must not decrease: bytes, rounded down, as ``position_at`` has it."""
        by = np.empty(len(t_us), np.int64)
        _positions(self.trace.time_us, self.trace.cumulative_bytes, _AFTER[self.trace.after], t_us + self.offset_us, by)
        return by

    @property
    def carries_bytes(self) -> int:
        """The position that no message can pass: the link's last byte, or FOREVER where it never stops."""
        carried = self.trace.cumulative_bytes
        ends = self.trace.after == "stop" or (self.trace.after == "hold" and carried[-1] == carried[-2])
        return int(carried[-1]) if ends else FOREVER


KEPT_KNOTS = 2**20
"""As many knots are stored (16 MB) before those of a trace that no sender follows any more make room for others."""


@dataclass(eq=False)
class _Place:
    """Where the knots of a trace lie, and how many senders follow it."""

    trace: Trace  # kept, as an id is only unique while its object lives
    first: int
    room: int
    senders: int = 0


class Knots:
    """The knots of several traces in two flat arrays, as kernels read them; each trace is stored once.

    Traces that come again stay stored, and so do all that a sender follows; of the others it forgets those that were
    left first, when it needs their room: a new trace for every episode takes no more and more memory.
    """

    def __init__(self) -> None:
        self.us = np.zeros(0, np.int64)
        self.bytes = np.zeros(0, np.int64)
        self._end = 0
        self._places: dict[int, _Place] = {}
        self._followed: dict[int, _Place] = {}
        self._idle: dict[int, _Place] = {}

    def place(self, trace: Trace, sender: int) -> tuple[int, int, int]:
        """(first knot, last knot, what follows the end) of ``trace``, which ``sender`` follows from now on."""
        left = self._followed.pop(sender, None)
        if left is not None:
            left.senders -= 1
            if not left.senders:
                self._idle[id(left.trace)] = left
        place = self._places.get(id(trace)) or self._stored(trace)
        place.senders += 1
        self._idle.pop(id(trace), None)
        self._followed[sender] = place
        return place.first, place.first + len(trace.time_us) - 1, _AFTER[trace.after]

    def _stored(self, trace: Trace) -> _Place:
        knots = len(trace.time_us)
        place = _Place(trace, *self._room(knots))
        self._places[id(trace)] = place
        here = slice(place.first, place.first + knots)
        self.us[here], self.bytes[here] = trace.time_us, trace.cumulative_bytes
        return place

    def _room(self, knots: int) -> tuple[int, int]:
        """(first, how many) knots that may be written."""
        if self._end + knots > max(KEPT_KNOTS, len(self.us)):
            for place in self._idle.values():
                if place.room >= knots:
                    self._forget(place)
                    return place.first, place.room
            # None of them alone has it; those at the end together may.
            for place in list(self._idle.values()):
                self._forget(place)
            self._end = max((place.first + place.room for place in self._places.values()), default=0)
        first, self._end = self._end, self._end + knots
        if self._end > len(self.us):
            more = np.zeros(max(self._end, 2 * len(self.us)) - len(self.us), np.int64)
            self.us, self.bytes = np.concatenate([self.us, more]), np.concatenate([self.bytes, more])
        return first, knots

    def _forget(self, place: _Place) -> None:
        del self._places[id(place.trace)], self._idle[id(place.trace)]


@kernel
def segment(knots: NDArray[np.int64], first: int, last: int, hint: int, point: int) -> int:
    """k with knots[k] <= point < knots[k + 1], first <= k < last. ``hint``: where it was last time, often still so."""
    for k in range(hint, min(hint + 4, last)):
        if knots[k] <= point < knots[k + 1]:
            return k
    low, high = first, last
    while high - low > 1:
        middle = (low + high) // 2
        if knots[middle] <= point:
            low = middle
        else:
            high = middle
    return low


@kernel
def position_at(
    us: NDArray[np.int64], size: NDArray[np.int64], first: int, last: int, after: int, hint: int, t_us: int
) -> tuple[int, int]:
    """(C(t) rounded down, bytes; segment it lies in) on the trace with knots ``first..last``."""
    duration, total = us[last], size[last]
    laps, t = 0, t_us
    if t_us >= duration:
        if after == STOP:
            return total, last - 1
        if after == HOLD:
            # Whole segment lengths first, so that the product below stays within 64 bits.
            span, carried = duration - us[last - 1], total - size[last - 1]
            whole, rest = (t_us - duration) // span, (t_us - duration) % span
            return total + whole * carried + carried * rest // span, last - 1
        laps, t = t_us // duration, t_us % duration
    k = segment(us, first, last, hint, t)
    return laps * total + size[k] + (size[k + 1] - size[k]) * (t - us[k]) // (us[k + 1] - us[k]), k


@kernel
def time_of(
    us: NDArray[np.int64], size: NDArray[np.int64], first: int, last: int, after: int, hint: int, position: int
) -> tuple[int, int]:
    """(first t with C(t) >= position, us; segment it lies in); FOREVER where that never comes. position > 0."""
    duration, total = us[last], size[last]
    laps, wanted = 0, position
    if position > total:
        if after == STOP:
            return FOREVER, last - 1
        if after == HOLD:
            span, carried = duration - us[last - 1], total - size[last - 1]
            if carried == 0:
                return FOREVER, last - 1
            whole, rest = (position - total) // carried, (position - total) % carried
            return duration + whole * span + -(-rest * span // carried), last - 1
        laps = (position - 1) // total
        wanted = position - laps * total
    k = segment(size, first, last, hint, wanted - 1)  # size[k] < wanted <= size[k + 1]
    need, carried = wanted - size[k], size[k + 1] - size[k]
    return laps * duration + us[k] + -(-need * (us[k + 1] - us[k]) // carried), k


@kernel
def _positions(
    us: NDArray[np.int64], size: NDArray[np.int64], after: int, t_us: NDArray[np.int64], by: NDArray[np.int64]
) -> None:
    """``by[k]`` = C(t_us[k])."""
    hint = 0
    for k in range(len(t_us)):
        by[k], hint = position_at(us, size, 0, len(us) - 1, after, hint, t_us[k])
