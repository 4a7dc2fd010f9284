"""The dynamic programme over (message, end) behind the clairvoyant: gains still possible, on a grid of bytes.

``labels`` takes its bounds from it for equal sizes, ``unequal`` its prices and its bound for others.
"""

from typing import NamedTuple

import numpy as np

from bufgym.jit import Floats, Ints, kernel
from bufgym.model.qoi import value

NEVER = -1
"""A limit that leaves no room for the message."""

MAX_CELLS = 1 << 23  # Most entries of ``future``, 8 bytes each; longer episodes take a coarser grid

BLOCK = 32  # Grid positions that share the range of successors to look at


class Messages(NamedTuple):
    """One episode's messages as the link sees them; arrays over messages."""

    c: Ints  # int64, bytes that the link can have carried when the message arrives
    size: Ints  # int64, bytes of the message
    limit: Ints  # int64, bytes that may still have to pass before it when it arrives, at most; or NEVER
    x: Floats  # float64, coordinate of the message
    v: Floats  # ``Value.array``
    ends: int  # the link's last byte

    @property
    def reach(self) -> int:
        """Bytes after its arrival by which every message has ended."""
        return max(0, int((self.limit + self.size).max()))

    def grid(self, steps: int) -> int:
        """Bytes to a grid step, see ``new_problem``; a whole number of them makes a mean message.

        Ends are rounded down to the grid: what is left of each message would add up over all that wait, and the bound
        would be far from the best.
        """
        mean = int(self.size.mean())
        grid = max(1, mean // steps, self.reach * len(self.c) // MAX_CELLS)
        return mean // (mean // grid) if grid < mean else grid


class Problem(NamedTuple):
    """``Messages`` and what the kernels look up about them."""

    c: Ints
    size: Ints
    limit: Ints
    x: Floats
    v: Floats
    ends: int
    between: Ints
    """int64, the last message before it that could have been sent before it arrives; -1: none."""
    idle: Ints
    """int64, after a message before ``between`` that ends by this byte, ``between`` could be sent in time."""
    grid: int  # bytes to a grid step
    future: Floats
    """float64[messages, steps], no plan gains more after message i, if that ends at byte (c_i // grid + k) * grid or
    later."""


class Room(NamedTuple):
    """Room in the queue, and the price that a message pays for waiting in it (see ``unequal``)."""

    capacity: int  # L, messages
    max_bytes: int  # B, bytes
    until: Floats
    """float64[2, steps], sum of the prices of all arrivals before this grid position; of a message, of a byte."""
    before: Floats  # float64[2, messages + 1], the same sum over the arrivals before each message
    begun: Floats
    """float64[messages, steps], like ``future``, if the message begins there after waiting; less its price."""


def new_problem(messages: Messages, certain: Ints, steps: int) -> Problem:
    """Set up one episode on a grid of ``steps`` to a mean message, or fewer (``MAX_CELLS``); ``future`` is 0.

    A message that waits for at most ``certain`` bytes finds room, whichever messages wait.
    """
    n, grid = len(messages.c), messages.grid(steps)
    between, idle = np.empty((2, n), np.int64)
    find_idle(*messages[:3], certain, between, idle)
    return Problem(*messages, between, idle, grid, np.zeros((n, messages.reach // grid + 2)))


@kernel
def find_idle(c: Ints, size: Ints, limit: Ints, certain: Ints, between: Ints, idle: Ints) -> None:
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
def find_future(p: Problem, room: Room, last: Ints, best: Floats) -> None:
    """Fill ``future`` and ``room.begun`` from the last message back; ``last`` and ``best`` are work space, [positions].

    What j gains if i ends at a grid position is V(x_j - x_i) plus a number that does not depend on i. V is concave: the
    further back i lies, the less a later j is ahead of an earlier one. So once j is beaten by an earlier message at a
    position, it stays beaten there for all i further back. ``last`` has the best j found so far at each position, the
    last that need be looked at.
    """
    n, steps = p.future.shape
    last[:] = n - 1
    for i in range(n - 1, -1, -1):
        if p.limit[i] < 0 or p.c[i] + p.size[i] > p.ends:
            continue
        at, length = p.c[i] // p.grid, p.size[i] // p.grid
        first, stop = at + length, min(at + steps, (p.c[i] + p.limit[i] + p.size[i]) // p.grid + 1)
        best[first:stop] = -np.inf
        for left in range(first, stop, BLOCK):
            right, furthest = min(stop, left + BLOCK), i
            for step in range(left, right):
                furthest = max(furthest, last[step])
            for j in range(i + 1, furthest + 1):
                if p.between[j] > i and p.idle[j] >= right * p.grid:
                    break  # ``between`` could be sent before every further message, too
                offer(p, room, i, j, max(left, p.idle[j] // p.grid), right, last, best)
        # Between i and these j nothing else could be sent, so i may also end earlier than ``idle``; for no other i.
        for j in range(i + 1, n):
            if p.between[j] > i:
                break
            if p.between[j] == i and p.limit[j] >= 0 and p.c[j] + p.size[j] <= p.ends:
                w = value(p.v, p.x[j] - p.x[i]) + p.future[j, (p.c[j] + p.size[j]) // p.grid - p.c[j] // p.grid]
                for step in range(first, min(stop, p.idle[j] // p.grid)):
                    best[step] = max(best[step], w)
        for step in range(first, stop):
            p.future[i, step - at] = max(0.0, best[step])
        for step in range(-(-p.c[i] // p.grid), min(p.c[i] + p.limit[i], p.ends - p.size[i]) // p.grid + 1):
            room.begun[i, step - at] = p.future[i, step - at + length] - waiting_cost(p, room, i, step)


@kernel
def offer(p: Problem, room: Room, i: int, j: int, low: int, right: int, last: Ints, best: Floats) -> None:
    """Raise ``best`` to what j after i gains at grid positions ``low`` to ``right``, and note j in ``last``."""
    if low >= right or p.limit[j] < 0 or p.c[j] + p.size[j] > p.ends:
        return
    added, at = value(p.v, p.x[j] - p.x[i]), p.c[j] // p.grid
    # Ends before c_j: the link is idle, and j begins when it arrives.
    split = max(low, min(right, -(-p.c[j] // p.grid)))
    w = added + p.future[j, (p.c[j] + p.size[j]) // p.grid - at]
    for step in range(low, split):
        if w > best[step]:
            best[step], last[step] = w, j
    # Later ends: j waits and begins there. Without a branch, the loop runs over several positions at once.
    right = max(split, min(right, min(p.c[j] + p.limit[j], p.ends - p.size[j]) // p.grid + 1))
    begun, bests, lasts = room.begun[j, split - at : right - at], best[split:right], last[split:right]
    for k in range(len(begun)):
        w = added + begun[k]
        better = w > bests[k]
        bests[k] = w if better else bests[k]
        lasts[k] = j if better else lasts[k]
