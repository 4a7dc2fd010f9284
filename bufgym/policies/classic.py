"""What middleware and network queues do today: decide by position alone."""

from __future__ import annotations

from bufgym.kernel import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.policies.registry import Arrival, Memory, register


@kernel
def keep_last(s: int, depth: float) -> int:
    """Keep the newest ``depth`` messages: where so many are among the s queued, the head goes."""
    return ACCEPT if s < depth else 0


@kernel
def keep_first(s: int, L: int) -> int:
    """Keep the s messages that are queued: the newcomer enters where there is room."""
    return ACCEPT if s < L else REJECT


@register("drop-oldest", source="ROS 1 roscpp subscriber link; ROS 2 / DDS KEEP_LAST", compile=True)
def drop_oldest(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """ROS: a full queue loses its head."""
    return keep_last(len(buffer.slots), buffer.capacity)


@register("drop-newest", source="drop tail; DDS KEEP_ALL, best effort", compile=True)
def drop_newest(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Drop tail: a full queue rejects the newcomer."""
    return keep_first(len(buffer.slots), buffer.capacity)


@register("replace-newest", source="replace tail", compile=True)
def replace_newest(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Replace tail: the newcomer overwrites the newest queued message."""
    return ACCEPT if len(buffer.slots) < buffer.capacity else buffer.capacity - 1


@register("latest-only", source="mailbox of one message, as KEEP_LAST(1), the default depth of DDS", compile=True)
def latest_only(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A queue of one: the newest replaces what waits."""
    return keep_last(len(buffer.slots), 1)


@register("random", source="AFR paper [wang2022afr], Eq. 9", compile=True)
def random(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Random Drop: the victim is uniform over the L queued messages and the newcomer."""
    L = buffer.capacity
    if len(buffer.slots) < L:
        return ACCEPT
    victim = int(arrival.uniform * (L + 1))
    return victim if victim < L else REJECT
