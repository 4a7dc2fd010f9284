"""Built-in fields outside the tables, computed if an environment's ``fields`` or a learned policy names them.

They describe the link's rate as the socket shows it, bytes beside that, and gaps counted in messages or per byte.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import Buffer, gaps
from bufgym.model.link import FOREVER
from bufgym.model.observe.declare import Field, chooser, clear, squash, writer
from bufgym.model.observe.past import PAST_FIELDS


@kernel
def mean_bytes(buffer: Buffer, arrival: Any) -> float:
    """Mean size of the queued messages and the newcomer."""
    return float((buffer.backlog_bytes + arrival.size_bytes) / (len(buffer.slots) + 1))


@kernel
def demand(buffer: Buffer, arrival: Any) -> float:
    """Rate that the robot would like to send at, bytes/s: a message of mean size at each arrival."""
    return 1e6 * mean_bytes(buffer, arrival) / max(buffer.period_us, 1.0)


@kernel
def time_to_free(buffer: Buffer, arrival: Any) -> float:
    """Time until the message in transmission has left, beside the arrival period."""
    if buffer.left_bytes == 0:
        return 0.0
    at_rate = 1e6 * buffer.left_bytes
    return at_rate / (at_rate + buffer.short_rate_bytes_per_s * max(buffer.period_us, 1.0))


@kernel
def carried(buffer: Buffer, arrival: Any) -> float:
    """A million times the bytes that the link carries in an arrival period, at the rate over 2 s."""
    return float(buffer.long_rate_bytes_per_s * max(buffer.period_us, 1.0))


@kernel
def size_spread(buffer: Buffer, arrival: Any) -> float:
    """Standard deviation of the natural logarithm of bytes, at most 1."""
    n, newcomer = len(buffer.slots) + 1, math.log(max(arrival.size_bytes, 1))
    total, squares = 0.0, 0.0
    for k in range(n - 1):
        off = math.log(max(buffer.slots[k].size_bytes, 1)) - newcomer
        total += off
        squares += off * off
    return math.sqrt(min(max((squares - total * total / n) / n, 0.0), 1.0))


ON_BOARD_FIELDS = (
    Field("rate_short", "context", "link", "g/(g+r), r = demand",
          "the link's rate, a running mean over about 0.1 s; demand: a message of mean size at each arrival",
          lambda buffer, arrival: squash(buffer.short_rate_bytes_per_s, demand(buffer, arrival))),
    Field("rate_medium", "context", "link", "g/(g+r), r = demand", "the same over about 0.5 s",
          lambda buffer, arrival: squash(buffer.medium_rate_bytes_per_s, demand(buffer, arrival))),
    Field("rate_long", "context", "link", "g/(g+r), r = demand", "the same over about 2 s",
          lambda buffer, arrival: squash(buffer.long_rate_bytes_per_s, demand(buffer, arrival))),
    Field("rate_trend", "context", "link", "g/(g+r), r = rate over 2 s",
          "the link's rate over 0.1 s beside that over 2 s: 0.5 = steady, more = it rises",
          lambda buffer, arrival: squash(buffer.short_rate_bytes_per_s, buffer.long_rate_bytes_per_s)),
    Field("time_to_free", "context", "link", "g/(g+r), r = arrival period",
          "time until the message in transmission has left, at the rate over 0.1 s; 1 where that is 0",
          lambda buffer, arrival: time_to_free(buffer, arrival)),
    Field("newcomer_bytes", "context", "link", "g/(g+r), r = bytes that the link carries in an arrival period",
          "the newcomer's bytes; the link's rate is that over 2 s: 0.5 = just keeps up, 1 = nothing carried yet",
          lambda buffer, arrival: squash(1e6 * arrival.size_bytes, carried(buffer, arrival))),
    Field("size_spread", "context", "queue", "standard deviation, at most 1",
          "spread of the natural logarithm of bytes, over the queued messages and the newcomer: 0 = all alike",
          lambda buffer, arrival: size_spread(buffer, arrival)),
    Field("load", "context", "link", "g/(g+r), r = rate over 2 s", "the bytes that arrive, kept or not, "
          "a running mean over about 8 arrivals: more than 0.5 = the link falls behind",
          lambda buffer, arrival: squash(1e6 * buffer.arrival_bytes, carried(buffer, arrival))),
    Field("remaining", "context", "time", "g/(g+r), r = 10 s",
          "time until the stream ends, as far as the robot was told; 1 where it was not",
          lambda buffer, arrival: squash(float(buffer.remaining_us), 10e6) if buffer.remaining_us < FOREVER else 1.0),
    Field("told", "context", "time", "1 or 0", "whether the robot was told when the stream ends",
          lambda buffer, arrival: 1.0 if buffer.remaining_us < FOREVER else 0.0),
    *PAST_FIELDS,
)  # fmt: skip
"""Context fields, in the order in which ``observe_on_board`` writes them."""
observe_on_board = writer(ON_BOARD_FIELDS, "buffer, arrival")
"""Write every value of ``ON_BOARD_FIELDS`` into ``row``, float[fields]: ``observe_on_board(buffer, arrival, row)``."""
choose_context = chooser(ON_BOARD_FIELDS, "buffer, arrival")
"""Write the fields that have a place: ``choose_context(buffer, arrival, places, row)``."""


@kernel
def index_gaps(buffer: Buffer, arrival: Any, k: int) -> tuple[float, float]:
    """Arrivals since the message kept before slot ``k``, and the gap left if that is dropped; of any topic.

    After the newcomer one more arrival is expected, just as other gaps expect one more step.
    """
    s = len(buffer.slots)
    before = buffer.slots[k - 1].seq if k > 0 else buffer.dequeued_seq
    own = buffer.slots[k].seq if k < s else arrival.seq
    after = arrival.seq + 1
    if k < s:
        after = buffer.slots[k + 1].seq if k + 1 < s else arrival.seq
    return float(max(own - before, 0)), float(max(after - before, 0))


@kernel
def merged_per_byte(buffer: Buffer, arrival: Any, k: int) -> float:
    """The motion gap left if slot ``k`` is dropped, for each of its bytes; the newcomer is ``len(buffer.slots)``."""
    return float(max(gaps(buffer, arrival, True, k)[4], 0.0) / max(bytes_of(buffer, arrival, k), 1))


@kernel
def bytes_of(buffer: Buffer, arrival: Any, k: int) -> int:
    """Bytes of slot ``k`` likewise."""
    return int(arrival.size_bytes if k == len(buffer.slots) else buffer.slots[k].size_bytes)


class WholeQueue(NamedTuple):
    """What the slots of a queue share."""

    even_index: float  # arrivals since the message dequeued last, divided by L + 1
    carried: float  # as ``carried``
    mean_per_byte: float  # mean of ``merged_per_byte`` over the queued messages and the newcomer


@kernel
def queue_of(buffer: Buffer, arrival: Any) -> WholeQueue:
    """Look once at the whole queue."""
    n, per_byte = len(buffer.slots) + 1, 0.0
    for k in range(n):
        per_byte += merged_per_byte(buffer, arrival, k)
    even_index = float(max(arrival.seq - buffer.dequeued_seq, 0) / (buffer.capacity + 1))
    return WholeQueue(even_index, carried(buffer, arrival), per_byte / n)


ON_BOARD_SLOT_FIELDS = (
    Field("index_before", "slot", "queue", "g/(g+r), r = even spacing in messages",
          "messages that arrived since the message kept before it, itself included",
          lambda buffer, arrival, k, queue: squash(index_gaps(buffer, arrival, k)[0], queue.even_index)),
    Field("index_merged", "slot", "queue", "g/(g+r), r = 2 x even spacing in messages",
          "gap in messages left if it is dropped",
          lambda buffer, arrival, k, queue: squash(index_gaps(buffer, arrival, k)[1], 2 * queue.even_index)),
    Field("bytes_in_period", "slot", "link", "g/(g+r), r = bytes that the link carries in an arrival period",
          "its bytes; the link's rate is that over 2 s",
          lambda buffer, arrival, k, queue: squash(1e6 * bytes_of(buffer, arrival, k), queue.carried)),
    Field("gap_per_byte", "slot", "motion", "g/(g+r), r = mean of the queue",
          "motion gap left if it is dropped, for each of its bytes",
          lambda buffer, arrival, k, queue: squash(merged_per_byte(buffer, arrival, k), queue.mean_per_byte)),
)  # fmt: skip
"""Slot fields, in the order in which ``observe_on_board_slots`` writes them."""
_write_slot = writer(ON_BOARD_SLOT_FIELDS, "buffer, arrival, k, queue")
_choose_slot = chooser(ON_BOARD_SLOT_FIELDS, "buffer, arrival, k, queue")


@kernel
def observe_on_board_slots(buffer: Buffer, arrival: Any, rows: NDArray[np.floating[Any]]) -> None:
    """Write every value of ``ON_BOARD_SLOT_FIELDS`` into ``rows`` (float[fields, L + 1]); the newcomer is last."""
    s, last = len(buffer.slots), buffer.capacity
    queue = queue_of(buffer, arrival)
    for f in range(len(rows)):
        rows[f, s:last] = 0.0
    for k in range(s + 1):
        _write_slot(buffer, arrival, k, queue, k if k < s else last, rows)


@kernel
def choose_on_board_slots(
    buffer: Buffer, arrival: Any, arriving: bool, places: NDArray[np.int64], row: NDArray[np.floating[Any]]
) -> None:
    """Write the ON_BOARD_SLOT_FIELDS that have a place, as ``chooser`` has it.

    Where the socket asks (not ``arriving``), ``arrival`` is the latest one and has no column.
    """
    s, last = len(buffer.slots), buffer.capacity
    queue = queue_of(buffer, arrival)
    clear(places, s, last + 1, row)
    for k in range(s + 1 if arriving else s):
        _choose_slot(buffer, arrival, k, queue, k if k < s else last, places, row)
