"""Fields of one queue: the kernels for ``fields.SLOT_FIELDS`` and ``CONTEXT_FIELDS``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import kernel
from bufgym.model.buffer import UNLIMITED_BYTES, Buffer, arrival_gain, gaps_among
from bufgym.model.observe import fields
from bufgym.model.qoi import merging_loss, value

# So that 0 / (0 + reference) is 0 where nothing moved at all.
TINY = 1e-30
# Where V is straight a merger loses nothing but rounding errors, whose differences mean nothing.
ROUNDING = 1e-12


@kernel
def squash(g: float, reference: float) -> float:
    """Map a length g >= 0 to [0, 1] by g / (g + reference); 0 if both are 0."""
    return g / (g + max(reference, TINY))


@kernel
def squash_row(row: NDArray[np.floating[Any]], reference: float) -> None:
    """Apply ``squash`` to every entry, in place and in single precision."""
    r = np.float32(max(reference, TINY))
    for k in range(len(row)):
        row[k] = row[k] / (row[k] + r)


@kernel
def even_gap(buffer: Buffer, arrival: Any) -> tuple[float, float]:
    """V of the even motion spacing, and the QoI lost by merging two such gaps."""
    even = (arrival.x - buffer.dequeued_x) / (buffer.capacity + 1)
    gain = value(buffer.v, even)
    return gain, merging_loss(buffer.v, even, gain, even, gain)


@kernel
def observe_link(buffer: Buffer, context: NDArray[np.floating[Any]]) -> None:
    """Write the fields that do not depend on the arrival into ``context``: state of the buffer and its link."""
    context[fields.OCCUPANCY] = len(buffer.slots) / buffer.capacity
    context[fields.BACKLOG] = buffer.backlog_bytes / buffer.max_bytes if buffer.max_bytes < UNLIMITED_BYTES else 0.0
    context[fields.BUSY] = buffer.busy
    context[fields.LEFT] = buffer.left_fraction
    context[fields.STALLED] = squash(buffer.stalled_us, (buffer.capacity + 1) * buffer.period_us)
    context[fields.DEPARTURES] = squash(buffer.departures, 1.0)
    context[fields.SERVICE_RATIO] = squash(buffer.service_ratio, 1.0)


@kernel
def observe_context(buffer: Buffer, arrival: Any, context: NDArray[np.floating[Any]]) -> None:
    """Write every CONTEXT_FIELDS value into ``context`` (float[fields])."""
    observe_link(buffer, context)
    spread = buffer.capacity + 1
    time_gap, motion_gap = arrival.arrival_us - buffer.previous_us, arrival.x - buffer.previous_x
    context[fields.ARRIVAL_TIME_GAP] = squash(time_gap, (arrival.arrival_us - buffer.dequeued_arrival_us) / spread)
    context[fields.ARRIVAL_MOTION_GAP] = squash(motion_gap, (arrival.x - buffer.dequeued_x) / spread)
    context[fields.EVEN_VALUE], even_loss = even_gap(buffer, arrival)
    context[fields.BEND] = even_loss / max(float(context[fields.EVEN_VALUE]), TINY)


@kernel
def observe_slots(buffer: Buffer, arrival: Any, rows: NDArray[np.floating[Any]]) -> None:
    """Write every SLOT_FIELDS value into ``rows``, float[fields, L + 1]; empty slots are 0, the newcomer is last.

    Losses equal ``buffer.loss``, from the gains that the messages carry. Lengths are squashed row by row afterwards.
    """
    s, last = len(buffer.slots), buffer.capacity
    per_rank = 1 / (s + 1)
    rows[:, s:last] = 0.0
    gain = buffer.slots[0].gain if s > 0 else arrival_gain(buffer, arrival)
    for k in range(s + 1):
        message, column = (buffer.slots[k], k) if k < s else (arrival, last)
        back_us, on_us, back_x, on_x, merged_x = gaps_among(buffer, arrival, True, k, False)
        if k == s:
            next_gain = value(buffer.v, on_x)
        else:
            next_gain = buffer.slots[k + 1].gain if k + 1 < s else arrival_gain(buffer, arrival)
        rows[fields.OCCUPIED, column] = 1.0
        rows[fields.RANK, column] = (k + 1) * per_rank if k < s else 1.0
        rows[fields.TIME_BEFORE, column] = back_us
        rows[fields.TIME_MERGED, column] = back_us + on_us
        rows[fields.MOTION_BEFORE, column] = back_x
        rows[fields.MOTION_MERGED, column] = merged_x
        # Rounding may make a loss negative. A first message has no gap before it to merge, so nothing is lost with it.
        rows[fields.LOSS, column] = max(merging_loss(buffer.v, back_x, gain, on_x, next_gain), 0.0)
        rows[fields.RELATIVE_LOSS, column] = rows[fields.LOSS, column]
        rows[fields.SIZE, column] = message.size_bytes
        gain = next_gain
    even = 1 / (buffer.capacity + 1)
    even_us, even_x = even * (arrival.arrival_us - buffer.dequeued_arrival_us), even * (arrival.x - buffer.dequeued_x)
    squash_row(rows[fields.TIME_BEFORE], even_us)
    squash_row(rows[fields.TIME_MERGED], 2 * even_us)
    squash_row(rows[fields.MOTION_BEFORE], even_x)
    squash_row(rows[fields.MOTION_MERGED], 2 * even_x)
    squash_row(rows[fields.RELATIVE_LOSS], max(even_gap(buffer, arrival)[1], ROUNDING))
    squash_row(rows[fields.SIZE], (buffer.backlog_bytes + arrival.size_bytes) * per_rank)
