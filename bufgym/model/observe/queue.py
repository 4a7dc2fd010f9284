"""The fields of one queue, ``SLOT_FIELDS`` and ``CONTEXT_FIELDS``, and the kernels made of them.

A slot's number is made of its ``Slot``, a context's of the ``Newcomer``: what several fields share is computed once.
Several topics have the same fields; ``topics`` only fills in other neighbours.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, unchecked_item
from bufgym.model.buffer import UNLIMITED_BYTES, Buffer, arrival_gain
from bufgym.model.observe.declare import TINY, Field, chooser, clear, kept, length, ratio, single, squash, writer
from bufgym.model.qoi import EXPONENTIAL, merging_loss, value

# Where V is straight a merger loses nothing but rounding errors, whose differences mean nothing.
ROUNDING = 1e-12


class Slot(NamedTuple):
    """A queued message or the newcomer, beside its neighbours."""

    rank: float  # (k + 1) / (s + 1) for slot k of s queued; 1 for the newcomer
    back_us: Any  # time since the message kept before it, us
    merged_us: Any  # time gap left if it is dropped, us
    back_x: Any  # motion since the message before it
    merged_x: Any  # motion gap left if it is dropped
    lost: Any  # V lost if it alone is dropped
    loss: float  # the same as a part of H: weighted with several topics
    size_bytes: Any  # its bytes
    even_us: Any  # the even time spacing, us
    even_x: Any  # the even motion spacing
    even_lost: Any  # V lost by merging two even gaps
    mean_bytes: Any  # mean bytes of the queued messages and the newcomer


SLOT_FIELDS = (
    Field("occupied", "slot", "queue", "flag", "1 where the slot holds a message (the newcomer's always does)",
          lambda slot: 1.0),
    Field("rank", "slot", "queue", "fraction", "(k + 1) / (s + 1) for slot k of s queued; 1 for the newcomer",
          lambda slot: slot.rank),
    Field("time_before", "slot", "time", "g/(g+r), r = even time spacing", "time since the message kept before it",
          lambda slot: ratio(slot.back_us, slot.even_us)),
    Field("time_merged", "slot", "time", "g/(g+r), r = 2 x even time spacing", "time gap left if it is dropped",
          lambda slot: ratio(slot.merged_us, slot.even_us + slot.even_us)),
    Field("motion_before", "slot", "motion", "g/(g+r), r = even motion spacing", "motion since the message before it",
          lambda slot: ratio(slot.back_x, slot.even_x)),
    Field("motion_merged", "slot", "motion", "g/(g+r), r = 2 x even motion spacing", "motion gap left if it is dropped",
          lambda slot: ratio(slot.merged_x, slot.even_x + slot.even_x)),
    Field("loss", "slot", "value", "QoI", "V(a) + V(b) - V(a+b): QoI lost if it alone is dropped now",
          lambda slot: slot.loss),
    Field("size", "slot", "queue", "g/(g+r), r = mean queued size", "its bytes",
          lambda slot: ratio(slot.size_bytes, slot.mean_bytes)),
    Field("relative_loss", "slot", "value", "l/(l+r), r = that of an even gap", "the same loss, free of V's scale",
          lambda slot: ratio(slot.lost, slot.even_lost)),
)  # fmt: skip
write_slot = writer(SLOT_FIELDS, "slot")
_choose_slot = chooser(SLOT_FIELDS, "slot")


class Shared(NamedTuple):
    """What all slots share."""

    rank: float  # 1 / (s + 1)
    newest: float  # V of the newcomer's gap
    even_us: Any  # as in ``Slot``, and so on
    even_x: Any
    even_lost: Any
    mean_bytes: Any


class Before(NamedTuple):
    """The message kept before a slot, and V of the gap between the two."""

    gain: float
    arrival_us: int
    x: float


@kernel
def _shared_by_slots(buffer: Buffer, arrival: Any, even_lost: float) -> Shared:
    per_rank, even = 1 / (len(buffer.slots) + 1), 1 / (buffer.capacity + 1)
    even_us, even_x = even * (arrival.arrival_us - buffer.dequeued_arrival_us), even * (arrival.x - buffer.dequeued_x)
    mean_bytes = (buffer.backlog_bytes + arrival.size_bytes) * per_rank
    newest = arrival_gain(buffer, arrival)
    return Shared(
        per_rank, newest, single(even_us), single(even_x), single(max(even_lost, ROUNDING)), single(mean_bytes)
    )


@kernel
def _before_all(buffer: Buffer, newest: float) -> Before:
    """What comes before slot 0."""
    gain = unchecked_item(buffer.slots, 0).gain if len(buffer.slots) > 0 else newest
    return Before(gain, buffer.dequeued_arrival_us, buffer.dequeued_x)


@kernel
def _slot_of(
    buffer: Buffer, arrival: Any, k: int, shared: Shared, before: Before, numbers: NDArray[np.floating[Any]]
) -> tuple[Slot, Before]:
    """Slot ``k``, whose numbers will be kept in ``numbers``, and what comes before slot ``k + 1``.

    Losses equal ``buffer.loss``, from the gains that the messages carry.
    """
    s, newest = len(buffer.slots), shared.newest
    message, place = (unchecked_item(buffer.slots, k), (k + 1) * shared.rank) if k < s else (arrival, 1.0)
    at_us, x, size_bytes = message.arrival_us, message.x, message.size_bytes
    back_us, back_x = at_us - before.arrival_us, x - before.x
    if k < s:
        behind, next_gain = arrival, newest
        if k + 1 < s:
            behind = unchecked_item(buffer.slots, k + 1)
            next_gain = behind.gain
        merged_us, on_x, merged_x = behind.arrival_us - before.arrival_us, behind.x - x, behind.x - before.x
    else:  # the next step is expected to be as long as the last one
        on_x = x - buffer.previous_x
        merged_us, merged_x = back_us + at_us - buffer.previous_us, back_x + on_x
        next_gain = newest if s > 0 and on_x == back_x else value(buffer.v, on_x)
    # Rounding may make a loss negative. A first message has no gap before it to merge, so nothing is lost with it.
    is_exponential = buffer.v[0] == EXPONENTIAL
    lost = before.gain * next_gain if is_exponential else merging_loss(buffer.v, back_x, before.gain, on_x, next_gain)
    lost = max(lost, 0.0)
    slot = Slot(
        place, length(back_us, numbers), length(merged_us, numbers), length(back_x, numbers),
        length(merged_x, numbers), length(lost, numbers), lost, length(size_bytes, numbers),
        shared.even_us, shared.even_x, shared.even_lost, shared.mean_bytes,
    )  # fmt: skip
    return slot, Before(next_gain, at_us, x)


@kernel
def _write_slots(buffer: Buffer, arrival: Any, even_lost: float, rows: NDArray[np.floating[Any]]) -> None:
    """Write every SLOT_FIELDS value."""
    s, last = len(buffer.slots), buffer.capacity
    rows[:, :] = 0.0
    shared = _shared_by_slots(buffer, arrival, even_lost)
    before = _before_all(buffer, shared.newest)
    for k in range(s + 1):
        slot, before = _slot_of(buffer, arrival, k, shared, before, rows)
        write_slot(slot, np.uint64(k if k < s else last), rows)


@kernel
def _choose_slots(
    buffer: Buffer, arrival: Any, even_lost: float, places: NDArray[np.int64], row: NDArray[np.floating[Any]]
) -> None:
    """Write the SLOT_FIELDS that have a place."""
    s, last = len(buffer.slots), buffer.capacity
    clear(places, s, last, row)
    shared = _shared_by_slots(buffer, arrival, even_lost)
    before = _before_all(buffer, shared.newest)
    for k in range(s + 1):
        slot, before = _slot_of(buffer, arrival, k, shared, before, row)
        _choose_slot(slot, k if k < s else last, places, row)


class Newcomer(NamedTuple):
    """The newcomer beside what came before it; all 0 where the socket asks."""

    gap_us: float  # time since the previous arrival, us
    gap_x: float  # motion since then
    even_us: float  # the even time spacing, us
    even_x: float  # the even motion spacing
    even_gain: float  # V of it
    even_value: float  # the same as a part of H: weighted with several topics
    even_lost: float  # V lost by merging two even gaps


CONTEXT_FIELDS = (
    Field("occupancy", "context", "queue", "fraction of L", "messages queued",
          lambda buffer, newcomer: len(buffer.slots) / buffer.capacity),
    Field("backlog", "context", "queue", "fraction of B", "bytes queued; 0 where there is no byte limit",
          lambda buffer, _: buffer.backlog_bytes / buffer.max_bytes if buffer.max_bytes < UNLIMITED_BYTES else 0.0),
    Field("arrival_time_gap", "context", "time", "g/(g+r), r = even time spacing", "time since the previous arrival",
          lambda buffer, newcomer: squash(newcomer.gap_us, newcomer.even_us)),
    Field("arrival_motion_gap", "context", "motion", "g/(g+r), r = even motion spacing", "motion since then",
          lambda buffer, newcomer: squash(newcomer.gap_x, newcomer.even_x)),
    Field("busy", "context", "link", "flag", "1 while a message is in transmission",
          lambda buffer, newcomer: float(buffer.busy)),
    Field("left", "context", "link", "fraction", "part of the message in transmission that is still to be transmitted",
          lambda buffer, newcomer: buffer.left_fraction),
    Field("stalled", "context", "link", "g/(g+r), r = L + 1 arrival periods", "time since a message was last dequeued",
          lambda buffer, newcomer: squash(buffer.stalled_us, (buffer.capacity + 1) * buffer.period_us)),
    Field("departures", "context", "link", "n/(n+1)", "messages dequeued since the previous arrival",
          lambda buffer, newcomer: squash(buffer.departures, 1.0)),
    Field("service_ratio", "context", "link", "g/(g+r), r = 1", "running mean of departures per arrival",
          lambda buffer, newcomer: squash(buffer.service_ratio, 1.0)),
    Field("even_value", "context", "value", "QoI", "V of the even motion spacing e",
          lambda buffer, newcomer: newcomer.even_value),
    Field("bend", "context", "value", "fraction", "(2 V(e) - V(2e)) / V(e): 0 where V is straight, 1 where it is flat",
          lambda buffer, newcomer: newcomer.even_lost / max(newcomer.even_gain, TINY)),
)  # fmt: skip
write_context = writer(CONTEXT_FIELDS, "buffer, newcomer")
_choose_context = chooser(CONTEXT_FIELDS, "buffer, newcomer")


@kernel
def newcomer_of(buffer: Buffer, arrival: Any, numbers: NDArray[np.floating[Any]]) -> Newcomer:
    """Facts of the context, whose numbers will be kept in ``numbers``."""
    spread = buffer.capacity + 1
    even_us = (arrival.arrival_us - buffer.dequeued_arrival_us) / spread
    even_x = (arrival.x - buffer.dequeued_x) / spread
    gain = value(buffer.v, even_x)
    lost = merging_loss(buffer.v, even_x, gain, even_x, gain)
    gap_us, gap_x = float(arrival.arrival_us - buffer.previous_us), arrival.x - buffer.previous_x
    return Newcomer(gap_us, gap_x, even_us, even_x, kept(gain, numbers), gain, lost)


@kernel
def observe(buffer: Buffer, arrival: Any, rows: NDArray[np.floating[Any]], context: NDArray[np.floating[Any]]) -> None:
    """Write every SLOT_FIELDS value into ``rows``, float[fields, L + 1], every CONTEXT_FIELDS value into ``context``.

    Empty slots are 0, the newcomer is last.
    """
    newcomer = newcomer_of(buffer, arrival, context)
    _write_slots(buffer, arrival, newcomer.even_lost, rows)
    write_context(buffer, newcomer, context)


@kernel
def choose_of_tables(
    buffer: Buffer,
    arrival: Any,
    slots: NDArray[np.int64],
    any_slots: bool,
    context: NDArray[np.int64],
    row: NDArray[np.floating[Any]],
) -> None:
    """Write the SLOT_FIELDS, if there are ``any_slots``, and the CONTEXT_FIELDS that have a place; see ``chooser``."""
    newcomer = newcomer_of(buffer, arrival, row)
    if any_slots:
        _choose_slots(buffer, arrival, newcomer.even_lost, slots, row)
    _choose_context(buffer, newcomer, context, row)
