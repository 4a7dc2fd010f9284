"""Policies that look at the gaps between messages: drop what its neighbours say best.

Dropping slot k merges its two gaps into one; the smaller the merged gap, the less is lost. Time gaps need a clock only,
motion gaps the robot's odometry.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.buffer import ACCEPT, REJECT, Buffer, motion_gaps, time_gaps
from bufgym.policies.registry import register
from bufgym.qoi import value


@register("min-gap", source="online checkpointing, smallest merged gap", compile=True)
def min_gap(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
    """A full queue drops what leaves the smallest merged time gap (newcomer included, ties to the oldest)."""
    s = len(buffer.slots)
    if s < buffer.capacity:
        return ACCEPT
    victim, smallest = 0, np.inf
    for k in range(s + 1):
        before, after = time_gaps(buffer, arrival, k)
        if before + after < smallest:
            victim, smallest = k, float(before + after)
    return victim if victim < s else REJECT


@register("min-motion-gap", source="as min-gap, on the robot's odometry", compile=True)
def min_motion_gap(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
    """A full queue drops what leaves the smallest merged motion gap (newcomer included, ties to the oldest)."""
    s = len(buffer.slots)
    if s < buffer.capacity:
        return ACCEPT
    victim, smallest = 0, np.inf
    for k in range(s + 1):
        before, after = motion_gaps(buffer, arrival, k)
        if before + after < smallest:
            victim, smallest = k, before + after
    return victim if victim < s else REJECT


@register("orbbuf", source="ORBBuf (IROS 2021), Jrdevil-Wang/ORBBuf, with Sim = 1 - V(motion gap)", compile=True)
def orbbuf(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
    """A full queue drops the message whose two queued neighbours are most similar; the newcomer is always kept.

    The released similarity compares images (and is a random stub there); without images, Sim = 1 - V(motion gap).
    The head and the tail have no two queued neighbours: for L < 3 the tail goes.
    """
    L = buffer.capacity
    if len(buffer.slots) < L:
        return ACCEPT
    victim, most_similar = L - 1, -np.inf
    for k in range(1, L - 1):
        similar = 1 - value(buffer.v, buffer.slots[k + 1].x - buffer.slots[k - 1].x)
        if similar > most_similar:
            victim, most_similar = k, similar
    return victim
