"""Messages of unequal sizes: a good plan, and a close upper bound.

See docs/methods.md, "The clairvoyant, messages of unequal sizes".
"""

import math

import numpy as np

from bufgym.jit import Floats, Ints, kernel
from bufgym.model.buffer import UNLIMITED_BYTES
from bufgym.model.qoi import value
from bufgym.oracle import beam
from bufgym.oracle.programme import Messages, Problem, Room, find_future, new_problem

ROUNDS = 40  # Most price updates
ENOUGH = 1e-4  # Gap between bound and plan, as a fraction of the bound, at which updates end
PATIENCE = 3  # Rounds without progress after which the step is halved
GRID, FINE_GRID = 12, 96  # Grid steps to a mean message: in the search for prices, and for the last bound
WIDTH, LAST_WIDTH = 8, 64  # States per message in the beam, likewise


def best(messages: Messages, certain: Ints, capacity: int, max_bytes: int) -> tuple[Ints, float]:
    """Find messages of a plan that keeps to L and B, in order, and an upper bound of any such plan's gain, H - 1.

    ``certain``, int64[messages], is explained at ``new_problem``.
    """
    messages = without_idle(messages, math.lcm(messages.grid(GRID), messages.grid(FINE_GRID)))
    n = len(messages.c)
    byte_limit = max_bytes < UNLIMITED_BYTES
    rooms = np.array([[capacity], [max_bytes if byte_limit else 0]], np.float64)
    # A step in the price of a byte is to that of a message as a byte to a mean message.
    scale = np.array([[1.0], [1 / messages.size.mean() if byte_limit else 0.0]])
    prices, kept_prices, queued = np.zeros((2, n)), np.zeros((2, n)), np.empty((2, n))
    message, begin, work = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    plan, plan_gain, bound = np.zeros(0, np.int64), 0.0, np.inf
    step, waited = 1.0, 0
    p = new_problem(messages, certain, GRID)
    states = beam.new_states(n, WIDTH)
    for _ in range(ROUNDS):
        room = priced(p, prices, capacity, max_bytes)
        length, gain = beam.search(p, room, states, work)
        if gain > plan_gain or not len(plan):
            plan, plan_gain = work[:length][::-1].copy(), gain
        length, gain = follow(p, room, message, begin)
        total = gain + float((rooms * prices).sum())
        waited = 0 if total < bound * (1 - ENOUGH / 10) else waited + 1
        if total < bound:
            bound, kept_prices = total, prices
        if bound - plan_gain <= ENOUGH * bound:
            break
        if waited >= PATIENCE:
            step, waited = step / 2, 0
        count_queued(p, message, begin, length, queued)
        slope = (queued - rooms) * scale
        slope[(prices <= 0) & (slope < 0)] = 0.0
        squares = float(np.square(slope).sum())
        if squares == 0:
            break
        prices = np.maximum(0.0, prices + step * (total - plan_gain) / squares * slope * scale)
    p = new_problem(messages, certain, FINE_GRID)
    room = priced(p, kept_prices, capacity, max_bytes)
    length, gain = beam.search(p, room, beam.new_states(n, LAST_WIDTH), work)
    if gain > plan_gain:
        plan, plan_gain = work[:length][::-1].copy(), gain
    _, gain = follow(p, room, message, begin)
    return plan, max(plan_gain, min(bound, gain + float((rooms * kept_prices).sum())))


def without_idle(messages: Messages, step: int) -> Messages:
    """Shorten the stretches of link, by whole ``step`` bytes, that no message reaches.

    On a fast link they are nearly all of it, and work space grows with the link's bytes. Nothing else changes: all
    rules compare bytes within the reach of one message.
    """
    c, ends = messages.c, messages.ends
    spare = np.diff(c, prepend=0) - messages.reach - int(messages.size.max())
    shorter = np.cumsum(np.maximum(0, spare) // step * step)
    before = int(np.searchsorted(c, ends, side="right"))  # messages that arrive while the link still carries bytes
    until = ends - int(shorter[before - 1]) if before else ends
    short = c - shorter
    return messages._replace(c=short, ends=min(until, int(short[before])) if before < len(c) else until)


def priced(p: Problem, prices: Floats, capacity: int, max_bytes: int) -> Room:
    """Make room at these prices [2, messages], and fill the programme's ``future`` under them."""
    before = np.concatenate([np.zeros((2, 1)), np.cumsum(prices, axis=1)], axis=1)
    positions = np.arange(int(p.c[-1]) // p.grid + p.future.shape[1] + 1) * p.grid
    until = np.ascontiguousarray(before[:, np.searchsorted(p.c, positions, side="left")])
    room = Room(capacity, max_bytes, until, before, np.empty_like(p.future))
    find_future(p, room, np.empty(len(positions), np.int64), np.empty(len(positions)))
    return room


@kernel
def follow(p: Problem, room: Room, message: Ints, begin: Ints) -> tuple[int, float]:
    """Write the programme's own best plan, which need not keep to the room; return (length, gain less prices).

    ``message`` and ``begin``, the byte at which each begins, are int64[messages], filled up to the length.
    """
    n, length, i, step, total = len(p.c), 0, -1, 0, 0.0
    while True:
        best, chosen, s = 0.0, -1, 0
        for j in range(i + 1, n):
            if i >= 0 and p.between[j] > i:
                if p.idle[j] >= p.c[i] + p.limit[i] + p.size[i]:
                    break
                if step < p.idle[j] // p.grid:
                    continue
            if p.limit[j] < 0 or p.c[j] + p.size[j] > p.ends:
                continue
            begins, w = p.c[j], 0.0
            if step < -(-p.c[j] // p.grid):
                w = p.future[j, (p.c[j] + p.size[j]) // p.grid - p.c[j] // p.grid]
            elif step <= min(p.c[j] + p.limit[j], p.ends - p.size[j]) // p.grid:
                begins = step * p.grid
                w = room.begun[j, step - p.c[j] // p.grid]
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
        waited = step >= -(-p.c[chosen] // p.grid)
        step = step + p.size[chosen] // p.grid if waited else (p.c[chosen] + p.size[chosen]) // p.grid
        i = chosen


@kernel
def count_queued(p: Problem, message: Ints, begin: Ints, length: int, queued: Floats) -> None:
    """Fill ``queued``, float64[2, messages]: messages and bytes that this plan has in the queue after each arrival."""
    queued[:, :] = 0.0
    for k in range(length):
        j = message[k]
        while j < len(p.c) and p.c[j] < begin[k]:
            queued[0, j] += 1.0
            queued[1, j] += p.size[message[k]]
            j += 1
