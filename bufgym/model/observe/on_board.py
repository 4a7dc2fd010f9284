"""Built-in fields outside the tables, computed if an environment's ``fields`` or a learned policy names them.

They describe the link's rate as the robot's own socket shows it, bytes beside what the link carries, and each slot's
gaps counted in messages or per byte.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import kernel
from bufgym.model.buffer import Buffer, gaps
from bufgym.model.link import FOREVER  # noqa: F401 (in generated lines)
from bufgym.model.observe.declare import Field, divide_row, made, squash, writer  # noqa: F401 (in generated lines)
from bufgym.model.observe.own import OWN_FIELDS, OwnField


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
def even_index_gap(buffer: Buffer, arrival: Any) -> float:
    """Arrivals since the message dequeued last, divided by L + 1."""
    return float(max(arrival.seq - buffer.dequeued_seq, 0) / (buffer.capacity + 1))


@kernel
def bytes_of(buffer: Buffer, arrival: Any, k: int) -> int:
    """Bytes of slot ``k``; the newcomer is ``len(buffer.slots)``."""
    return int(arrival.size_bytes if k == len(buffer.slots) else buffer.slots[k].size_bytes)


@kernel
def merged_per_byte(buffer: Buffer, arrival: Any, k: int) -> float:
    """The motion gap left if slot ``k`` is dropped, for each of its bytes."""
    return float(max(gaps(buffer, arrival, True, k)[4], 0.0) / max(bytes_of(buffer, arrival, k), 1))


@kernel
def mean_per_byte(buffer: Buffer, arrival: Any) -> float:
    """The mean of ``merged_per_byte`` over the queued messages and the newcomer."""
    total = 0.0
    for k in range(len(buffer.slots) + 1):
        total += merged_per_byte(buffer, arrival, k)
    return total / (len(buffer.slots) + 1)


_CONTEXT = (
    Field("rate_short", "context", "link", "g/(g+r), r = demand",
          "the link's rate, a running mean over about 0.1 s; demand: a message of mean size at each arrival",
          number="squash(buffer.short_rate_bytes_per_s, demand(buffer, arrival))"),
    Field("rate_medium", "context", "link", "g/(g+r), r = demand", "the same over about 0.5 s",
          number="squash(buffer.medium_rate_bytes_per_s, demand(buffer, arrival))"),
    Field("rate_long", "context", "link", "g/(g+r), r = demand", "the same over about 2 s",
          number="squash(buffer.long_rate_bytes_per_s, demand(buffer, arrival))"),
    Field("rate_trend", "context", "link", "g/(g+r), r = rate over 2 s",
          "the link's rate over 0.1 s beside that over 2 s: 0.5 = steady, more = it rises",
          number="squash(buffer.short_rate_bytes_per_s, buffer.long_rate_bytes_per_s)"),
    Field("time_to_free", "context", "link", "g/(g+r), r = arrival period",
          "time until the message in transmission has left, at the rate over 0.1 s; 1 where that is 0",
          number="time_to_free(buffer, arrival)"),
    Field("newcomer_bytes", "context", "link", "g/(g+r), r = bytes that the link carries in an arrival period",
          "the newcomer's bytes; the link's rate is that over 2 s: 0.5 = just keeps up, 1 = nothing carried yet",
          number="squash(1e6 * arrival.size_bytes, carried(buffer, arrival))"),
    Field("size_spread", "context", "queue", "standard deviation, at most 1",
          "spread of the natural logarithm of bytes, over the queued messages and the newcomer: 0 = all alike",
          number="size_spread(buffer, arrival)"),
    Field("load", "context", "link", "g/(g+r), r = rate over 2 s", "the bytes that arrive, kept or not, "
          "a running mean over about 8 arrivals: more than 0.5 = the link falls behind",
          number="squash(1e6 * buffer.arrival_bytes, carried(buffer, arrival))"),
    Field("remaining", "context", "time", "g/(g+r), r = 10 s",
          "time until the stream ends, as far as the robot was told; 1 where it was not",
          number="squash(float(buffer.remaining_us), 10e6) if buffer.remaining_us < FOREVER else 1.0"),
)  # fmt: skip
_SLOTS = (
    Field("index_before", "slot", "queue", "g/(g+r), r = even spacing in messages",
          "messages that arrived since the message kept before it, itself included",
          number="index_gaps(buffer, arrival, k)[0]", mean="even_index_gap(buffer, arrival)"),
    Field("index_merged", "slot", "queue", "g/(g+r), r = 2 x even spacing in messages",
          "gap in messages left if it is dropped",
          number="index_gaps(buffer, arrival, k)[1]", mean="2 * even_index_gap(buffer, arrival)"),
    Field("bytes_in_period", "slot", "link", "g/(g+r), r = bytes that the link carries in an arrival period",
          "its bytes; the link's rate is that over 2 s",
          number="1e6 * bytes_of(buffer, arrival, k)", mean="carried(buffer, arrival)"),
    Field("gap_per_byte", "slot", "motion", "g/(g+r), r = mean of the queue",
          "motion gap left if it is dropped, for each of its bytes",
          number="merged_per_byte(buffer, arrival, k)", mean="mean_per_byte(buffer, arrival)"),
)  # fmt: skip


def _registered(field: Field, arguments: str, number: str) -> OwnField:
    function = made(globals(), arguments, f"return {number}")
    OWN_FIELDS[field.name] = OwnField(**vars(field), function=function, compile=True)
    return OWN_FIELDS[field.name]


ON_BOARD_FIELDS = [_registered(field, "buffer, arrival", field.number) for field in _CONTEXT]
"""Context fields, in the order in which ``observe_on_board`` writes them."""
ON_BOARD_SLOT_FIELDS = [
    _registered(field, "buffer, arrival, k", f"squash({field.number}, {field.mean})") for field in _SLOTS
]
"""Slot fields, in the order in which ``observe_on_board_slots`` writes them."""
observe_on_board = writer(globals(), _CONTEXT, "buffer, arrival, context", "context[{i}] = {n}")
"""Write every value of ``ON_BOARD_FIELDS`` into ``context`` (float[fields])."""
_write = writer(globals(), _SLOTS, "buffer, arrival, k, column, rows", "rows[{i}, column] = {n}")
# A mean is computed once for all slots.
_divide = writer(globals(), _SLOTS, "buffer, arrival, rows", "divide_row(rows[{i}], {r})")


@kernel
def observe_on_board_slots(buffer: Buffer, arrival: Any, rows: NDArray[np.floating[Any]]) -> None:
    """Write every value of ``ON_BOARD_SLOT_FIELDS`` into ``rows`` (float[fields, L + 1]); the newcomer is last."""
    s, last = len(buffer.slots), buffer.capacity
    rows[:, s:last] = 0.0
    for k in range(s + 1):
        _write(buffer, arrival, k, k if k < s else last, rows)
    _divide(buffer, arrival, rows)
