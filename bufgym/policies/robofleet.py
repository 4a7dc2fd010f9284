"""Robofleet's client, as published and as released, and native ROS; `rosbridge` is in ``middleware.py``.

See docs/methods.md, "Robofleet's clients, ours beside theirs".
"""

import math

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, HOLD, REJECT, Buffer, is_first
from bufgym.policies.registry import Arrival, ClientSettings, Memory, built_in
from bufgym.policies.schedulers import fits, make_room, oldest, topic_of


@kernel
def overwrite(buffer: Buffer, arrival: Arrival) -> int:
    """Keep one slot a topic, which the newcomer overwrites; ``no_drop`` messages are queued instead."""
    own = oldest(buffer, arrival, True)
    return own if own != REJECT else make_room(buffer, arrival)


@kernel
def next_no_drop(buffer: Buffer, start: int) -> int:
    """The oldest ``no_drop`` message from slot ``start`` on, or HOLD."""
    for k in range(start, len(buffer.slots)):
        if topic_of(buffer, buffer.slots[k]).no_drop == 1:
            return k
    return HOLD


@kernel
def prioritised_wait(buffer: Buffer, k: int) -> float:
    """Priority x time since slot ``k``'s topic was last sent, us; time counts from 0 before the first."""
    topic = topic_of(buffer, buffer.slots[k])
    return float(topic.priority * (buffer.now_us - topic.last_dequeue_us))


@kernel
def goes_before(buffer: Buffer, k: int, rank: float, other: int, other_rank: float) -> bool:
    """Whether slot ``k`` goes before slot ``other``: the smaller rank, or the first topic if equal."""
    return rank < other_rank or (rank == other_rank and buffer.slots[k].topic < buffer.slots[other].topic)


def longest_wait(buffer: Buffer, memory: Memory) -> int:
    """All ``no_drop`` first, in order of arrival; then the largest priority x wait, the first topic if equal."""
    best = next_no_drop(buffer, 0)
    if best != HOLD:
        return best
    longest = -math.inf
    for k in range(len(buffer.slots)):
        if is_first(buffer, k):
            wait = prioritised_wait(buffer, k)
            if goes_before(buffer, k, -wait, best, -longest):
                best, longest = k, wait
    return best


@built_in("robofleet", on_send=longest_wait, for_topics=True, source="Robofleet [sikand2021robofleet], as published")
def robofleet(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Robofleet as published: one slot a topic, no_drop queued and sent first, then the largest priority x wait."""
    return overwrite(buffer, arrival)


built_in(
    "robofleet-literal",
    on_send=longest_wait,
    for_topics=True,
    source="Robofleet [sikand2021robofleet], rate limits by the letter: since last transmitted",
    client=ClientSettings(limit_since_sent=True),
    about="Robofleet by the letter: as `robofleet`, but a topic's rate limit counts from when it was last sent, not"
    " kept.",
)(robofleet)  # a waiting message is overwritten until a message of its topic is sent


FLUSHING = 0


def shortest_wait(buffer: Buffer, memory: Memory) -> int:
    """One pass of the released scheduler, at an arrival or an ack; the first topic if equal.

    It begins only while fewer than n_T are in flight. Then all ``no_drop`` messages go, however many there are. After
    them go messages with the smallest priority x wait, as long as n_T and their topics' rate limits allow.
    """
    full = buffer.in_flight >= buffer.window
    if not full or memory[FLUSHING] == 1:
        flushed = next_no_drop(buffer, 0)
        if flushed != HOLD:
            memory[FLUSHING] = 0.0 if next_no_drop(buffer, flushed + 1) == HOLD else 1.0
            return flushed
    best, shortest = HOLD, math.inf
    if full:
        return best
    for k in range(len(buffer.slots)):
        topic = topic_of(buffer, buffer.slots[k])
        held_back = topic.dequeued > 0 and buffer.now_us - topic.last_dequeue_us < topic.period_us
        if is_first(buffer, k) and not held_back:
            wait = prioritised_wait(buffer, k)
            if goes_before(buffer, k, wait, best, shortest):
                best, shortest = k, wait
    return best


@built_in(
    "robofleet-released",
    memory={"flushing": 0.0},
    on_send=shortest_wait,
    for_topics=True,
    source="Robofleet [sikand2021robofleet], released code (ut-amrl/robofleet_client_lib)",
    client=ClientSettings(limit_at_send=True, flush_no_drop=True),
)
def robofleet_released(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Robofleet as released: rate limits at the socket, no_drop flushed past n_T, the smallest priority x wait first.

    Left out: the code counts a topic's first wait from its first message instead of time 0, in whole milliseconds. It
    sends from a topic only later than 1 / rate after the last time, not exactly then. It pings again and reconnects
    after 2 s.
    """
    return overwrite(buffer, arrival)


def longest_ago(buffer: Buffer, memory: Memory) -> int:
    """The oldest message of the topic served longest ago, at time 0 if never; the first topic if equal."""
    best, earliest_us = 0, buffer.now_us + 1
    for k in range(len(buffer.slots)):
        if is_first(buffer, k):
            last_dequeue_us = topic_of(buffer, buffer.slots[k]).last_dequeue_us
            if goes_before(buffer, k, last_dequeue_us, best, earliest_us):
                best, earliest_us = k, last_dequeue_us
    return best


@built_in(
    "ros-native",
    on_send=longest_ago,
    for_topics=True,
    source="ROS publishers, a queue a topic (queue_size: the topic's limit)",
    client=ClientSettings(encoding="ros", awaits_acks=False, copies=True),
)
def ros_native(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Native ROS: each topic drops its oldest; topics take turns; one copy for each consumer; no acks.

    ROS has a TCP connection per subscriber, and these share the link. With one socket the closest model is round robin
    by message: the topic served longest ago goes next, and a copy to each consumer is a topic of its own. Two things
    are left out, the sockets' own buffers and fairness by bytes. Here a topic of large messages gets a larger share of
    the link, and small messages wait for whole large ones.

    Topics have queues of their own in ROS. If L is too small for all of them, the oldest message of any topic goes.
    """
    if fits(buffer, arrival):
        return ACCEPT
    own = oldest(buffer, arrival, True)
    return own if own != REJECT else oldest(buffer, arrival, False)
