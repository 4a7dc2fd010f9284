"""The gain still attainable from any moment of an episode: the clairvoyant for states that policies reach.

See docs/methods.md, "The best from any moment on".
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import Floats, Ints, kernel, unchecked_at
from bufgym.model.qoi import value
from bufgym.sim.state import Batch

ALWAYS = 2**62  # A byte beyond every message's end

NO_ROOM, NO_WORK_SPACE = -1, -2  # Results of ``find_steps`` that ran out of room or of work space

TIE = 1e-12  # Least difference by which a gain must be better to replace another


class Ahead(NamedTuple):
    """The staircases of the episodes of n senders.

    Fields:
        c: int64[n, messages], bytes that the link can have carried when the message arrives.
        between, idle: int64[n, messages], as in ``programme.Problem``.
        link: int64[n, 3], b (bytes of every message), R (messages for which there is room), the link's last byte.
        begin, stop: int64[n, messages], the steps of a message are ``begin : stop`` of the arrays below.
        lead: float64[n, messages], the most by which the gain after a message exceeds that after the next one, if both
            find room; infinite for the last.
        latest: int64[room], F(i, e) >= ``gain`` for e <= ``latest``; falls within a message, beginning at ``ALWAYS``.
        gain: float64[room], rises within a message, beginning at 0.
        follow: int32[room], the message to send next for this gain; -1 for none.
    """

    c: Ints
    between: Ints
    idle: Ints
    link: Ints
    begin: Ints
    stop: Ints
    lead: Floats
    latest: Ints
    gain: Floats
    follow: NDArray[np.int32]


class Rivals(NamedTuple):
    """Messages that may follow one message best, by rising index; work space for as many as arrays have entries.

    V is concave, so a later message is the better one to follow the later the socket is free: each message of the list
    is best from its byte ``since`` on, up to that of the next one.
    """

    message: Ints  # int64[room]
    since: Ints  # int64[room]
    least: Ints  # int64[room], byte up to which the link waits for it anyway
    top: Ints  # int64[room], last byte from which it can follow
    added: Floats  # float64[room], V of its gap


def new_rivals(room: int) -> Rivals:
    """Work space for so many messages."""
    message, since, least, top = np.zeros((4, room), np.int64)
    return Rivals(message, since, least, top, np.zeros(room))


@kernel
def find_steps(batch: Batch, ahead: Ahead, i: int, place: int, rivals: Rivals) -> int:
    """Write the steps of sender ``i``'s episode from ``place`` on; return their end, NO_ROOM or NO_WORK_SPACE."""
    for m in range(batch.senders[i].arrivals - 1, -1, -1):
        count = 0
        for j in range(m + 1, min(_furthest(batch, ahead, i, m) + 1, batch.senders[i].arrivals)):
            enough, top = _ends_before(ahead, i, m, j)
            if top < 0:
                break
            if top < enough or _beaten(batch, ahead, i, m, j):
                continue
            if count == len(rivals.message):
                return NO_WORK_SPACE
            added = value(
                batch.v[batch.senders[i].v_start :],
                unchecked_at(batch.arrivals, i, j).x - unchecked_at(batch.arrivals, i, m).x,
            )
            rivals.message[count], rivals.least[count] = j, max(enough, unchecked_at(ahead.c, i, j))
            rivals.top[count], rivals.added[count] = top, added
            count = _rank(ahead, i, rivals, count)
        stop = _write_steps(ahead, i, rivals, count, place)
        if stop < 0:
            return NO_ROOM
        ahead.begin[i, m], ahead.stop[i, m] = place, stop
        place = stop
        ahead.lead[i, m] = _lead(batch, ahead, i, m)
    return place


@kernel
def _step(ahead: Ahead, i: int, rivals: Rivals, k: int, e: int) -> int:
    """The step that rival ``k`` is on if it follows a message that ends at byte ``e``."""
    return step_of(ahead, i, rivals.message[k], max(e, rivals.least[k]) + ahead.link[i, 0])


@kernel
def _rank(ahead: Ahead, i: int, rivals: Rivals, new: int) -> int:
    """Find from which byte on rival ``new`` beats all before it; return how many rivals remain."""
    k = new - 1
    while k >= 0:
        low, high = rivals.since[k], rivals.top[k]
        more, less = rivals.added[new], rivals.added[k] + TIE
        step, other = _step(ahead, i, rivals, new, high), _step(ahead, i, rivals, k, high)
        if more + ahead.gain[step] <= less + ahead.gain[other]:
            low = high + 1
        else:
            last, other_last = _step(ahead, i, rivals, new, low), _step(ahead, i, rivals, k, low)
            if more + ahead.gain[last] > less + ahead.gain[other_last]:
                k -= 1
                continue
            # It loses at ``low`` and wins at ``high``. Steps between lie between those of the two.
            while high - low > 1:
                middle = (low + high) // 2
                b = ahead.link[i, 0]
                here = step_within(ahead, step, last + 1, max(middle, rivals.least[new]) + b)
                there = step_within(ahead, other, other_last + 1, max(middle, rivals.least[k]) + b)
                if more + ahead.gain[here] > less + ahead.gain[there]:
                    high, step, other = middle, here, there
                else:
                    low, last, other_last = middle, here, there
            low = high
        if low > rivals.top[new]:
            return new
        break
    at_ = k + 1
    rivals.message[at_], rivals.least[at_], rivals.top[at_] = rivals.message[new], rivals.least[new], rivals.top[new]
    rivals.added[at_] = rivals.added[new]
    rivals.since[at_] = low if k >= 0 else 0
    return at_ + 1


@kernel
def _write_steps(ahead: Ahead, i: int, rivals: Rivals, count: int, place: int) -> int:
    """Write the steps that these rivals give, from the latest byte down; return their end or NO_ROOM."""
    b, stop, best, last = ahead.link[i, 0], place, -1.0, ALWAYS
    for k in range(count, -1, -1):
        if k == count:
            first, end, added = 0, 1, 0.0  # nothing follows
        else:
            j = rivals.message[k]
            first, end, added = (
                step_of(ahead, i, j, min(rivals.top[k], last) + b),
                unchecked_at(ahead.stop, i, j),
                rivals.added[k],
            )
        for step in range(first, end):
            e, g = last, added
            if k < count:
                if ahead.latest[step] - b < max(rivals.since[k], rivals.least[k]):
                    break
                e, g = min(ahead.latest[step] - b, min(rivals.top[k], last)), added + ahead.gain[step]
            if g > best + TIE:
                if stop > place and ahead.latest[stop - 1] == e:
                    stop -= 1
                if stop == len(ahead.latest):
                    return NO_ROOM
                ahead.latest[stop], ahead.gain[stop] = e, g
                ahead.follow[stop] = rivals.message[k] if k < count else -1
                best, stop = g, stop + 1
        if k < count:
            last = min(last, rivals.since[k] - 1)
    return stop


@kernel
def _beaten(batch: Batch, ahead: Ahead, i: int, m: int, j: int) -> bool:
    """Whether j + 1 follows ``m`` better than ``j`` after every byte."""
    if ahead.lead[i, j] == np.inf or unchecked_at(ahead.between, i, j + 1) > m:
        return False
    v, x = batch.v[batch.senders[i].v_start :], unchecked_at(batch.arrivals, i, m).x
    added = value(v, unchecked_at(batch.arrivals, i, j + 1).x - x) - value(v, unchecked_at(batch.arrivals, i, j).x - x)
    return bool(added > ahead.lead[i, j] + TIE)


@kernel
def _lead(batch: Batch, ahead: Ahead, i: int, m: int) -> float:
    """``Ahead.lead`` of a message."""
    b = ahead.link[i, 0]
    if m + 1 == batch.senders[i].arrivals or unchecked_at(ahead.c, i, m + 1) + b > ahead.link[i, 2]:
        return np.inf
    # Both gains fall with the byte at which a message ends; they differ most just after the other's has fallen.
    first, last = unchecked_at(ahead.c, i, m) + b, unchecked_at(ahead.c, i, m) + (ahead.link[i, 1] + 1) * b
    k, stop = unchecked_at(ahead.begin, i, m), unchecked_at(ahead.stop, i, m)
    other, end = unchecked_at(ahead.begin, i, m + 1), unchecked_at(ahead.stop, i, m + 1)
    least, most = unchecked_at(ahead.c, i, m + 1) + b, 0.0
    while k + 1 < stop and ahead.latest[k + 1] >= last:
        k += 1
    while k < stop and ahead.latest[k] >= first:
        e = max(min(ahead.latest[k], last), least)
        while other + 1 < end and ahead.latest[other + 1] >= e:
            other += 1
        most = max(most, ahead.gain[k] - ahead.gain[other])
        k += 1
    return float(most)


@kernel
def _furthest(batch: Batch, ahead: Ahead, i: int, m: int) -> int:
    """The last message that may follow ``m`` best.

    V is concave: what follows m best is what follows m + 1 best after the same byte, or one before it. Bytes that m + 1
    cannot end at lie less than a message beyond c: there j could follow m + 1 if c_j is two beyond.
    """
    arrivals, b = batch.senders[i].arrivals, ahead.link[i, 0]
    furthest = m + 1
    if furthest >= arrivals:
        return furthest
    begin, stop = unchecked_at(ahead.begin, i, m + 1), unchecked_at(ahead.stop, i, m + 1)
    for k in range(begin + 1, stop):
        furthest = max(furthest, ahead.follow[k])
    c, c_next = unchecked_at(ahead.c, i, m), unchecked_at(ahead.c, i, m + 1)
    while c_next > c and furthest + 1 < arrivals:
        if unchecked_at(ahead.c, i, furthest + 1) >= c_next + 2 * b:
            break
        furthest += 1
    if stop - begin == 1 or ahead.latest[begin + 1] < c + (ahead.link[i, 1] + 1) * b:
        return int(arrivals)  # nothing follows m + 1 best: this is later than any message
    return furthest


@kernel
def _ends_before(ahead: Ahead, i: int, m: int, j: int) -> tuple[int, int]:
    """First and last byte at which ``m`` may end so that ``j`` follows it; (0, -1) if neither j nor a later one can."""
    b, room, ends = ahead.link[i, 0], ahead.link[i, 1], ahead.link[i, 2]
    c, c_j = unchecked_at(ahead.c, i, m), unchecked_at(ahead.c, i, j)
    enough, reach = c + b, c + (room + 1) * b
    if unchecked_at(ahead.between, i, j) > m:
        if unchecked_at(ahead.idle, i, j) >= reach:
            return 0, -1  # ``between`` could be sent before every further message, too
        enough = max(enough, unchecked_at(ahead.idle, i, j) + 1)
    if c_j + b > ends or room == 0:
        return 0, -1
    return enough, min(c_j + room * b, ends - b, reach)


@kernel
def step_of(ahead: Ahead, i: int, m: int, e: int) -> int:
    """Index of the step that message ``m`` of sender ``i`` is on if it ends at byte ``e``."""
    return step_within(ahead, unchecked_at(ahead.begin, i, m), unchecked_at(ahead.stop, i, m), e)


@kernel
def step_within(ahead: Ahead, low: int, high: int, e: int) -> int:
    """Likewise, of a message whose step is known to be one of ``low : high``."""
    while high - low > 1:
        middle = (low + high) >> 1
        if ahead.latest[middle] >= e:
            low = middle
        else:
            high = middle
    return int(low)


@kernel
def sends(ahead: Ahead, i: int, m: int, e: int, steps: Ints) -> float:
    """Largest gain after message ``m`` if it is sent next, from byte ``e`` on, without its own gain.

    -1 if it found no room; -2 if neither it nor any later message can be delivered any more. ``steps[m]`` is the step
    of an earlier byte, or -1; it becomes this one's.
    """
    b, c = ahead.link[i, 0], unchecked_at(ahead.c, i, m)
    u = max(e, c)
    if u + b > ahead.link[i, 2]:
        return -2.0
    room = ahead.link[i, 1]
    if room == 0 or u - c > room * b:
        return -1.0
    step = steps[m]
    if step < 0:
        step = step_of(ahead, i, m, u + b)
    else:  # the first step of all is that of the latest bytes
        while ahead.latest[step] < u + b:
            step -= 1
    steps[m] = step
    return float(ahead.gain[step])
