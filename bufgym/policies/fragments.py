"""Middleware that cuts a message into fragments, all of which must arrive: Zenoh, and DDS over UDP.

What fits in part is sent in part. A message that loses a fragment is lost, yet its other fragments use up the link; on
a link that is somewhat too slow for the stream this can leave next to nothing that arrives. The sender here carries
whole messages only, so each policy keeps an account of the bytes ahead of a newcomer, lost fragments included
(``Pipe``), and rejects a message that would lose one. What it knows is what a robot knows: its queue, its clock, and
how much of the message in transmission has left, hence the rate at which the link drains.

Limits of this model. Lost fragments delay later decisions, not the messages that are queued. While only fragments of
lost messages would cross, the rate can't be seen: it is taken to be what it was, for `rate_memory_s` (a setting of this
model, not of the program); then the link is taken to be free and the next message measures it. So on a link that stays
too slow about one message in `rate_memory_s` arrives that really would not.
"""

from __future__ import annotations

import math

from bufgym.kernel import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.policies.classic import keep_first, keep_last
from bufgym.policies.registry import Arrival, Memory, register

UNKNOWN = 1e6
"""bytes/us, 1 TB/s: the rate of a link of which nothing is known."""
AHEAD, SINCE, OWN, RATE, SEEN = range(5)  # where the account of a pipe lies in the memory
PIPE = {"ahead_bytes": 0.0, "since_us": 0.0, "own_bytes": 0.0, "bytes_per_us": UNKNOWN, "seen_us": 0.0}
"""Bytes not yet transmitted, lost fragments included, and when that was; those of whole messages among them; the link's
rate, and when it was last seen."""


@kernel
def unsent(buffer: Buffer) -> int:
    """Bytes of whole messages, queued or in transmission, that have not been transmitted."""
    return buffer.backlog_bytes + buffer.left_bytes


@kernel
def ahead_of_newcomer(buffer: Buffer, memory: Memory, rate_memory_s: float) -> float:
    """Bytes ahead of the newcomer, lost fragments included; brings the rate up to date.

    The rate is that of the time since the previous arrival. If all had left before now, the link was faster than that,
    and a link that is unknown remains so: it keeps up.
    """
    now_us, own_bytes = buffer.now_us, unsent(buffer)
    left_bytes, passed_us = memory[OWN] - own_bytes, now_us - memory[SINCE]
    if memory[OWN] > 0 and left_bytes >= 0 and passed_us > 0:
        rate = left_bytes / passed_us
        memory[RATE] = rate if own_bytes > 0 else max(rate, memory[RATE])
        memory[SEEN] = now_us
    if now_us - memory[SEEN] > 1e6 * rate_memory_s:
        memory[RATE] = UNKNOWN
    # In whole bytes, so that without lost fragments these are the queue's own.
    return float(max(own_bytes, math.floor(memory[AHEAD] - memory[RATE] * passed_us)))


@kernel
def account(buffer: Buffer, memory: Memory, ahead_bytes: float, kept_bytes: float) -> None:
    """From now on so many bytes are to be transmitted, ``kept_bytes`` of them the newcomer's."""
    memory[AHEAD], memory[SINCE], memory[OWN] = ahead_bytes, buffer.now_us, unsent(buffer) + kept_bytes


BATCH, BATCHES, SOCKET, WAIT, MORE, FORGETS = range(6)  # where the parameters of Zenoh lie


@register(
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
    source="Zenoh, congestion control DROP [zenoh], measured against version 1.10.2",
    compile=True,
)
def zenoh_drop(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Zenoh DROP: put cuts the newcomer into batches and drops it when one of them finds no room in time.

    Room is `queue_size` batches of `batch_size` bytes and the socket's buffer, of which the kernel grants twice what
    `so_sndbuf` asks for (bytes; unset, the kernel chooses it itself). The first batch waits `wait_before_drop` us. Each
    further one extends the time by twice as much as the one before it did, all together by at most
    `max_wait_before_drop_fragments` us: 1, 3, 7, 15, 31, 51 ms. The batches before one that finds no room are sent in
    vain. L holds too: when full the newcomer is dropped.
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


@register(
    "ros2-best-effort",
    parameters={"queue_kb": 200.0, "rate_memory_s": 1.0},
    memory=PIPE,
    source="ROS 2 over Fast DDS and UDP, RELIABILITY best effort [fastdds]",
    compile=True,
)
def ros2_best_effort(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """ROS 2, best effort over UDP: all packets of the newcomer go at once; lost unless the link's queue takes them all.

    `queue_kb`: what the link's own queue holds (a driver's, a modem's), kB. Packets that find it full are lost, the
    others cross in vain. A message larger than this queue never arrives; in truth a few do, for even a burst takes
    time. L holds too: when full the newcomer is dropped.
    """
    room_bytes, rate_memory_s = 1e3 * buffer.parameters[0], buffer.parameters[1]
    ahead_bytes = ahead_of_newcomer(buffer, memory, rate_memory_s)
    decision = keep_first(buffer, arrival)
    filled_bytes = ahead_bytes + arrival.size_bytes
    if filled_bytes > room_bytes:
        decision, filled_bytes = REJECT, max(ahead_bytes, room_bytes)
    account(buffer, memory, filled_bytes, arrival.size_bytes if decision == ACCEPT else 0.0)
    return decision


@register(
    "ros2-reliable-udp",
    parameters={"queue_kb": 200.0, "depth": 10.0, "rate_memory_s": 1.0},
    memory=PIPE,
    source="ROS 2 over Fast DDS and UDP, RELIABILITY reliable, HISTORY KEEP_LAST(depth) [fastdds]",
    compile=True,
)
def ros2_reliable_udp(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """ROS 2, reliable over UDP: what the link's queue loses is sent again, until `depth` newer messages overwrite it.

    All messages of the history send again what they lack, and so share the link. One that does not fit into the link's
    queue (`queue_kb`) at once is complete in time only if the link, in `depth` periods, carries what is ahead of it and
    as many messages like it as arrive by then; else it is lost, and its packets have crossed in vain. Left out: the
    time until a loss is noticed, packets sent twice, and the end of a stream, whose last `depth` messages do arrive.
    """
    room_bytes, rate_memory_s = 1e3 * buffer.parameters[0], buffer.parameters[2]
    depth = min(buffer.parameters[1], buffer.capacity)
    decision = keep_last(buffer, arrival, depth)
    if buffer.evictions > 0:  # asked again about a newcomer that the account has already
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
    most_bytes = unsent(buffer) + history_bytes  # older messages than the history holds are sent no more
    account(buffer, memory, min(ahead_bytes + arrival.size_bytes, most_bytes), kept_bytes)
    return decision
