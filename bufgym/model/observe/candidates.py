"""Ordered candidates: the few messages that could go now, cheapest first, and what an agent observes of them.

Every queued message and the newcomer could go; the message in transmission could not. Dropping one merges the motion
gaps before and after it. Candidates are sorted by that merged gap, per byte where sizes differ: the cheapest drop comes
first. The head is one more candidate, since its turn to be sent comes next. So a choice among three or four candidates
serves every L, and a random choice does little harm. With nothing queued and nothing in transmission there is no
candidate, and the newcomer is accepted: no policy leaves the link idle. See docs/methods.md, "Ordered candidates".

All numbers observed are logarithms of ratios, so one set of weights serves every L, frame rate and size. With

    e <- (x_new - x_dequeued) / (L + 1), the even spacing;  r <- the link's rate over 2 s;  p <- the arrival period

a candidate's numbers compare its gaps with e, and the queue's numbers compare the link with the demand.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, unchecked_item, unchecked_table
from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.model.observe.declare import Field, writer
from bufgym.model.qoi import merging_loss, value

MOST = 3.0
"""Largest absolute value of a logarithm observed."""
LEAST, LARGEST = math.exp(-MOST), math.exp(MOST)
SQRT_HALF = int(np.float32(math.sqrt(0.5)).view(np.int32))
LOG_2, C3, C5, C7 = np.float32(math.log(2)), np.float32(2 / 3), np.float32(2 / 5), np.float32(2 / 7)
MOST_CANDIDATES = 64
NONE = -3
"""Entry of ``order`` for a candidate that is not there; no decision has this number."""
TIE = 1e-12
"""Gaps closer than this are equal, and the older message comes first: rounding never decides."""


@kernel
def inverse(b: float) -> float:
    """1 / b of a number >= 0, infinite for 0: several ratios to b need one division."""
    return 1.0 / b if b > 0 else np.inf


@kernel
def times(a: float, per: float) -> float:
    """``ratio`` of ``a`` to the number whose ``inverse`` is ``per``."""
    if a > 0:
        return min(max(a * per, LEAST), LARGEST)
    return LEAST if per < np.inf else 1.0


@kernel
def ratio(a: float, b: float) -> float:
    """The ratio a / b of two numbers >= 0, between e^-3 and e^3; 1 if both are 0."""
    if b > 0:
        return min(max(a / b, LEAST), LARGEST)
    return LARGEST if a > 0 else 1.0


@kernel
def take_logarithms(ratios: NDArray[np.floating[Any]]) -> None:
    """Replace each of ``ratios``, numbers from e^-3 to e^3, by its natural logarithm, to 1e-6.

    A loop without branches or calls, so that it runs over several numbers at once: 16 calls of ``math.log`` take a
    third of a step's time. With r = m 2^n and m in [0.7, 1.4), log m is the series of 2 artanh((m - 1) / (m + 1)).
    """
    for k in range(np.uint64(len(ratios))):  # an unsigned index is not checked
        bits = np.int64(np.float32(ratios[k]).view(np.int32))
        power = (bits - SQRT_HALF) >> 23
        m = np.int32(bits - (power << 23)).view(np.float32)
        t = (m - np.float32(1)) / (m + np.float32(1))
        u = t * t
        series = ((u * C7 + C5) * u + C3) * u + np.float32(2)
        ratios[k] = np.float32(power) * LOG_2 + t * series


@kernel
def find_candidates(buffer: Buffer, arrival: Any, order: NDArray[Any], cost: NDArray[np.float64]) -> None:
    """Find the cheapest candidates and the head.

    Behind the newcomer its last step is expected again. The newcomer is no candidate once a message was evicted for it,
    which happens under a byte limit, nor when nothing is queued or in transmission.

    Args:
        buffer: the queue of s messages.
        arrival: the newcomer.
        order: [k + 1], written: slots of the k cheapest candidates in rising order of cost, s for the newcomer; then
            0 for the head; ``NONE`` where there is no such candidate.
        cost: float64[k + 1], written: the merged gap per byte, times the mean bytes of all candidates; 0 for none.
    """
    s, k = len(buffer.slots), len(order) - 1
    mean_bytes = (buffer.backlog_bytes + arrival.size_bytes) / (s + 1)
    found, head = 0, 0.0
    from_x = buffer.dequeued_x
    may_reject = buffer.evictions == 0 and (s > 0 or buffer.busy > 0)
    for j in range(s + 1 if may_reject else s):
        if j < s:
            message = unchecked_item(buffer.slots, j)
            x, size_bytes = message.x, message.size_bytes
            after = (unchecked_item(buffer.slots, j + 1).x if j + 1 < s else arrival.x) - x
        else:
            x, size_bytes = arrival.x, arrival.size_bytes
            after = x - buffer.previous_x
        own = (x - from_x) + after
        if size_bytes != mean_bytes:
            own *= mean_bytes / size_bytes
        from_x = x
        if j == 0 and s > 0:
            head = own
        place = found
        while place > 0 and cost[place - 1] > own + TIE:
            if place < k:
                order[place], cost[place] = order[place - 1], cost[place - 1]
            place -= 1
        if place < k:
            order[place], cost[place] = j, own
            found = min(found + 1, k)
    for place in range(found, k):
        order[place], cost[place] = NONE, 0.0
    order[k], cost[k] = 0 if s > 0 else NONE, head


@kernel
def decision_of_candidate(order: NDArray[Any], newcomer: int, at_arrivals: bool, room: bool, action: int) -> int:
    """The decision that an action stands for: a slot, REJECT or ACCEPT.

    Args:
        order: [k + 1], as ``find_candidates`` writes it.
        newcomer: the newcomer's number in ``order``, s.
        at_arrivals: whether action 0 accepts where there is room, and the candidates come after it. Otherwise action 0
            is the cheapest candidate.
        room: whether there is room for the newcomer.
        action: 0..k at a full buffer, 0..k + 1 at arrivals; of a candidate that is not there, the cheapest goes.
            Without any candidate a newcomer that fits is accepted.
    """
    place = action
    if at_arrivals:
        if action == 0 and room:
            return ACCEPT
        place = max(action - 1, 0)
    slot = int(order[place])
    if slot == NONE:
        slot = int(order[0])
    if slot == NONE:
        return ACCEPT if room else REJECT
    return REJECT if slot == newcomer else slot


@kernel
def is_offered(order: NDArray[Any], at_arrivals: bool, room: bool, action: int) -> bool:
    """Whether the action mask shows ``action``: its candidate is there.

    Without room action 0 at arrivals does what action 1 does, and only action 0 is shown.
    """
    if action == 0:
        return True
    if not at_arrivals:
        return bool(order[action] != NONE)
    return bool(order[action - 1] != NONE and (room or action > 1))


class Candidate(NamedTuple):
    """One candidate beside its neighbours."""

    cost: float  # merged gap, per byte times mean bytes
    before: float  # motion gap to the message kept before it
    after: float  # motion gap to the message after it
    per_even: float  # 1 / e
    place: float  # (j + 1) / (s + 1) for slot j of s; 1 for the newcomer
    is_newcomer: bool
    is_head: bool


_RATIO = "logarithm of a ratio"
CANDIDATE_FIELDS = (
    Field("candidate_place", "candidate", "queue", "-1 to 1",
          "2 (j + 1) / (s + 1) - 1 for slot j of s; 1 for the newcomer",
          lambda c: 2.0 * c.place - 1.0, -1.0),
    Field("candidate_newcomer", "candidate", "queue", "0 or 1", "1 for the newcomer",
          lambda c: 1.0 if c.is_newcomer else 0.0),
    Field("candidate_head", "candidate", "queue", "0 or 1", "1 for the oldest message",
          lambda c: 1.0 if c.is_head else 0.0),
    Field("candidate_merged", "candidate", "motion", _RATIO,
          "log(gap left if it is dropped / 2e), per byte where sizes differ",
          lambda c: times(c.cost, 0.5 * c.per_even), -MOST, MOST),
    Field("candidate_before", "candidate", "motion", _RATIO, "log(gap to the message kept before it / e)",
          lambda c: times(c.before, c.per_even), -MOST, MOST),
    Field("candidate_after", "candidate", "motion", _RATIO, "log(gap to the message after it / e)",
          lambda c: times(c.after, c.per_even), -MOST, MOST),
)  # fmt: skip
"""Numbers of each candidate; all 0 for one that is not there."""


class Around(NamedTuple):
    """The queue and the link, as far as several numbers need them."""

    even: float  # e
    per_even: float  # 1 / e
    short: float  # the link's rate over about 0.1 s, bytes/us
    medium: float  # over about 0.5 s
    rate: float  # r, over about 2 s
    per_rate: float  # 1 / r
    per_size: float  # 1 / the newcomer's bytes
    period_us: float  # p
    step: float  # motion since the previous arrival


QUEUE_FIELDS = (
    Field("queue_to_free", "context", "link", _RATIO, "log(arrivals until the message in transmission has left)",
          lambda buffer, arrival, q: ratio(float(buffer.left_bytes), q.short * q.period_us), -MOST, MOST),
    Field("queue_short_rate", "context", "link", _RATIO, "log(link's rate over 0.1 s / r)",
          lambda buffer, arrival, q: times(q.short, q.per_rate), -MOST, MOST),
    Field("queue_medium_rate", "context", "link", _RATIO, "log(link's rate over 0.5 s / r)",
          lambda buffer, arrival, q: times(q.medium, q.per_rate), -MOST, MOST),
    Field("queue_carried", "context", "link", _RATIO, "log(messages that the link carries in p at r) + 2",
          lambda buffer, arrival, q: times(q.rate * q.period_us * (math.e * math.e), q.per_size),
          -MOST, MOST),
    Field("queue_step", "context", "motion", _RATIO, "log(motion since the previous arrival / e) + 1",
          lambda buffer, arrival, q: times(q.step * math.e, q.per_even), -MOST, MOST),
    Field("queue_age", "context", "link", _RATIO,
          "log(age of the message dequeued last / time in which the link sends L + 1 messages at r)",
          lambda buffer, arrival, q: ratio(
              q.rate * (arrival.arrival_us - buffer.dequeued_arrival_us),
              float((buffer.capacity + 1) * arrival.size_bytes)), -MOST, MOST),
    Field("queue_stalled", "context", "link", _RATIO,
          "log(time since a message was last dequeued / time of one message at r)",
          lambda buffer, arrival, q: times(q.rate * buffer.stalled_us, q.per_size), -MOST, MOST),
    Field("queue_bend", "context", "value", "-1 to 1", "2 (2 V(e) - V(2e)) / V(e) - 1: -1 where V is straight",
          lambda buffer, arrival, q: bend(buffer, q.even), -1.0),
    Field("queue_fill", "context", "queue", "-1 to 1", "2 s / L - 1 for s messages queued",
          lambda buffer, arrival, q: 2.0 * len(buffer.slots) / buffer.capacity - 1.0, -1.0),
)  # fmt: skip
"""Numbers of the queue and the link."""
# Ratios come last among the numbers of candidates and first among those of the queue: one loop takes all logarithms.
_FIELDS = len(CANDIDATE_FIELDS)
_FLAGS = sum(field.unit != _RATIO for field in CANDIDATE_FIELDS)
_RATIOS = sum(field.unit == _RATIO for field in QUEUE_FIELDS)
_write_candidate = writer(CANDIDATE_FIELDS, "candidate")
_write_queue = writer(QUEUE_FIELDS, "buffer, arrival, around")


@kernel
def bend(buffer: Buffer, even: float) -> float:
    """How much two merged even gaps lose, from -1 (nothing) to 1 (all of one gap's worth)."""
    gain = value(buffer.v, even)
    if gain <= 0:
        return -1.0
    return min(2 * merging_loss(buffer.v, even, gain, even, gain) / gain - 1, 1.0)


@kernel
def observe_candidates(
    buffer: Buffer, arrival: Any, order: NDArray[Any], cost: NDArray[np.float64], numbers: NDArray[np.floating[Any]]
) -> None:
    """Write ``CANDIDATE_FIELDS``, k + 1 numbers each, and then ``QUEUE_FIELDS`` into ``numbers``.

    ``order`` and ``cost`` come from ``find_candidates``.
    """
    s, places = len(buffer.slots), len(order)
    first = _FLAGS * places
    rows, context = unchecked_table(numbers, _FIELDS, places), numbers[_FIELDS * places :]
    even = (arrival.x - buffer.dequeued_x) / (buffer.capacity + 1)
    step, per_even = arrival.x - buffer.previous_x, inverse(even)
    for column in range(places):
        j = int(order[column])
        if j == NONE:
            rows[:_FLAGS, column], rows[_FLAGS:, column] = 0.0, 1.0
            continue
        from_x = unchecked_item(buffer.slots, j - 1).x if j > 0 else buffer.dequeued_x
        x = unchecked_item(buffer.slots, j).x if j < s else arrival.x
        after = step
        if j < s:
            after = (unchecked_item(buffer.slots, j + 1).x if j + 1 < s else arrival.x) - x
        candidate = Candidate(cost[column], x - from_x, after, per_even, (j + 1) / (s + 1), j == s, j == 0)
        _write_candidate(candidate, column, rows)
    rate = buffer.long_rate_bytes_per_s * 1e-6
    around = Around(
        even,
        per_even,
        buffer.short_rate_bytes_per_s * 1e-6,
        buffer.medium_rate_bytes_per_s * 1e-6,
        rate,
        inverse(rate),
        inverse(float(arrival.size_bytes)),
        max(buffer.period_us, 1.0),
        step,
    )
    _write_queue(buffer, arrival, around, context)
    take_logarithms(numbers[first : _FIELDS * places + _RATIOS])
