"""Messages of unequal sizes: a good plan, and an upper bound that is close to it.

The bound comes from the priced programme (``priced``), the plan from a beam search that the programme guides
(``beam``). Prices follow the subgradient (Held, Wolfe and Crowder, Mathematical Programming 6, 1974): they rise where
the programme's own plan queues too much and fall where it leaves room, in steps of Polyak's length towards the best
plan known, which are halved when the bound stands still. Every round gives a bound; the least of all is returned.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bufgym.model.buffer import UNLIMITED_BYTES
from bufgym.oracle import beam
from bufgym.oracle.labels import MAX_CELLS
from bufgym.oracle.priced import Problem, Programme, count_queued, find_future, follow

ROUNDS = 40
"""Price updates at most."""
ENOUGH = 1e-4
"""They end when the bound is this close to the plan, as a fraction of the bound."""
PATIENCE = 3
"""Rounds without progress after which the step is halved."""
GRID, FINE_GRID = 12, 96
"""Grid steps to a mean message while prices are sought, and for the last bound."""
WIDTH, LAST_WIDTH = 8, 64
"""States a message in the beam, likewise."""


def best(p: Problem) -> tuple[NDArray[np.int64], float]:
    """(messages of a plan that keeps to L and B, in order; an upper bound of any such plan's gain, H - 1)."""
    n = len(p.c)
    byte_limit = p.max_bytes < UNLIMITED_BYTES
    room = np.array([[p.capacity], [p.max_bytes if byte_limit else 0]], np.float64)
    # A step in the price of a byte is to that of a message as a byte to a mean message.
    scale = np.array([[1.0], [1 / p.size.mean() if byte_limit else 0.0]])
    prices, kept_prices, queued = np.zeros((2, n)), np.zeros((2, n)), np.empty((2, n))
    message, begin, work = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    plan, plan_gain, bound = np.zeros(0, np.int64), 0.0, np.inf
    step, waited = 1.0, 0
    states = beam.new_states(n, WIDTH)
    for _ in range(ROUNDS):
        d = _programme(p, prices, GRID)
        length, gain = beam.search(p, d, states, work)
        if gain > plan_gain or not len(plan):
            plan, plan_gain = work[:length][::-1].copy(), gain
        length, gain = follow(p, d, message, begin)
        total = gain + float((room * prices).sum())
        waited = 0 if total < bound * (1 - ENOUGH / 10) else waited + 1
        if total < bound:
            bound, kept_prices = total, prices
        if bound - plan_gain <= ENOUGH * bound:
            break
        if waited >= PATIENCE:
            step, waited = step / 2, 0
        count_queued(p, message, begin, length, queued)
        slope = (queued - room) * scale
        slope[(prices <= 0) & (slope < 0)] = 0.0
        squares = float(np.square(slope).sum())
        if squares == 0:
            break
        prices = np.maximum(0.0, prices + step * (total - plan_gain) / squares * slope * scale)
    d = _programme(p, kept_prices, FINE_GRID)
    length, gain = beam.search(p, d, beam.new_states(n, LAST_WIDTH), work)
    if gain > plan_gain:
        plan, plan_gain = work[:length][::-1].copy(), gain
    _, gain = follow(p, d, message, begin)
    return plan, max(plan_gain, min(bound, gain + float((room * kept_prices).sum())))


def _programme(p: Problem, prices: NDArray[np.float64], steps: int) -> Programme:
    """The programme under ``prices`` [2, messages], filled, with so many grid ``steps`` to a mean message."""
    n, furthest = len(p.c), max(0, int((p.limit + p.size).max()))
    grid = max(1, int(p.size.mean()) // steps, furthest * n // MAX_CELLS)
    before = np.concatenate([np.zeros((2, 1)), np.cumsum(prices, axis=1)], axis=1)
    positions = np.arange((int(p.c[-1]) + furthest) // grid + 3) * grid
    price = np.ascontiguousarray(before[:, np.searchsorted(p.c, positions, side="left")])
    d = Programme(grid, price, before, np.empty((n, furthest // grid + 3)))
    find_future(p, d)
    return d
