"""What middleware and network queues do today: decide by position alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.buffer import ACCEPT, REJECT, Buffer
from bufgym.policies.registry import register


@register("drop-oldest", source="ROS 1 roscpp subscriber link; ROS 2 / DDS KEEP_LAST", compile=True)
def drop_oldest(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
    """ROS: a full queue loses its head."""
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


@register("drop-newest", source="drop tail; DDS KEEP_ALL, best effort", compile=True)
def drop_newest(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
    """Drop tail: a full queue rejects the newcomer."""
    return ACCEPT if len(buffer.slots) < buffer.capacity else REJECT


@register("replace-newest", source="replace tail", compile=True)
def replace_newest(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
    """Replace tail: the newcomer overwrites the newest queued message."""
    return ACCEPT if len(buffer.slots) < buffer.capacity else buffer.capacity - 1


@register("random", source="AFR paper, Eq. 9", compile=True)
def random(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
    """Random Drop: the victim is uniform over the L queued messages and the newcomer."""
    L = buffer.capacity
    if len(buffer.slots) < L:
        return ACCEPT
    victim = int(arrival.luck * (L + 1))
    return victim if victim < L else REJECT
