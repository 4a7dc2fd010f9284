"""The dynamic programme over (message, end) behind the clairvoyant: gains still possible, on a grid of bytes.

``labels`` takes its bounds from it for equal sizes, ``unequal`` its prices and its bound for others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import kernel
from bufgym.model.qoi import value

NEVER = -1
"""A limit that leaves no room for the message."""

MAX_CELLS = 1 << 23
"""Most entries of ``future``, 8 bytes each; longer episodes take a coarser grid."""


class Problem(NamedTuple):
    """One episode as the kernels read it; arrays over messages.

    Fields:
        c: int64, bytes that the link can have carried when the message arrives.
        size: int64, bytes of the message.
        limit: int64, bytes that may still have to pass before it when it arrives, at most; or NEVER.
        x: float64, coordinate of the message.
        v: ``Value.array``.
        ends: the link's last byte.
        between: int64, the last message before it that could have been sent before it arrives; -1: none.
        idle: int64, after a message before ``between`` that ends by this byte, ``between`` could be sent in time.
        grid: bytes to a grid step.
        future: float64[messages, steps], no plan gains more after message i, if that ends at byte
            (c_i // grid + k) * grid or later.
    """

    c: NDArray[np.int64]
    size: NDArray[np.int64]
    limit: NDArray[np.int64]
    x: NDArray[np.float64]
    v: NDArray[np.float64]
    ends: int
    between: NDArray[np.int64]
    idle: NDArray[np.int64]
    grid: int
    future: NDArray[np.float64]


class Room(NamedTuple):
    """Room in the queue, and the price that a message pays for waiting in it (see ``unequal``).

    Fields:
        capacity: L, messages.
        max_bytes: B, bytes.
        until: float64[2, steps], sum of the prices of all arrivals before this grid position; of a message, of a byte.
        before: float64[2, messages + 1], the same sum over the arrivals before each message.
    """

    capacity: int
    max_bytes: int
    until: NDArray[np.float64]
    before: NDArray[np.float64]


def new_problem(
    c: NDArray[np.int64],
    size: NDArray[np.int64],
    limit: NDArray[np.int64],
    certain: NDArray[np.int64],
    x: NDArray[np.float64],
    v: NDArray[np.float64],
    ends: int,
    steps: int,
) -> Problem:
    """Set up one episode on a grid of ``steps`` to a mean message, or fewer (``MAX_CELLS``); ``future`` is 0.

    A message that waits for at most ``certain`` bytes finds room, whichever messages wait.
    """
    n, furthest = len(c), max(0, int((limit + size).max()))
    grid = max(1, int(size.mean()) // steps, furthest * n // MAX_CELLS)
    between, idle = np.empty((2, n), np.int64)
    find_idle(c, size, limit, certain, between, idle)
    return Problem(c, size, limit, x, v, ends, between, idle, grid, np.zeros((n, furthest // grid + 2)))


@kernel
def find_idle(
    c: NDArray[np.int64],
    size: NDArray[np.int64],
    limit: NDArray[np.int64],
    certain: NDArray[np.int64],
    between: NDArray[np.int64],
    idle: NDArray[np.int64],
) -> None:
    """Fill ``between`` and ``idle`` (see ``Problem``); ``certain`` as in ``new_problem``."""
    for i in range(len(c)):
        m = i - 1
        while m >= 0 and (limit[m] < 0 or c[m] + size[m] > c[i]):
            m -= 1
        between[i] = m
        idle[i] = min(c[i] - size[m], c[m] + certain[m]) if m >= 0 else -1


@kernel
def waiting_cost(p: Problem, room: Room, j: int, step: int) -> float:
    """Price that message j pays for waiting until it begins at this grid step."""
    message = room.until[0, step] - room.before[0, j]
    byte = room.until[1, step] - room.before[1, j]
    return float(max(0.0, message) + p.size[j] * max(0.0, byte))


@kernel
def find_future(p: Problem, room: Room | None) -> None:
    """Fill ``future`` (zeros so far) from the last message back; waiting costs the prices of ``room``, if any."""
    n, steps = p.future.shape
    for i in range(n - 1, -1, -1):
        step_i, reach = p.c[i] // p.grid, p.c[i] + p.limit[i] + p.size[i]
        top = min(steps, reach // p.grid - step_i + 1)
        for j in range(i + 1, n):
            low = 0
            if p.between[j] > i:
                if p.idle[j] >= reach:
                    break  # ``between`` could be sent before every further message, too
                low = max(0, p.idle[j] // p.grid - step_i)
            if p.limit[j] < 0 or p.c[j] + p.size[j] > p.ends:
                continue
            added = value(p.v, p.x[j] - p.x[i])
            # Ends before c_j: the link is idle, and j begins when it arrives.
            split = -(-p.c[j] // p.grid) - step_i
            w = added + p.future[j, (p.c[j] + p.size[j]) // p.grid - p.c[j] // p.grid]
            for k in range(low, min(split, top)):
                p.future[i, k] = max(p.future[i, k], w)
            # Later ends: j waits and begins there.
            last = min(p.c[j] + p.limit[j], p.ends - p.size[j]) // p.grid - step_i
            shift = step_i + p.size[j] // p.grid - p.c[j] // p.grid
            for k in range(max(low, split), min(top, last + 1)):
                w = added if room is None else added - waiting_cost(p, room, j, step_i + k)
                p.future[i, k] = max(p.future[i, k], w + p.future[j, k + shift])
