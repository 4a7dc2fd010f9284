"""What several topics side by side add to the sender: each has its own gaps, limits and rights.

A topic's messages are sent in the order of their arrival. ``no_drop`` messages are neither evicted nor rejected while
anything else could make room for them. Rate limits, ``no_drop`` and the in-flight window are Robofleet's
(github ut-amrl/robofleet_client_lib); FACTS of the published and the released client differ, both are settings here.
"""

from __future__ import annotations

from typing import Any

from bufgym.kernel import kernel
from bufgym.model.qoi import value
from bufgym.sim.state import Batch


@kernel
def kept_before(batch: Batch, i: int, k: int, topic: int) -> int:
    """The slot before slot ``k`` on the same topic, -1 where there is none."""
    first = batch.senders[i].first
    j = k - 1
    while j >= 0 and batch.slots[i, first + j].topic != topic:
        j -= 1
    return j


@kernel
def topic_gain(batch: Batch, i: int, k: int, topic: int, x: float) -> float:
    """Weight times V of the gap from what is kept before slot ``k`` on its topic to ``x``; 0 for its first message."""
    rules = batch.topics[i, topic]
    j = kept_before(batch, i, k, topic)
    if j >= 0:
        return float(rules.weight * value(batch.v[rules.v_start :], x - batch.slots[i, batch.senders[i].first + j].x))
    if rules.dequeued > 0:
        return float(rules.weight * value(batch.v[rules.v_start :], x - rules.dequeued_x))
    return 0.0


@kernel
def merge_on_topic(batch: Batch, i: int, k: int) -> None:
    """Slot ``k`` is about to be evicted: the gap of the next message on its topic reaches back over it."""
    sender = batch.senders[i]
    topic = batch.slots[i, sender.first + k].topic
    batch.topics[i, topic].queued -= 1
    for j in range(k + 1, sender.occupancy):
        after = batch.slots[i, sender.first + j]
        if after.topic == topic:
            merged = topic_gain(batch, i, k, topic, after.x)
            sender.retained_gain += merged - after.gain
            after.gain = merged
            return


@kernel
def dequeued_on_topic(batch: Batch, i: int, message: Any) -> None:
    """The socket has taken ``message``."""
    topic = batch.topics[i, message.topic]
    topic.queued -= 1
    topic.dequeued += 1
    topic.dequeued_arrival_us, topic.dequeued_x = message.arrival_us, message.x
    topic.last_dequeue_us = batch.senders[i].now_us


@kernel
def age_until(batch: Batch, i: int, topic: int, until_us: int) -> None:
    """Count the age of a topic's information at the server up to ``until_us``, times its weight.

    It begins with the topic's first arrival and ends with the episode's last, whatever a policy does.
    """
    sender = batch.senders[i]
    rules = batch.topics[i, topic]
    until_us = min(until_us, batch.arrivals[i, sender.arrivals - 1].arrival_us)
    if rules.arrived == 0 or until_us <= rules.aged_us:
        return
    from_s, until_s = (rules.aged_us - rules.newest_us) / 1e6, (until_us - rules.newest_us) / 1e6
    area = (from_s + until_s) / 2 * (until_s - from_s)
    rules.aged += area
    sender.aged += rules.weight * area
    rules.aged_us = until_us


@kernel
def arrives_on_topic(batch: Batch, i: int, message: Any, received_us: int) -> None:
    """``message`` has reached the server: its topic is younger again, and it may have come too late."""
    age_until(batch, i, message.topic, received_us)
    topic = batch.topics[i, message.topic]
    topic.received += 1
    topic.newest_us = max(topic.newest_us, message.arrival_us)
    if received_us - message.arrival_us > topic.deadline_us:
        batch.senders[i].late += topic.weight


@kernel
def too_soon(batch: Batch, i: int, topic: int) -> bool:
    """Whether the arrival at hand comes sooner after the last one kept than its topic's rate limit allows."""
    rules = batch.topics[i, topic]
    return bool(rules.kept_us >= 0 and batch.senders[i].now_us - rules.kept_us < rules.period_us)


@kernel
def at_limit(batch: Batch, i: int, topic: int) -> bool:
    """Whether as many messages of this topic are queued as may be."""
    rules = batch.topics[i, topic]
    return bool(rules.queued >= rules.limit)


@kernel
def refuge(batch: Batch, i: int) -> int:
    """The slot that goes for a no_drop message when nothing else helps: lowest priority, oldest; -1 if none may."""
    sender = batch.senders[i]
    size_bytes = batch.arrivals[i, sender.next].size_bytes
    best = -1
    lowest = 0.0
    for k in range(sender.occupancy):
        slot = batch.slots[i, sender.first + k]
        rules = batch.topics[i, slot.topic]
        fits = sender.backlog_bytes - slot.size_bytes + size_bytes <= sender.max_bytes
        if rules.no_drop == 0 and fits and (best < 0 or rules.priority < lowest):
            best, lowest = k, rules.priority
    return best


@kernel
def sendable(batch: Batch, i: int, k: int) -> bool:
    """Whether slot ``k`` may be sent by the window and, where rate limits hold back at the socket, by its own."""
    sender = batch.senders[i]
    full = sender.dequeued - sender.acked >= sender.window
    if sender.topics == 1:
        return not full
    rules = batch.topics[i, batch.slots[i, sender.first + k].topic]
    if full and not (sender.flush_no_drop == 1 and rules.no_drop == 1):
        return False
    held_back = (
        sender.limit_at_send == 1 and rules.dequeued > 0 and sender.now_us - rules.last_dequeue_us < rules.period_us
    )
    return not held_back
