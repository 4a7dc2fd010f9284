"""The transition: one function moves a sender, or the robots of a cell that share a link, on to the next event.

``shares`` tells the two cases apart. It is None if every sender has a link of its own; *cell* c is then sender c.
Otherwise it holds the cells of ``bufgym.sim.shared_link``. Each case is compiled separately.
"""

from bufgym.jit import kernel, unchecked_at
from bufgym.sim.decisions import arrive, choose, oldest_sendable
from bufgym.sim.shared_link import Shares, join, next_in_cell
from bufgym.sim.socket import begin_transmission, dequeue, finish_transmission, may_dequeue, next_ack_us
from bufgym.sim.state import (
    ARRIVAL_WAITS,
    CARRIES,
    CHOSEN,
    DECISION,
    DEPARTURE,
    DEQUEUE,
    END,
    FREED,
    HELD,
    IDLE,
    NOT_YET,
    NOTHING,
    SEND,
    SOCKET_WAITS,
    UNASKED,
    Batch,
)


@kernel
def next_event(batch: Batch, shares: Shares | None, c: int) -> int:
    """Move cell ``c`` on to its next DEPARTURE, DECISION, DEQUEUE, SEND or END (see ``bufgym/sim/__init__.py``).

    The event is about sender ``sender_of(shares, c)``. While its arrival waits, the DECISION is due again.
    """
    if batch.senders[sender_of(shares, c)].waiting == ARRIVAL_WAITS:
        return DECISION
    return move_on(batch, shares, c)


@kernel
def move_on(batch: Batch, shares: Shares | None, c: int) -> int:
    """Compute ``next_event`` for a cell in which no arrival waits."""
    while True:
        i = sender_of(shares, c)
        # The message of the last DEPARTURE: the policy has heard of it, and no time has passed, so it begins now.
        if shares is None and batch.senders[i].link != CARRIES and batch.senders[i].busy > 0:
            begin_transmission(batch, i)
        # The socket before the clock: a free one takes its message at the moment at which it became free.
        event = offer(batch, shares, i)
        if event == NOTHING:
            event = next_on_link(batch, c) if shares is None else next_in_cell(batch, shares, c)
        if event != NOTHING:
            return event


@kernel
def sender_of(shares: Shares | None, c: int) -> int:
    """The sender that the last event of cell ``c`` is about, and whose socket may be free."""
    if shares is None:
        return c
    return int(shares.cells[c].row)


@kernel
def offer(batch: Batch, shares: Shares | None, i: int) -> int:
    """Let the socket of sender ``i`` dequeue: DEPARTURE if it does, NOTHING if it may not.

    DEQUEUE or SEND if the policy must be asked first.
    """
    sender = batch.senders[i]
    if may_dequeue(batch, i):
        # Drops at the head come first: a scheduler chooses among what is left.
        if sender.ask_at_dequeue == 1 and sender.socket == UNASKED:
            return DEQUEUE
        if sender.socket != CHOSEN:
            if sender.ask_at_send == 1:
                sender.waiting = SOCKET_WAITS
                return SEND
            if batch.several is not None and (sender.limit_at_send == 1 or sender.flush_no_drop == 1):
                choose(batch, i, oldest_sendable(batch, i))
        if sender.socket != HELD:
            dequeue(batch, i, sender.chosen)
            if shares is not None:
                join(batch, shares, i)
            return DEPARTURE
    # Nothing follows at once: the next message starts at C(now), not on the very next byte.
    if sender.link == FREED:
        sender.link = IDLE
    return NOTHING


@kernel
def next_on_link(batch: Batch, i: int) -> int:
    """The next event of a sender with its own link: a message transmitted, an ack, an arrival, or the END.

    At one time acks come first, then the end of a transmission, then arrivals. NOTHING unless an arrival asks for a
    DECISION.
    """
    sender = batch.senders[i]
    more = sender.next < sender.arrivals
    arrives_us = unchecked_at(batch.arrivals, i, sender.next).arrival_us if more else NOT_YET
    ack_us = next_ack_us(batch, i)
    # <= lets what finishes at an arrival's own time leave before it; < lets an ack of that time come first.
    if sender.finish_us <= arrives_us and sender.finish_us < ack_us:
        finish_transmission(batch, i, sender.finish_us)
    elif ack_us <= arrives_us:
        sender.now_us = ack_us
        sender.acked += 1
        sender.socket = UNASKED
    # FOREVER, the finish on a dead link, is above NOT_YET: it never happens, and the run ends here.
    elif arrives_us < NOT_YET:
        return arrive(batch, i)
    else:
        return END
    return NOTHING
