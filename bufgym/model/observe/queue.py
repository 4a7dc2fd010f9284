"""The fields of one queue, ``SLOT_FIELDS`` and ``CONTEXT_FIELDS``, each a function, and the kernels made of them.

A slot's function sees its ``Slot``, a context's the ``Newcomer``: what several fields share is computed once. Several
topics have the same fields; ``topics`` only fills in other neighbours.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import kernel
from bufgym.model.buffer import UNLIMITED_BYTES, Buffer, arrival_gain, gaps_among
from bufgym.model.observe.declare import TINY, Field, declare, kept, squash, squash_row, writer  # noqa: F401 (in generated lines)
from bufgym.model.qoi import merging_loss, value

# Where V is straight a merger loses nothing but rounding errors, whose differences mean nothing.
ROUNDING = 1e-12

_SLOTS: list[Field] = []
_CONTEXT: list[Field] = []


# --- slots -----------------------------------------------------------------------------------------------------------


class Slot(NamedTuple):
    """A queued message or the newcomer, beside its neighbours.

    Fields:
        rank: (k + 1) / (s + 1) for slot k of s queued; 1 for the newcomer.
        back_us: time since the message kept before it, us.
        merged_us: time gap left if it is dropped, us.
        back_x: motion since the message before it.
        merged_x: motion gap left if it is dropped.
        lost: V lost if it alone is dropped.
        loss: the same as a part of H: weighted with several topics.
        size_bytes: its bytes.
        even_us: the even time spacing, us.
        even_x: the even motion spacing.
        even_lost: V lost by merging two even gaps.
        mean_bytes: mean bytes of the queued messages and the newcomer.
    """

    rank: float
    back_us: float
    merged_us: float
    back_x: float
    merged_x: float
    lost: float
    loss: float
    size_bytes: int
    even_us: float
    even_x: float
    even_lost: float
    mean_bytes: float


@declare(_SLOTS, "slot", "queue", "flag")
def occupied(buffer: Buffer, arrival: Any, slot: Slot) -> float:
    "1 where the slot holds a message (the newcomer's always does)"
    return 1.0


@declare(_SLOTS, "slot", "queue", "fraction")
def rank(buffer: Buffer, arrival: Any, slot: Slot) -> float:
    "(k + 1) / (s + 1) for slot k of s queued; 1 for the newcomer"
    return slot.rank


@declare(_SLOTS, "slot", "time", "g/(g+r), r = even time spacing", reference="slot.even_us")
def time_before(buffer: Buffer, arrival: Any, slot: Slot) -> float:
    "time since the message kept before it"
    return slot.back_us


@declare(_SLOTS, "slot", "time", "g/(g+r), r = 2 x even time spacing", reference="2 * slot.even_us")
def time_merged(buffer: Buffer, arrival: Any, slot: Slot) -> float:
    "time gap left if it is dropped"
    return slot.merged_us


@declare(_SLOTS, "slot", "motion", "g/(g+r), r = even motion spacing", reference="slot.even_x")
def motion_before(buffer: Buffer, arrival: Any, slot: Slot) -> float:
    "motion since the message before it"
    return slot.back_x


@declare(_SLOTS, "slot", "motion", "g/(g+r), r = 2 x even motion spacing", reference="2 * slot.even_x")
def motion_merged(buffer: Buffer, arrival: Any, slot: Slot) -> float:
    "motion gap left if it is dropped"
    return slot.merged_x


@declare(_SLOTS, "slot", "value", "QoI")
def loss(buffer: Buffer, arrival: Any, slot: Slot) -> float:
    "V(a) + V(b) - V(a+b): QoI lost if it alone is dropped now"
    return slot.loss


@declare(_SLOTS, "slot", "queue", "g/(g+r), r = mean queued size", mean="slot.mean_bytes")
def size(buffer: Buffer, arrival: Any, slot: Slot) -> float:
    "its bytes"
    return slot.size_bytes


@declare(_SLOTS, "slot", "value", "l/(l+r), r = that of an even gap", reference="slot.even_lost")
def relative_loss(buffer: Buffer, arrival: Any, slot: Slot) -> float:
    "the same loss, free of V's scale"
    return slot.lost


SLOT_FIELDS = tuple(_SLOTS)
_LENGTH, _SQUASHED = (
    "rows[{i}, column] = {f}(buffer, arrival, slot)",
    "squash_row(rows[{i}], {r})",
)
_RATIO = "rows[{i}, column] = squash({f}(buffer, arrival, slot), {r})"
_OF_SLOT, _OF_ROWS = "buffer, arrival, slot, column, rows", "buffer, arrival, slot, rows"
_write = writer(globals(), SLOT_FIELDS, _OF_SLOT, _LENGTH)
_squash_rows = writer(globals(), SLOT_FIELDS, _OF_ROWS, "", _SQUASHED, _SQUASHED)
# With references of its own for each slot.
write_by_slot = writer(globals(), SLOT_FIELDS, _OF_SLOT, _LENGTH, _RATIO)
squash_means = writer(globals(), SLOT_FIELDS, _OF_ROWS, "", "", _SQUASHED)


@kernel
def even_gap(buffer: Buffer, arrival: Any) -> tuple[float, float]:
    """V of the even motion spacing, and the QoI lost by merging two such gaps."""
    even = (arrival.x - buffer.dequeued_x) / (buffer.capacity + 1)
    gain = value(buffer.v, even)
    return gain, merging_loss(buffer.v, even, gain, even, gain)


@kernel
def observe_slots(buffer: Buffer, arrival: Any, rows: NDArray[np.floating[Any]]) -> None:
    """Write every SLOT_FIELDS value into ``rows``, float[fields, L + 1]; empty slots are 0, the newcomer is last.

    Losses equal ``buffer.loss``, from the gains that the messages carry. Lengths are squashed row by row afterwards.
    """
    s, last = len(buffer.slots), buffer.capacity
    per_rank, even = 1 / (s + 1), 1 / (buffer.capacity + 1)
    rows[:, s:last] = 0.0
    even_us, even_x = even * (arrival.arrival_us - buffer.dequeued_arrival_us), even * (arrival.x - buffer.dequeued_x)
    even_lost = max(even_gap(buffer, arrival)[1], ROUNDING)
    mean_bytes = (buffer.backlog_bytes + arrival.size_bytes) * per_rank
    gain = buffer.slots[0].gain if s > 0 else arrival_gain(buffer, arrival)
    for k in range(s + 1):
        message, column = (buffer.slots[k], k) if k < s else (arrival, last)
        back_us, on_us, back_x, on_x, merged_x = gaps_among(buffer, arrival, True, k, False)
        if k == s:
            next_gain = value(buffer.v, on_x)
        else:
            next_gain = buffer.slots[k + 1].gain if k + 1 < s else arrival_gain(buffer, arrival)
        # Rounding may make a loss negative. A first message has no gap before it to merge, so nothing is lost with it.
        lost = max(merging_loss(buffer.v, back_x, gain, on_x, next_gain), 0.0)
        place = (k + 1) * per_rank if k < s else 1.0
        size_bytes, merged_us = message.size_bytes, float(back_us + on_us)
        slot = Slot(
            place, float(back_us), merged_us, back_x, merged_x, lost, lost, size_bytes,
            even_us, even_x, even_lost, mean_bytes,
        )  # fmt: skip
        _write(buffer, arrival, slot, column, rows)
        gain = next_gain
    _squash_rows(buffer, arrival, slot, rows)


# --- context ---------------------------------------------------------------------------------------------------------


class Newcomer(NamedTuple):
    """The newcomer beside what came before it; all 0 where the socket asks.

    Fields:
        gap_us: time since the previous arrival, us.
        gap_x: motion since then.
        even_us: the even time spacing, us.
        even_x: the even motion spacing.
        even_gain: V of it.
        even_value: the same as a part of H: weighted with several topics.
        even_lost: V lost by merging two even gaps.
    """

    gap_us: float
    gap_x: float
    even_us: float
    even_x: float
    even_gain: float
    even_value: float
    even_lost: float


@declare(_CONTEXT, "context", "queue", "fraction of L")
def occupancy(buffer: Buffer, arrival: Any, newcomer: Newcomer) -> float:
    "messages queued"
    return len(buffer.slots) / buffer.capacity


@declare(_CONTEXT, "context", "queue", "fraction of B")
def backlog(buffer: Buffer, arrival: Any, newcomer: Newcomer) -> float:
    "bytes queued; 0 where there is no byte limit"
    return buffer.backlog_bytes / buffer.max_bytes if buffer.max_bytes < UNLIMITED_BYTES else 0.0


@declare(_CONTEXT, "context", "time", "g/(g+r), r = even time spacing")
def arrival_time_gap(buffer: Buffer, arrival: Any, newcomer: Newcomer) -> float:
    "time since the previous arrival"
    return squash(newcomer.gap_us, newcomer.even_us)


@declare(_CONTEXT, "context", "motion", "g/(g+r), r = even motion spacing")
def arrival_motion_gap(buffer: Buffer, arrival: Any, newcomer: Newcomer) -> float:
    "motion since then"
    return squash(newcomer.gap_x, newcomer.even_x)


@declare(_CONTEXT, "context", "link", "flag")
def busy(buffer: Buffer, arrival: Any, newcomer: Newcomer) -> float:
    "1 while a message is in transmission"
    return float(buffer.busy)


@declare(_CONTEXT, "context", "link", "fraction")
def left(buffer: Buffer, arrival: Any, newcomer: Newcomer) -> float:
    "part of the message in transmission that is still to be transmitted"
    return buffer.left_fraction


@declare(_CONTEXT, "context", "link", "g/(g+r), r = L + 1 arrival periods")
def stalled(buffer: Buffer, arrival: Any, newcomer: Newcomer) -> float:
    "time since a message was last dequeued"
    return squash(buffer.stalled_us, (buffer.capacity + 1) * buffer.period_us)


@declare(_CONTEXT, "context", "link", "n/(n+1)")
def departures(buffer: Buffer, arrival: Any, newcomer: Newcomer) -> float:
    "messages dequeued since the previous arrival"
    return squash(buffer.departures, 1.0)


@declare(_CONTEXT, "context", "link", "g/(g+r), r = 1")
def service_ratio(buffer: Buffer, arrival: Any, newcomer: Newcomer) -> float:
    "running mean of departures per arrival"
    return squash(buffer.service_ratio, 1.0)


@declare(_CONTEXT, "context", "value", "QoI")
def even_value(buffer: Buffer, arrival: Any, newcomer: Newcomer) -> float:
    "V of the even motion spacing e"
    return newcomer.even_value


@declare(_CONTEXT, "context", "value", "fraction")
def bend(buffer: Buffer, arrival: Any, newcomer: Newcomer) -> float:
    "(2 V(e) - V(2e)) / V(e): 0 where V is straight, 1 where it is flat"
    return newcomer.even_lost / max(newcomer.even_gain, TINY)


CONTEXT_FIELDS = tuple(_CONTEXT)
_LINE = "context[{i}] = {f}(buffer, arrival, newcomer)"
write_context = writer(globals(), CONTEXT_FIELDS, "buffer, arrival, newcomer, context", _LINE)


@kernel
def observe_context(buffer: Buffer, arrival: Any, context: NDArray[np.floating[Any]]) -> None:
    """Write every CONTEXT_FIELDS value into ``context`` (float[fields])."""
    spread = buffer.capacity + 1
    even_us = (arrival.arrival_us - buffer.dequeued_arrival_us) / spread
    even_x = (arrival.x - buffer.dequeued_x) / spread
    gap_us, gap_x = float(arrival.arrival_us - buffer.previous_us), arrival.x - buffer.previous_x
    gain, lost = even_gap(buffer, arrival)
    newcomer = Newcomer(gap_us, gap_x, even_us, even_x, kept(gain, context), gain, lost)
    write_context(buffer, arrival, newcomer, context)
