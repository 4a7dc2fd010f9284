"""The microbenchmark for speed: the job of one step of ``Uplink-v1``'s batch, without episodes, logs, limits or topics.

A step has one decision, an exact link, the next message, and all numbers of the observation and mask.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import Ints, Repeated, kernel

Reals = NDArray[np.float32]

PERIOD_US, SIZE_BYTES, KNOTS, KNOT_US, SLOT_FIELDS, CONTEXT_FIELDS = 33_333, 230_000, 64, 500_000, 9, 11
QUEUED, NOW_US, FINISH_US, LEFT, LEFT_US, SEED = range(6)
ONE, TWO, TINY, STEEP, SECOND, STRIDE, KEPT = np.array([1, 2, 1e-9, 3, 1e-6, 0.01, 0.95], np.float32)


class Bare(NamedTuple):
    """n queues. Place 0 has the message that left last, then the s queued ones, the newcomer, the expected next one."""

    places: Reals  # [n, 4, L + 3]: time, x, size, and V of the step from the place before, 1 - exp(-STEEP dx)
    previous: Reals  # [n, 3]: time and x of the arrival before the newcomer, and the running mean of departures
    state: Ints  # [n, 6]: QUEUED to SEED
    link: Ints  # [n, KNOTS], bytes a second

    @classmethod
    def new(cls, n: int, capacity: int) -> Bare:
        """Empty queues, and links of 0.1 to 4 MB/s."""
        state, link = np.zeros((n, 6), np.int64), np.random.default_rng(0).integers(100_000, 4_000_000, (n, KNOTS))
        state[:, SEED] = np.arange(n)
        return cls(np.zeros((n, 4, capacity + 3), np.float32), np.zeros((n, 3), np.float32), state, link)


@kernel
def _finish_us(bare: Bare, i: int, begins_us: int) -> int:
    rate = bare.link[i, (begins_us // KNOT_US) % KNOTS]
    return int(begins_us + 1_000_000 * int(bare.places[i, 2, 1]) // rate)


@kernel
def _close(bare: Bare, i: int, first: int, last: int) -> None:
    for column in bare.places[i]:
        for p in range(first, last):
            column[p] = column[p + 1]


@kernel
def _move(bare: Bare, i: int, action: int, capacity: int) -> None:
    """One decision, the link until the next arrival, and the newcomer."""
    at, state, last = bare.places[i], bare.state[i], bare.previous[i]
    at_s, x, size, gain = at[0], at[1], at[2], at[3]
    s = state[QUEUED]
    if action < s:
        _close(bare, i, action + 1, s + 1)
        gain[action + 1] = ONE - math.exp(-STEEP * (x[action + 1] - x[action]))
    enqueues = action == capacity + 1 and s < capacity
    s += enqueues
    if action == 0 or (enqueues and s == 1):
        state[FINISH_US] = _finish_us(bare, i, state[NOW_US])
    state[NOW_US], state[LEFT] = state[NOW_US] + PERIOD_US, 0
    while s > 0 and state[FINISH_US] <= state[NOW_US]:
        _close(bare, i, 0, s)
        s -= 1
        state[LEFT], state[LEFT_US] = state[LEFT] + 1, state[FINISH_US]
        state[FINISH_US] = _finish_us(bare, i, state[LEFT_US])
    state[QUEUED], state[SEED] = s, (state[SEED] * 1103515245 + 12345) % 2147483648
    at_s[s + 1], size[s + 1] = np.float32(state[NOW_US]) * SECOND, np.float32(SIZE_BYTES)
    x[s + 1] = last[1] + STRIDE * np.float32(state[SEED] // 65536 % 8)
    at_s[s + 2], x[s + 2] = TWO * at_s[s + 1] - last[0], TWO * x[s + 1] - last[1]
    gain[s + 1] = ONE - math.exp(-STEEP * (x[s + 1] - x[s]))
    gain[s + 2] = ONE - math.exp(-STEEP * (x[s + 1] - last[1]))
    last[2] = KEPT * last[2] + (ONE - KEPT) * np.float32(state[LEFT])


@kernel
def _squash(length: Any, reference: Any) -> Any:
    return length / (length + reference + TINY)


@kernel
def observe(bare: Bare, i: int, flat: Reals, mask: NDArray[np.int8]) -> None:
    """Write all numbers of queue ``i``: slot fields of L + 1 columns each, the context, the mask."""
    at, out = bare.places[i], flat[i]
    at_s, x, size, gain = at[0], at[1], at[2], at[3]
    s, width, last = bare.state[i, QUEUED], mask.shape[1] - 1, bare.previous[i]
    even_s, even_x = (at_s[s + 1] - at_s[0]) / np.float32(width), (x[s + 1] - x[0]) / np.float32(width)
    even, share = np.float32(ONE - math.exp(-STEEP * even_x)), ONE / np.float32(s + 1)
    mean = np.float32(0)
    for k in range(s + 1):
        mean += size[k + 1] * share
    for k in range(s + 1):
        lost = gain[k + 1] * gain[k + 2]
        out[k], out[width + k] = ONE, np.float32(k + 1) * share
        out[2 * width + k] = _squash(at_s[k + 1] - at_s[k], even_s)
        out[3 * width + k] = _squash(at_s[k + 2] - at_s[k], TWO * even_s)
        out[4 * width + k] = _squash(x[k + 1] - x[k], even_x)
        out[5 * width + k] = _squash(x[k + 2] - x[k], TWO * even_x)
        out[6 * width + k], out[7 * width + k] = lost, _squash(size[k + 1], mean)
        out[8 * width + k] = _squash(lost, even * even)
    for field in range(SLOT_FIELDS):
        out[field * width + width - 1] = out[field * width + s]
        out[field * width + s : field * width + width - 1] = 0
    context, now_us = out[SLOT_FIELDS * width :], bare.state[i, NOW_US]
    left_us = np.float32(bare.state[i, FINISH_US] - now_us)
    context[0], context[1] = np.float32(s) / np.float32(width - 1), 0
    context[2], context[3] = _squash(at_s[s + 1] - last[0], even_s), _squash(x[s + 1] - last[1], even_x)
    context[4], context[5] = min(s, 1), left_us / (left_us + np.float32(PERIOD_US)) if s > 0 else 0
    context[6] = _squash(np.float32(now_us - bare.state[i, LEFT_US]), np.float32(width * PERIOD_US))
    context[7], context[8] = _squash(np.float32(bare.state[i, LEFT]), ONE), _squash(last[2], ONE)
    context[9:] = even
    last[0], last[1] = at_s[s + 1], x[s + 1]
    mask[i, :s] = 1
    mask[i, s : width - 1] = 0
    mask[i, width - 1], mask[i, width] = 1, s < width - 1


@kernel
def _step(bare: Bare, actions: Ints, flat: Reals, mask: NDArray[np.int8]) -> None:
    for i in range(len(actions)):
        _move(bare, i, actions[i], mask.shape[1] - 2)
        observe(bare, i, flat, mask)


def passes(n: int, capacity: int) -> tuple[Callable[[], None], int]:
    """(Ten steps of ``n`` queues, the number of steps in them)."""
    rng, flat = np.random.default_rng(1), np.zeros((n, SLOT_FIELDS * (capacity + 1) + CONTEXT_FIELDS), np.float32)
    actions = np.where(rng.random(n) < 0.5, capacity + 1, rng.integers(0, capacity, n))
    bare, mask = Bare.new(n, capacity), np.zeros((n, capacity + 2), np.int8)

    again = Repeated()

    def run() -> None:
        for _ in range(10):
            again(_step, bare, actions, flat, mask)

    return run, 10 * n
