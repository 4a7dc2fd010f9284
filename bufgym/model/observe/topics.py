"""Fields with several topics: the fields of one queue, with neighbours of the same topic, and ``TOPIC_FIELDS``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import kernel
from bufgym.model.buffer import Buffer, arrival_gain, gaps, is_first
from bufgym.model.observe import fields
from bufgym.model.observe.queue import ROUNDING, TINY, observe_link, squash, squash_row
from bufgym.model.qoi import merging_loss, value
from bufgym.model.topics import NO_DEADLINE_US

_SECOND_US = 1_000_000


@kernel
def largest(buffer: Buffer) -> tuple[float, float]:
    """The highest priority and the largest weight of all topics, to divide by."""
    priority, weight = TINY, TINY
    for k in range(len(buffer.topics)):
        priority = max(priority, buffer.topics[k].priority)
        weight = max(weight, buffer.topics[k].weight)
    return priority, weight


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

    Empty slots are 0. The newcomer is last; if the socket asks (not ``arriving``) its column is empty too.
    """
    s, capacity = len(buffer.slots), buffer.capacity
    priority, weight = largest(buffer)
    rows[:, s:] = 0.0
    count = s + 1 if arriving else s
    size_sum, gain_sum = 0.0, 0.0
    for k in range(count):
        message, column = (buffer.slots[k], k) if k < s else (arrival, capacity)
        topic = buffer.topics[message.topic]
        back_us, on_us, back_x, on_x, _ = gaps(buffer, arrival, arriving, k)
        gain = message.gain
        if k == s:
            if topic.queued == 0 and topic.dequeued == 0:  # nothing of the topic was kept before it
                back_us, back_x = 0, 0.0
            gain = arrival_gain(buffer, arrival)
        age_us, known_us = buffer.now_us - message.arrival_us, topic.dequeued_arrival_us if topic.dequeued > 0 else 0
        rows[fields.OCCUPIED, column] = 1.0
        rows[fields.RANK, column] = (k + 1) / (s + 1)
        own = arriving and message.topic == arrival.topic
        last_us, last_x = (arrival.arrival_us, arrival.x) if own else (topic.previous_us, topic.previous_x)
        even_us, even_x = even_gaps(topic, last_us, last_x)
        # Rounded as the rows are.
        rows[fields.TIME_BEFORE, column], rows[fields.MOTION_BEFORE, column] = back_us, back_x
        before_us, before_x = float(rows[fields.TIME_BEFORE, column]), float(rows[fields.MOTION_BEFORE, column])
        v = buffer.v[topic.v_start :]
        lost = max(merging_loss(v, before_x, value(v, before_x), on_x, value(v, on_x)), 0.0)
        even_gain = value(v, even_x)
        even_loss = max(merging_loss(v, even_x, even_gain, even_x, even_gain), ROUNDING)
        rows[fields.TIME_BEFORE, column] = squash(before_us, even_us)
        rows[fields.TIME_MERGED, column] = squash(before_us + on_us, 2 * even_us)
        rows[fields.MOTION_BEFORE, column] = squash(before_x, even_x)
        rows[fields.MOTION_MERGED, column] = squash(before_x + on_x, 2 * even_x)
        rows[fields.LOSS, column] = lost * topic.weight / weight
        rows[fields.RELATIVE_LOSS, column] = squash(lost, even_loss)
        rows[fields.SIZE, column] = message.size_bytes
        rows[fields.PRIORITY, column] = topic.priority / priority
        rows[fields.WEIGHT, column] = topic.weight / weight
        rows[fields.NO_DROP, column] = topic.no_drop
        rows[fields.OLDEST, column] = 1.0 if k < s and is_first(buffer, k) else 0.0
        rows[fields.OWN, column] = 1.0 if own else 0.0
        rows[fields.WAITED, column] = squash(age_us, _SECOND_US)
        rows[fields.SILENCE, column] = squash(max(buffer.now_us - known_us, 0), _SECOND_US)
        rows[fields.LATENESS, column] = squash(age_us, topic.deadline_us) if topic.deadline_us < NO_DEADLINE_US else 0.0
        rows[fields.QUEUED, column] = topic.queued / capacity
        rows[fields.GAIN, column] = gain / weight
        rows[fields.GAIN_PER_BYTE, column] = float(rows[fields.GAIN, column]) / message.size_bytes
        size_sum += message.size_bytes
        gain_sum += float(rows[fields.GAIN_PER_BYTE, column])
    squash_row(rows[fields.SIZE], size_sum / max(count, 1))
    squash_row(rows[fields.GAIN_PER_BYTE], gain_sum / max(count, 1))


@kernel
def observe_topic_context(buffer: Buffer, arrival: Any, arriving: bool, context: NDArray[np.floating[Any]]) -> None:
    """Write every CONTEXT_FIELDS and TOPIC_CONTEXT_FIELDS value into ``context`` (float[fields])."""
    observe_link(buffer, context)
    context[fields.ARRIVAL_TIME_GAP], context[fields.ARRIVAL_MOTION_GAP] = 0.0, 0.0
    context[fields.EVEN_VALUE], context[fields.BEND] = 0.0, 0.0
    if arriving:
        topic = buffer.topics[arrival.topic]
        v = buffer.v[topic.v_start :]
        even_us, even_x = even_gaps(topic, arrival.arrival_us, arrival.x)
        context[fields.ARRIVAL_TIME_GAP] = squash(arrival.arrival_us - buffer.previous_us, even_us)
        context[fields.ARRIVAL_MOTION_GAP] = squash(arrival.x - buffer.previous_x, even_x)
        gain = value(v, even_x)
        context[fields.EVEN_VALUE] = topic.weight * gain / largest(buffer)[1]
        context[fields.BEND] = min(merging_loss(v, even_x, gain, even_x, gain) / max(gain, TINY), 1.0)
    context[fields.SOCKET_ASKS] = 0.0 if arriving else 1.0
    context[fields.IN_FLIGHT] = squash(buffer.in_flight, buffer.window)
