"""The worth of a queued message where bytes cost: the best chain through the queue with it, and without it.

A chain leads from the message dequeued last through some of the queued messages, and perhaps the newcomer, to an end
behind them. A step from message i to message j is worth

    V(x_j - x_i) - price x bytes of j

and the step to the end, which costs nothing, V(x_end - x_i). The *advantage* of dropping k is the best chain without k
less the best chain through k, by one pass from the end and one from the begin. A step skips < ``SPAN`` messages.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, unchecked_item
from bufgym.model.buffer import Buffer
from bufgym.model.qoi import value

SPAN = 24  # Messages that a step leads on, at most
COLUMNS = 3 + SPAN
"""Numbers of scratch for each place of a chain: the best chain from it, to it and without it, then its steps."""
FROM, TO, WITHOUT = range(3)
STEPS = 3
SCRATCH = (2 * COLUMNS, COLUMNS)
"""``Policy.work`` of a rule that weighs chains: a place for each candidate, the message dequeued last, and the end."""


@kernel
def weigh(buffer: Buffer, arrival: Any, price: float, end_x: float, scratch: NDArray[np.float64]) -> None:
    """Fill ``scratch`` for ``advantage``, at a ``price`` of QoI per byte."""
    s = len(buffer.slots)
    end = s + 2
    scratch[end * COLUMNS + FROM] = 0.0
    for i in range(end - 1, -1, -1):
        from_x = x_of(buffer, arrival, i, end_x)
        best = -np.inf
        for j in range(i + 1, min(i + SPAN, end) + 1):
            step = value(buffer.v, x_of(buffer, arrival, j, end_x) - from_x) - price * bytes_of(buffer, arrival, j)
            scratch[i * COLUMNS + STEPS + j - i - 1] = step
            best = max(best, step + scratch[j * COLUMNS + FROM])
        scratch[i * COLUMNS + FROM] = best
        scratch[i * COLUMNS + TO] = scratch[i * COLUMNS + WITHOUT] = -np.inf
    scratch[TO] = 0.0
    for i in range(end):
        so_far, around = scratch[i * COLUMNS + TO], -np.inf
        for j in range(min(i + SPAN, end), i, -1):
            reached = so_far + scratch[i * COLUMNS + STEPS + j - i - 1]
            if j < end:
                scratch[j * COLUMNS + TO] = max(scratch[j * COLUMNS + TO], reached)
                scratch[j * COLUMNS + WITHOUT] = max(scratch[j * COLUMNS + WITHOUT], around)
            around = max(around, reached + scratch[j * COLUMNS + FROM])


@kernel
def advantage(scratch: NDArray[np.float64], k: int) -> float:
    """The advantage of dropping slot ``k``, or the newcomer, slot s, in QoI."""
    i = (k + 1) * COLUMNS
    return float(scratch[i + WITHOUT] - scratch[i + TO] - scratch[i + FROM])


@kernel
def x_of(buffer: Buffer, arrival: Any, i: int, end_x: float) -> float:
    """The coordinate of place ``i`` of a chain."""
    if i == 0:
        return buffer.dequeued_x
    s = len(buffer.slots)
    if i <= s:
        return float(unchecked_item(buffer.slots, i - 1).x)
    return float(arrival.x) if i == s + 1 else end_x


@kernel
def bytes_of(buffer: Buffer, arrival: Any, i: int) -> int:
    """The bytes of place ``i`` > 0 of a chain; the end has none."""
    s = len(buffer.slots)
    if i <= s:
        return int(unchecked_item(buffer.slots, i - 1).size_bytes)
    return int(arrival.size_bytes) if i == s + 1 else 0
