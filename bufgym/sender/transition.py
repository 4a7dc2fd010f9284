"""The transition: one function moves a sender on to its next event, others carry out what was decided there."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from bufgym.buffer import ACCEPT, HOLD, REJECT, Buffer, evict, push
from bufgym.kernel import kernel
from bufgym.link import FOREVER, position_at, time_of
from bufgym.qoi import value
from bufgym.sender.rules import (
    arrives_on_topic,
    at_limit,
    kept_before,
    merge_on_topic,
    refuge,
    sendable,
    taken_on_topic,
    too_soon,
    topic_gain,
)
from bufgym.sender.state import DECISION, DEPARTURE, DEQUEUE, END, NEVER, SEND, Batch

# Weights of the running means: about the last 8 arrivals for the period, 16 for the drain.
_PERIOD_WEIGHT, _DRAIN_WEIGHT = 1 / 8, 1 / 16

ARRIVAL_WAITS, SOCKET_WAITS = 1, 2
"""What a sender may be ``waiting`` for: a decision on its arrival, or the choice of what to send."""


@kernel
def load_row(
    batch: Batch,
    i: int,
    arrivals: NDArray[Any],
    topics: NDArray[Any],
    buffer: tuple[int, int, int],
    decisions: tuple[int, int],
    link: tuple[int, int, int, int, int],
    window: tuple[int, int],
) -> None:
    """Put sender ``i`` at the beginning of an episode: empty buffer, idle socket, nothing arrived.

    ``topics``: TOPIC[topics], their settings; ``buffer``: capacity, max_bytes, ask_when_full; ``decisions``: first and
    last arrival that asks for one; ``link``: first and last knot, what follows the end, offset_us, propagation_us;
    ``window``: n_T and the time from a message's crossing to its pong, us.
    """
    for k in range(len(arrivals)):
        batch.arrivals[i, k] = arrivals[k]
        fate = batch.fates[i, k]
        fate.taken_us, fate.due_us, fate.crossed_us, fate.dropped_us, fate.limited = NEVER, NEVER, NEVER, NEVER, 0
    for k in range(len(topics)):
        batch.topics[i, k] = topics[k]
    sender = batch.senders[i]
    sender.capacity, sender.max_bytes, sender.ask_when_full = buffer
    sender.first_decision, sender.last_decision = decisions
    sender.first_knot, sender.last_knot, sender.after, sender.offset_us, sender.propagation_us = link
    sender.topics, sender.window, sender.pong_us = len(topics), window[0], window[1]
    sender.segment_now, sender.segment_finish = sender.first_knot, sender.first_knot
    sender.arrivals = len(arrivals)
    sender.first = 1
    sender.now_us, sender.next, sender.waiting, sender.occupancy, sender.backlog_bytes = 0, 0, 0, 0, 0
    sender.busy, sender.position, sender.finish_us = 0, 0, 0
    sender.ask_at_dequeue, sender.cleared, sender.follows = 0, 0, 0
    sender.ask_at_send, sender.chosen, sender.held, sender.ponged = 0, NEVER, 0, 0
    sender.limit_at_send, sender.flush_no_drop = 0, 0
    sender.taken, sender.crossed, sender.credited = 0, 0, 0
    sender.rejected, sender.evicted, sender.impossible, sender.peak_backlog_bytes = 0, 0, 0, 0
    sender.previous_us, sender.taken_at_us, sender.departures = 0, 0, 0
    sender.previous_x, sender.period_us, sender.drain = 0.0, 0.0, 0.0
    sender.delivered_gain, sender.retained_gain, sender.aged, sender.late = 0.0, 0.0, 0.0, 0.0


# --- the socket ------------------------------------------------------------------------------------------------------


@kernel
def take(batch: Batch, i: int, k: int) -> None:
    """Slot ``k`` goes from the buffer to the socket; when its bytes will have crossed is the link's affair."""
    sender = batch.senders[i]
    first = sender.first
    if k > 0:
        # All but its gain stands in the list of arrivals as well.
        seq, gain = batch.slots[i, first + k].seq, batch.slots[i, first + k].gain
        for j in range(first + k, first, -1):
            batch.slots[i, j] = batch.slots[i, j - 1]
        batch.slots[i, first] = batch.arrivals[i, seq]
        batch.slots[i, first].gain = gain
    head = batch.slots[i, first]
    batch.order[i, sender.taken] = head.seq
    sender.busy += 1
    sender.first += 1
    sender.occupancy -= 1
    sender.backlog_bytes -= head.size_bytes
    sender.taken += 1
    sender.taken_at_us = sender.now_us
    sender.departures += 1
    fate = batch.fates[i, head.seq]
    fate.taken_us, fate.gain = sender.now_us, head.gain
    if sender.topics > 1:
        taken_on_topic(batch, i, head)


@kernel
def transmit(batch: Batch, i: int) -> None:
    """The link carries what was taken last: behind the message before it, or from now on if the link was idle."""
    sender = batch.senders[i]
    head = batch.slots[i, sender.first - 1]
    if sender.busy == 1 and sender.follows == 0:
        reached, sender.segment_now = position_at(
            batch.knot_us,
            batch.knot_bytes,
            sender.first_knot,
            sender.last_knot,
            sender.after,
            sender.segment_now,
            sender.now_us + sender.offset_us,
        )
        sender.position = max(reached, sender.position)
    sender.position += head.size_bytes
    at_us, sender.segment_finish = time_of(
        batch.knot_us,
        batch.knot_bytes,
        sender.first_knot,
        sender.last_knot,
        sender.after,
        sender.segment_finish,
        sender.position,
    )
    due_us = at_us if at_us == FOREVER else at_us - sender.offset_us
    if sender.busy == 1:
        sender.finish_us = due_us
    else:
        batch.fates[i, head.seq].due_us = due_us


@kernel
def cross(batch: Batch, i: int) -> None:
    """The last byte of the message in transmission has crossed; without pongs to wait for, its place is free."""
    sender = batch.senders[i]
    seq = batch.order[i, sender.crossed]
    batch.fates[i, seq].crossed_us = sender.finish_us
    sender.now_us = sender.finish_us
    sender.crossed += 1
    sender.busy -= 1
    if sender.busy > 0:
        sender.finish_us = batch.fates[i, batch.order[i, sender.crossed]].due_us
    elif sender.occupancy > 0:
        sender.follows = 1
    if sender.pong_us == 0:
        sender.ponged += 1
        sender.held = 0


@kernel
def next_pong_us(batch: Batch, i: int) -> int:
    """When the next pong comes for a message that has crossed; FOREVER if none is on its way."""
    sender = batch.senders[i]
    if sender.ponged == sender.crossed:
        return FOREVER
    return int(batch.fates[i, batch.order[i, sender.ponged]].crossed_us + sender.pong_us)


@kernel
def credit(batch: Batch, i: int, until_us: int) -> None:
    """Count the information of what reached the server by ``until_us``, propagation included."""
    sender = batch.senders[i]
    while sender.credited < sender.crossed:
        seq = batch.order[i, sender.credited]
        fate = batch.fates[i, seq]
        received_us = fate.crossed_us + sender.propagation_us
        if until_us < received_us:
            break
        sender.delivered_gain += fate.gain
        sender.credited += 1
        if sender.topics > 1:
            arrives_on_topic(batch, i, batch.arrivals[i, seq], received_us)


# --- the next event --------------------------------------------------------------------------------------------------


@kernel
def may_take(batch: Batch, i: int) -> bool:
    """Whether the socket may take a message now: one is queued, and n_T leaves room in flight."""
    sender = batch.senders[i]
    if sender.occupancy == 0 or sender.held == 1:
        return False
    if sender.taken - sender.ponged < sender.window:
        return True
    if sender.flush_no_drop == 1:
        for k in range(sender.occupancy):
            if sendable(batch, i, k):
                return True
    return False


@kernel
def next_event(batch: Batch, i: int) -> int:
    """Move sender ``i`` on to its next DEPARTURE, DECISION, DEQUEUE, SEND or END (see the package's text)."""
    sender = batch.senders[i]
    while True:
        if may_take(batch, i):
            if sender.ask_at_dequeue > sender.cleared:
                return DEQUEUE
            if sender.ask_at_send == 1 and sender.chosen == NEVER:
                sender.waiting = SOCKET_WAITS
                return SEND
            if sender.chosen == NEVER and (sender.limit_at_send == 1 or sender.flush_no_drop == 1):
                choose(batch, i, oldest_sendable(batch, i))
                continue
            take(batch, i, max(sender.chosen, 0))
            transmit(batch, i)
            sender.cleared, sender.follows, sender.chosen = 0, 0, NEVER
            return DEPARTURE
        sender.follows = 0
        more = sender.next < sender.arrivals
        arrives_us = batch.arrivals[i, sender.next].arrival_us if more else FOREVER - 1
        pong_us = next_pong_us(batch, i) if sender.pong_us > 0 else FOREVER
        if sender.busy > 0 and sender.finish_us <= arrives_us and sender.finish_us < pong_us:
            cross(batch, i)
            continue
        if sender.pong_us > 0 and pong_us <= arrives_us:
            sender.now_us = pong_us
            sender.ponged += 1
            sender.held = 0
            continue
        if not more:
            return END
        if arrive(batch, i):
            sender.waiting = ARRIVAL_WAITS
            return DECISION


@kernel
def arrive(batch: Batch, i: int) -> bool:
    """The next message arrives. Whether it asks for a decision; if not it is enqueued where there is room."""
    sender = batch.senders[i]
    arrival = batch.arrivals[i, sender.next]
    arrives_us = arrival.arrival_us
    sender.now_us = arrives_us
    sender.held = 0
    if sender.next > 0:
        gap_us = arrives_us - sender.previous_us
        if sender.next == 1:
            sender.period_us = float(gap_us)
        sender.period_us += _PERIOD_WEIGHT * (gap_us - sender.period_us)
        sender.drain += _DRAIN_WEIGHT * (sender.departures - sender.drain)
    else:
        sender.previous_us, sender.previous_x = arrives_us, arrival.x
    if sender.topics > 1 and sender.limit_at_send == 0 and too_soon(batch, i, arrival.topic):
        batch.fates[i, sender.next].limited = 1
        decide(batch, i, REJECT)  # which is possible: a no_drop topic has no rate limit
        return False
    asked = sender.first_decision <= sender.next <= sender.last_decision
    if asked and not (sender.ask_when_full == 1 and has_room(batch, i)):
        return True
    decide(batch, i, ACCEPT)
    return False


# --- decisions -------------------------------------------------------------------------------------------------------


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
    fate = batch.fates[i, sender.next]
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
            if topic.taken + topic.queued == 0:
                # until one is sent, spacing counts from here
                topic.taken_us, topic.taken_x = arrival.arrival_us, arrival.x
            topic.queued += 1
            topic.kept_us = arrival.arrival_us
        elif sender.taken > 0 or sender.occupancy > 0:
            arrival.gain = value(batch.v, arrival.x - batch.slots[i, sender.first + sender.occupancy - 1].x)
        sender.retained_gain += arrival.gain
        sender.first = push(batch.slots, i, sender.first, sender.occupancy, arrival)
        sender.occupancy += 1
        sender.backlog_bytes += arrival.size_bytes
        sender.peak_backlog_bytes = max(sender.peak_backlog_bytes, sender.backlog_bytes)
    else:
        fate.dropped_us = sender.now_us
        sender.rejected += 1
    if not possible:
        sender.impossible += 1
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
    batch.fates[i, gone.seq].dropped_us = sender.now_us
    if sender.topics > 1:
        merge_on_topic(batch, i, k)
    elif k + 1 < sender.occupancy:
        after = batch.slots[i, sender.first + k + 1]
        merged = 0.0
        if sender.taken > 0 or k > 0:
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
    if sender.next < sender.arrivals or sender.ponged < sender.taken:
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
        sender.impossible += 1
        k = oldest_sendable(batch, i)
    choose(batch, i, k)
    return possible


# --- what is seen ----------------------------------------------------------------------------------------------------


@kernel
def socket_bytes(batch: Batch, i: int) -> int:
    """Bytes of the messages that the socket took and that have not crossed as a whole."""
    sender = batch.senders[i]
    if sender.busy == 1:
        return int(batch.slots[i, sender.first - 1].size_bytes)
    total = 0
    for k in range(sender.crossed, sender.taken):
        total += batch.arrivals[i, batch.order[i, k]].size_bytes
    return total


@kernel
def view(batch: Batch, i: int) -> Buffer:
    """What the policy of sender ``i`` may see now."""
    sender = batch.senders[i]
    capacity, first, occupancy = sender.capacity, sender.first, sender.occupancy
    sent = batch.slots[i, first - 1]
    taken_us, taken_x = sent.arrival_us, sent.x
    previous_us, previous_x = sender.previous_us, sender.previous_x
    if sender.taken == 0:
        taken_us, taken_x = previous_us, previous_x
        if sender.occupancy > 0:
            # a scheduler holds the first of all back
            taken_us, taken_x = batch.slots[i, first].arrival_us, batch.slots[i, first].x
    if sender.topics > 1 and sender.waiting == ARRIVAL_WAITS:
        # gaps are those of the newcomer's topic
        arrival = batch.arrivals[i, sender.next]
        topic = batch.topics[i, arrival.topic]
        previous_us, previous_x = arrival.arrival_us, arrival.x
        if topic.arrived > 0:
            previous_us, previous_x = topic.previous_us, topic.previous_x
        taken_us, taken_x = previous_us, previous_x
        if topic.taken > 0:
            taken_us, taken_x = topic.taken_us, topic.taken_x
        elif topic.queued > 0:
            k = first
            while batch.slots[i, k].topic != arrival.topic:
                k += 1
            taken_us, taken_x = batch.slots[i, k].arrival_us, batch.slots[i, k].x
    taken_bytes = socket_bytes(batch, i) if sender.busy > 0 else 0
    left_bytes = taken_bytes
    if sender.busy > 0 and (sender.taken_at_us < sender.now_us or sender.busy > 1):
        reached, sender.segment_now = position_at(
            batch.knot_us,
            batch.knot_bytes,
            sender.first_knot,
            sender.last_knot,
            sender.after,
            sender.segment_now,
            sender.now_us + sender.offset_us,
        )
        left_bytes = min(left_bytes, max(0, sender.position - reached))
    return Buffer(
        batch.slots[i, first : first + occupancy],
        capacity,
        sender.max_bytes,
        sender.backlog_bytes,
        sender.now_us,
        sender.taken,
        taken_us,
        taken_x,
        previous_us,
        previous_x,
        1 if sender.busy > 0 else 0,
        left_bytes,
        left_bytes / taken_bytes if sender.busy > 0 else 0.0,
        sender.now_us - sender.taken_at_us,
        sender.period_us,
        sender.departures,
        sender.drain,
        batch.v,
        batch.topics[i],
        sender.window,
        sender.taken - sender.ponged,
    )


@kernel
def arrival_of(batch: Batch, i: int) -> Any:
    """The arrival that waits for a decision."""
    return batch.arrivals[i, batch.senders[i].next]
