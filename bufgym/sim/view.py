"""A policy's view of its sender."""

from typing import Any

from bufgym.jit import kernel, unchecked_at, unchecked_slice
from bufgym.model.buffer import Buffer
from bufgym.model.link import FOREVER
from bufgym.sim.socket import held_bytes, left_of
from bufgym.sim.state import ARRIVAL_WAITS, Batch


@kernel
def view(batch: Batch, i: int) -> Buffer:
    """What the policy of sender ``i`` may see now."""
    sender = batch.senders[i]
    first, occupancy = sender.first, sender.occupancy
    last = unchecked_at(batch.slots, i, first - 1)
    dequeued_arrival_us, dequeued_x, dequeued_seq = last.arrival_us, last.x, last.seq
    previous_us, previous_x = sender.previous_us, sender.previous_x
    if sender.dequeued == 0:
        dequeued_arrival_us, dequeued_x = previous_us, previous_x
        dequeued_seq = unchecked_at(batch.arrivals, i, max(sender.next - 1, 0)).seq
        if occupancy > 0:
            # a scheduler holds back the first of all
            oldest = unchecked_at(batch.slots, i, first)
            dequeued_arrival_us, dequeued_x, dequeued_seq = oldest.arrival_us, oldest.x, oldest.seq
    if batch.several is not None and sender.waiting == ARRIVAL_WAITS:
        # these gaps belong to the newcomer's topic
        arrival = unchecked_at(batch.arrivals, i, sender.next)
        topic = unchecked_at(batch.topics, i, arrival.topic)
        previous_us, previous_x = arrival.arrival_us, arrival.x
        if topic.arrived > 0:
            previous_us, previous_x = topic.previous_us, topic.previous_x
        dequeued_arrival_us, dequeued_x = previous_us, previous_x
        if topic.dequeued > 0:
            dequeued_arrival_us, dequeued_x = topic.dequeued_arrival_us, topic.dequeued_x
        elif topic.queued > 0:
            k = first
            while unchecked_at(batch.slots, i, k).topic != arrival.topic:
                k += 1
            dequeued_arrival_us, dequeued_x = (
                unchecked_at(batch.slots, i, k).arrival_us,
                unchecked_at(batch.slots, i, k).x,
            )
    left_bytes, left_fraction = 0, 0.0
    if sender.busy > 0 and sender.shows_left == 1:
        total_bytes = held_bytes(batch, i)
        # Measured as the arrival came; evictions since then have moved no byte.
        if sender.measures == 1 and sender.waiting == ARRIVAL_WAITS:
            left_bytes = sender.left_bytes
        else:
            left_bytes = left_of(batch, i, total_bytes)
        left_fraction = left_bytes / total_bytes
    remaining_us = max(sender.ends_us - sender.now_us, 0) if sender.ends_us < FOREVER else FOREVER
    return Buffer(
        unchecked_slice(batch.slots, i, first, occupancy), sender.capacity, sender.max_bytes, sender.backlog_bytes,
        sender.now_us, sender.forgotten + sender.dequeued, dequeued_arrival_us, dequeued_x, dequeued_seq,
        previous_us, previous_x, min(sender.busy, 1), left_bytes, left_fraction,
        sender.now_us - sender.last_dequeue_us, sender.period_us, sender.arrival_bytes,
        sender.departures, sender.service_ratio, sender.drained_bytes, sender.drained_us,
        1e6 * sender.short_rate, 1e6 * sender.medium_rate, 1e6 * sender.long_rate,
        batch.v[sender.v_start :], unchecked_slice(batch.topics, i, 0, sender.topics),
        sender.window, sender.dequeued - sender.acked, sender.evictions, remaining_us, batch.parameters,
        batch.past[i],
    )  # fmt: skip


@kernel
def arrival_of(batch: Batch, i: int) -> Any:
    """The arrival that waits for a decision."""
    return unchecked_at(batch.arrivals, i, batch.senders[i].next)


@kernel
def last_arrival(batch: Batch, i: int) -> Any:
    """The arrival that waits for a decision; where the socket asks, the latest arrival."""
    sender = batch.senders[i]
    return unchecked_at(batch.arrivals, i, sender.next if sender.waiting == ARRIVAL_WAITS else sender.next - 1)
