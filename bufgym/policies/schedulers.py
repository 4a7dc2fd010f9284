"""Schedulers for several topics over one uplink: which message goes next, and which one makes room for a newcomer.

`fifo`, `strict-priority`, `age-greedy` and `edf` differ only in the message sent next; at an arrival all four follow
``make_room``. A topic's messages are sent in the order of their arrival, so the candidates are the oldest queued
message of each topic. On a sender with a single topic, each is a queue that drops its oldest message.
"""

import math
from typing import Any

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, could_fit, has_space, is_first
from bufgym.policies.registry import Arrival, Memory, built_in
from bufgym.utils.modules import first_line


@kernel
def topic_of(buffer: Buffer, message: Any) -> Any:
    """The TOPIC row of a message; a sender with a single topic has one row for all."""
    return buffer.topics[message.topic if len(buffer.topics) > 1 else 0]


@kernel
def same_topic(buffer: Buffer, a: Any, b: Any) -> bool:
    """Whether two messages share a queue."""
    return len(buffer.topics) == 1 or a.topic == b.topic


@kernel
def fits(buffer: Buffer, arrival: Arrival) -> bool:
    """Whether the newcomer fits without a drop: by messages, by bytes, and by its topic's limit."""
    topic = topic_of(buffer, arrival)
    return has_space(buffer, arrival) and bool(topic.queued < topic.limit)


@kernel
def makes_room(buffer: Buffer, arrival: Arrival, k: int) -> bool:
    """Whether slot ``k`` may be dropped for the newcomer, which fits then or after further drops."""
    slot, topic = buffer.slots[k], topic_of(buffer, arrival)
    within_limit = same_topic(buffer, slot, arrival) or topic.queued < topic.limit
    spare_bytes = buffer.max_bytes - buffer.backlog_bytes - arrival.size_bytes
    return bool(
        topic_of(buffer, slot).no_drop == 0 and within_limit and could_fit(spare_bytes, buffer.slots, buffer.topics)
    )


@kernel
def oldest(buffer: Buffer, arrival: Arrival, own: bool) -> int:
    """The oldest message that makes room, of any topic or of the newcomer's ``own``, or REJECT."""
    for k in range(len(buffer.slots)):
        if (not own or same_topic(buffer, buffer.slots[k], arrival)) and makes_room(buffer, arrival, k):
            return k
    return REJECT


@kernel
def oldest_of_lowest(buffer: Buffer, arrival: Arrival) -> int:
    """The oldest message of the lowest priority that makes room, unless it ranks above the newcomer: then REJECT.

    A ``no_drop`` newcomer enters whatever its priority.
    """
    newcomer = topic_of(buffer, arrival)
    victim, lowest = REJECT, math.inf
    for k in range(len(buffer.slots)):
        priority = topic_of(buffer, buffer.slots[k]).priority
        if priority < lowest and makes_room(buffer, arrival, k):
            victim, lowest = k, priority
    return victim if lowest <= newcomer.priority or newcomer.no_drop == 1 else REJECT


@kernel
def make_room(buffer: Buffer, arrival: Arrival) -> int:
    """Accept a message that fits; else the oldest of its topic goes, else the oldest of the lowest priority."""
    if fits(buffer, arrival):
        return ACCEPT
    own = oldest(buffer, arrival, True)
    return own if own != REJECT else oldest_of_lowest(buffer, arrival)


@built_in("fifo", for_topics=True, source="first come, first served over all topics")
def fifo(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """First in, first out, whatever the topic; a full queue drops the oldest of the newcomer's topic."""
    return make_room(buffer, arrival)


def highest_priority(buffer: Buffer, memory: Memory) -> int:
    """Highest priority first, first in, first out among equals; low priorities starve while high ones fill the link."""
    best, highest = 0, -math.inf
    for k in range(len(buffer.slots)):
        priority = topic_of(buffer, buffer.slots[k]).priority
        if priority > highest:
            best, highest = k, priority
    return best


def most_aged(buffer: Buffer, memory: Memory) -> int:
    """The topic with the largest weight x age of information goes first.

    The age of a topic is the time since its newest *sent* message arrived at the sender, which is the age at the server
    once every sent message is there [kaul2012status]. A topic that has sent nothing is as old as its oldest queued
    message. Candidates are the oldest of each topic; of equals the oldest goes. This is the greedy policy of
    [kadota2018scheduling], which sends where the age is highest; here ages are weighted.
    """
    best, most = 0, -math.inf
    for k in range(len(buffer.slots)):
        if is_first(buffer, k):
            slot, topic = buffer.slots[k], topic_of(buffer, buffer.slots[k])
            newest_us = topic.dequeued_arrival_us if topic.dequeued > 0 else slot.arrival_us
            age = topic.weight * (buffer.now_us - newest_us)  # weight x us
            if age > most:
                best, most = k, age
    return best


def earliest_deadline(buffer: Buffer, memory: Memory) -> int:
    """Earliest deadline first: arrival + its topic's deadline; a message already late is still sent."""
    best, earliest_us = 0, 0
    for k in range(len(buffer.slots)):
        deadline_us = buffer.slots[k].arrival_us + topic_of(buffer, buffer.slots[k]).deadline_us
        if k == 0 or deadline_us < earliest_us:
            best, earliest_us = k, deadline_us
    return best


for name, on_send, source in (
    ("strict-priority", highest_priority, "strict priority queueing, as IEEE 802.1Q transmission selection"),
    ("age-greedy", most_aged, "age of information [kaul2012status]; greedy by weighted age [kadota2018scheduling]"),
    ("edf", earliest_deadline, "earliest deadline first, Liu and Layland 1973 [liu1973scheduling]"),
):
    built_in(name, on_send=on_send, for_topics=True, source=source, about=first_line(on_send))(fifo)
