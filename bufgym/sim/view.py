"""What a policy sees of its sender."""

from __future__ import annotations

from typing import Any

from bufgym.kernel import at, kernel, stretch
from bufgym.model.buffer import Buffer
from bufgym.model.link import carried_by
from bufgym.sim.socket import next_size_bytes
from bufgym.sim.state import ARRIVAL_WAITS, Batch


@kernel
def left_of_all(batch: Batch, i: int) -> tuple[int, int]:
    """(bytes not yet transmitted, all bytes) of the messages in a busy socket."""
    sender = batch.senders[i]
    total_bytes = at(batch.slots, i, sender.first - 1).size_bytes
    if sender.busy == 1 and sender.last_dequeue_us == sender.now_us:
        return total_bytes, total_bytes
    for k in range(sender.transmitted, sender.dequeued - 1):
        total_bytes += at(batch.arrivals, i, at(batch.order, i, k)).size_bytes
    waiting_bytes = total_bytes - next_size_bytes(batch, i)
    carried_bytes = carried_by(batch.knot_us, batch.knot_bytes, sender, sender.now_us)
    left_bytes = sender.position - carried_bytes + waiting_bytes
    return min(total_bytes, max(0, left_bytes)), total_bytes


@kernel
def view(batch: Batch, i: int) -> Buffer:
    """What the policy of sender ``i`` may see now."""
    sender = batch.senders[i]
    first, occupancy = sender.first, sender.occupancy
    last = at(batch.slots, i, first - 1)
    dequeued_arrival_us, dequeued_x = last.arrival_us, last.x
    previous_us, previous_x = sender.previous_us, sender.previous_x
    if sender.dequeued == 0:
        dequeued_arrival_us, dequeued_x = previous_us, previous_x
        if occupancy > 0:
            # a scheduler holds the first of all back
            dequeued_arrival_us, dequeued_x = at(batch.slots, i, first).arrival_us, at(batch.slots, i, first).x
    if sender.topics > 1 and sender.waiting == ARRIVAL_WAITS:
        # gaps are those of the newcomer's topic
        arrival = at(batch.arrivals, i, sender.next)
        topic = at(batch.topics, i, arrival.topic)
        previous_us, previous_x = arrival.arrival_us, arrival.x
        if topic.arrived > 0:
            previous_us, previous_x = topic.previous_us, topic.previous_x
        dequeued_arrival_us, dequeued_x = previous_us, previous_x
        if topic.dequeued > 0:
            dequeued_arrival_us, dequeued_x = topic.dequeued_arrival_us, topic.dequeued_x
        elif topic.queued > 0:
            k = first
            while at(batch.slots, i, k).topic != arrival.topic:
                k += 1
            dequeued_arrival_us, dequeued_x = at(batch.slots, i, k).arrival_us, at(batch.slots, i, k).x
    left_bytes, left_fraction = 0, 0.0
    if sender.busy > 0:
        left_bytes, total_bytes = left_of_all(batch, i)
        left_fraction = left_bytes / total_bytes
    return Buffer(
        stretch(batch.slots, i, first, occupancy),
        sender.capacity,
        sender.max_bytes,
        sender.backlog_bytes,
        sender.now_us,
        sender.forgotten + sender.dequeued,
        dequeued_arrival_us,
        dequeued_x,
        previous_us,
        previous_x,
        1 if sender.busy > 0 else 0,
        left_bytes,
        left_fraction,
        sender.now_us - sender.last_dequeue_us,
        sender.period_us,
        sender.departures,
        sender.service_ratio,
        batch.v[sender.v_start :],
        stretch(batch.topics, i, 0, sender.topics),
        sender.window,
        sender.dequeued - sender.acked,
        sender.evictions,
        batch.parameters,
    )


@kernel
def arrival_of(batch: Batch, i: int) -> Any:
    """The arrival that waits for a decision."""
    return at(batch.arrivals, i, batch.senders[i].next)
