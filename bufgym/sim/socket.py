"""The socket: dequeueing, transmission, acks, and receipt at the server."""

from bufgym.jit import kernel, unchecked_at
from bufgym.model.link import FOREVER, carried_by, finish_of
from bufgym.sim.rules import dequeued_on_topic, received_on_topic, sendable
from bufgym.sim.state import CARRIES, FREED, HELD, IDLE, UNASKED, Batch, place_of


@kernel
def may_dequeue(batch: Batch, i: int) -> bool:
    """Whether the socket may dequeue a message now: one is queued, and n_T leaves room in flight."""
    sender = batch.senders[i]
    if sender.occupancy == 0 or sender.socket == HELD:
        return False
    if sender.dequeued - sender.acked < sender.window:
        return True
    if batch.several is not None and sender.flush_no_drop == 1:
        for k in range(sender.occupancy):
            if sendable(batch, i, k):
                return True
    return False


@kernel
def dequeue(batch: Batch, i: int, k: int) -> None:
    """Move slot ``k`` from the buffer to the socket; the link has yet to begin with it."""
    sender = batch.senders[i]
    first = sender.first
    if k > 0:
        # Everything but its gain is in the list of arrivals too.
        sent = unchecked_at(batch.slots, i, first + k)
        place, gain = place_of(batch, i, sent), sent.gain
        for j in range(first + k, first, -1):
            batch.slots[i, j] = unchecked_at(batch.slots, i, j - 1)
        batch.slots[i, first] = unchecked_at(batch.arrivals, i, place)
        unchecked_at(batch.slots, i, first).gain = gain
    head = unchecked_at(batch.slots, i, first)
    place = place_of(batch, i, head)
    batch.order[i, sender.dequeued] = place
    sender.busy += 1
    sender.first += 1
    sender.occupancy -= 1
    sender.backlog_bytes -= head.size_bytes
    sender.dequeued += 1
    sender.dequeued_bytes += head.size_bytes
    sender.last_dequeue_us = sender.now_us
    sender.departures += 1
    sender.socket, sender.chosen = UNASKED, 0
    entry = unchecked_at(batch.log, i, place)
    entry.dequeued_us, entry.gain = sender.now_us, head.gain
    if batch.several is not None:
        dequeued_on_topic(batch, i, head)


@kernel
def next_size_bytes(batch: Batch, i: int) -> int:
    """Size of the message in the socket that the link carries or is to carry next."""
    sender = batch.senders[i]
    if sender.busy == 1:
        return int(unchecked_at(batch.slots, i, sender.first - 1).size_bytes)
    return int(unchecked_at(batch.arrivals, i, unchecked_at(batch.order, i, sender.transmitted)).size_bytes)


@kernel
def held_bytes(batch: Batch, i: int) -> int:
    """All bytes of the messages in the socket, those transmitted included."""
    sender = batch.senders[i]
    if sender.busy == 0:
        return 0
    total_bytes = unchecked_at(batch.slots, i, sender.first - 1).size_bytes
    for k in range(sender.transmitted, sender.dequeued - 1):
        total_bytes += unchecked_at(batch.arrivals, i, unchecked_at(batch.order, i, k)).size_bytes
    return int(total_bytes)


@kernel
def left_of(batch: Batch, i: int, total_bytes: int) -> int:
    """Bytes of ``held_bytes`` not yet transmitted."""
    sender = batch.senders[i]
    # Taken at this very moment: C(now) may be past its first byte, but nothing of it has left yet.
    if sender.busy == 0 or (sender.busy == 1 and sender.last_dequeue_us == sender.now_us):
        return total_bytes
    waiting_bytes = total_bytes - next_size_bytes(batch, i)
    # Later messages in the socket have not begun: all of their bytes are left.
    carried_bytes = carried_by(batch.knot_us, batch.knot_bytes, sender, sender.now_us)
    left_bytes = sender.position - carried_bytes + waiting_bytes
    return int(min(total_bytes, max(0, left_bytes)))


@kernel
def begin_transmission(batch: Batch, i: int) -> None:
    """Let the link of sender ``i`` alone begin with the next message in the socket: at once if freed, else now."""
    sender = batch.senders[i]
    if sender.link == IDLE:
        sender.position = max(carried_by(batch.knot_us, batch.knot_bytes, sender, sender.now_us), sender.position)
    sender.link, sender.began_us = CARRIES, sender.now_us
    sender.position += next_size_bytes(batch, i)
    sender.finish_us = finish_of(batch.knot_us, batch.knot_bytes, sender, sender.position)


@kernel
def finish_transmission(batch: Batch, i: int, at_us: int) -> None:
    """Let the last byte of the message in transmission cross the link; without acks its place is free."""
    sender = batch.senders[i]
    unchecked_at(batch.log, i, unchecked_at(batch.order, i, sender.transmitted)).transmitted_us = at_us
    sender.carried_us += at_us - sender.began_us
    sender.now_us, sender.finish_us, sender.link = at_us, FOREVER, FREED
    sender.transmitted += 1
    sender.busy -= 1
    if sender.ack_delay_us == 0:
        sender.acked += 1
        sender.socket = UNASKED


@kernel
def next_ack_us(batch: Batch, i: int) -> int:
    """Time of the next ack for a transmitted message; FOREVER if none is on its way."""
    sender = batch.senders[i]
    if sender.acked == sender.transmitted:  # always so without acks to wait for
        return FOREVER
    return int(
        unchecked_at(batch.log, i, unchecked_at(batch.order, i, sender.acked)).transmitted_us + sender.ack_delay_us
    )


@kernel
def credit(batch: Batch, i: int, until_us: int) -> None:
    """Count the information that reached the server by ``until_us``, propagation included."""
    sender = batch.senders[i]
    while sender.credited < sender.transmitted:
        seq = unchecked_at(batch.order, i, sender.credited)
        entry = unchecked_at(batch.log, i, seq)
        received_us = entry.transmitted_us + sender.propagation_us
        # Messages arrive in the order of transmission, as all have the same propagation.
        if until_us < received_us:
            break
        sender.delivered_gain += entry.gain
        sender.credited += 1
        if batch.several is not None:
            received_on_topic(batch, i, unchecked_at(batch.arrivals, i, seq), received_us)
