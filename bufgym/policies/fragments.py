"""Middleware that cuts a message into fragments, and all must arrive: Zenoh, and DDS over UDP.

See docs/methods.md, "Messages in fragments".
"""

import math

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.policies.classic import keep_first, keep_last
from bufgym.policies.registry import Arrival, Memory, built_in

UNKNOWN = 1e6  # Rate of a link that has not been measured, bytes/us: 1 TB/s
AHEAD, SINCE, OWN, RATE, SEEN = range(5)  # indices of a pipe's account in the memory
PIPE = {"ahead_bytes": 0.0, "since_us": 0.0, "own_bytes": 0.0, "bytes_per_us": UNKNOWN, "seen_us": 0.0}
"""Account of a pipe: bytes not yet transmitted, with lost fragments, and the time of that count; those of whole
messages; the link's rate and the time it was last seen."""


@kernel
def unsent(buffer: Buffer) -> int:
    """Bytes of whole messages, queued or in transmission, not yet transmitted."""
    return buffer.backlog_bytes + buffer.left_bytes


@kernel
def ahead_of_newcomer(buffer: Buffer, memory: Memory, rate_memory_s: float) -> float:
    """Bytes ahead of the newcomer, lost fragments included; updates the rate.

    The rate is measured since the previous arrival. If all bytes had left before now, the link was faster than that; an
    unmeasured link then stays unmeasured, as it keeps up.
    """
    now_us, own_bytes = buffer.now_us, unsent(buffer)
    left_bytes, passed_us = memory[OWN] - own_bytes, now_us - memory[SINCE]
    if memory[OWN] > 0 and left_bytes >= 0 and passed_us > 0:
        rate = left_bytes / passed_us
        memory[RATE] = rate if own_bytes > 0 else max(rate, memory[RATE])
        memory[SEEN] = now_us
    if now_us - memory[SEEN] > 1e6 * rate_memory_s:
        memory[RATE] = UNKNOWN
    # In whole bytes, so without lost fragments this equals the queue's own count.
    return float(max(own_bytes, math.floor(memory[AHEAD] - memory[RATE] * passed_us)))


@kernel
def account(buffer: Buffer, memory: Memory, ahead_bytes: float, kept_bytes: float) -> None:
    """Enter ``ahead_bytes`` to transmit from now on, ``kept_bytes`` of them the newcomer's."""
    memory[AHEAD], memory[SINCE], memory[OWN] = ahead_bytes, buffer.now_us, unsent(buffer) + kept_bytes


BATCH, BATCHES, SOCKET, WAIT, MORE, FORGETS = range(6)  # indices of Zenoh's parameters


@built_in(
    "zenoh-drop",
    parameters={
        "batch_size": 65_535.0,
        "queue_size": 2.0,
        "so_sndbuf": 131_072.0,
        "wait_before_drop": 1_000.0,
        "max_wait_before_drop_fragments": 50_000.0,
        "rate_memory_s": 1.0,
    },
    memory=PIPE,
    reads_left=True,
    source="Zenoh, congestion control DROP [zenoh], measured against version 1.10.2",
)
def zenoh_drop(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Zenoh DROP: put cuts the newcomer into batches and drops it when one of them finds no room in time.

    Room is `queue_size` batches of `batch_size` bytes and the socket's buffer. The kernel grants twice the `so_sndbuf`
    asked for, in bytes; unset, it chooses the buffer itself. The first batch waits `wait_before_drop` us. Each further
    one extends the time by twice as much as its predecessor, all together by at most `max_wait_before_drop_fragments`
    us: 1, 3, 7, 15, 31, 51 ms. The batches before one that finds no room are sent in vain. L holds too: when full the
    newcomer is dropped.
    """
    batch_bytes, wait_us, more_us = buffer.parameters[BATCH], buffer.parameters[WAIT], buffer.parameters[MORE]
    room_bytes = buffer.parameters[BATCHES] * batch_bytes + 2 * buffer.parameters[SOCKET]
    ahead_bytes = ahead_of_newcomer(buffer, memory, buffer.parameters[FORGETS])
    size_bytes = arrival.size_bytes
    decision = keep_first(buffer, arrival)
    deadline_us, put_bytes = wait_us, 0.0
    while decision == ACCEPT and put_bytes < size_bytes:
        with_next_bytes = put_bytes + min(batch_bytes, size_bytes - put_bytes)
        if ahead_bytes + with_next_bytes - memory[RATE] * deadline_us > room_bytes:
            decision = REJECT
        else:
            put_bytes = with_next_bytes
            wait_us *= 2
            extension_us = min(wait_us, more_us)
            deadline_us += extension_us
            more_us -= extension_us
    account(buffer, memory, ahead_bytes + put_bytes, size_bytes if decision == ACCEPT else 0.0)
    return decision


@built_in(
    "ros2-best-effort",
    parameters={"queue_kb": 200.0, "rate_memory_s": 1.0},
    memory=PIPE,
    reads_left=True,
    source="ROS 2 over Fast DDS and UDP, RELIABILITY best effort [fastdds]",
)
def ros2_best_effort(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """ROS 2, best effort over UDP: all packets of the newcomer go at once; lost unless the link's queue takes them all.

    `queue_kb` is the size of the link's own queue, such as a driver's or a modem's, kB. Packets that find it full are
    lost, and the others cross in vain. A message larger than this queue never arrives; in reality a few do, as even a
    burst takes time. L holds too: when full the newcomer is dropped.
    """
    room_bytes, rate_memory_s = 1e3 * buffer.parameters[0], buffer.parameters[1]
    ahead_bytes = ahead_of_newcomer(buffer, memory, rate_memory_s)
    decision = keep_first(buffer, arrival)
    filled_bytes = ahead_bytes + arrival.size_bytes
    if filled_bytes > room_bytes:
        decision, filled_bytes = REJECT, max(ahead_bytes, room_bytes)
    account(buffer, memory, filled_bytes, arrival.size_bytes if decision == ACCEPT else 0.0)
    return decision


@built_in(
    "ros2-reliable-udp",
    parameters={"queue_kb": 200.0, "depth": 10.0, "rate_memory_s": 1.0},
    memory=PIPE,
    reads_left=True,
    source="ROS 2 over Fast DDS and UDP, RELIABILITY reliable, HISTORY KEEP_LAST(depth) [fastdds]",
)
def ros2_reliable_udp(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """ROS 2, reliable over UDP: packets lost in the link's queue are sent again until `depth` newer messages come.

    All messages of the history send their missing packets again and share the link. A message that does not fit into
    the link's queue (`queue_kb`) at once is complete in time only if in `depth` periods the link carries the bytes
    ahead of it and as many messages of its size as arrive by then. Otherwise it is lost, and its packets have crossed
    in vain. The model leaves out the time until a loss is noticed, packets sent twice, and the end of a stream, whose
    last `depth` messages do arrive.
    """
    room_bytes, rate_memory_s = 1e3 * buffer.parameters[0], buffer.parameters[2]
    depth = min(buffer.parameters[1], buffer.capacity)
    decision = keep_last(buffer, arrival, depth)
    if buffer.evictions > 0:  # asked again about a newcomer that is already in the account
        if decision >= 0:
            memory[OWN] -= buffer.slots[0].size_bytes
        return decision
    ahead_bytes = ahead_of_newcomer(buffer, memory, rate_memory_s)
    history_bytes = depth * arrival.size_bytes
    fits_at_once = ahead_bytes + arrival.size_bytes <= room_bytes
    in_time = memory[RATE] == UNKNOWN or ahead_bytes + history_bytes <= memory[RATE] * depth * buffer.period_us
    if not fits_at_once and not in_time:
        decision = REJECT
    kept_bytes = 0.0 if decision == REJECT else float(arrival.size_bytes)
    if decision >= 0:
        kept_bytes -= buffer.slots[0].size_bytes  # overwritten
    most_bytes = unsent(buffer) + history_bytes  # messages older than the history are no longer sent
    account(buffer, memory, min(ahead_bytes + arrival.size_bytes, most_bytes), kept_bytes)
    return decision
