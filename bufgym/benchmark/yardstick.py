"""The yardstick for speed: the job of one step of ``Uplink-v0``'s batch, and nothing else.

A step has one decision, an exact link in whole microseconds and bytes, the next message, and all numbers of the
observation and mask. There are no episodes, logs, limits, topics or choices of fields: a lower bound, not a design.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import Ints, kernel

Reals = NDArray[np.float32]

PERIOD_US = 33_333
SIZE_BYTES = 230_000
KNOTS, KNOT_US = 64, 500_000
SLOT_FIELDS, CONTEXT_FIELDS = 9, 11
QUEUED, NOW_US, FINISH_US, LEFT, LEFT_US, SEED = range(6)
ONE, TWO, TINY = np.float32(1), np.float32(2), np.float32(1e-9)
STEEP = np.float32(3)
"""V of a step x is 1 - exp(-STEEP x)."""
SECOND, STRIDE, KEPT = np.float32(1e-6), np.float32(0.01), np.float32(0.95)


class Bare(NamedTuple):
    """n queues of L places. Place 0 has the message that left last, then the s queued ones, the newcomer, and the next
    message, which is expected to be as far from the newcomer as the newcomer is from the message before it."""

    at_s: Reals  # [n, L + 3]
    x: Reals
    size: Reals
    gain: Reals
    """V of the step from the place before it."""
    previous: Reals
    """[n, 3]: time and x of the arrival before the newcomer, and the running mean of departures."""
    state: Ints
    """[n, 6]: QUEUED to SEED."""
    link: Ints
    """[n, KNOTS]: bytes a second."""

    @classmethod
    def new(cls, n: int, capacity: int) -> Bare:
        """Empty queues, and links of 0.1 to 4 MB/s."""
        places = [np.zeros((n, capacity + 3), np.float32) for _ in range(4)]
        state = np.zeros((n, 6), np.int64)
        state[:, SEED] = np.arange(n)
        link = np.random.default_rng(0).integers(100_000, 4_000_000, (n, KNOTS))
        return cls(places[0], places[1], places[2], places[3], np.zeros((n, 3), np.float32), state, link)


@kernel
def _finish_us(bare: Bare, i: int, begins_us: int) -> int:
    rate = bare.link[i, (begins_us // KNOT_US) % KNOTS]
    return int(begins_us + 1_000_000 * int(bare.size[i, 1]) // rate)


@kernel
def _close(bare: Bare, i: int, first: int, last: int) -> None:
    """Move the places after ``first``, up to ``last``, forward by one."""
    for p in range(first, last):
        bare.at_s[i, p], bare.x[i, p] = bare.at_s[i, p + 1], bare.x[i, p + 1]
        bare.size[i, p], bare.gain[i, p] = bare.size[i, p + 1], bare.gain[i, p + 1]


@kernel
def _move(bare: Bare, i: int, action: int, capacity: int) -> None:
    """One decision, the link until the next arrival, and the newcomer."""
    at_s, x, gain, state = bare.at_s[i], bare.x[i], bare.gain[i], bare.state[i]
    s = state[QUEUED]
    if action < s:
        _close(bare, i, action + 1, s + 1)
        gain[action + 1] = ONE - np.exp(-STEEP * (x[action + 1] - x[action]))
        if action == 0:
            state[FINISH_US] = _finish_us(bare, i, state[NOW_US])
    elif action == capacity + 1 and s < capacity:
        s += 1
        if s == 1:
            state[FINISH_US] = _finish_us(bare, i, state[NOW_US])
    state[NOW_US] += PERIOD_US
    state[LEFT] = 0
    while s > 0 and state[FINISH_US] <= state[NOW_US]:
        _close(bare, i, 0, s)
        s -= 1
        state[LEFT] += 1
        state[LEFT_US] = state[FINISH_US]
        if s > 0:
            state[FINISH_US] = _finish_us(bare, i, state[LEFT_US])
    state[QUEUED] = s
    state[SEED] = (state[SEED] * 1103515245 + 12345) % 2147483648
    last = bare.previous[i]
    at_s[s + 1], bare.size[i, s + 1] = np.float32(state[NOW_US]) * SECOND, np.float32(SIZE_BYTES)
    x[s + 1] = last[1] + STRIDE * np.float32(state[SEED] // 65536 % 8)
    at_s[s + 2], x[s + 2] = TWO * at_s[s + 1] - last[0], TWO * x[s + 1] - last[1]
    gain[s + 1] = ONE - np.exp(-STEEP * (x[s + 1] - x[s]))
    gain[s + 2] = ONE - np.exp(-STEEP * (x[s + 1] - last[1]))
    last[2] = KEPT * last[2] + (ONE - KEPT) * np.float32(state[LEFT])


@kernel
def _squash(length: Any, reference: Any) -> Any:
    return length / (length + reference + TINY)


@kernel
def observe(bare: Bare, i: int, flat: Reals, mask: NDArray[np.int8]) -> None:
    """Write all numbers of queue ``i``: slot fields of L + 1 columns each, the context, the mask."""
    at_s, x, size, gain, out = bare.at_s[i], bare.x[i], bare.size[i], bare.gain[i], flat[i]
    s, capacity = bare.state[i, QUEUED], mask.shape[1] - 2
    width, last = capacity + 1, bare.previous[i]
    even_s, even_x = (at_s[s + 1] - at_s[0]) / np.float32(width), (x[s + 1] - x[0]) / np.float32(width)
    even = ONE - np.exp(-STEEP * even_x)
    share, mean = ONE / np.float32(s + 1), np.float32(0)
    for p in range(1, s + 2):
        mean += size[p] * share
    for k in range(s + 1):
        lost = gain[k + 1] * gain[k + 2]
        out[k] = ONE
        out[width + k] = np.float32(k + 1) * share
        out[2 * width + k] = _squash(at_s[k + 1] - at_s[k], even_s)
        out[3 * width + k] = _squash(at_s[k + 2] - at_s[k], TWO * even_s)
        out[4 * width + k] = _squash(x[k + 1] - x[k], even_x)
        out[5 * width + k] = _squash(x[k + 2] - x[k], TWO * even_x)
        out[6 * width + k] = lost
        out[7 * width + k] = _squash(size[k + 1], mean)
        out[8 * width + k] = _squash(lost, even * even)
    for field in range(SLOT_FIELDS):
        out[field * width + capacity] = out[field * width + s]
        for k in range(s, capacity):
            out[field * width + k] = 0
    context, now_us = out[SLOT_FIELDS * width :], bare.state[i, NOW_US]
    left_us = np.float32(bare.state[i, FINISH_US] - now_us)
    context[0], context[1] = np.float32(s) / np.float32(capacity), 0
    context[2], context[3] = _squash(at_s[s + 1] - last[0], even_s), _squash(x[s + 1] - last[1], even_x)
    context[4], context[5] = min(s, 1), left_us / (left_us + np.float32(PERIOD_US)) if s > 0 else 0
    context[6] = _squash(np.float32(now_us - bare.state[i, LEFT_US]), np.float32(width * PERIOD_US))
    context[7], context[8] = _squash(np.float32(bare.state[i, LEFT]), ONE), _squash(last[2], ONE)
    context[9], context[10] = even, even
    last[0], last[1] = at_s[s + 1], x[s + 1]
    mask[i, :s], mask[i, s:capacity] = 1, 0
    mask[i, capacity], mask[i, capacity + 1] = 1, s < capacity


@kernel
def step(bare: Bare, actions: Ints, flat: Reals, mask: NDArray[np.int8]) -> None:
    """One step of every queue."""
    for i in range(len(actions)):
        _move(bare, i, actions[i], mask.shape[1] - 2)
        observe(bare, i, flat, mask)
