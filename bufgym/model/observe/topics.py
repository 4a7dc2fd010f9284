"""Fields with several topics: the fields of one queue, with neighbours of the same topic, and ``TOPIC_FIELDS``."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import Buffer, arrival_gain, gaps, is_first
from bufgym.model.observe.declare import TINY, Field, kept, length, ratio, single, squash, writer
from bufgym.model.observe.queue import CONTEXT_FIELDS, ROUNDING, SLOT_FIELDS, Newcomer, Slot, write_context, write_slot
from bufgym.model.qoi import merging_loss, value
from bufgym.model.topics import NO_DEADLINE_US

_SECOND_US = 1_000_000


class OfTopic(NamedTuple):
    """One message among several topics."""

    topic: Any  # TOPIC: its topic's settings and past
    first: bool  # whether it is the oldest queued message of its topic
    own: bool  # whether its topic is the newcomer's
    age_us: int  # time since its arrival, us
    silent_us: int  # time since the arrival of its topic's message dequeued last, or since 0 before there is one, us
    capacity: int  # L
    priority: float  # the highest priority
    weight: float  # the largest weight
    gain: float  # what its delivery adds to H, in units of that weight
    per_byte: Any  # the same for each byte of it
    mean_per_byte: Any  # the mean of that over the queue


TOPIC_SLOT_FIELDS = (
    Field("priority", "slot", "topic", "fraction of the highest", "priority of its topic",
          lambda slot: float(slot.topic.priority / slot.priority)),
    Field("weight", "slot", "topic", "fraction of the largest", "weight of its topic in the sum of H",
          lambda slot: float(slot.topic.weight / slot.weight)),
    Field("no_drop", "slot", "topic", "flag", "1 where it may not be dropped", lambda slot: float(slot.topic.no_drop)),
    Field("oldest", "slot", "topic", "flag", "1 where it is the oldest of its topic, the only one that may be sent",
          lambda slot: 1.0 if slot.first else 0.0),
    Field("own", "slot", "topic", "flag", "1 where its topic is the newcomer's; 0 when the socket asks",
          lambda slot: 1.0 if slot.own else 0.0),
    Field("waited", "slot", "topic", "g/(g+r), r = 1 s", "time since its arrival",
          lambda slot: squash(slot.age_us, _SECOND_US)),
    Field("silence", "slot", "topic", "g/(g+r), r = 1 s", "time since the arrival of its topic's message dequeued last",
          lambda slot: squash(slot.silent_us, _SECOND_US)),
    Field("lateness", "slot", "topic", "g/(g+r), r = its deadline", "time since its arrival; 0 without a deadline",
          lambda slot:
          squash(slot.age_us, slot.topic.deadline_us) if slot.topic.deadline_us < NO_DEADLINE_US else 0.0),
    Field("queued", "slot", "topic", "fraction of L", "messages of its topic in the buffer",
          lambda slot: float(slot.topic.queued / slot.capacity)),
    Field("gain", "slot", "topic", "QoI, weighted", "what its delivery adds to H", lambda slot: slot.gain),
    Field("gain_per_byte", "slot", "topic", "g/(g+r), r = mean of the queue", "the same for each byte of it",
          lambda slot: ratio(slot.per_byte, slot.mean_per_byte)),
)  # fmt: skip
TOPIC_CONTEXT_FIELDS = (
    Field("socket_asks", "context", "topic", "flag", "1 where the socket asks what to send, 0 at an arrival",
          lambda buffer, arriving: 0.0 if arriving else 1.0),
    Field("in_flight", "context", "topic", "n/(n+r), r = n_T", "messages sent and not yet acknowledged",
          lambda buffer, arriving: squash(buffer.in_flight, buffer.window)),
)  # fmt: skip
FIELDS = SLOT_FIELDS + CONTEXT_FIELDS
TOPIC_FIELDS = TOPIC_SLOT_FIELDS + TOPIC_CONTEXT_FIELDS
"""Fields observed besides ``FIELDS`` with several topics."""
_write_slot = writer(TOPIC_SLOT_FIELDS, "slot", first=len(SLOT_FIELDS))
_write_context = writer(TOPIC_CONTEXT_FIELDS, "buffer, arriving", first=len(CONTEXT_FIELDS))


@kernel
def largest(buffer: Buffer) -> tuple[float, float]:
    """The highest priority and the largest weight of all topics, to divide by."""
    return max(TINY, buffer.topics[0].highest_priority), max(TINY, buffer.topics[0].largest_weight)


@kernel
def even_gaps(topic: Any, last_us: int, last_x: float) -> tuple[float, float]:
    """The even spacing of a topic up to its last arrival, in time (us) and motion."""
    if topic.dequeued == 0 and topic.queued == 0:
        return 0.0, 0.0
    share = 1 / (topic.queued + 1)
    return share * max(last_us - topic.dequeued_arrival_us, 0), share * max(last_x - topic.dequeued_x, 0.0)


@kernel
def observe_topic_slots(buffer: Buffer, arrival: Any, arriving: bool, rows: NDArray[np.floating[Any]]) -> None:
    """Write every SLOT_FIELDS and TOPIC_SLOT_FIELDS value into ``rows``, float[fields, L + 1].

    Empty slots are 0. The newcomer is last; if the socket asks (not ``arriving``) its column is empty too. A gap and a
    gain are rounded as the rows are before others are made of them.
    """
    s, capacity = len(buffer.slots), buffer.capacity
    priority, weight = largest(buffer)
    rows[:, :] = 0.0
    count = s + 1 if arriving else s
    newest = arrival_gain(buffer, arrival) if arriving else 0.0
    size_sum, per_byte_sum = 0.0, 0.0
    for k in range(count):
        message, gain = (buffer.slots[k], buffer.slots[k].gain) if k < s else (arrival, newest)
        size_sum += message.size_bytes
        per_byte_sum += kept(kept(gain / weight, rows) / message.size_bytes, rows)
    mean_bytes, mean_per_byte = single(size_sum / max(count, 1)), single(per_byte_sum / max(count, 1))
    for k in range(count):
        message, column = (buffer.slots[k], k) if k < s else (arrival, capacity)
        topic = buffer.topics[message.topic]
        back_us, on_us, back_x, on_x, _ = gaps(buffer, arrival, arriving, k)
        if k == s and topic.queued == 0 and topic.dequeued == 0:  # nothing of the topic was kept before it
            back_us, back_x = 0, 0.0
        own = arriving and message.topic == arrival.topic
        last_us, last_x = (arrival.arrival_us, arrival.x) if own else (topic.previous_us, topic.previous_x)
        even_us, even_x = even_gaps(topic, last_us, last_x)
        before_us, before_x = kept(back_us, rows), kept(back_x, rows)
        v = buffer.v[topic.v_start :]
        lost = max(merging_loss(v, before_x, value(v, before_x), on_x, value(v, on_x)), 0.0)
        even_gain = value(v, even_x)
        even_lost = max(merging_loss(v, even_x, even_gain, even_x, even_gain), ROUNDING)
        slot = Slot(
            (k + 1) / (s + 1), before_us, before_us + on_us, before_x, before_x + on_x,
            lost, lost * topic.weight / weight, length(message.size_bytes, rows),
            max(even_us, TINY), max(even_x, TINY), even_lost, mean_bytes,
        )  # fmt: skip
        write_slot(slot, column, rows)
        gain = kept((message.gain if k < s else newest) / weight, rows)
        per_byte = length(gain / message.size_bytes, rows)
        age_us = buffer.now_us - message.arrival_us
        silent_us = max(buffer.now_us - (topic.dequeued_arrival_us if topic.dequeued > 0 else 0), 0)
        first = k < s and is_first(buffer, k)
        of_topic = OfTopic(
            topic, first, own, age_us, silent_us, capacity, priority, weight, gain, per_byte, mean_per_byte
        )  # fmt: skip
        _write_slot(of_topic, column, rows)


@kernel
def observe_topic_context(buffer: Buffer, arrival: Any, arriving: bool, context: NDArray[np.floating[Any]]) -> None:
    """Write every CONTEXT_FIELDS and TOPIC_CONTEXT_FIELDS value into ``context`` (float[fields])."""
    newcomer = Newcomer(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if arriving:
        topic = buffer.topics[arrival.topic]
        v = buffer.v[topic.v_start :]
        even_us, even_x = even_gaps(topic, arrival.arrival_us, arrival.x)
        gap_us, gap_x = float(arrival.arrival_us - buffer.previous_us), arrival.x - buffer.previous_x
        gain = value(v, even_x)
        lost = min(merging_loss(v, even_x, gain, even_x, gain), max(gain, TINY))
        share = topic.weight * gain / largest(buffer)[1]
        newcomer = Newcomer(gap_us, gap_x, even_us, even_x, gain, share, lost)
    write_context(buffer, newcomer, context)
    _write_context(buffer, arriving, context)
