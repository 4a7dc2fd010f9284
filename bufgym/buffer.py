"""The bounded buffer of one sender, as a row of an array: push, pop the head, evict a slot.

A row of ``slots`` holds, in order, the message that the socket took last (in transmission or already delivered) and
then the queued ones. The head sits at ``first``; so ``slots[first - 1]`` is what the head's information is measured
against, and popping the head moves nothing. Slot 0 is the oldest queued message (DESIGN: slot, head, tail).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.errors import BufgymError
from bufgym.kernel import kernel
from bufgym.qoi import merging_loss, value

MESSAGE = np.dtype(
    [
        ("seq", np.int64),  # position in the episode's list of arrivals
        ("arrival_us", np.int64),  # when it reached the sender
        ("size_bytes", np.int64),
        ("topic", np.int64),
        ("x", np.float64),  # coordinate: how far the scene has moved on (frame index or motion)
        ("luck", np.float64),  # uniform in [0, 1): a randomised policy's own draw for this arrival
        ("gain", np.float64),  # V(x - x of the message kept before it): what its delivery adds
    ],
    align=True,
)

# A policy's decision is the slot to evict for the newcomer (0 = oldest), or one of these.
REJECT, ACCEPT = -1, -2

UNLIMITED_BYTES = 2**62
MAX_CAPACITY = 10**6


def check_limits(capacity: int, max_bytes: int | None) -> None:
    """An error unless these can be L, messages, and B, bytes (None for no limit)."""
    if isinstance(capacity, bool) or not isinstance(capacity, int | np.integer) or not 1 <= capacity <= MAX_CAPACITY:
        raise BufgymError(f"capacity = {capacity!r}: L must be a whole number from 1 to {MAX_CAPACITY}")
    if max_bytes is not None and not (isinstance(max_bytes, int | np.integer) and 1 <= max_bytes < UNLIMITED_BYTES):
        raise BufgymError(f"max_bytes = {max_bytes!r}: B must be a whole number >= 1, or None for no limit")


class Buffer(NamedTuple):
    """All that a policy may see: what the robot has on board when a message arrives. No field of it is to be written.

    Whatever is written here is known without feedback from the server and without measuring the link's bandwidth.
    """

    slots: NDArray[Any]
    """MESSAGE[occupancy]: the queued messages, 0 = oldest. Not the one in transmission: it can't be dropped."""
    capacity: int
    """L, messages."""
    max_bytes: int
    """B, bytes; UNLIMITED_BYTES where only L counts."""
    backlog_bytes: int
    """Bytes queued."""
    now_us: int
    """The robot's clock, us."""
    taken: int
    """How many messages the socket has taken so far (delivered, or in transmission)."""
    taken_us: int
    """Arrival time of the message that the socket took last, us; that of the previous arrival while there was none."""
    taken_x: float
    """Coordinate of the message that the socket took last."""
    previous_us: int
    """Arrival time of the arrival before this one, kept or not, us."""
    previous_x: float
    """Coordinate of the arrival before this one, kept or not."""
    busy: int
    """1 while a message is in transmission, else 0."""
    left_bytes: int
    """Bytes of the message in transmission that have not crossed yet."""
    left_fraction: float
    """The same as a fraction of that message, in [0, 1]."""
    stalled_us: int
    """Time since the socket last took a message, us."""
    period_us: float
    """Running mean of the time between arrivals, us."""
    departures: int
    """Messages the socket has taken since the arrival before this one."""
    drain: float
    """Running mean of departures per arrival: 1 = the link keeps up, 0 = it stands still."""
    v: NDArray[np.float64]
    """The value function, for ``qoi.value(buffer.v, distance)``."""


@kernel
def push(slots: NDArray[Any], i: int, first: int, occupancy: int, arrival: Any) -> int:
    """Put ``arrival`` behind the tail of row ``i``; return the head's index, which moves when the row is packed."""
    if first + occupancy == slots.shape[1]:
        for k in range(occupancy + 1):
            slots[i, k] = slots[i, first - 1 + k]
        first = 1
    slots[i, first + occupancy] = arrival
    return first


@kernel
def evict(slots: NDArray[Any], i: int, first: int, occupancy: int, k: int) -> int:
    """Take slot ``k`` out of row ``i``, closing the gap from its shorter side; return the head's index."""
    if 2 * k < occupancy:
        for j in range(first + k, first - 1, -1):
            slots[i, j] = slots[i, j - 1]
        return first + 1
    for j in range(first + k, first + occupancy - 1):
        slots[i, j] = slots[i, j + 1]
    return first


def row_width(capacity: int) -> int:
    """Columns of ``slots`` for L = ``capacity``: the message taken last, L queued, L more to pop without moving."""
    return 1 + 2 * capacity


@kernel
def time_gaps(buffer: Buffer, arrival: Any, k: int) -> tuple[int, int]:
    """Time from slot ``k`` back to the message kept before it and on to the one kept after it, us.

    The newcomer is slot ``len(buffer.slots)``. What follows it has not come yet: one more step like the last is
    expected, so its second gap is the time since the previous arrival.
    """
    s = len(buffer.slots)
    here = arrival.arrival_us if k == s else buffer.slots[k].arrival_us
    before = buffer.taken_us if k == 0 else buffer.slots[k - 1].arrival_us
    if k == s:
        after = arrival.arrival_us + (arrival.arrival_us - buffer.previous_us)
    elif k == s - 1:
        after = arrival.arrival_us
    else:
        after = buffer.slots[k + 1].arrival_us
    return here - before, after - here


@kernel
def motion_gaps(buffer: Buffer, arrival: Any, k: int) -> tuple[float, float]:
    """The same as ``time_gaps`` in the coordinate x: what the scene moved before slot ``k`` and after it."""
    s = len(buffer.slots)
    here = arrival.x if k == s else buffer.slots[k].x
    before = buffer.taken_x if k == 0 else buffer.slots[k - 1].x
    if k == s:
        after = arrival.x + (arrival.x - buffer.previous_x)
    elif k == s - 1:
        after = arrival.x
    else:
        after = buffer.slots[k + 1].x
    return here - before, after - here


@kernel
def arrival_gain(buffer: Buffer, arrival: Any) -> float:
    """V of the newcomer's gap to the message kept before it: what accepting it adds. 0 for the very first message."""
    if len(buffer.slots) > 0:
        return value(buffer.v, arrival.x - buffer.slots[len(buffer.slots) - 1].x)
    return value(buffer.v, arrival.x - buffer.taken_x) if buffer.taken > 0 else 0.0


@kernel
def loss(buffer: Buffer, arrival: Any, k: int) -> float:
    """QoI lost if slot ``k`` went and nothing else: V(a) + V(b) - V(a + b) for its gaps a, b; >= 0 as V is concave."""
    a, b = motion_gaps(buffer, arrival, k)
    return merging_loss(buffer.v, a, value(buffer.v, a), b, value(buffer.v, b))
