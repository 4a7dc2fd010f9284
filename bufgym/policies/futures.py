"""Sampled futures of a link that a robot knows from its own socket alone, and when its messages would go in each.

The model is generic: what the link's rate does on its way back to its long-run mean. Its logarithm is

    log r(t) = log m + slow(t) + fast(t),

m being the mean over the last ``MEAN_S``, and ``slow`` and ``fast`` two autoregressive processes that begin where the
rates over 2 s and over 0.1 s are now. Their standard deviations are those of recordings: beside the mean of the last
20 s, 0.6 over the 30 Belgium 4G logs and 1.2 over 83 of the 5G uplinks. There a regression of the rate that comes on
the rate now has slopes of 0.5 to 0.6 after 1 s, 0.2 to 0.4 after 4 s and 0.12 to 0.26 after 8 s. That would make the
slow process faster; of a few settings tried on lte-v1's validation links this one decided best.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.kernel import kernel

MEAN_S = 20.0
"""Over how much sending time m is taken, s."""
SLOW_S, SLOW_SD = 20.0, 0.8
"""Time constant and standard deviation of the slow process."""
FAST_S, FAST_SD = 1.0, 0.4
"""The same of the fast one."""
LEAST = 0.02
"""No rate is below this part of m: a link that stands still is left to another rule."""

FUTURES = 64
"""Futures at most."""
DRAWS = 257
"""Normal draws for each future, used over again by longer ones."""
NORMAL: NDArray[np.float64] = np.random.default_rng(16).standard_normal((FUTURES // 2, 2, DRAWS))
"""The same at each decision, so that all candidates of all decisions meet the same chance."""


class Link(NamedTuple):
    """What is known of the link now; bytes and us."""

    mean: float
    """m, bytes/us."""
    slow: float
    """log of the rate over 2 s beside m."""
    fast: float
    """log of the rate over 0.1 s beside that over 2 s."""
    left_bytes: float
    """Of the message in transmission."""
    size_bytes: float
    """Of each message behind it."""
    capacity: int
    """Messages that wait."""
    period_us: float
    """Between arrivals."""


class Grid(NamedTuple):
    """The arrivals to come as a grid of points, the same in every future."""

    points: int
    """How many, beginning with 1."""
    step_us: float
    """Between two of them."""


@kernel
def sample(link: Link, grid: Grid, number: int, dequeue_us: NDArray[np.float64]) -> int:
    """Fill ``dequeue_us[k]``, from now on, for the k-th message (from 1) that the socket takes; how many it takes.

    Future 0 is the expected one; 1 and 2, 3 and 4 and so on mirror each other. The socket takes a message as soon as
    the one before it has left, but none before it has arrived.
    """
    keeps_slow, keeps_fast = math.exp(-grid.step_us / (SLOW_S * 1e6)), math.exp(-grid.step_us / (FAST_S * 1e6))
    stir_slow = SLOW_SD * math.sqrt(1 - keeps_slow * keeps_slow)
    stir_fast = FAST_SD * math.sqrt(1 - keeps_fast * keeps_fast)
    sign = 0.0
    if number > 0:
        sign = 1.0 if number % 2 == 1 else -1.0
    pair = max(number - 1, 0) // 2
    slow, fast, us, need, count = link.slow, link.fast, 0.0, link.left_bytes, 0
    most = len(dequeue_us) - 1
    for cell in range(grid.points):
        draw = cell % DRAWS
        slow = keeps_slow * slow + sign * stir_slow * NORMAL[pair, 0, draw]
        fast = keeps_fast * fast + sign * stir_fast * NORMAL[pair, 1, draw]
        rate = link.mean * max(math.exp(slow + fast), LEAST)
        end_us = (cell + 1) * grid.step_us
        while us < end_us:
            done_us = us + need / rate
            if done_us > end_us:
                need -= rate * (end_us - us)
                us = end_us
                break
            us = max(done_us, (count + 1 - link.capacity) * link.period_us)
            if us > grid.points * grid.step_us:
                return count
            count += 1
            dequeue_us[count] = us
            need = link.size_bytes
            if count == most:
                return count
    return count
