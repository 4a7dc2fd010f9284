"""What an agent observes and what it is paid for: one table each, from which spaces, code and docs are made.

Every field is computed from the ``Buffer`` view and the arrival alone, that is from what a robot has on board (its
buffer, clock, odometry, and what its own socket still holds); nothing comes from the server or the link's future.

Every field lies in [0, 1] and is free of scale. Lengths g (of time, motion, bytes) appear as g / (g + r) with a
stated reference r, so 0.5 means "as long as the reference". For gaps r is the *even spacing*: the distance from the
message that the socket took last to the newcomer, divided by L + 1, which is what an even thinning of that stretch
to L kept messages would leave between neighbours (AFR's aim). So one set of weights serves every L and frame rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.buffer import UNLIMITED_BYTES, Buffer, arrival_gain
from bufgym.kernel import kernel
from bufgym.qoi import merging_loss, value


@dataclass(frozen=True)
class Field:
    """One observed quantity. ``per``: "slot" fields have L + 1 entries, the newcomer last; "context" fields one."""

    name: str
    per: str
    group: str
    """What it takes to know it: queue (counting), time (a clock), motion (odometry), value (V), link (its socket)."""
    unit: str
    meaning: str
    low: float = 0.0
    high: float = 1.0


SLOT_FIELDS = (
    Field("occupied", "slot", "queue", "flag", "1 where the slot holds a message (the newcomer's always does)"),
    Field("rank", "slot", "queue", "fraction", "(k + 1) / (s + 1) for slot k of s queued; 1 for the newcomer"),
    Field("time_before", "slot", "time", "g/(g+r), r = even time spacing", "time since the message kept before it"),
    Field("time_merged", "slot", "time", "g/(g+r), r = 2 x even time spacing", "time gap left if it is dropped"),
    Field("motion_before", "slot", "motion", "g/(g+r), r = even motion spacing", "motion since the message before it"),
    Field(
        "motion_merged", "slot", "motion", "g/(g+r), r = 2 x even motion spacing", "motion gap left if it is dropped"
    ),
    Field("loss", "slot", "value", "QoI", "V(a) + V(b) - V(a+b): QoI lost if it alone is dropped now"),
    Field("size", "slot", "queue", "g/(g+r), r = mean queued size", "its bytes"),
    Field("relative_loss", "slot", "value", "l/(l+r), r = that of an even gap", "the same loss, free of V's scale"),
)
CONTEXT_FIELDS = (
    Field("occupancy", "context", "queue", "fraction of L", "messages queued"),
    Field("backlog", "context", "queue", "fraction of B", "bytes queued; 0 where there is no byte limit"),
    Field("arrival_time_gap", "context", "time", "g/(g+r), r = even time spacing", "time since the previous arrival"),
    Field("arrival_motion_gap", "context", "motion", "g/(g+r), r = even motion spacing", "motion since then"),
    Field("busy", "context", "link", "flag", "1 while a message is in transmission"),
    Field("left", "context", "link", "fraction", "part of the message in transmission that has not crossed yet"),
    Field("stalled", "context", "link", "g/(g+r), r = L + 1 arrival periods", "time since the socket took a message"),
    Field("departures", "context", "link", "n/(n+1)", "messages the socket took since the previous arrival"),
    Field("drain", "context", "link", "g/(g+r), r = 1", "running mean of departures per arrival"),
    Field("even_value", "context", "value", "QoI", "V of the even motion spacing e"),
    Field("bend", "context", "value", "fraction", "(2 V(e) - V(2e)) / V(e): 0 where V is straight, 1 where it is flat"),
)
FIELDS = SLOT_FIELDS + CONTEXT_FIELDS

_NUMBER = {field.name: i for i, field in enumerate(SLOT_FIELDS)} | {
    field.name: i for i, field in enumerate(CONTEXT_FIELDS)
}
OCCUPIED, RANK, SIZE, LOSS = (_NUMBER[name] for name in ("occupied", "rank", "size", "loss"))
TIME_BEFORE, TIME_MERGED = _NUMBER["time_before"], _NUMBER["time_merged"]
MOTION_BEFORE, MOTION_MERGED = _NUMBER["motion_before"], _NUMBER["motion_merged"]
OCCUPANCY, BACKLOG, BUSY, LEFT = (_NUMBER[name] for name in ("occupancy", "backlog", "busy", "left"))
ARRIVAL_TIME_GAP, ARRIVAL_MOTION_GAP = _NUMBER["arrival_time_gap"], _NUMBER["arrival_motion_gap"]
STALLED, DEPARTURES, DRAIN = _NUMBER["stalled"], _NUMBER["departures"], _NUMBER["drain"]
RELATIVE_LOSS, EVEN_VALUE, BEND = _NUMBER["relative_loss"], _NUMBER["even_value"], _NUMBER["bend"]


@dataclass(frozen=True)
class RewardTerm:
    """One named reward; an env pays a weighted sum of them and reports each by name in ``info``."""

    name: str
    unit: str
    meaning: str


REWARD_TERMS = (
    RewardTerm("delivered", "QoI", "V gained when a message arrives at the server; sums to H - 1"),
    RewardTerm("retained", "QoI", "change of the H that delivering all that is kept would give; sums to H - 1 too"),
)
"""``retained`` is ``delivered`` shaped by a potential (Ng, Harada and Russell 1999): the QoI held, not yet delivered.
It pays at the moment of the decision what the decision costs or gains, and telescopes to the same total."""


# So that 0 / (0 + reference) is 0 where nothing moved at all.
_TINY = 1e-30
# Where V is straight a merger loses nothing but rounding errors, which are not to be told from one another.
_ROUNDING = 1e-12


@kernel
def squash(g: float, reference: float) -> float:
    """g / (g + reference), in [0, 1]; 0 where both are 0."""
    return g / (g + max(reference, _TINY))


@kernel
def squash_row(row: NDArray[np.floating[Any]], reference: float) -> None:
    """``squash`` of every entry, in place and in single precision."""
    r = np.float32(max(reference, _TINY))
    for k in range(len(row)):
        row[k] = row[k] / (row[k] + r)


@kernel
def even_gap(buffer: Buffer, arrival: Any) -> tuple[float, float]:
    """V of the even motion spacing, and the QoI lost where two such gaps become one."""
    even = (arrival.x - buffer.taken_x) / (buffer.capacity + 1)
    gain = value(buffer.v, even)
    return gain, merging_loss(buffer.v, even, gain, even, gain)


@kernel
def observe_context(buffer: Buffer, arrival: Any, context: NDArray[np.floating[Any]]) -> None:
    """Write every CONTEXT_FIELDS value into ``context`` (float[fields])."""
    spread = buffer.capacity + 1
    context[OCCUPANCY] = len(buffer.slots) / buffer.capacity
    context[BACKLOG] = buffer.backlog_bytes / buffer.max_bytes if buffer.max_bytes < UNLIMITED_BYTES else 0.0
    time_gap, motion_gap = arrival.arrival_us - buffer.previous_us, arrival.x - buffer.previous_x
    context[ARRIVAL_TIME_GAP] = squash(time_gap, (arrival.arrival_us - buffer.taken_us) / spread)
    context[ARRIVAL_MOTION_GAP] = squash(motion_gap, (arrival.x - buffer.taken_x) / spread)
    context[BUSY] = buffer.busy
    context[LEFT] = buffer.left_fraction
    context[STALLED] = squash(buffer.stalled_us, spread * buffer.period_us)
    context[DEPARTURES] = squash(buffer.departures, 1.0)
    context[DRAIN] = squash(buffer.drain, 1.0)
    context[EVEN_VALUE], even_loss = even_gap(buffer, arrival)
    context[BEND] = even_loss / max(context[EVEN_VALUE], _TINY)


@kernel
def observe_slots(buffer: Buffer, arrival: Any, rows: NDArray[np.floating[Any]]) -> None:
    """Write every SLOT_FIELDS value into ``rows`` (float[fields, L + 1]); empty slots are 0, the newcomer is last.

    The gaps are those of ``buffer.time_gaps`` and ``motion_gaps``, the loss that of ``buffer.loss``, found in one walk
    along the queue; gaps and relative losses are squashed row by row afterwards.
    """
    s, last = len(buffer.slots), buffer.capacity
    per_rank = 1 / (s + 1)
    before_us, before_x = buffer.taken_us, buffer.taken_x
    newcomer_gain = arrival_gain(buffer, arrival)
    for k in range(s):
        slot = buffer.slots[k]
        here_us, here_x, gain = slot.arrival_us, slot.x, slot.gain
        if k + 1 < s:
            after = buffer.slots[k + 1]
            after_us, after_x, after_gain = after.arrival_us, after.x, after.gain
        else:
            after_us, after_x, after_gain = arrival.arrival_us, arrival.x, newcomer_gain
        rows[OCCUPIED, k] = 1.0
        rows[RANK, k] = (k + 1) * per_rank
        rows[TIME_BEFORE, k] = here_us - before_us
        rows[TIME_MERGED, k] = after_us - before_us
        rows[MOTION_BEFORE, k] = here_x - before_x
        rows[MOTION_MERGED, k] = after_x - before_x
        rows[LOSS, k] = merging_loss(buffer.v, here_x - before_x, gain, after_x - here_x, after_gain)
        rows[RELATIVE_LOSS, k] = max(rows[LOSS, k], 0.0)
        rows[SIZE, k] = slot.size_bytes
        before_us, before_x = here_us, here_x
    for k in range(s, last):
        for field in range(len(rows)):
            rows[field, k] = 0.0
    step_us, step_x = arrival.arrival_us - buffer.previous_us, arrival.x - buffer.previous_x
    rows[OCCUPIED, last] = 1.0
    rows[RANK, last] = 1.0
    rows[TIME_BEFORE, last] = arrival.arrival_us - before_us
    rows[TIME_MERGED, last] = arrival.arrival_us - before_us + step_us
    rows[MOTION_BEFORE, last] = arrival.x - before_x
    rows[MOTION_MERGED, last] = arrival.x - before_x + step_x
    rows[LOSS, last] = merging_loss(buffer.v, arrival.x - before_x, newcomer_gain, step_x, value(buffer.v, step_x))
    rows[RELATIVE_LOSS, last] = max(rows[LOSS, last], 0.0)
    rows[SIZE, last] = arrival.size_bytes
    even = 1 / (buffer.capacity + 1)
    even_us, even_x = even * (arrival.arrival_us - buffer.taken_us), even * (arrival.x - buffer.taken_x)
    squash_row(rows[TIME_BEFORE], even_us)
    squash_row(rows[TIME_MERGED], 2 * even_us)
    squash_row(rows[MOTION_BEFORE], even_x)
    squash_row(rows[MOTION_MERGED], 2 * even_x)
    squash_row(rows[RELATIVE_LOSS], max(even_gap(buffer, arrival)[1], _ROUNDING))
    squash_row(rows[SIZE], (buffer.backlog_bytes + arrival.size_bytes) * per_rank)
