"""Carrying out decisions: at an arrival, at the head of the queue, and on the message to dequeue."""

from bufgym.jit import kernel, unchecked_at, unchecked_slice
from bufgym.model.buffer import ACCEPT, HOLD, REJECT, evict, of_topic, push, running_mean
from bufgym.model.past import begin_past, remember_past
from bufgym.sim import rules
from bufgym.sim.socket import held_bytes, left_of
from bufgym.sim.state import (
    ARRIVAL_WAITS,
    CARRIES,
    CHOSEN,
    CLEARED,
    DECISION,
    HELD,
    NEVER,
    NOTHING,
    NOTHING_WAITS,
    UNASKED,
    Batch,
    place_of,
)

# Weights of the running means: about the last 8 arrivals for the period and the bytes, 16 for the service ratio.
_PERIOD_WEIGHT, _SERVICE_WEIGHT = 1 / 8, 1 / 16
# Sending time over which the link's rate is averaged, us.
_SHORT_US, _MEDIUM_US, _LONG_US = 100_000, 500_000, 2_000_000


@kernel
def arrive(batch: Batch, i: int) -> int:
    """Let the next message arrive: DECISION if it asks for one; else NOTHING, and it is enqueued if there is room."""
    sender = batch.senders[i]
    arrival = unchecked_at(batch.arrivals, i, sender.next)
    arrives_us = arrival.arrival_us
    sender.now_us = arrives_us
    sender.socket = UNASKED
    entry = unchecked_at(batch.log, i, sender.next)
    # Loading an episode leaves the log of the one before; each entry is cleared as its message arrives.
    entry.dequeued_us, entry.transmitted_us, entry.dropped_us, entry.limited, entry.gain = NEVER, NEVER, NEVER, 0, 0.0
    if sender.next > 0:
        gap_us = arrives_us - sender.previous_us
        # The first gap is the mean; the line below it then changes nothing.
        if sender.next == 1:
            sender.period_us = float(gap_us)
        sender.period_us += _PERIOD_WEIGHT * (gap_us - sender.period_us)
        sender.arrival_bytes += _PERIOD_WEIGHT * (arrival.size_bytes - sender.arrival_bytes)
        sender.service_ratio += _SERVICE_WEIGHT * (sender.departures - sender.service_ratio)
        if sender.measures == 1:
            measure_rate(batch, i)
            if sender.remembers == 1:
                remember_past(
                    batch.past[i], arrives_us, gap_us, arrival.x, arrival.x - sender.previous_x,
                    sender.sent_bytes, sender.sending_us, 1e6 * sender.medium_rate,
                )  # fmt: skip
    else:
        begin_past(batch.past[i], arrives_us, arrival.x)
        sender.previous_us, sender.previous_x = arrives_us, arrival.x
        sender.arrival_bytes = float(arrival.size_bytes)
    # Rate limits come before the policy, as in Robofleet's client: it never sees what they drop.
    if batch.several is not None and sender.limit_at_send == 0 and rules.too_soon(batch, i, arrival.topic):
        entry.limited = 1
        decision = REJECT
    else:
        asked = sender.first_decision <= sender.next <= sender.last_decision
        decision = ACCEPT
        if sender.screens == 1:
            sender.evictions = 0
            asked = asked and not (sender.ask_when_full == 1 and has_room(batch, i))
            if arrival.size_bytes > sender.max_bytes:
                asked, decision = False, REJECT  # it can't fit, whatever is evicted
        if asked:
            sender.waiting = ARRIVAL_WAITS
            return DECISION
    seq = sender.next
    while sender.next == seq:  # a no_drop message may need several evictions
        decide(batch, i, decision)
    return NOTHING


@kernel
def measure_rate(batch: Batch, i: int) -> None:
    """Measure the link's rate since the previous arrival, by the bytes that left the socket.

    A running mean over about the time w gives an interval of u us the weight u / (u + w). Before a time w has been
    seen, w is the time seen so far. Time without bytes to send does not count.
    """
    sender = batch.senders[i]
    # Measured once and stored: the views of this arrival would otherwise look it up on the trace again.
    held = held_bytes(batch, i)
    sender.left_bytes = left_of(batch, i, held)
    sent_bytes = sender.dequeued_bytes - sender.left_bytes
    sending_us = sender.carried_us + (sender.now_us - sender.began_us if sender.link == CARRIES else 0)
    sent, us = sent_bytes - sender.sent_bytes, sending_us - sender.sending_us
    sender.drained_bytes, sender.drained_us = sent, us
    if us > 0:
        seen_us = sender.sending_us
        sender.short_rate = running_mean(sender.short_rate, sent, us, seen_us, _SHORT_US)
        sender.medium_rate = running_mean(sender.medium_rate, sent, us, seen_us, _MEDIUM_US)
        sender.long_rate = running_mean(sender.long_rate, sent, us, seen_us, _LONG_US)
    sender.sent_bytes, sender.sending_us = sent_bytes, sending_us


@kernel
def has_room(batch: Batch, i: int) -> bool:
    """Whether the present arrival fits without a drop, by messages and by bytes."""
    sender = batch.senders[i]
    arrival = unchecked_at(batch.arrivals, i, sender.next)
    if sender.occupancy >= sender.capacity or rules.at_limit(batch, i, arrival.topic):
        return False
    return bool(sender.backlog_bytes + arrival.size_bytes <= sender.max_bytes)


@kernel
def can_evict(batch: Batch, i: int, k: int) -> bool:
    """Whether slot ``k`` may go for the present arrival. In one queue any may, even if more have to follow.

    With several topics it must be droppable, and of the newcomer's topic if that is at its limit. In the end bytes must
    suffice.
    """
    sender = batch.senders[i]
    if not 0 <= k < sender.occupancy:
        return False
    if batch.several is None:
        return True
    topic = unchecked_at(batch.slots, i, sender.first + k).topic
    arriving = unchecked_at(batch.arrivals, i, sender.next).topic
    if rules.no_drop(batch, i, topic) or (topic != arriving and rules.at_limit(batch, i, arriving)):
        return False
    return rules.can_fit(batch, i)


@kernel
def can_reject(batch: Batch, i: int) -> bool:
    """Whether the present arrival may be dropped: always, except a no_drop message that could be kept somehow.

    The rate limit comes first: a message that comes too soon is dropped even on a no_drop topic.
    """
    if batch.several is None:
        return True
    sender = batch.senders[i]
    topic, limited = (
        unchecked_at(batch.arrivals, i, sender.next).topic,
        unchecked_at(batch.log, i, sender.next).limited == 1,
    )
    return (
        limited
        or not rules.no_drop(batch, i, topic)
        or (not has_room(batch, i) and rules.last_resort_victim(batch, i) < 0)
    )


@kernel
def decide(batch: Batch, i: int, decision: int) -> bool:
    """Carry out a decision on the present arrival; False if it was invalid and did what a queue does instead.

    That is: accept if there is room, reject if there is none; for a no_drop message evict the oldest message of the
    lowest priority. If B has no room even after an eviction, the arrival waits on and the policy is asked again.
    """
    sender = batch.senders[i]
    arrival = unchecked_at(batch.arrivals, i, sender.next)
    valid, enqueue, victim = True, True, -1
    if decision >= 0 and can_evict(batch, i, decision):
        victim = decision
    elif decision == REJECT and can_reject(batch, i):
        enqueue = False
    else:
        enqueue = has_room(batch, i)
        valid = decision == ACCEPT and enqueue
        if batch.several is not None and not enqueue and rules.no_drop(batch, i, arrival.topic):
            victim = rules.last_resort_victim(batch, i)
            enqueue = victim >= 0
    if not valid:
        sender.invalid += 1
    if victim >= 0:
        remove(batch, i, victim)
        if sender.screens == 1 and sender.backlog_bytes + arrival.size_bytes > sender.max_bytes:
            # ``next`` stays where it is, so the same DECISION comes again with the present queue.
            sender.evictions += 1
            return valid
    if enqueue:
        # The first message of all, or of its topic, is the 1 in H = 1 + sum of V.
        gain = rules.gain_behind(batch, i, sender.occupancy, arrival.topic, arrival.x)
        sender.retained_gain += gain
        sender.first = push(batch.slots, i, sender.first, sender.occupancy, arrival)
        unchecked_at(batch.slots, i, sender.first + sender.occupancy).gain = gain
        sender.occupancy += 1
        sender.backlog_bytes += arrival.size_bytes
        sender.peak_backlog_bytes = max(sender.peak_backlog_bytes, sender.backlog_bytes)
    else:
        unchecked_at(batch.log, i, sender.next).dropped_us = sender.now_us
        sender.rejected += 1
    if batch.several is not None:
        rules.arrived_on_topic(batch, i, arrival, enqueue)
    sender.previous_us, sender.previous_x = arrival.arrival_us, arrival.x
    # Departures count from the arrival that was decided on last.
    sender.departures = 0
    sender.waiting = NOTHING_WAITS
    sender.next += 1
    return valid


@kernel
def remove(batch: Batch, i: int, k: int) -> None:
    """Evict slot ``k``: its gap and the next one on its topic become one."""
    sender = batch.senders[i]
    gone = unchecked_at(batch.slots, i, sender.first + k)
    sender.backlog_bytes -= gone.size_bytes
    sender.retained_gain -= gone.gain
    unchecked_at(batch.log, i, place_of(batch, i, gone)).dropped_us = sender.now_us
    if batch.several is not None:
        unchecked_at(batch.topics, i, gone.topic).queued -= 1
    j = k + 1
    if batch.several is not None:
        j = of_topic(unchecked_slice(batch.slots, i, sender.first, sender.occupancy), k, gone.topic, 1)
    if j < sender.occupancy:
        behind = unchecked_at(batch.slots, i, sender.first + j)
        # Before the slot is closed, while k is still the place of the message that goes.
        merged = rules.gain_behind(batch, i, k, gone.topic, behind.x)
        sender.retained_gain += merged - behind.gain
        behind.gain = merged
    sender.first = evict(batch.slots, i, sender.first, sender.occupancy, k)
    sender.occupancy -= 1
    sender.evicted += 1


@kernel
def answer_dequeue(batch: Batch, i: int, drop: bool) -> None:
    """Take the policy's answer to DEQUEUE: drop the head, or let it go. A no_drop message is never dropped."""
    sender = batch.senders[i]
    if drop and not rules.no_drop(batch, i, unchecked_at(batch.slots, i, sender.first).topic):
        remove(batch, i, 0)
    else:
        # Not asked again about this head, only after the next departure, arrival or ack.
        sender.socket = CLEARED


@kernel
def can_send(batch: Batch, i: int, k: int) -> bool:
    """Whether the socket may dequeue slot ``k``: it is the oldest of its topic, and n_T and its rate limit allow it."""
    sender = batch.senders[i]
    if not 0 <= k < sender.occupancy:
        return False
    topic = unchecked_at(batch.slots, i, sender.first + k).topic
    older = k - 1
    if batch.several is not None:
        older = of_topic(unchecked_slice(batch.slots, i, sender.first, sender.occupancy), k, topic, -1)
    return older < 0 and rules.sendable(batch, i, k)


@kernel
def can_hold(batch: Batch, i: int) -> bool:
    """Whether the socket may wait: an event is still to come, or nothing may be sent."""
    sender = batch.senders[i]
    if sender.next < sender.arrivals or sender.acked < sender.dequeued:
        return True
    return oldest_sendable(batch, i) == HOLD


@kernel
def oldest_sendable(batch: Batch, i: int) -> int:
    """The oldest slot that the socket may dequeue, or HOLD."""
    for k in range(batch.senders[i].occupancy):
        if can_send(batch, i, k):
            return k
    return HOLD


@kernel
def choose(batch: Batch, i: int, k: int) -> None:
    """Let the socket dequeue slot ``k`` next; HOLD waits for the next arrival or ack, which asks again."""
    sender = batch.senders[i]
    if k == HOLD:
        sender.socket = HELD
    else:
        sender.socket, sender.chosen = CHOSEN, k


@kernel
def answer_send(batch: Batch, i: int, k: int) -> bool:
    """Take the scheduler's answer to SEND: the slot that the socket dequeues, or HOLD; False if it was invalid.

    An invalid answer sends the oldest message that may be sent; if there is none, the socket waits.
    """
    sender = batch.senders[i]
    sender.waiting = NOTHING_WAITS
    valid = can_hold(batch, i) if k == HOLD else can_send(batch, i, k)
    if not valid:
        sender.invalid += 1
        k = oldest_sendable(batch, i)
    choose(batch, i, k)
    return valid
