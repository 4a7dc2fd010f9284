"""Plausible actions: the few of a queue's L + 2 actions that a good rule chooses among.

Random decisions are ruinous, because a message that is dropped at random is missing for the rest of the episode. The
plausible actions are to accept, to reject, to evict one of the two messages whose eviction leaves the smallest gaps in
motion, and to evict the head when its turn is near (the socket is free within ``NEAR`` arrivals).
"""

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, without_dispatch
from bufgym.policies.gaps import gap_left
from bufgym.policies.target_gap import free_soon
from bufgym.sim.state import ARRIVAL_WAITS, Batch
from bufgym.sim.view import arrival_of, view

NEAR = 1.5
"""Arrivals, as ``target-gap`` has them."""


@without_dispatch
@kernel
def keep_plausible(batch: Batch, rows: NDArray[np.int64], action_mask: NDArray[np.int8]) -> None:
    """Clear the actions of ``rows`` that are valid and not plausible.

    Args:
        batch: senders of one queue each.
        rows: int64[rows], which to look at.
        action_mask: int8[n, L + 2], 1 for a valid action; cleared in place.
    """
    for i in rows:
        if batch.senders[i].waiting != ARRIVAL_WAITS:
            continue
        buffer, arrival = view(batch, i), arrival_of(batch, i)
        first, second = -1, -1
        least, next_least = np.inf, np.inf
        for k in range(len(buffer.slots)):
            left = gap_left(buffer, arrival, k)
            if left < least:
                second, next_least = first, least
                first, least = k, left
            elif left < next_least:
                second, next_least = k, left
        head_is_near = free_soon(buffer, NEAR)
        for k in range(len(buffer.slots)):
            if k != first and k != second and not (k == 0 and head_is_near):
                action_mask[i, k] = 0
