"""Drop rules of today's middleware and network queues, which decide by position alone."""

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, has_space
from bufgym.policies.registry import Arrival, Memory, built_in


@kernel
def keep_last(buffer: Buffer, arrival: Arrival, depth: float) -> int:
    """Keep the newest ``depth`` messages: drop-oldest if as many are queued or the newcomer does not fit."""
    return ACCEPT if len(buffer.slots) < depth and has_space(buffer, arrival) else 0


@kernel
def keep_first(buffer: Buffer, arrival: Arrival) -> int:
    """Keep the queued messages: the newcomer enters only if there is room."""
    return ACCEPT if has_space(buffer, arrival) else REJECT


@kernel
def uniform_draw(buffer: Buffer, arrival: Arrival) -> float:
    """The arrival's uniform draw; for each further question about it, the next of a congruential sequence."""
    u = arrival.uniform
    for _ in range(buffer.evictions):
        u = 7919 * u % 1
    return float(u)


@built_in("drop-oldest", source="ROS 1 roscpp subscriber link; ROS 2 / DDS KEEP_LAST")
def drop_oldest(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """ROS: a full queue loses its head."""
    return keep_last(buffer, arrival, buffer.capacity)


@built_in("drop-newest", source="drop tail; DDS KEEP_ALL, best effort")
def drop_newest(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Drop tail: a full queue rejects the newcomer."""
    return keep_first(buffer, arrival)


@built_in("replace-newest", source="replace tail")
def replace_newest(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Replace tail: the newcomer overwrites the newest queued message."""
    return ACCEPT if has_space(buffer, arrival) else len(buffer.slots) - 1


@built_in("latest-only", source="mailbox of one message, as KEEP_LAST(1), the default depth of DDS")
def latest_only(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A queue of one: the newest replaces what waits."""
    return keep_last(buffer, arrival, 1)


@built_in("random", source="AFR paper [wang2022afr], Eq. 9")
def random(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Random Drop: a full queue drops one of its messages or the newcomer, each as likely as the others.

    Under B further messages may have to go for a newcomer that stays.
    """
    if has_space(buffer, arrival):
        return ACCEPT
    s = len(buffer.slots)
    victim = int(uniform_draw(buffer, arrival) * (s if buffer.evictions > 0 else s + 1))
    return victim if victim < s else REJECT
