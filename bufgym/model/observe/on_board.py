"""Built-in fields outside the tables, computed if an environment's ``fields`` or a learned policy names them.

They describe the link's rate as the robot's own socket shows it, bytes beside what the link carries, and each slot's
gaps counted in messages or per byte.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import kernel
from bufgym.ground.modules import first_line
from bufgym.model.buffer import Buffer, gaps
from bufgym.model.link import FOREVER
from bufgym.model.observe.declare import Field, Function, declare, divide_row, squash, writer  # noqa: F401 (in generated lines)
from bufgym.model.observe.own import OWN_FIELDS, OwnField

ON_BOARD_FIELDS: list[OwnField] = []
"""Context fields, in the order in which ``observe_on_board`` writes them."""
ON_BOARD_SLOT_FIELDS: list[OwnField] = []
"""Slot fields, in the order in which ``observe_on_board_slots`` writes them."""
_LENGTHS: list[Field] = []
"""The slot fields before they are divided by their means."""


def _context(group: str, unit: str) -> Callable[[Function], Function]:
    """Register the decorated function as a context field of its own name; it comes back as a kernel."""

    def add(function: Function) -> Function:
        name, meaning = function.__name__, first_line(function)
        OWN_FIELDS[name] = OwnField(name, "context", group, unit, meaning, function=function, compile=True)
        ON_BOARD_FIELDS.append(OWN_FIELDS[name])
        return kernel(function)

    return add


def _slot(group: str, unit: str, mean: Function) -> Callable[[Function], Function]:
    """Register the decorated function, which gives a slot's length g, as the field g / (g + r) of its own name.

    ``mean`` gives r, which is computed once for all slots.
    """

    def add(function: Function) -> Function:
        length = declare(_LENGTHS, "slot", group, unit, mean=f"{mean.__name__}(buffer, arrival)")(function)

        def squashed(buffer: Buffer, arrival: Any, k: int) -> float:
            return squash(length(buffer, arrival, k), mean(buffer, arrival))

        name, meaning = function.__name__, first_line(function)
        OWN_FIELDS[name] = OwnField(name, "slot", group, unit, meaning, function=squashed, compile=True)
        ON_BOARD_SLOT_FIELDS.append(OWN_FIELDS[name])
        return length

    return add


# --- the link --------------------------------------------------------------------------------------------------------


@kernel
def mean_bytes(buffer: Buffer, arrival: Any) -> float:
    """Mean size of the queued messages and the newcomer."""
    return float((buffer.backlog_bytes + arrival.size_bytes) / (len(buffer.slots) + 1))


@kernel
def demand(buffer: Buffer, arrival: Any) -> float:
    """Rate that the robot would like to send at, bytes/s: a message of mean size at each arrival."""
    return 1e6 * mean_bytes(buffer, arrival) / max(buffer.period_us, 1.0)


@_context("link", "g/(g+r), r = demand")
def rate_short(buffer: Buffer, arrival: Any) -> float:
    "the link's rate, a running mean over about 0.1 s; demand: a message of mean size at each arrival"
    return squash(buffer.short_rate_bytes_per_s, demand(buffer, arrival))


@_context("link", "g/(g+r), r = demand")
def rate_medium(buffer: Buffer, arrival: Any) -> float:
    "the same over about 0.5 s"
    return squash(buffer.medium_rate_bytes_per_s, demand(buffer, arrival))


@_context("link", "g/(g+r), r = demand")
def rate_long(buffer: Buffer, arrival: Any) -> float:
    "the same over about 2 s"
    return squash(buffer.long_rate_bytes_per_s, demand(buffer, arrival))


@_context("link", "g/(g+r), r = rate over 2 s")
def rate_trend(buffer: Buffer, arrival: Any) -> float:
    "the link's rate over 0.1 s beside that over 2 s: 0.5 = steady, more = it rises"
    return squash(buffer.short_rate_bytes_per_s, buffer.long_rate_bytes_per_s)


@_context("link", "g/(g+r), r = arrival period")
def time_to_free(buffer: Buffer, arrival: Any) -> float:
    "time until the message in transmission has left, at the rate over 0.1 s; 1 where that is 0"
    if buffer.left_bytes == 0:
        return 0.0
    at_rate = 1e6 * buffer.left_bytes
    return at_rate / (at_rate + buffer.short_rate_bytes_per_s * max(buffer.period_us, 1.0))


@kernel
def carried(buffer: Buffer, arrival: Any) -> float:
    """A million times the bytes that the link carries in an arrival period, at the rate over 2 s."""
    return float(buffer.long_rate_bytes_per_s * max(buffer.period_us, 1.0))


@_context("link", "g/(g+r), r = bytes that the link carries in an arrival period")
def newcomer_bytes(buffer: Buffer, arrival: Any) -> float:
    "the newcomer's bytes; the link's rate is that over 2 s: 0.5 = just keeps up, 1 = nothing carried yet"
    return squash(1e6 * arrival.size_bytes, carried(buffer, arrival))


@_context("queue", "standard deviation, at most 1")
def size_spread(buffer: Buffer, arrival: Any) -> float:
    "spread of the natural logarithm of bytes, over the queued messages and the newcomer: 0 = all alike"
    n, newcomer = len(buffer.slots) + 1, math.log(max(arrival.size_bytes, 1))
    total, squares = 0.0, 0.0
    for k in range(n - 1):
        off = math.log(max(buffer.slots[k].size_bytes, 1)) - newcomer
        total += off
        squares += off * off
    return math.sqrt(min(max((squares - total * total / n) / n, 0.0), 1.0))


@_context("link", "g/(g+r), r = rate over 2 s")
def load(buffer: Buffer, arrival: Any) -> float:
    "the bytes that arrive, kept or not, a running mean over about 8 arrivals: more than 0.5 = the link falls behind"
    return squash(1e6 * buffer.arrival_bytes, carried(buffer, arrival))


@_context("time", "g/(g+r), r = 10 s")
def remaining(buffer: Buffer, arrival: Any) -> float:
    "time until the stream ends, as far as the robot was told; 1 where it was not"
    return squash(float(buffer.remaining_us), 10e6) if buffer.remaining_us < FOREVER else 1.0


# --- each slot -------------------------------------------------------------------------------------------------------


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
def two_even_index_gaps(buffer: Buffer, arrival: Any) -> float:
    """Twice the even spacing."""
    return 2 * even_index_gap(buffer, arrival)


@_slot("queue", "g/(g+r), r = even spacing in messages", even_index_gap)
def index_before(buffer: Buffer, arrival: Any, k: int) -> float:
    "messages that arrived since the message kept before it, itself included"
    return index_gaps(buffer, arrival, k)[0]


@_slot("queue", "g/(g+r), r = 2 x even spacing in messages", two_even_index_gaps)
def index_merged(buffer: Buffer, arrival: Any, k: int) -> float:
    "gap in messages left if it is dropped"
    return index_gaps(buffer, arrival, k)[1]


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


@_slot("link", "g/(g+r), r = bytes that the link carries in an arrival period", carried)
def bytes_in_period(buffer: Buffer, arrival: Any, k: int) -> float:
    "its bytes; the link's rate is that over 2 s"
    return 1e6 * bytes_of(buffer, arrival, k)


@_slot("motion", "g/(g+r), r = mean of the queue", mean_per_byte)
def gap_per_byte(buffer: Buffer, arrival: Any, k: int) -> float:
    "motion gap left if it is dropped, for each of its bytes"
    return merged_per_byte(buffer, arrival, k)


# --- the kernels -----------------------------------------------------------------------------------------------------

observe_on_board = writer(globals(), ON_BOARD_FIELDS, "buffer, arrival, context", "context[{i}] = {f}(buffer, arrival)")
"""Write every value of ``ON_BOARD_FIELDS`` into ``context`` (float[fields])."""
_OF_SLOT, _LENGTH = "buffer, arrival, k, column, rows", "rows[{i}, column] = {f}(buffer, arrival, k)"
_write = writer(globals(), _LENGTHS, _OF_SLOT, _LENGTH)
_divide = writer(globals(), _LENGTHS, "buffer, arrival, rows", "divide_row(rows[{i}], {r})")


@kernel
def observe_on_board_slots(buffer: Buffer, arrival: Any, rows: NDArray[np.floating[Any]]) -> None:
    """Write every value of ``ON_BOARD_SLOT_FIELDS`` into ``rows`` (float[fields, L + 1]); the newcomer is last."""
    s, last = len(buffer.slots), buffer.capacity
    rows[:, s:last] = 0.0
    for k in range(s + 1):
        _write(buffer, arrival, k, k if k < s else last, rows)
    _divide(buffer, arrival, rows)
