"""The bounded buffer of one sender, as a row of an array: push, pop the head, evict a slot.

A row of ``slots`` holds the message dequeued last (delivered or still in transmission), then the queued messages in
order. Slot 0, the head, is the oldest queued message; it is at column ``first``. Its information is measured against
``slots[first - 1]``, and popping it moves nothing in memory.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, unchecked_item
from bufgym.model.documented import documented
from bufgym.model.past import PAST, Past
from bufgym.model.qoi import merging_loss, value
from bufgym.utils.errors import BufgymError

MESSAGE = np.dtype(
    [
        ("seq", np.int64),  # position in the episode's list of arrivals
        ("arrival_us", np.int64),  # when it reached the sender
        ("size_bytes", np.int64),
        ("topic", np.int64),
        ("x", np.float64),  # coordinate: how far the scene has moved on (frame index or motion)
        ("uniform", np.float64),  # uniform draw in [0, 1), for randomised policies
        ("gain", np.float64),  # V(x - x of the message kept before it): what its delivery adds
    ],
    align=True,
)

TOPIC = np.dtype(
    [
        # settings (see ``bufgym.model.topics.Topic``)
        ("priority", np.float64),
        ("weight", np.float64),  # factor of the topic's H in the weighted sum
        ("period_us", np.int64),  # rate limit: at most one message a period; 0 for none
        ("limit", np.int64),  # most messages of this topic in the buffer
        ("no_drop", np.int64),  # 1: may not be dropped
        ("deadline_us", np.int64),  # a message is late when it is older than this at the server
        ("v_start", np.int64),  # where the topic's V begins in the array of all V
        ("highest_priority", np.float64),  # the highest priority and
        ("largest_weight", np.float64),  # the largest weight of all topics, in every row
        # the topic's past, as the sender knows it
        ("queued", np.int64),  # messages in the buffer
        ("arrived", np.int64),
        ("kept_us", np.int64),  # arrival time of the message enqueued last
        ("previous_us", np.int64),  # arrival time of the topic's previous message, kept or not
        ("previous_x", np.float64),
        ("step_us", np.int64),  # time between the topic's last two arrivals
        ("step_x", np.float64),
        ("dequeued", np.int64),  # messages the socket dequeued
        ("dequeued_arrival_us", np.int64),  # arrival time of the message dequeued last
        ("dequeued_x", np.float64),
        ("last_dequeue_us", np.int64),  # time at which it was dequeued
        # the topic at the server: statistics that the robot does not know
        ("received", np.int64),
        ("newest_us", np.int64),  # arrival time of the newest received
        ("aged_us", np.int64),  # time up to which the topic's age has been counted
        ("aged", np.float64),  # its age, integrated over that time, s^2
    ],
    align=True,
)

REJECT = -1
"""A policy's decision is the slot to evict for the newcomer (0 = oldest), or to reject the newcomer."""
ACCEPT = -2
"""Or to accept the newcomer, which needs room."""
HOLD = -1
"""A scheduler's choice is the slot to send, or to send nothing until the next arrival or ack."""

UNLIMITED_BYTES = 2**62
NO_PARAMETERS: NDArray[np.float64] = np.zeros(0)
NO_PARAMETERS.flags.writeable = False
NO_PAST: Past = np.zeros(PAST)
NO_PAST.flags.writeable = False
MAX_CAPACITY = 10**6


def check_limits(capacity: int, max_bytes: int | None) -> None:
    """Check the limits L, messages, and B, bytes or None for no limit; raise a BufgymError if one is unusable."""
    if isinstance(capacity, bool) or not isinstance(capacity, int | np.integer) or not 1 <= capacity <= MAX_CAPACITY:
        raise BufgymError(f"capacity = {capacity!r}: L must be a whole number from 1 to {MAX_CAPACITY}")
    if max_bytes is not None and not (isinstance(max_bytes, int | np.integer) and 1 <= max_bytes < UNLIMITED_BYTES):
        raise BufgymError(f"max_bytes = {max_bytes!r}: B must be a whole number >= 1, or None for no limit")


@documented
class Buffer(NamedTuple):
    """What a robot knows on board when a message arrives: all that a policy may see. Do not write to it.

    Nothing here needs feedback from the server or a measurement of the link's bandwidth.
    """

    slots: NDArray[Any]
    """MESSAGE[occupancy]: the queued messages, 0 = oldest. The message in transmission, never dropped, is not here."""
    capacity: int
    """L, messages."""
    max_bytes: int
    """B, bytes; UNLIMITED_BYTES for no byte limit."""
    backlog_bytes: int
    """Bytes queued."""
    now_us: int
    """The robot's clock, us."""
    dequeued: int
    """Messages dequeued so far (delivered, or in transmission)."""
    dequeued_arrival_us: int
    """Arrival time of the message dequeued last, us. Before the first dequeue: of the oldest queued message, or of the
    previous arrival if the queue is empty. With several topics this field, ``dequeued_x``, ``previous_us`` and
    ``previous_x`` describe the newcomer's topic."""
    dequeued_x: float
    """Coordinate x of the message dequeued last."""
    dequeued_seq: int
    """``seq`` of the message dequeued last, on any topic. Before the first dequeue: as for ``dequeued_arrival_us``."""
    previous_us: int
    """Time of the previous arrival, kept or not, us."""
    previous_x: float
    """Coordinate x of the previous arrival, kept or not."""
    busy: int
    """1 while a message is in transmission, otherwise 0."""
    left_bytes: int
    """Bytes of the message in transmission that the link has not carried yet."""
    left_fraction: float
    """``left_bytes`` as a fraction of that message, in [0, 1]."""
    stalled_us: int
    """Time since a message was last dequeued, us."""
    period_us: float
    """Running mean of the time between arrivals, us."""
    arrival_bytes: float
    """Running mean of the bytes of an arrival, kept or not; the newcomer counts."""
    departures: int
    """Messages dequeued since the previous arrival."""
    service_ratio: float
    """Running mean of departures per arrival: 1 when the link keeps up, 0 when it stands still."""
    drained_bytes: int
    """Bytes that left the socket between the previous arrival and this one."""
    drained_us: int
    """Time since the previous arrival in which the socket had bytes to send, us."""
    short_rate_bytes_per_s: float
    """The link's rate, bytes/s: a running mean of the bytes sent, over about the last 0.1 s in which the socket had
    bytes to send. 0 before the first."""
    medium_rate_bytes_per_s: float
    """The same mean over about 0.5 s."""
    long_rate_bytes_per_s: float
    """The same mean over about 2 s."""
    v: NDArray[np.float64]
    """float64[entries]: the value function, for ``qoi.value(buffer.v, distance)``. With several topics, the V of each
    begins at its ``v_start``."""
    topics: NDArray[Any]
    """TOPIC[topics]: settings and past of each topic. A single queue has one row, which holds settings only."""
    window: int
    """n_T, the most messages that may be sent and not yet acked."""
    in_flight: int
    """Messages sent and not yet acked; on a link without acks, not yet transmitted."""
    evictions: int
    """Messages evicted so far for the current arrival. It is 0 at the first question; the policy is asked again while
    B still has no room. A policy that counts arrivals counts only where this is 0."""
    remaining_us: int
    """Time until the stream ends, as far as the robot was told, at least 0; FOREVER if it was not."""
    parameters: NDArray[np.float64] = NO_PARAMETERS
    """float64[parameters], read-only: the policy's own settings in the order of its registration, or its weights."""
    past: Past = NO_PAST
    """float64[PAST]: what was measured of link and camera so far; ``bufgym.model.past`` has its entries."""


@kernel
def running_mean(mean: float, amount: float, us: float, seen_us: float, window_us: float) -> float:
    """Update ``mean``, in units per us, by an ``amount`` that came in the next ``us``.

    The mean covers about ``window_us``, or all the time so far (``seen_us``) if that is less.
    """
    return mean + (amount - mean * us) / (us + min(window_us, seen_us))


@kernel
def push(slots: NDArray[Any], i: int, first: int, occupancy: int, arrival: Any) -> int:
    """Put ``arrival`` behind the tail of row ``i``; return the head's index, which changes when the row is packed."""
    if first + occupancy == slots.shape[1]:
        for k in range(occupancy + 1):
            slots[i, k] = slots[i, first - 1 + k]
        first = 1
    slots[i, first + occupancy] = arrival
    return first


@kernel
def evict(slots: NDArray[Any], i: int, first: int, occupancy: int, k: int) -> int:
    """Take slot ``k`` out of row ``i``, closing the gap from its shorter side; return the head's index."""
    if 2 * k < occupancy:
        for j in range(first + k, first - 1, -1):
            slots[i, j] = slots[i, j - 1]
        return first + 1
    for j in range(first + k, first + occupancy - 1):
        slots[i, j] = slots[i, j + 1]
    return first


def row_width(capacity: int) -> int:
    """Columns of ``slots`` for L = ``capacity``: the message dequeued last, L queued, L more to pop without moving."""
    return 1 + 2 * capacity


@kernel
def has_space(buffer: Buffer, arrival: Any) -> bool:
    """Whether the newcomer fits into the queue as it is, by messages and by bytes."""
    return bool(len(buffer.slots) < buffer.capacity and buffer.backlog_bytes + arrival.size_bytes <= buffer.max_bytes)


@kernel
def suffices(buffer: Buffer, arrival: Any, freed_bytes: int) -> bool:
    """Whether the newcomer fits by bytes once so many have been freed."""
    return bool(buffer.backlog_bytes - freed_bytes + arrival.size_bytes <= buffer.max_bytes)


@kernel
def newcomer_stays(buffer: Buffer, arrival: Any, ahead: bool, freed_bytes: int) -> bool:
    """Whether the newcomer stays where there is no room: it is ``ahead``, and the bytes behind it make room.

    Once a message has gone for it, it stays in any case.
    """
    return bool(buffer.evictions > 0 or (ahead and suffices(buffer, arrival, freed_bytes)))


@kernel
def fill(buffer: Buffer) -> float:
    """Fill level of the queue by messages or by bytes, whichever is higher; 1 when full."""
    return max(len(buffer.slots) / buffer.capacity, buffer.backlog_bytes / buffer.max_bytes)


@kernel
def of_topic(slots: NDArray[Any], k: int, topic: int, step: int) -> int:
    """The next slot on this topic from ``k`` on in steps of 1 or -1; -1 or ``len(slots)`` if there is none."""
    k += step
    while 0 <= k < len(slots) and unchecked_item(slots, k).topic != topic:
        k += step
    return k


@kernel
def before(buffer: Buffer, k: int, topic: int) -> int:
    """The slot before slot ``k`` on the same topic, or -1 if there is none."""
    return of_topic(buffer.slots, k, topic, -1) if len(buffer.topics) > 1 else k - 1


@kernel
def after(buffer: Buffer, k: int, topic: int) -> int:
    """The slot after slot ``k`` on the same topic, or ``len(buffer.slots)``."""
    return of_topic(buffer.slots, k, topic, 1) if len(buffer.topics) > 1 else k + 1


@kernel
def could_fit(spare_bytes: int, slots: NDArray[Any], topics: NDArray[Any]) -> bool:
    """Whether ``spare_bytes`` would not be negative if every droppable message went."""
    k = 0
    while spare_bytes < 0 and k < len(slots):
        slot = unchecked_item(slots, k)
        if len(topics) == 1 or unchecked_item(topics, slot.topic).no_drop == 0:
            spare_bytes += slot.size_bytes
        k += 1
    return spare_bytes >= 0


@kernel
def is_first(buffer: Buffer, k: int) -> bool:
    """Whether slot ``k`` is the oldest of its topic. Each topic's messages are sent in order."""
    return before(buffer, k, unchecked_item(buffer.slots, k).topic) < 0


@kernel
def gaps(buffer: Buffer, arrival: Any, arriving: bool, k: int) -> tuple[int, int, float, float, float]:
    """Gaps of slot ``k`` to the messages kept before and after it on its topic; the newcomer is ``len(buffer.slots)``.

    The successor of the newcomer, and of a topic's last message, is still to come: the next step is expected to be as
    long as the last one. Where the socket asks (not ``arriving``), ``arrival`` follows nothing.

    Returns:
        Time gaps before and after, us; gaps in x before and after; the gap in x left if the message is dropped.
    """
    s, by_topic = len(buffer.slots), len(buffer.topics) > 1
    message = arrival if k == s else unchecked_item(buffer.slots, k)
    at_us, x, topic = message.arrival_us, message.x, message.topic
    from_us, from_x = at_us, x
    follows = not by_topic or (arriving and arrival.topic == topic)  # whether the arrival is the next message
    j = before(buffer, k, topic)
    if j >= 0:
        from_us, from_x = unchecked_item(buffer.slots, j).arrival_us, unchecked_item(buffer.slots, j).x
    elif follows:
        from_us, from_x = buffer.dequeued_arrival_us, buffer.dequeued_x
    elif unchecked_item(buffer.topics, topic).dequeued > 0:
        past = unchecked_item(buffer.topics, topic)
        from_us, from_x = past.dequeued_arrival_us, past.dequeued_x
    back_us, back_x = at_us - from_us, x - from_x
    if k == s:
        step_us, step_x = at_us - buffer.previous_us, x - buffer.previous_x
        return back_us, step_us, back_x, step_x, back_x + step_x
    j = after(buffer, k, topic)
    if j == s and not follows:
        past = unchecked_item(buffer.topics, topic)
        step_us = max(past.previous_us - at_us, 0) + past.step_us
        step_x = max(past.previous_x - x, 0.0) + past.step_x
        return back_us, step_us, back_x, step_x, back_x + step_x
    to_us, to_x = arrival.arrival_us, arrival.x
    if j < s:
        to_us, to_x = unchecked_item(buffer.slots, j).arrival_us, unchecked_item(buffer.slots, j).x
    return back_us, to_us - at_us, back_x, to_x - x, to_x - from_x


@kernel
def motion_gaps(buffer: Buffer, arrival: Any, k: int) -> tuple[float, float]:
    """Distances in x between slot ``k`` and the messages kept before and after it on its topic; see ``gaps``."""
    _, _, back_x, on_x, _ = gaps(buffer, arrival, True, k)
    return back_x, on_x


@kernel
def arrival_gain(buffer: Buffer, arrival: Any) -> float:
    """V of the newcomer's gap to the message kept before it, gained by accepting it; 0 for the first message."""
    s = len(buffer.slots)
    if len(buffer.topics) == 1:
        if s > 0:
            return value(buffer.v, arrival.x - buffer.slots[s - 1].x)
        return value(buffer.v, arrival.x - buffer.dequeued_x) if buffer.dequeued > 0 else 0.0
    topic = buffer.topics[arrival.topic]
    if topic.queued == 0 and topic.dequeued == 0:
        return 0.0
    return float(topic.weight * value(buffer.v[topic.v_start :], motion_gaps(buffer, arrival, s)[0]))


@kernel
def loss(buffer: Buffer, arrival: Any, k: int) -> float:
    """QoI lost by dropping slot ``k`` alone, V(a) + V(b) - V(a + b) for its gaps a and b.

    It is never negative, as V is concave. With several topics it is multiplied by the weight of the slot's topic.
    """
    a, b = motion_gaps(buffer, arrival, k)
    if len(buffer.topics) == 1:
        return merging_loss(buffer.v, a, value(buffer.v, a), b, value(buffer.v, b))
    topic = buffer.topics[arrival.topic if k == len(buffer.slots) else buffer.slots[k].topic]
    v = buffer.v[topic.v_start :]
    return float(topic.weight * merging_loss(v, a, value(v, a), b, value(v, b)))
