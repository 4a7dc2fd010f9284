"""The gain still attainable from any moment of an episode: the clairvoyant for states that policies reach.

See docs/methods.md, "The best from any moment on".
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import Floats, Ints, at, kernel
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


@kernel
def find_steps(
    batch: Batch, ahead: Ahead, i: int, place: int, latest: Ints, gain: Floats, follow: NDArray[np.int32]
) -> int:
    """Write the steps of sender ``i``'s episode from ``place`` on; return their end, NO_ROOM or NO_WORK_SPACE.

    ``latest``, ``gain`` and ``follow`` are work space, each [2, room for the steps of one message]. One of the two
    lists holds the steps found so far, and the other takes them merged with those of the next message.
    """
    for m in range(batch.senders[i].arrivals - 1, -1, -1):
        now, held = 0, 1  # which of the two lists, and its number of steps
        latest[0, 0], gain[0, 0], follow[0, 0] = ALWAYS, 0.0, -1
        for j in range(m + 1, min(_furthest(batch, ahead, i, m) + 1, batch.senders[i].arrivals)):
            enough, top = _ends_before(ahead, i, m, j)
            if top < 0:
                break
            if top < enough or _beaten(batch, ahead, i, m, j):
                continue
            if held + at(ahead.stop, i, j) - at(ahead.begin, i, j) > latest.shape[1]:
                return NO_WORK_SPACE
            held = _merge(batch, ahead, i, m, j, enough, top, now, held, latest, gain, follow)
            now = 1 - now
        if place + held > len(ahead.latest):
            return NO_ROOM
        ahead.begin[i, m], ahead.stop[i, m] = place, place + held
        for k in range(held):
            ahead.latest[place + k], ahead.gain[place + k] = latest[now, k], gain[now, k]
            ahead.follow[place + k] = follow[now, k]
        place += held
        ahead.lead[i, m] = _lead(batch, ahead, i, m)
    return place


@kernel
def _beaten(batch: Batch, ahead: Ahead, i: int, m: int, j: int) -> bool:
    """Whether j + 1 follows ``m`` better than ``j`` after every byte."""
    if ahead.lead[i, j] == np.inf or at(ahead.between, i, j + 1) > m:
        return False
    v, x = batch.v[batch.senders[i].v_start :], at(batch.arrivals, i, m).x
    added = value(v, at(batch.arrivals, i, j + 1).x - x) - value(v, at(batch.arrivals, i, j).x - x)
    return bool(added > ahead.lead[i, j] + TIE)


@kernel
def _lead(batch: Batch, ahead: Ahead, i: int, m: int) -> float:
    """``Ahead.lead`` of a message."""
    b = ahead.link[i, 0]
    if m + 1 == batch.senders[i].arrivals or at(ahead.c, i, m + 1) + b > ahead.link[i, 2]:
        return np.inf
    # Both gains fall with the byte at which a message ends; they differ most just after the other's has fallen.
    first, last = at(ahead.c, i, m) + b, at(ahead.c, i, m) + (ahead.link[i, 1] + 1) * b
    k, stop = at(ahead.begin, i, m), at(ahead.stop, i, m)
    other, end = at(ahead.begin, i, m + 1), at(ahead.stop, i, m + 1)
    least, most = at(ahead.c, i, m + 1) + b, 0.0
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
    begin, stop = at(ahead.begin, i, m + 1), at(ahead.stop, i, m + 1)
    for k in range(begin + 1, stop):
        furthest = max(furthest, ahead.follow[k])
    c, c_next = at(ahead.c, i, m), at(ahead.c, i, m + 1)
    while c_next > c and furthest + 1 < arrivals:
        if at(ahead.c, i, furthest + 1) >= c_next + 2 * b:
            break
        furthest += 1
    if stop - begin == 1 or ahead.latest[begin + 1] < c + (ahead.link[i, 1] + 1) * b:
        return int(arrivals)  # nothing follows m + 1 best: this is later than any message
    return furthest


@kernel
def _ends_before(ahead: Ahead, i: int, m: int, j: int) -> tuple[int, int]:
    """First and last byte at which ``m`` may end so that ``j`` follows it; (0, -1) if neither j nor a later one can."""
    b, room, ends = ahead.link[i, 0], ahead.link[i, 1], ahead.link[i, 2]
    c, c_j = at(ahead.c, i, m), at(ahead.c, i, j)
    enough, reach = c + b, c + (room + 1) * b
    if at(ahead.between, i, j) > m:
        if at(ahead.idle, i, j) >= reach:
            return 0, -1  # ``between`` could be sent before every further message, too
        enough = max(enough, at(ahead.idle, i, j) + 1)
    if c_j + b > ends or room == 0:
        return 0, -1
    return enough, min(c_j + room * b, ends - b, reach)


@kernel
def _merge(
    batch: Batch,
    ahead: Ahead,
    i: int,
    m: int,
    j: int,
    enough: int,
    top: int,
    now: int,
    held: int,
    latest: Ints,
    gain: Floats,
    follow: NDArray[np.int32],
) -> int:
    """Merge the ``held`` steps of list ``now`` with those by which ``j`` follows ``m``; return how many remain.

    The other list takes them. Both are walked from the latest byte down, and a step stays if it gains more than those
    before it.
    """
    b, v = ahead.link[i, 0], batch.v[batch.senders[i].v_start :]
    added = value(v, at(batch.arrivals, i, j).x - at(batch.arrivals, i, m).x)
    least = max(enough, at(ahead.c, i, j)) + b
    k, stop = at(ahead.begin, i, j), at(ahead.stop, i, j)
    while k + 1 < stop and ahead.latest[k + 1] - b >= top:  # the highest step of j within reach
        k += 1
    then, kept, old, best = 1 - now, 0, 0, -1.0
    while True:
        late = -1
        if k < stop and ahead.latest[k] >= least:
            late = min(ahead.latest[k] - b, top)
        from_old = old < held and latest[now, old] >= late
        if not from_old and late < 0:
            return kept
        if from_old:
            e, g, f = latest[now, old], gain[now, old], follow[now, old]
            old += 1
        else:
            e, g, f = late, added + ahead.gain[k], np.int32(j)
            k += 1
        if g > best + TIE:
            if kept > 0 and latest[then, kept - 1] == e:
                kept -= 1
            latest[then, kept], gain[then, kept], follow[then, kept] = e, g, f
            best = g
            kept += 1


@kernel
def step_of(ahead: Ahead, i: int, m: int, e: int) -> int:
    """Index of the step that message ``m`` of sender ``i`` is on if it ends at byte ``e``."""
    low, high = at(ahead.begin, i, m), at(ahead.stop, i, m)
    while high - low > 1:
        middle = (low + high) // 2
        if ahead.latest[middle] >= e:
            low = middle
        else:
            high = middle
    return int(low)


@kernel
def sends(ahead: Ahead, i: int, m: int, e: int) -> float:
    """Largest gain after message ``m`` if it is sent next, from byte ``e`` on, without its own gain.

    -1 if it found no room; -2 if neither it nor any later message can be delivered any more.
    """
    b, c = ahead.link[i, 0], at(ahead.c, i, m)
    u = max(e, c)
    if u + b > ahead.link[i, 2]:
        return -2.0
    if u - c > ahead.link[i, 1] * b:
        return -1.0
    return float(ahead.gain[step_of(ahead, i, m, u + b)])
