"""The best possible QoI in one interruption whose length T is known (AFR [wang2022afr], Sec. III-C).

Message 0 was sent before and message T + 1 is sent after; L of the T messages between can be kept. This makes L + 1
gaps that add up to T + 1. V is concave, so equal gaps are best. ``ideal`` and ``integer`` count the information gained
after message 0, as the paper does: compare them with H - 1 of a run.

``by_length`` scores a policy for every T at once. Until an arrival, nothing that a policy sees depends on T. So the
longest interruption holds all shorter ones, and one run gives the exact mean over any law of T.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.errors import BufgymError
from bufgym.ground.kernel import kernel
from bufgym.model.qoi import Value, value


def _check(capacity: int, T: int) -> None:
    if capacity < 1 or T < 0:
        raise BufgymError(f"oracle: L = {capacity}, T = {T}: need L >= 1 and T >= 0")


def ideal(capacity: int, T: int, v: Value) -> float:
    """``oracle-ideal``: (L + 1) V((T + 1) / (L + 1)) with real-numbered gaps; for T <= L, T + 1 gaps of 1."""
    _check(capacity, T)
    gaps = min(capacity, T) + 1
    return gaps * v((T + 1) / gaps)


def integer(capacity: int, T: int, v: Value) -> float:
    """``oracle``: the best whole-numbered gaps, as equal as possible, some of q and the others of q + 1."""
    _check(capacity, T)
    gaps = min(capacity, T) + 1
    q, longer = divmod(T + 1, gaps)
    return longer * v(q + 1) + (gaps - longer) * v(q)


def evenly_kept(capacity: int, T: int) -> NDArray[np.int64]:
    """Messages of 1..T that ``integer`` keeps; empty if there is no room for any."""
    gaps = min(capacity, T) + 1
    kept: NDArray[np.int64] = np.arange(1, gaps) * (T + 1) // gaps
    return kept


def by_length(dropped: NDArray[np.int64], v: Value) -> NDArray[np.float64]:
    """H of each interruption of T = 0..t_max messages, float64[t_max + 1], from one run through the longest.

    ``dropped``, int64[t_max + 2], tells for each message 0..t_max + 1 of that run at which arrival it was dropped (1 =
    the first of the interruption). A number after t_max means never.
    """
    h, kept = np.ones(len(dropped) - 1), np.zeros(len(dropped), np.int64)
    _by_length(np.ascontiguousarray(dropped, np.int64), v.array, kept, h)
    return h


@kernel
def _by_length(
    dropped: NDArray[np.int64], v: NDArray[np.float64], kept: NDArray[np.int64], h: NDArray[np.float64]
) -> None:
    held = 0
    for T in range(len(h)):
        if T > 0:
            remaining = 0
            for k in range(held):
                if dropped[kept[k]] > T:
                    kept[remaining] = kept[k]
                    remaining += 1
            if dropped[T] > T:
                kept[remaining] = T
                remaining += 1
            held = remaining
        before = 0
        for k in range(held):
            h[T] += value(v, float(kept[k] - before))
            before = kept[k]
        h[T] += value(v, float(T + 1 - before))
