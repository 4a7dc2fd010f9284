"""The transition: one function moves a sender on to its next event."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from bufgym.kernel import kernel
from bufgym.model.buffer import ACCEPT, REJECT
from bufgym.model.link import FOREVER
from bufgym.sim.decisions import choose, decide, has_room, oldest_sendable
from bufgym.sim.rules import (
    too_soon,
)
from bufgym.sim.socket import begin_transmission, dequeue, finish_transmission, may_dequeue, next_ack_us
from bufgym.sim.state import ARRIVAL_WAITS, DECISION, DEPARTURE, DEQUEUE, END, NEVER, SEND, SOCKET_WAITS, Batch

# Weights of the running means: about the last 8 arrivals for the period, 16 for the drain.
_PERIOD_WEIGHT, _DRAIN_WEIGHT = 1 / 8, 1 / 16


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
        entry = batch.log[i, k]
        entry.dequeued_us, entry.due_us, entry.transmitted_us, entry.dropped_us, entry.limited = (
            NEVER,
            NEVER,
            NEVER,
            NEVER,
            0,
        )
    for k in range(len(topics)):
        batch.topics[i, k] = topics[k]
    sender = batch.senders[i]
    sender.capacity, sender.max_bytes, sender.ask_when_full = buffer
    sender.first_decision, sender.last_decision = decisions
    sender.first_knot, sender.last_knot, sender.after, sender.offset_us, sender.propagation_us = link
    sender.topics, sender.window, sender.ack_delay_us = len(topics), window[0], window[1]
    sender.segment_now, sender.segment_finish = sender.first_knot, sender.first_knot
    sender.arrivals = len(arrivals)
    sender.first = 1
    sender.now_us, sender.next, sender.waiting, sender.occupancy, sender.backlog_bytes = 0, 0, 0, 0, 0
    sender.busy, sender.position, sender.finish_us = 0, 0, 0
    sender.ask_at_dequeue, sender.cleared, sender.follows = 0, 0, 0
    sender.ask_at_send, sender.chosen, sender.held, sender.acked = 0, NEVER, 0, 0
    sender.limit_at_send, sender.flush_no_drop = 0, 0
    sender.dequeued, sender.transmitted, sender.credited = 0, 0, 0
    sender.rejected, sender.evicted, sender.invalid, sender.peak_backlog_bytes = 0, 0, 0, 0
    sender.previous_us, sender.last_dequeue_us, sender.departures = 0, 0, 0
    sender.previous_x, sender.period_us, sender.service_ratio = 0.0, 0.0, 0.0
    sender.delivered_gain, sender.retained_gain, sender.aged, sender.late = 0.0, 0.0, 0.0, 0.0


@kernel
def next_event(batch: Batch, i: int) -> int:
    """Move sender ``i`` on to its next DEPARTURE, DECISION, DEQUEUE, SEND or END (see the package's text)."""
    sender = batch.senders[i]
    while True:
        if may_dequeue(batch, i):
            if sender.ask_at_dequeue > sender.cleared:
                return DEQUEUE
            if sender.ask_at_send == 1 and sender.chosen == NEVER:
                sender.waiting = SOCKET_WAITS
                return SEND
            if sender.chosen == NEVER and (sender.limit_at_send == 1 or sender.flush_no_drop == 1):
                choose(batch, i, oldest_sendable(batch, i))
                continue
            dequeue(batch, i, max(sender.chosen, 0))
            begin_transmission(batch, i)
            sender.cleared, sender.follows, sender.chosen = 0, 0, NEVER
            return DEPARTURE
        sender.follows = 0
        more = sender.next < sender.arrivals
        arrives_us = batch.arrivals[i, sender.next].arrival_us if more else FOREVER - 1
        ack_delay_us = next_ack_us(batch, i) if sender.ack_delay_us > 0 else FOREVER
        if sender.busy > 0 and sender.finish_us <= arrives_us and sender.finish_us < ack_delay_us:
            finish_transmission(batch, i)
            continue
        if sender.ack_delay_us > 0 and ack_delay_us <= arrives_us:
            sender.now_us = ack_delay_us
            sender.acked += 1
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
        sender.service_ratio += _DRAIN_WEIGHT * (sender.departures - sender.service_ratio)
    else:
        sender.previous_us, sender.previous_x = arrives_us, arrival.x
    if sender.topics > 1 and sender.limit_at_send == 0 and too_soon(batch, i, arrival.topic):
        batch.log[i, sender.next].limited = 1
        decide(batch, i, REJECT)  # which is possible: a no_drop topic has no rate limit
        return False
    asked = sender.first_decision <= sender.next <= sender.last_decision
    if asked and not (sender.ask_when_full == 1 and has_room(batch, i)):
        return True
    decide(batch, i, ACCEPT)
    return False
