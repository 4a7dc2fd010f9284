"""The dynamic programme for messages of unequal sizes, with prices on room in the queue.

With unequal sizes the room left at an arrival depends on which messages wait, which a label (end, gain) cannot carry.
So room gets a price (Lagrangian relaxation: Fisher, Management Science 27(1), 1981). A message that waits while message
i arrives pays ``price_i``; in return every plan receives L x the sum of all prices. For any prices >= 0

    max over all plans of  gain + sum over i of price_i (L - messages queued after arrival i)

is an upper bound of the best plan's gain: a plan that keeps to L loses nothing by it. What message j pays depends only
on the byte at which it begins, as it waits during the arrivals j, j + 1, ... whose byte lies before that one. So a
programme over (message, end) finds the maximum. Under a byte limit B the bytes that wait are priced likewise.

As in ``labels``, leaving a message out while the link is idle is never worth it; here that is used only where the
message finds room whichever messages wait (``idle``).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.kernel import kernel
from bufgym.model.qoi import value


class Problem(NamedTuple):
    """One episode as the kernels read it; arrays over messages."""

    c: NDArray[np.int64]
    """Bytes that the link can have carried when the message arrives."""
    size: NDArray[np.int64]
    limit: NDArray[np.int64]
    """Bytes that it can wait for at most, or labels.NEVER."""
    x: NDArray[np.float64]
    v: NDArray[np.float64]
    ends: int
    """The link's last byte."""
    between: NDArray[np.int64]
    """The last message before it that could have been transmitted before it arrives; -1: none."""
    idle: NDArray[np.int64]
    """After a message before ``between`` that ends by this byte, ``between`` finds room and is transmitted in time."""
    capacity: int
    """L, messages."""
    max_bytes: int
    """B, bytes."""


class Programme(NamedTuple):
    """The programme on a grid of byte positions, under certain prices."""

    grid: int
    """Bytes to a grid step."""
    price: NDArray[np.float64]
    """[2, steps]: sum of the prices of all arrivals before this grid position; of a message, and of a byte."""
    before: NDArray[np.float64]
    """[2, messages + 1]: the same sum over the arrivals before each message."""
    future: NDArray[np.float64]
    """[messages, steps]: no plan gains more after message i, if that ends at byte (c_i // grid + k) * grid or later."""


@kernel
def waiting_cost(p: Problem, d: Programme, j: int, step: int) -> float:
    """What message j pays for waiting until it begins at this grid step."""
    message, byte = d.price[0, step] - d.before[0, j], d.price[1, step] - d.before[1, j]
    return float(max(0.0, message) + p.size[j] * max(0.0, byte))


@kernel
def ends_too_early(p: Problem, i: int, e: int, j: int) -> bool:
    """Whether another message is worth sending between message i, which ends at byte e, and message j."""
    return bool(p.between[j] > i and e <= p.idle[j])


@kernel
def find_future(p: Problem, d: Programme) -> None:
    """Fill ``future``, from the last message back."""
    n, steps = d.future.shape
    for i in range(n - 1, -1, -1):
        d.future[i, :] = 0.0
        if p.limit[i] < 0:
            continue
        step_i, reach = p.c[i] // d.grid, p.c[i] + p.limit[i] + p.size[i]
        top = min(steps, reach // d.grid - step_i + 1)
        for j in range(i + 1, n):
            low = 0
            if p.between[j] > i:
                if p.idle[j] >= reach:
                    break  # every further message as well would be preceded by ``between``
                low = max(0, p.idle[j] // d.grid - step_i)
            if p.limit[j] < 0 or p.c[j] + p.size[j] > p.ends:
                continue
            added = value(p.v, p.x[j] - p.x[i])
            # Ends before c_j: the link is idle, and j begins when it arrives.
            split = -(-p.c[j] // d.grid) - step_i
            w = added + d.future[j, (p.c[j] + p.size[j]) // d.grid - p.c[j] // d.grid]
            for k in range(low, min(split, top)):
                d.future[i, k] = max(d.future[i, k], w)
            # Later ends: j waits and begins there.
            last = min(p.c[j] + p.limit[j], p.ends - p.size[j]) // d.grid - step_i
            shift = step_i + p.size[j] // d.grid - p.c[j] // d.grid
            for k in range(max(low, split), min(top, last + 1)):
                w = added - waiting_cost(p, d, j, step_i + k) + d.future[j, k + shift]
                d.future[i, k] = max(d.future[i, k], w)


@kernel
def follow(p: Problem, d: Programme, message: NDArray[np.int64], begin: NDArray[np.int64]) -> tuple[int, float]:
    """(length, gain less prices) of the programme's own best plan, which need not keep to the room.

    ``message`` and ``begin``, the byte at which each begins: int64[messages], filled up to the length.
    """
    n, length, i, step, total = len(p.c), 0, -1, 0, 0.0
    while True:
        best, chosen, s = 0.0, -1, 0
        for j in range(i + 1, n):
            if i >= 0 and p.between[j] > i:
                if p.idle[j] >= p.c[i] + p.limit[i] + p.size[i]:
                    break
                if step < p.idle[j] // d.grid:
                    continue
            if p.limit[j] < 0 or p.c[j] + p.size[j] > p.ends:
                continue
            begins, w = p.c[j], 0.0
            if step < -(-p.c[j] // d.grid):
                w = d.future[j, (p.c[j] + p.size[j]) // d.grid - p.c[j] // d.grid]
            elif step <= min(p.c[j] + p.limit[j], p.ends - p.size[j]) // d.grid:
                begins = step * d.grid
                w = d.future[j, step + p.size[j] // d.grid - p.c[j] // d.grid] - waiting_cost(p, d, j, step)
            else:
                continue
            if i >= 0:
                w += value(p.v, p.x[j] - p.x[i])
            if w > best or (i < 0 and chosen < 0):
                best, chosen, s = w, j, begins
        if i < 0:
            total = best
        if chosen < 0:
            return length, total
        message[length], begin[length] = chosen, s
        length += 1
        # Ends are rounded down, as in ``future``.
        waited = step >= -(-p.c[chosen] // d.grid)
        step = step + p.size[chosen] // d.grid if waited else (p.c[chosen] + p.size[chosen]) // d.grid
        i = chosen


@kernel
def count_queued(
    p: Problem, message: NDArray[np.int64], begin: NDArray[np.int64], length: int, queued: NDArray[np.float64]
) -> None:
    """``queued``, float64[2, messages]: messages, and bytes, that this plan has in the queue after each arrival."""
    queued[:, :] = 0.0
    for k in range(length):
        j = message[k]
        while j < len(p.c) and p.c[j] < begin[k]:
            queued[0, j] += 1.0
            queued[1, j] += p.size[message[k]]
            j += 1
