"""The value of every action at a queue, combining the queued messages with ``ahead`` for later arrivals.

See docs/methods.md, "The best from a queue on".
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import Floats, Ints, kernel, unchecked_at
from bufgym.model.qoi import value
from bufgym.oracle.ahead import TIE, Ahead, sends, step_of
from bufgym.sim.decisions import has_room
from bufgym.sim.state import ARRIVAL_WAITS, Batch


class Work(NamedTuple):
    """Work space of ``find_values`` for queues of up to L messages."""

    x: Floats  # float64[L + 1], coordinates of the queued messages and of the newcomer, its last
    first: Floats  # float64[L + 1], gain of each if it is sent next
    pair: Floats  # float64[L + 1, L + 1], gain of the second if it is sent after the first
    own: Floats
    """float64[L + 2, L + 1], best gain of so many of the queue's own messages, of which this is the last."""
    jump: Floats  # float64[L + 2, L + 1], best gain after these if only later arrivals follow
    target: Ints  # int64[L + 2, L + 1], the first of those arrivals; -1 for none
    slots: Ints  # int64[L + 1], messages queued after the action
    arrived: Ints  # int64[L + 2], arrivals after the newcomer by the time of the t-th transmission
    future: Floats  # float64[messages], gain after each later arrival
    steps: Ints  # int64[messages], the step that has it, see ``sends``
    places: Floats  # float64[L + 1 + messages], coordinate of each candidate of ``forced``
    best: Ints  # int64[L + 1 + messages], its best predecessor
    forced: Floats  # float64[2, L + 1 + messages], its gain


def new_work(capacity: int, messages: int) -> Work:
    """Make work space for L = ``capacity`` and episodes of so many ``messages``."""
    L = capacity
    table = (L + 2, L + 1)
    return Work(
        np.zeros(L + 1),
        np.zeros(L + 1),
        np.zeros((L + 1, L + 1)),
        np.zeros(table),
        np.zeros(table),
        np.zeros(table, np.int64),
        np.zeros(L + 1, np.int64),
        np.zeros(L + 2, np.int64),
        np.zeros(messages),
        np.zeros(messages, np.int64),
        np.zeros(L + 1 + messages),
        np.zeros(L + 1 + messages, np.int64),
        np.zeros((2, L + 1 + messages)),
    )


@kernel
def find_values(batch: Batch, ahead: Ahead, work: Work, decisions: Ints, values: NDArray[Any]) -> None:
    """Fill ``values``, float64[n, m]: the best H attainable in hindsight with each of the ``decisions``, int64[n, m].

    A decision is 0..L-1 to evict that slot, L to reject, L + 1 to accept. NaN for any other and for invalid ones.
    """
    for i in range(len(batch.senders)):
        sender = batch.senders[i]
        values[i, :] = np.nan
        if sender.waiting == ARRIVAL_WAITS:
            h, e = reach(batch, ahead, work, i)
            for k in range(decisions.shape[1]):
                decision = decisions[i, k]
                evicts = 0 <= decision < sender.occupancy
                if evicts or sender.capacity <= decision <= sender.capacity + has_room(batch, i):
                    values[i, k] = h + best_without(batch, ahead, work, i, e, decision)


@kernel
def find_most(batch: Batch, ahead: Ahead, work: Work, rows: Ints, most: NDArray[Any]) -> None:
    """Fill ``most``, float64[n], at ``rows``: the best H with any decision; 0 where no decision is due.

    The present decision may drop a message of the queue, just as that of any later arrival may.
    """
    for i in rows:
        sender = batch.senders[i]
        most[i] = 0.0
        if sender.waiting == ARRIVAL_WAITS:
            h, e = reach(batch, ahead, work, i)
            if e > ahead.link[i, 2]:
                most[i] = h  # no further message is delivered
                continue
            for k in range(sender.occupancy + 1):
                work.slots[k] = k
            count, best = sender.occupancy + 1, 0.0
            for goes in range(2):  # the newcomer is accepted, where there is room, or one message of all goes
                if goes == 1 or has_room(batch, i):
                    best = max(best, best_from(batch, ahead, work, i, e, count, goes))
            most[i] = h + best


@kernel
def reach(batch: Batch, ahead: Ahead, work: Work, i: int) -> tuple[float, int]:
    """H of what sender ``i`` has sent, and the byte at which its socket is free; fills ``work`` if that helps."""
    sender = batch.senders[i]
    h, e = so_far(batch, i, ahead.link[i, 2])
    if e <= ahead.link[i, 2]:
        e = max(e, unchecked_at(ahead.c, i, sender.next)) if sender.busy == 0 else e
        look(batch, ahead, work, i, e)
    return h, e


@kernel
def best_without(batch: Batch, ahead: Ahead, work: Work, i: int, e: int, action: int) -> float:
    """Best gain of sender ``i`` after a decision: 0..L-1 evicts that slot, L rejects, L + 1 accepts."""
    if e > ahead.link[i, 2]:
        return 0.0  # no further message is delivered
    sender = batch.senders[i]
    own, count = sender.occupancy + 1, 0
    for k in range(own):
        gone = k == action if action < sender.capacity else action == sender.capacity and k == own - 1
        if not gone:
            work.slots[count] = k
            count += 1
    return best_from(batch, ahead, work, i, e, count, 0)


@kernel
def so_far(batch: Batch, i: int, ends: int) -> tuple[float, int]:
    """H of all messages that the socket took and the link will carry, and the byte at which the last of them ends."""
    sender = batch.senders[i]
    gain, counted = sender.delivered_gain, sender.dequeued
    e = sender.position  # of one queue with a link of its own: what is in the socket, the link carries
    if e > ends:
        counted -= sender.busy
    for k in range(sender.credited, counted):
        gain += unchecked_at(batch.log, i, unchecked_at(batch.order, i, k)).gain
    return (1.0 + gain if counted > 0 else 0.0), e


@kernel
def look(batch: Batch, ahead: Ahead, work: Work, i: int, e: int) -> None:
    """Fill ``x``, ``first``, ``pair``, ``jump``, ``target`` and ``arrived`` for the decision of sender ``i``."""
    sender = batch.senders[i]
    own, n, b = sender.occupancy + 1, sender.next, ahead.link[i, 0]
    v = batch.v[sender.v_start :]
    last_x = unchecked_at(batch.slots, i, sender.first - 1).x
    sent = sender.dequeued > 0
    for k in range(own):
        x = unchecked_at(batch.arrivals, i, n).x if k == own - 1 else unchecked_at(batch.slots, i, sender.first + k).x
        work.x[k] = x
        work.first[k] = value(v, x - last_x) if sent else 1.0  # the very first message gains the 1 in H
        for j in range(k):
            work.pair[j, k] = value(v, x - work.x[j])
    count, chosen, known = 0, n + 1, n
    for t in range(1, own + 2):
        if t <= own:
            while n + 1 + count < sender.arrivals and unchecked_at(ahead.c, i, n + 1 + count) < e + (t - 1) * b:
                count += 1
            work.arrived[t] = count
        if t == 1:
            look_ahead(batch, ahead, work, i, e)
            continue
        # V is concave: the best successor is no earlier if the message before it is later, or the socket free later. So
        # that of the newcomer bounds all others, and it is known: the newcomer is message n.
        u, first = e + (t - 1) * b, t - 2
        step = step_of(ahead, i, n, u)
        work.jump[t - 1, own - 1], last = ahead.gain[step], ahead.follow[step]
        work.target[t - 1, own - 1] = last
        if first == own - 1:
            continue
        chosen = max(n + 1, work.target[t - 2, first] if t > 2 else 0)
        # Nothing follows the newcomer best: later messages are like it. Of these the first that finds room will do.
        alike = last < 0
        for m in range(chosen, sender.arrivals if alike else last + 1):
            while known < m:
                known += 1
                work.steps[known] = -1
            work.future[m] = sends(ahead, i, m, u, work.steps)
            last = max(last, m)
            if alike and work.future[m] != -1:
                break
        for k in range(first, own - 1):
            most, target = 0.0, -1
            for m in range(chosen, last + 1):
                after = work.future[m]
                if after >= 0 and after + 1 <= most:
                    break  # a later message has no larger gain after it
                if after >= 0:
                    gain = value(v, unchecked_at(batch.arrivals, i, m).x - work.x[k]) + after
                    if gain > most + TIE or target < 0:
                        most, target = gain, m
            work.jump[t - 1, k], work.target[t - 1, k] = most, target
            chosen = target if target >= 0 else chosen


@kernel
def look_ahead(batch: Batch, ahead: Ahead, work: Work, i: int, e: int) -> None:
    """Fill ``jump`` and ``target`` for no message of the queue: what follows the message sent last, and -1 for none."""
    sender = batch.senders[i]
    v, n = batch.v[sender.v_start :], sender.next
    x = unchecked_at(batch.slots, i, sender.first - 1).x
    most, target = 0.0, -1
    for m in range(n + 1, sender.arrivals):
        if unchecked_at(ahead.between, i, m) > n and unchecked_at(ahead.idle, i, m) >= e:
            break  # another message could be sent in the meantime
        work.steps[m] = -1
        after = sends(ahead, i, m, e, work.steps)
        if after < -1 or (after >= 0 and after + 1 <= most):
            break  # a later message has no larger gain after it
        if after >= 0:
            added = value(v, unchecked_at(batch.arrivals, i, m).x - x) if sender.dequeued > 0 else 1.0
            if added + after > most + TIE or target < 0:
                most, target = added + after, m
    work.jump[0, 0], work.target[0, 0] = most, target


@kernel
def best_from(batch: Batch, ahead: Ahead, work: Work, i: int, e: int, count: int, spare: int) -> float:
    """Best gain with the first ``count`` of ``work.slots`` queued and the socket free at byte ``e``.

    ``spare`` is 1 if one of these messages has still to go before the next arrival, else 0.
    """
    b, ends = ahead.link[i, 0], ahead.link[i, 2]
    until = min(count - spare, (ends - e) // b)  # transmissions of this queue that are delivered
    most, sent, target = work.jump[0, 0], 0, work.target[0, 0]
    for t in range(1, until + 1):
        for p in range(t - 1, min(count, t + spare + work.arrived[t])):
            k = work.slots[p]
            gain = work.first[k]
            if t > 1:
                gain = -1.0
                for before in range(t - 2, min(p, t - 1 + spare + work.arrived[t - 1])):
                    j = work.slots[before]
                    gain = max(gain, work.own[t - 1, j] + work.pair[j, k])
            work.own[t, k] = gain
            # Of equal plans those that send more: they are less often impossible.
            if gain + work.jump[t, k] >= most - TIE:
                most, sent, target = gain + work.jump[t, k], t, work.target[t, k]
    if possible(batch, ahead, work, i, e, (count - spare, until, sent, target)):
        return float(most)
    return forced(batch, ahead, work, i, e, count, until, spare)


@kernel
def possible(batch: Batch, ahead: Ahead, work: Work, i: int, e: int, plan: tuple[int, int, int, int]) -> bool:
    """Whether a plan keeps the socket busy enough.

    ``plan`` is (messages queued after the present decision, transmissions delivered, queued messages that it sends, the
    arrival that it sends next); ``best_from`` makes it.
    """
    b, n = ahead.link[i, 0], batch.senders[i].next
    count, until, sent, m = plan
    for t in range(sent + 1, until + 1):
        if m < 0 or m - n > work.arrived[t] - (count - t):
            return False
        m = ahead.follow[step_of(ahead, i, m, e + t * b)]
    return True


@kernel
def forced(batch: Batch, ahead: Ahead, work: Work, i: int, e: int, count: int, until: int, spare: int) -> float:
    """Compute ``best_from`` with the condition kept by each of the first ``until`` transmissions.

    Candidates are numbered: the queue from 0 on, later arrivals from ``count`` on. V is concave: of a later candidate
    the best predecessor is no earlier. So every second one is done first, and bounds those between.
    """
    b, n = ahead.link[i, 0], batch.senders[i].next
    v = batch.v[batch.senders[i].v_start :]
    last_x = unchecked_at(batch.slots, i, batch.senders[i].first - 1).x
    known = min(until + spare, count) + work.arrived[until]
    for m in range(known):
        work.places[m] = work.x[work.slots[m]] if m < count else unchecked_at(batch.arrivals, i, n + 1 + m - count).x
    for m in range(min(1 + spare, count) + work.arrived[1]):
        work.forced[1, m] = work.first[work.slots[m]] if m < count else value(v, work.places[m] - last_x)
    for t in range(2, until + 1):
        gains, before = work.forced[(t - 1) % 2], work.arrived[t - 1] + min(t - 1 + spare, count)
        first, stop, step = t - 1, min(t + spare, count) + work.arrived[t], 1
        while step < stop - first:
            step *= 2
        while step > 0:
            for m in range(first + step - 1, stop, 2 * step):
                low = work.best[m - step] if m - step >= first else t - 2
                high = work.best[m + step] + 1 if m + step < stop else before
                gain = -1.0
                for j in range(low, min(m, before, high)):
                    g = gains[j] + value(v, work.places[m] - work.places[j])
                    if g > gain:
                        gain, work.best[m] = g, j
                work.forced[t % 2, m] = gain
            step //= 2
    most = 0.0
    for m in range(until - 1, known):
        if m < count:
            after = work.jump[until, work.slots[m]]
        else:
            after = ahead.gain[step_of(ahead, i, n + 1 + m - count, e + until * b)]
        most = max(most, work.forced[until % 2, m] + after)
    return most
