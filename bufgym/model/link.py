"""The link: a capacity trace turned into delivery times, exactly, in whole microseconds and bytes.

A trace gives C(t), the bytes that the link could have carried by time t, linear between knots. The socket sends one
message at a time and never idles while one waits. A message starts at a byte position u: C(t) on an idle link,
otherwise the position where its predecessor ended. It has been transmitted at the first microsecond t with C(t) >= u +
bytes. Messages pass on positions, not times, so rounding errors never add up.

After the trace's end the link may *loop* to its beginning, *hold* the last segment's rate or *stop* for good.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, unchecked_item
from bufgym.model.checks import whole
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S, Trace
from bufgym.utils.errors import BufgymError

FOREVER = 2**62  # A time that never comes, us

MAX_TIME_US = MAX_DURATION_S * US_PER_S  # The latest arrival of a message, and the longest delay, us

LOOP, HOLD, STOP = 0, 1, 2
_AFTER = {"loop": LOOP, "hold": HOLD, "stop": STOP}


@dataclass(frozen=True)
class Link:
    """One sender's link: a trace from an offset on, with a propagation delay."""

    trace: Trace
    """Capacity over time, and how it continues after the end."""
    offset_us: int = 0
    """Where on the trace the episode begins, us."""
    propagation_us: int = 0
    """Time from the end of a message's transmission to its receipt at the server, us."""

    def __post_init__(self) -> None:
        if not isinstance(self.trace, Trace):
            raise BufgymError(f"trace: {self.trace!r} is not a bufgym.traces Trace")
        whole("offset_us", self.offset_us, 0, FOREVER - 1)
        whole("propagation_us", self.propagation_us, 0, MAX_TIME_US)

    def check_reach(self, last_us: int, total_bytes: int, pauses: int = 0, pause_us: int = 0) -> None:
        """Raise a BufgymError unless every time and byte position of a run over this link stays within 64 bits.

        Messages of ``total_bytes`` in all arrive until ``last_us``. The socket pauses ``pauses`` times for acks, each
        time for ``pause_us``. The bound counts whole laps of the part that repeats, and two more for each start or
        restart.
        """
        trace = self.trace
        # Python's integers, which do not overflow.
        lap_us, lap_bytes, total_bytes = int(trace.duration_us), int(trace.total_bytes), int(total_bytes)
        until_us, until_bytes = max(last_us + self.offset_us, lap_us) + pauses * pause_us, lap_bytes + total_bytes
        if trace.after == "hold":
            lap_us -= int(trace.time_us[-2])
            lap_bytes -= int(trace.cumulative_bytes[-2])
        if trace.after != "stop" and lap_bytes > 0:
            until_us += (total_bytes // lap_bytes + 2 * (1 + pauses)) * lap_us
            until_bytes = trace.total_bytes + (until_us // lap_us + 1) * lap_bytes
        if until_us >= FOREVER // 2 or until_bytes >= FOREVER:
            raise BufgymError(
                f"link on {trace.name}: may need {until_us:.3g} us, and pass {until_bytes:.3g} bytes, for messages of "
                f"{total_bytes} bytes until {last_us} us: must stay below 2**61 us and 2**62 bytes"
            )

    def carried_by(self, t_us: NDArray[np.int64]) -> NDArray[np.int64]:
        """C at the given times (int64[n], us, not decreasing) as int64[n], bytes, rounded down."""
        carried = np.empty(len(t_us), np.int64)
        trace = self.trace
        _positions(trace.time_us, trace.cumulative_bytes, _AFTER[trace.after], t_us + self.offset_us, carried)
        return carried

    def carried_at(self, t_us: int) -> int:
        """C at one time, bytes, rounded down."""
        return int(self.carried_by(np.array([t_us], np.int64))[0])

    def time_at(self, position: int) -> int:
        """The first time, us, at which the link has carried ``position`` > 0 bytes; FOREVER if it never will."""
        trace = self.trace
        us, size, after = trace.time_us, trace.cumulative_bytes, _AFTER[trace.after]
        t_us = int(time_of(us, size, 0, len(us) - 1, after, 0, position)[0])
        return t_us if t_us == FOREVER else t_us - self.offset_us

    @property
    def carries_bytes(self) -> int:
        """All bytes that the link will ever carry; FOREVER if it never stops."""
        carried = self.trace.cumulative_bytes
        ends = self.trace.after == "stop" or (self.trace.after == "hold" and carried[-1] == carried[-2])
        return int(carried[-1]) if ends else FOREVER


KEPT_KNOTS = 2**20  # Knots to store (16 MB) before traces that no sender uses make room for others


PLACE_WORDS = "first_knot", "last_knot", "after", "segment_now", "segment_finish"
"""Fields of a record of a link (see ``carried_by``), in the order in which ``KnotStore.place`` returns them."""


@dataclass(eq=False)
class _Place:
    """Where the knots of a trace lie, and how many senders use them."""

    trace: Trace  # kept, as an id is only unique while its object lives
    first: int
    room: int
    senders: int = 0

    def __post_init__(self) -> None:
        first, last = self.first, self.first + len(self.trace.time_us) - 1
        given = {"first_knot": first, "last_knot": last, "after": _AFTER[self.trace.after]}
        given |= {"segment_now": first, "segment_finish": first}  # where the search for a time, or a byte, begins
        self.words = np.array([given[name] for name in PLACE_WORDS], np.int64)


class KnotStore:
    """The knots of several traces in two flat arrays, which kernels read; each trace is stored once.

    A trace stays stored while a sender uses it, and afterwards until its room is needed; the trace left first goes
    first. So memory stays bounded even if every episode brings a new trace.
    """

    def __init__(self) -> None:
        self.us = np.zeros(0, np.int64)
        self.bytes = np.zeros(0, np.int64)
        self._end = 0
        self._places: dict[int, _Place] = {}
        self._followed: dict[int, _Place] = {}
        self._idle: dict[int, _Place] = {}

    def place(self, trace: Trace, sender: int) -> NDArray[np.int64]:
        """Store ``trace`` for ``sender``; return int64[5], the values of ``PLACE_WORDS``."""
        left = self._followed.pop(sender, None)
        if left is not None:
            left.senders -= 1
            if not left.senders:
                self._idle[id(left.trace)] = left
        place = self._places.get(id(trace))
        if place is None:
            knots = len(trace.time_us)
            place = self._places[id(trace)] = _Place(trace, *self._room(knots))
            here = slice(place.first, place.first + knots)
            self.us[here], self.bytes[here] = trace.time_us, trace.cumulative_bytes
        place.senders += 1
        self._idle.pop(id(trace), None)
        self._followed[sender] = place
        return place.words

    def _room(self, knots: int) -> tuple[int, int]:
        """Find room for so many knots; return (first knot, size of the room)."""
        if self._end + knots > max(KEPT_KNOTS, len(self.us)):
            for place in self._idle.values():
                if place.room >= knots:
                    self._forget(place)
                    return place.first, place.room
            # No single idle trace leaves enough room; dropping all of them may free enough at the end.
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
    """Find k with knots[k] <= point < knots[k + 1] and first <= k < last; try ``hint``, the last answer, first."""
    for k in range(hint, min(hint + 4, last)):
        if unchecked_item(knots, k) <= point < unchecked_item(knots, k + 1):
            return k
    low, high = first, last
    while high - low > 1:
        middle = (low + high) // 2
        if unchecked_item(knots, middle) <= point:
            low = middle
        else:
            high = middle
    return low


@kernel
def share(part: int, whole: int, amount: int) -> Any:
    """Compute part / whole of ``amount``, rounded down; no argument is negative, so Numba need not check signs."""
    return np.int64(np.uint64(part * amount) // np.uint64(whole))


@kernel
def position_at(
    us: NDArray[np.int64], size: NDArray[np.int64], first: int, last: int, after: int, hint: int, t_us: int
) -> tuple[int, int]:
    """Bytes C(t), rounded down, and the segment that t lies in, on the trace with knots ``first..last``."""
    duration, total = us[last], size[last]
    laps, t = 0, t_us
    if t_us >= duration:
        if after == STOP:
            return total, last - 1
        if after == HOLD:
            # Whole segment lengths first, so that the product below stays within 64 bits.
            span, carried = duration - us[last - 1], total - size[last - 1]
            whole, rest = (t_us - duration) // span, (t_us - duration) % span
            return total + whole * carried + share(rest, span, carried), last - 1
        laps, t = t_us // duration, t_us % duration
    k = segment(us, first, last, hint, t)
    from_us, from_bytes = unchecked_item(us, k), unchecked_item(size, k)
    return laps * total + from_bytes + share(
        t - from_us, unchecked_item(us, k + 1) - from_us, unchecked_item(size, k + 1) - from_bytes
    ), k


@kernel
def time_of(
    us: NDArray[np.int64], size: NDArray[np.int64], first: int, last: int, after: int, hint: int, position: int
) -> tuple[int, int]:
    """First time t (us) with C(t) >= ``position`` > 0, or FOREVER, and the segment that t lies in."""
    duration, total = us[last], size[last]
    laps, within = 0, position
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
        within = position - laps * total
    k = segment(size, first, last, hint, within - 1)  # size[k] < within <= size[k + 1]
    from_us, from_bytes = unchecked_item(us, k), unchecked_item(size, k)
    span, carried = unchecked_item(us, k + 1) - from_us, unchecked_item(size, k + 1) - from_bytes
    # Rounded up: the segment's span minus the rest, rounded down.
    return laps * duration + from_us + span - share(from_bytes + carried - within, carried, span), k


@kernel
def carried_by(knot_us: NDArray[np.int64], knot_bytes: NDArray[np.int64], link: Any, t_us: int) -> int:
    """Bytes that a link has carried by the sender's time ``t_us``.

    ``link`` is a record with the fields first_knot, last_knot, after, offset_us, segment_now and segment_finish.
    """
    position, link.segment_now = position_at(
        knot_us, knot_bytes, link.first_knot, link.last_knot, link.after, link.segment_now, t_us + link.offset_us
    )
    return position


@kernel
def finish_of(knot_us: NDArray[np.int64], knot_bytes: NDArray[np.int64], link: Any, position: int) -> int:
    """The sender's time (us) at which the same kind of ``link`` has carried ``position`` bytes, or FOREVER."""
    t_us, link.segment_finish = time_of(
        knot_us, knot_bytes, link.first_knot, link.last_knot, link.after, link.segment_finish, position
    )
    return t_us if t_us == FOREVER else t_us - link.offset_us


@kernel
def _positions(
    us: NDArray[np.int64], size: NDArray[np.int64], after: int, t_us: NDArray[np.int64], carried: NDArray[np.int64]
) -> None:
    """Write C(t_us[k]) into ``carried[k]``."""
    hint = 0
    for k in range(len(t_us)):
        carried[k], hint = position_at(us, size, 0, len(us) - 1, after, hint, t_us[k])
