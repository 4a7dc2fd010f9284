"""Carrying out what was decided: at an arrival, at the head of the queue, and which message the socket takes."""

from __future__ import annotations

from bufgym.kernel import kernel
from bufgym.model.buffer import ACCEPT, HOLD, REJECT, evict, push
from bufgym.model.qoi import value
from bufgym.sim.rules import (
    at_limit,
    kept_before,
    merge_on_topic,
    refuge,
    sendable,
    topic_gain,
)
from bufgym.sim.state import Batch

# --- at an arrival ----------------------------------------------------------------------------------------------------


@kernel
def has_room(batch: Batch, i: int) -> bool:
    """Whether the arrival at hand fits without a drop, by messages and by bytes."""
    sender = batch.senders[i]
    arrival = batch.arrivals[i, sender.next]
    if sender.topics > 1 and at_limit(batch, i, arrival.topic):
        return False
    return bool(sender.occupancy < sender.capacity and sender.backlog_bytes + arrival.size_bytes <= sender.max_bytes)


@kernel
def can_evict(batch: Batch, i: int, k: int) -> bool:
    """Whether evicting slot ``k`` makes the arrival at hand fit."""
    sender = batch.senders[i]
    if not 0 <= k < sender.occupancy:
        return False
    slot = batch.slots[i, sender.first + k]
    arrival = batch.arrivals[i, sender.next]
    if sender.topics > 1:
        if batch.topics[i, slot.topic].no_drop == 1:
            return False
        if slot.topic != arrival.topic and at_limit(batch, i, arrival.topic):
            return False
    return bool(sender.backlog_bytes - slot.size_bytes + arrival.size_bytes <= sender.max_bytes)


@kernel
def can_reject(batch: Batch, i: int) -> bool:
    """Whether the arrival at hand may be dropped: always, but for a no_drop message that could be kept somehow."""
    sender = batch.senders[i]
    if sender.topics == 1 or batch.topics[i, batch.arrivals[i, sender.next].topic].no_drop == 0:
        return True
    return not has_room(batch, i) and refuge(batch, i) < 0


@kernel
def decide(batch: Batch, i: int, decision: int) -> bool:
    """Carry out a decision on the arrival at hand; False if it was impossible and did what a queue does instead.

    That is: accept where there is room, reject where there is none; for a no_drop message evict the oldest message of
    the lowest priority.
    """
    sender = batch.senders[i]
    arrival = batch.arrivals[i, sender.next]
    entry = batch.log[i, sender.next]
    possible = True
    enqueue = True
    if decision >= 0 and can_evict(batch, i, decision):
        remove(batch, i, decision)
        sender.evicted += 1
    elif decision == REJECT and can_reject(batch, i):
        enqueue = False
    else:
        enqueue = has_room(batch, i)
        possible = decision == ACCEPT and enqueue
        if not enqueue and sender.topics > 1 and not can_reject(batch, i):
            remove(batch, i, refuge(batch, i))
            sender.evicted += 1
            enqueue = True
    if enqueue:
        # The first message of all, or of its topic, is the 1 in H = 1 + sum of V.
        arrival.gain = 0.0
        if sender.topics > 1:
            arrival.gain = topic_gain(batch, i, sender.occupancy, arrival.topic, arrival.x)
            topic = batch.topics[i, arrival.topic]
            if topic.dequeued + topic.queued == 0:
                # until one is sent, spacing counts from here
                topic.dequeued_arrival_us, topic.dequeued_x = arrival.arrival_us, arrival.x
            topic.queued += 1
            topic.kept_us = arrival.arrival_us
        elif sender.dequeued > 0 or sender.occupancy > 0:
            arrival.gain = value(batch.v, arrival.x - batch.slots[i, sender.first + sender.occupancy - 1].x)
        sender.retained_gain += arrival.gain
        sender.first = push(batch.slots, i, sender.first, sender.occupancy, arrival)
        sender.occupancy += 1
        sender.backlog_bytes += arrival.size_bytes
        sender.peak_backlog_bytes = max(sender.peak_backlog_bytes, sender.backlog_bytes)
    else:
        entry.dropped_us = sender.now_us
        sender.rejected += 1
    if not possible:
        sender.invalid += 1
    if sender.topics > 1:
        topic = batch.topics[i, arrival.topic]
        topic.step_us, topic.step_x = 0, 0.0
        if topic.arrived > 0:
            topic.step_us, topic.step_x = arrival.arrival_us - topic.previous_us, arrival.x - topic.previous_x
        else:
            topic.aged_us, topic.newest_us = arrival.arrival_us, arrival.arrival_us
        topic.previous_us, topic.previous_x = arrival.arrival_us, arrival.x
        topic.arrived += 1
    sender.previous_us, sender.previous_x = arrival.arrival_us, arrival.x
    sender.departures = 0
    sender.waiting = 0
    sender.next += 1
    return possible


@kernel
def remove(batch: Batch, i: int, k: int) -> None:
    """Evict slot ``k``: its gap and its successor's become one."""
    sender = batch.senders[i]
    gone = batch.slots[i, sender.first + k]
    sender.backlog_bytes -= gone.size_bytes
    sender.retained_gain -= gone.gain
    batch.log[i, gone.seq].dropped_us = sender.now_us
    if sender.topics > 1:
        merge_on_topic(batch, i, k)
    elif k + 1 < sender.occupancy:
        after = batch.slots[i, sender.first + k + 1]
        merged = 0.0
        if sender.dequeued > 0 or k > 0:
            merged = value(batch.v, after.x - batch.slots[i, sender.first + k - 1].x)
        sender.retained_gain += merged - after.gain
        after.gain = merged
    sender.first = evict(batch.slots, i, sender.first, sender.occupancy, k)
    sender.occupancy -= 1


@kernel
def answer_dequeue(batch: Batch, i: int, drop: bool) -> None:
    """The policy's answer to DEQUEUE: drop the head, or let the socket take it. A no_drop message is never dropped."""
    sender = batch.senders[i]
    if not drop or (sender.topics > 1 and batch.topics[i, batch.slots[i, sender.first].topic].no_drop == 1):
        sender.cleared = 1
        return
    remove(batch, i, 0)
    sender.evicted += 1
    if sender.occupancy == 0:
        sender.follows = 0  # nobody follows: the link goes idle


# --- choices of a scheduler ------------------------------------------------------------------------------------------


@kernel
def can_send(batch: Batch, i: int, k: int) -> bool:
    """Whether the free socket may take slot ``k``: the oldest of its topic, by n_T and by its rate limit."""
    sender = batch.senders[i]
    if not 0 <= k < sender.occupancy:
        return False
    if sender.topics == 1:
        return k == 0
    if kept_before(batch, i, k, batch.slots[i, sender.first + k].topic) >= 0:
        return False
    return sendable(batch, i, k)


@kernel
def can_hold(batch: Batch, i: int) -> bool:
    """Whether the socket may wait: for something that is still to come, or because nothing may be sent."""
    sender = batch.senders[i]
    if sender.next < sender.arrivals or sender.acked < sender.dequeued:
        return True
    return oldest_sendable(batch, i) == HOLD


@kernel
def oldest_sendable(batch: Batch, i: int) -> int:
    """The oldest slot that the free socket may take, HOLD if there is none."""
    for k in range(batch.senders[i].occupancy):
        if can_send(batch, i, k):
            return k
    return HOLD


@kernel
def choose(batch: Batch, i: int, k: int) -> None:
    """The socket takes slot ``k`` next; HOLD: nothing before the next arrival or pong, and then all is asked anew."""
    sender = batch.senders[i]
    if k == HOLD:
        sender.held, sender.follows, sender.cleared = 1, 0, 0
    else:
        sender.chosen = k


@kernel
def answer_send(batch: Batch, i: int, k: int) -> bool:
    """The scheduler's answer to SEND: the slot that the socket takes, or HOLD; False if it was impossible.

    Then the oldest message that may be sent goes, and the socket waits if there is none.
    """
    sender = batch.senders[i]
    sender.waiting = 0
    possible = True
    if k == HOLD:
        possible = can_hold(batch, i)
    else:
        possible = can_send(batch, i, k)
    if not possible:
        sender.invalid += 1
        k = oldest_sendable(batch, i)
    choose(batch, i, k)
    return possible
