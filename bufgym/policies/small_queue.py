"""The exact best decisions for a queue of up to four messages on a link that stands still, from a table.

An interruption of unknown length T reveals nothing but that it goes on. So its best policy is one plan, a list of
evictions, one for each arrival. For V = 1 - b^d and T log-uniform, the exact optimum (``bufgym.oracle.online_optimum``)
gives the plan up to the largest T that fits its table. A beam search continues it from there. ``small_queue.txt`` has
plans for bases b from 0.24 to 0.99. Each line has the base, L, and for each arrival from L + 1 on a digit, the slot
that goes (0 = oldest, L = the newcomer). ``python -m agents.small_queue`` makes it.

A plan applies if each arrival moves the scene on by the same step, with V of that step as its V, and only while the
queue holds exactly the messages that the plan has kept so far.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import kernel
from bufgym.model.buffer import REJECT, Buffer
from bufgym.model.qoi import EXPONENTIAL

CAPACITIES = (1, 2, 3, 4)
"""Values of L."""
LONGEST = 400
"""Arrivals of the longest interruption in the plans."""
_RATIO = (math.log(0.618) / math.log(0.9)) ** (1 / 7)
BASES = tuple(math.exp(math.log(0.9) * _RATIO**k) for k in range(-10, 13))
"""Bases b, evenly spaced in the logarithm of ln b; 0.9 and 0.618 are among them."""
DIGITS = 16
"""Digits of a plan in one number, three bits each."""
PLAN = -(-LONGEST // DIGITS)
"""Numbers of one plan."""
NUMBERS = len(BASES) * len(CAPACITIES) * PLAN
"""Numbers of all plans."""
NONE = -3
"""Answer where no plan applies."""
# For the kernel, and for C.
SLACK = 1e-6
FIRST, STEP = math.log(BASES[0]), math.log(_RATIO)
COUNT, EACH = len(BASES), len(CAPACITIES) * PLAN


@cache
def packed() -> NDArray[np.float64]:
    """float64[NUMBERS]: base by base, L by L, ``DIGITS`` digits a number, the first one lowest."""
    lines = Path(__file__).with_suffix(".txt").read_text(encoding="utf-8").split("\n")
    numbers = []
    for line in lines[:-1]:
        digits = [int(digit) for digit in line.split()[2]]
        for k in range(0, LONGEST, DIGITS):
            numbers.append(float(sum(digit << 3 * i for i, digit in enumerate(digits[k : k + DIGITS]))))
    return np.array(numbers)


@kernel
def nearest(log_base: float) -> int:
    """Index in ``BASES`` of the base with about this logarithm (< 0), or -1."""
    place = math.floor(math.log(log_base / FIRST) / STEP + 0.5)
    return int(place) if 0 <= place < COUNT else -1


@kernel
def planned(buffer: Buffer, arrival: Any, plans: NDArray[np.float64]) -> int:
    """The slot that the plan for this queue evicts, REJECT, or NONE without a plan; ``plans`` come from ``packed``."""
    L, step = buffer.capacity, arrival.x - buffer.previous_x
    if L > 4 or len(buffer.slots) != L or buffer.v[0] != EXPONENTIAL or len(buffer.topics) > 1 or step <= 0:
        return NONE
    place = nearest(buffer.v[1] * step)
    t = math.floor((arrival.x - buffer.dequeued_x) / step + 0.5)
    if place < 0 or t <= L or t > LONGEST:
        return NONE
    plan = plans[place * EACH + (L - 1) * PLAN :]
    first, second, third, last = 1, 2, 3, 4  # what is kept, as arrivals since the message dequeued last
    slot = 0
    for u in range(L + 1, t + 1):
        k = u - L - 1
        slot = (int(plan[k // DIGITS]) >> (3 * (k % DIGITS))) & 7
        if u == t:
            break
        if slot == 0:
            first = second if L > 1 else u
        if slot <= 1 < L:
            second = third if L > 2 else u
        if slot <= 2 < L:
            third = last if L > 3 else u
        if slot <= 3 < L:
            last = u
    for k in range(L):
        kept = first
        if k > 0:
            kept = second if k == 1 else third if k == 2 else last
        if abs(buffer.slots[k].x - buffer.dequeued_x - kept * step) > SLACK * step:
            return NONE
    return slot if slot < L else REJECT
