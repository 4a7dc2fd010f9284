"""What a policy sees of its sender."""

from __future__ import annotations

from typing import Any

from bufgym.kernel import kernel
from bufgym.model.buffer import Buffer
from bufgym.sim.socket import carried_by_now
from bufgym.sim.state import ARRIVAL_WAITS, Batch


@kernel
def socket_bytes(batch: Batch, i: int) -> int:
    """Bytes of the messages that the socket took and that have not crossed as a whole."""
    sender = batch.senders[i]
    if sender.busy == 1:
        return int(batch.slots[i, sender.first - 1].size_bytes)
    total = 0
    for k in range(sender.transmitted, sender.dequeued):
        total += batch.arrivals[i, batch.order[i, k]].size_bytes
    return total


@kernel
def view(batch: Batch, i: int) -> Buffer:
    """What the policy of sender ``i`` may see now."""
    sender = batch.senders[i]
    capacity, first, occupancy = sender.capacity, sender.first, sender.occupancy
    sent = batch.slots[i, first - 1]
    dequeued_arrival_us, dequeued_x = sent.arrival_us, sent.x
    previous_us, previous_x = sender.previous_us, sender.previous_x
    if sender.dequeued == 0:
        dequeued_arrival_us, dequeued_x = previous_us, previous_x
        if sender.occupancy > 0:
            # a scheduler holds the first of all back
            dequeued_arrival_us, dequeued_x = batch.slots[i, first].arrival_us, batch.slots[i, first].x
    if sender.topics > 1 and sender.waiting == ARRIVAL_WAITS:
        # gaps are those of the newcomer's topic
        arrival = batch.arrivals[i, sender.next]
        topic = batch.topics[i, arrival.topic]
        previous_us, previous_x = arrival.arrival_us, arrival.x
        if topic.arrived > 0:
            previous_us, previous_x = topic.previous_us, topic.previous_x
        dequeued_arrival_us, dequeued_x = previous_us, previous_x
        if topic.dequeued > 0:
            dequeued_arrival_us, dequeued_x = topic.dequeued_arrival_us, topic.dequeued_x
        elif topic.queued > 0:
            k = first
            while batch.slots[i, k].topic != arrival.topic:
                k += 1
            dequeued_arrival_us, dequeued_x = batch.slots[i, k].arrival_us, batch.slots[i, k].x
    socket_total = socket_bytes(batch, i) if sender.busy > 0 else 0
    left_bytes = socket_total
    if sender.busy > 0 and (sender.last_dequeue_us < sender.now_us or sender.busy > 1):
        left_bytes = min(left_bytes, max(0, sender.position - carried_by_now(batch, i)))
    return Buffer(
        batch.slots[i, first : first + occupancy],
        capacity,
        sender.max_bytes,
        sender.backlog_bytes,
        sender.now_us,
        sender.dequeued,
        dequeued_arrival_us,
        dequeued_x,
        previous_us,
        previous_x,
        1 if sender.busy > 0 else 0,
        left_bytes,
        left_bytes / socket_total if sender.busy > 0 else 0.0,
        sender.now_us - sender.last_dequeue_us,
        sender.period_us,
        sender.departures,
        sender.service_ratio,
        batch.v,
        batch.topics[i],
        sender.window,
        sender.dequeued - sender.acked,
        batch.parameters,
    )


@kernel
def arrival_of(batch: Batch, i: int) -> Any:
    """The arrival that waits for a decision."""
    return batch.arrivals[i, batch.senders[i].next]
