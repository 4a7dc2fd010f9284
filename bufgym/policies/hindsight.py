"""The queue's dynamic programme in one future: how much information is reached at best, whichever message goes.

Points are what may be sent, in order: 0 the message dequeued last, 1..n the queued ones and the newcomer (n), then the
arrivals to come on a grid. The socket takes its k-th message at a known time. It may be any point that has arrived by
then, behind the one sent before it; and as at most C messages wait, it arrived after the (k - C)-th was taken. A plan
gains the sum of V over its gaps. One of 1..n goes now, and the plans that lack it are those that jump over it; where
there is room (n <= C) none has to. A message that the socket takes before the next arrival is beyond recall: every
plan then begins with the oldest that is kept.

    before(a, k)   the most that k messages from 1..a can gain, a being the k-th
    after(a, k)    the most that can be gained behind a, if a is the k-th
    without j      max over a < j < b and k of before(a, k) + V(a, b) + after(b, k + 1)
    sent(a, k)     before(a, k) of the plans that begin with 1

``before`` is the same in all futures; ``after`` takes one sweep for each, backwards, and then every candidate is known.
On the grid ``after`` is concave, since V is, so the best next point is found by climbing, and moves on with a. The
number of messages left out so far, d = a - k, is at most ``SKIPS``: memory and work then grow with L, not its square.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.kernel import kernel
from bufgym.model.buffer import Buffer
from bufgym.model.qoi import value
from bufgym.policies.futures import Grid

SKIPS = 32
"""Queued messages that a plan may leave out."""
NOWHERE = -1e30
"""The gain of a plan that does not exist."""


class Tables(NamedTuple):
    """One decision's scratch; d counts rows, points count columns."""

    near: NDArray[np.float64]
    """[SKIPS + 1, n]: V from point a to a + 1 + e."""
    far: NDArray[np.float64]
    """[SKIPS + 1, points + 1]: V from point n - e to a point of the grid."""
    apart: NDArray[np.float64]
    """[points + 1]: V between grid points so many steps apart."""
    before: NDArray[np.float64]
    """[SKIPS + 1, n + 1]"""
    after: NDArray[np.float64]
    """[SKIPS + 1, n + 1]"""
    sent: NDArray[np.float64]
    """[SKIPS + 1, n + 1]: ``before`` of the plans that begin with point 1."""
    ahead: NDArray[np.float64]
    """[SKIPS + 1, n + 1]: the part of ``after`` that sends a point of the grid next."""
    grid: NDArray[np.float64]
    """[2, points + 1]: ``after`` of the grid's points, for this k and the next."""
    dequeue_us: NDArray[np.float64]
    """[messages + 1]: when the socket takes its k-th message."""
    without: NDArray[np.float64]
    """[n + 1]: the result for each candidate in one future; first if none goes."""
    total: NDArray[np.float64]
    """[n + 1]: the sum over all futures."""


def room(per_candidate: int, points: int) -> tuple[int, int]:
    """Numbers that ``divide`` needs: so many, and so many more for each of L + 1 candidates; ``points`` for each."""
    rows = SKIPS + 1
    each = 5 * rows + (rows + 3) * per_candidate + 2 + 3
    return 5 * rows + (rows + 3) * (points + 1) + 8, each


@kernel
def divide(memory: NDArray[np.float64], points: int, capacity: int) -> Tables:
    """The memory as room for one decision."""
    rows, columns, wide = SKIPS + 1, capacity + 2, points + 1
    a = rows * columns
    far, apart = 5 * a, 5 * a + rows * wide
    grid = apart + wide
    taken = grid + 2 * wide
    without = taken + 3 * columns
    return Tables(
        memory[:a].reshape((rows, columns)),
        memory[far:apart].reshape((rows, wide)),
        memory[apart:grid],
        memory[a : 2 * a].reshape((rows, columns)),
        memory[2 * a : 3 * a].reshape((rows, columns)),
        memory[3 * a : 4 * a].reshape((rows, columns)),
        memory[4 * a : far].reshape((rows, columns)),
        memory[grid:taken].reshape((2, wide)),
        memory[taken : taken + 2 * (columns - 2) + 1],
        memory[without : without + columns],
        memory[without + columns : without + 2 * columns],
    )


@kernel
def coordinate(buffer: Buffer, arrival: Any, a: int) -> float:
    """x of point ``a``."""
    if a == 0:
        return float(buffer.dequeued_x)
    return float(buffer.slots[a - 1].x if a <= len(buffer.slots) else arrival.x)


@kernel
def prepare(buffer: Buffer, arrival: Any, step_x: float, grid: Grid, t: Tables) -> None:
    """Fill what is the same in all futures; ``step_x``: from one point of the grid to the next."""
    n = len(buffer.slots) + 1
    for a in range(n):
        x = coordinate(buffer, arrival, a)
        for e in range(min(SKIPS, n - a - 1) + 1):
            t.near[e, a] = value(buffer.v, coordinate(buffer, arrival, a + 1 + e) - x)
    for e in range(min(SKIPS, n) + 1):
        behind = arrival.x - coordinate(buffer, arrival, n - e)
        for p in range(1, grid.points + 1):
            t.far[e, p] = value(buffer.v, behind + p * step_x)
    for p in range(grid.points + 1):
        t.apart[p] = value(buffer.v, p * step_x)
    t.before[0, 0], t.sent[0, 0], t.total[0] = 0.0, NOWHERE, 0.0
    for a in range(1, n + 1):
        t.total[a] = 0.0
        for d in range(min(SKIPS, a - 1) + 1):
            best, sent = NOWHERE, NOWHERE
            for e in range(d + 1):
                b = a - 1 - e
                if d - e > max(b - 1, 0):
                    continue  # more left out than there are
                best = max(best, t.before[d - e, b] + t.near[e, b])
                sent = max(sent, t.sent[d - e, b] + t.near[e, b])
            t.before[d, a], t.sent[d, a] = best, best if a == 1 else sent


@kernel
def first_point(t: Tables, grid: Grid, n: int, capacity: int, taken: int, k: int) -> int:
    """The oldest grid point that may be the k-th message, of which ``taken`` go before the end."""
    earliest = 1
    if k > capacity:
        earliest = math.ceil(t.dequeue_us[min(k - capacity, taken)] / grid.step_us)
    return max(1, min(earliest, last_point(t, grid, n, capacity, taken, k)))


@kernel
def last_point(t: Tables, grid: Grid, n: int, capacity: int, taken: int, k: int) -> int:
    """The newest; at the end all that waits is sent."""
    us = t.dequeue_us[k] if k <= taken else grid.points * grid.step_us
    if k > taken and taken == len(t.dequeue_us) - 1:
        us = t.dequeue_us[taken]
    newest = min(int(us / grid.step_us), grid.points)
    return max(newest, 1) if k > min(n, capacity) else newest


@kernel
def sweep(n: int, capacity: int, grid: Grid, taken: int, t: Tables) -> int:
    """Fill ``after`` and ``ahead`` for a future in which the socket takes ``taken`` messages before its end.

    ``n``: the queued messages and the newcomer; ``capacity``: how many may wait.

    What it returns is how much it had to look at.
    """
    work, low, high = 0, 0, -1
    for k in range(taken + capacity, -1, -1):
        now, then = t.grid[k % 2], t.grid[(k + 1) % 2]
        # The points of the grid; ``low`` and ``high``: those that may be the next message.
        first, last = 1, 0
        if k > 0:
            first, last = first_point(t, grid, n, capacity, taken, k), last_point(t, grid, n, capacity, taken, k)
        at = low
        for p in range(first, last + 1):
            if high < 0:
                now[p] = 0.0
                continue
            at = max(at, p)
            best = t.apart[at - p] + then[at]
            while at < high:
                other = t.apart[at + 1 - p] + then[at + 1]
                if other < best:
                    break
                best = other
                at += 1
            now[p] = best
        work += 2 * max(last - first + 1, 0)
        if k <= capacity:
            at = max(low, 1)
            for a in range(k, (min(n, k + SKIPS) if k > 0 else 0) + 1):
                d, gap = a - k, n - a
                ahead, best = NOWHERE, NOWHERE
                if high < 0:
                    ahead = 0.0
                elif high >= 1 and gap <= SKIPS:
                    ahead = t.far[gap, at] + then[at]
                    while at < high:
                        other = t.far[gap, at + 1] + then[at + 1]
                        if other < ahead:
                            break
                        ahead = other
                        at += 1
                if a == n and k < capacity and d > 0:
                    ahead = max(ahead, t.ahead[d - 1, n])  # nothing new has come: the socket idles
                if k < capacity:
                    for e in range(min(SKIPS - d, n - a - 1) + 1):
                        best = max(best, t.near[e, a] + t.after[d + e, a + 1 + e])
                    work += n - a
                t.ahead[d, a], t.after[d, a] = ahead, max(ahead, best)
        low, high = first, last
    return work


@kernel
def collect(n: int, takes: bool, t: Tables) -> None:
    """Fill ``without`` from a future's ``after``, and add it to ``total``.

    ``takes``: whether the socket takes a message before the next arrival. Then nobody is asked, and the oldest goes.
    """
    before = t.sent if takes else t.before
    jump = NOWHERE
    for j in range(1, n + 1):
        t.without[j] = NOWHERE
    for a in range(n):
        for d in range(min(SKIPS, max(a - 1, 0)) + 1):
            gained = before[d, a]
            jump = max(jump, gained + t.ahead[d, a])
            run = NOWHERE
            if a - d < n - 1:
                for e in range(min(SKIPS - d, n - a - 1), 0, -1):
                    run = max(run, gained + t.near[e, a] + t.after[d + e, a + 1 + e])
                    t.without[a + e] = max(t.without[a + e], run)
        t.without[a + 1] = max(t.without[a + 1], jump)
    t.without[0] = t.after[0, 0]
    if takes:
        t.without[0] = t.near[0, 0] + t.after[0, 1]
        t.without[1] = t.near[1, 0] + t.after[1, 2] if n > 1 else t.ahead[0, 0]
    for j in range(n + 1):
        t.total[j] += t.without[j]
