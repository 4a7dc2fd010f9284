"""Several topics: the same fields with each message's neighbours on its own topic, and those of ``TOPIC_FIELDS``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.kernel import kernel
from bufgym.model.buffer import UNLIMITED_BYTES, Buffer
from bufgym.model.qoi import merging_loss, value
from bufgym.model.topics import NO_DEADLINE_US
from bufgym.observe.fields import (
    ARRIVAL_MOTION_GAP,
    ARRIVAL_TIME_GAP,
    BACKLOG,
    BEND,
    BUSY,
    DEPARTURES,
    DRAIN,
    EVEN_VALUE,
    GAIN,
    GAIN_PER_BYTE,
    IN_FLIGHT,
    LATENESS,
    LEFT,
    LOSS,
    MOTION_BEFORE,
    MOTION_MERGED,
    NO_DROP,
    OCCUPANCY,
    OCCUPIED,
    OLDEST,
    OWN,
    PRIORITY,
    QUEUED,
    RANK,
    RELATIVE_LOSS,
    SILENCE,
    SIZE,
    SOCKET_ASKS,
    STALLED,
    TIME_BEFORE,
    TIME_MERGED,
    WAITED,
    WEIGHT,
)
from bufgym.observe.queue import ROUNDING, TINY, squash, squash_row

_SECOND_US = 1_000_000


@kernel
def largest(buffer: Buffer) -> tuple[float, float]:
    """The highest priority and the largest weight of all topics."""
    priority, weight = 0.0, 0.0
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
def last_of(topic: Any, number: int, arrival: Any, arriving: bool) -> tuple[int, float]:
    """Time and coordinate of a topic's last arrival, the one at hand included."""
    if arriving and number == arrival.topic:
        return arrival.arrival_us, arrival.x
    return topic.previous_us, topic.previous_x


@kernel
def fill_row(
    buffer: Buffer,
    message: Any,
    k: int,
    gain: float,
    before_us: int,
    before_x: float,
    of_all: tuple[float, float],
    rows: NDArray[np.floating[Any]],
) -> None:
    """What concerns message ``k`` and what was before it."""
    topic = buffer.topics[message.topic]
    age_us = buffer.now_us - message.arrival_us
    rows[OCCUPIED, k] = 1.0
    rows[TIME_BEFORE, k] = message.arrival_us - before_us
    rows[MOTION_BEFORE, k] = message.x - before_x
    rows[SIZE, k] = message.size_bytes
    rows[PRIORITY, k] = topic.priority / max(of_all[0], TINY)
    rows[WEIGHT, k] = topic.weight / max(of_all[1], TINY)
    rows[NO_DROP, k] = topic.no_drop
    rows[WAITED, k] = squash(age_us, _SECOND_US)
    known_us = topic.dequeued_arrival_us if topic.dequeued > 0 else 0
    rows[SILENCE, k] = squash(max(buffer.now_us - known_us, 0), _SECOND_US)
    rows[LATENESS, k] = squash(age_us, topic.deadline_us) if topic.deadline_us < NO_DEADLINE_US else 0.0
    rows[QUEUED, k] = topic.queued / buffer.capacity
    rows[GAIN, k] = gain / max(of_all[1], TINY)
    rows[GAIN_PER_BYTE, k] = rows[GAIN, k] / message.size_bytes


@kernel
def fill_after(
    buffer: Buffer,
    topic_number: int,
    k: int,
    step_us: int,
    step_x: float,
    last: tuple[int, float],
    of_all: tuple[float, float],
    rows: NDArray[np.floating[Any]],
) -> None:
    """What concerns message ``k`` and what comes ``step_us``, ``step_x`` after it on its topic, squashed."""
    topic = buffer.topics[topic_number]
    v = buffer.v[topic.v_start :]
    before_us, before_x = float(rows[TIME_BEFORE, k]), float(rows[MOTION_BEFORE, k])
    even_us, even_x = even_gaps(topic, last[0], last[1])
    lost = max(merging_loss(v, before_x, value(v, before_x), step_x, value(v, step_x)), 0.0)
    even_gain = value(v, even_x)
    even_loss = max(merging_loss(v, even_x, even_gain, even_x, even_gain), ROUNDING)
    rows[LOSS, k] = lost * topic.weight / max(of_all[1], TINY)
    rows[RELATIVE_LOSS, k] = squash(lost, even_loss)
    rows[TIME_MERGED, k] = squash(before_us + step_us, 2 * even_us)
    rows[MOTION_MERGED, k] = squash(before_x + step_x, 2 * even_x)
    rows[TIME_BEFORE, k] = squash(before_us, even_us)
    rows[MOTION_BEFORE, k] = squash(before_x, even_x)


@kernel
def observe_topic_slots(buffer: Buffer, arrival: Any, arriving: bool, rows: NDArray[np.floating[Any]]) -> None:
    """Write every SLOT_FIELDS and TOPIC_SLOT_FIELDS value into ``rows`` (float[fields, L + 1]).

    Empty slots are 0. The newcomer is last; where the socket asks (not ``arriving``) its place is empty too.
    """
    s, capacity = len(buffer.slots), buffer.capacity
    of_all = largest(buffer)
    for k in range(len(buffer.topics)):
        buffer.topics[k].mark = -1
    rows[:, s:] = 0.0
    for k in range(s):
        slot = buffer.slots[k]
        topic = buffer.topics[slot.topic]
        j = topic.mark
        before_us, before_x = topic.dequeued_arrival_us, topic.dequeued_x
        if j >= 0:
            before_us, before_x = buffer.slots[j].arrival_us, buffer.slots[j].x
        elif topic.dequeued == 0:
            before_us, before_x = slot.arrival_us, slot.x
        fill_row(buffer, slot, k, slot.gain, before_us, before_x, of_all, rows)
        rows[RANK, k] = (k + 1) / (s + 1)
        rows[OLDEST, k] = 1.0 if j < 0 else 0.0
        rows[OWN, k] = 1.0 if arriving and slot.topic == arrival.topic else 0.0
        if j >= 0:
            last = last_of(topic, slot.topic, arrival, arriving)
            fill_after(buffer, slot.topic, j, slot.arrival_us - before_us, slot.x - before_x, last, of_all, rows)
        topic.mark = k
    for number in range(len(buffer.topics)):
        topic = buffer.topics[number]
        j = topic.mark
        if j < 0:
            continue
        tail = buffer.slots[j]
        if arriving and number == arrival.topic:
            step_us, step_x = arrival.arrival_us - tail.arrival_us, arrival.x - tail.x
        else:
            step_us = max(topic.previous_us - tail.arrival_us, 0) + topic.step_us
            step_x = max(topic.previous_x - tail.x, 0.0) + topic.step_x
        fill_after(buffer, number, j, step_us, step_x, last_of(topic, number, arrival, arriving), of_all, rows)
    size_sum = float(buffer.backlog_bytes)
    if arriving:
        topic = buffer.topics[arrival.topic]
        before_us, before_x, gain = arrival.arrival_us, arrival.x, 0.0
        if topic.mark >= 0:
            before_us, before_x = buffer.slots[topic.mark].arrival_us, buffer.slots[topic.mark].x
        elif topic.dequeued > 0:
            before_us, before_x = topic.dequeued_arrival_us, topic.dequeued_x
        if topic.mark >= 0 or topic.dequeued > 0:
            gain = topic.weight * value(buffer.v[topic.v_start :], arrival.x - before_x)
        fill_row(buffer, arrival, capacity, gain, before_us, before_x, of_all, rows)
        rows[RANK, capacity] = 1.0
        rows[OWN, capacity] = 1.0
        step_us, step_x = 0, 0.0
        if topic.arrived > 0:
            step_us, step_x = arrival.arrival_us - topic.previous_us, arrival.x - topic.previous_x
        newest = last_of(topic, arrival.topic, arrival, arriving)
        fill_after(buffer, arrival.topic, capacity, step_us, step_x, newest, of_all, rows)
        size_sum += arrival.size_bytes
    count = s + (1 if arriving else 0)
    total = 0.0
    for k in range(s):
        total += rows[GAIN_PER_BYTE, k]
    total += rows[GAIN_PER_BYTE, capacity]
    squash_row(rows[SIZE], size_sum / max(count, 1))
    squash_row(rows[GAIN_PER_BYTE], total / max(count, 1))


@kernel
def observe_topic_context(buffer: Buffer, arrival: Any, arriving: bool, context: NDArray[np.floating[Any]]) -> None:
    """Write every CONTEXT_FIELDS and TOPIC_CONTEXT_FIELDS value into ``context`` (float[fields])."""
    spread = buffer.capacity + 1
    context[OCCUPANCY] = len(buffer.slots) / buffer.capacity
    context[BACKLOG] = buffer.backlog_bytes / buffer.max_bytes if buffer.max_bytes < UNLIMITED_BYTES else 0.0
    context[ARRIVAL_TIME_GAP], context[ARRIVAL_MOTION_GAP] = 0.0, 0.0
    context[EVEN_VALUE], context[BEND] = 0.0, 0.0
    if arriving:
        topic = buffer.topics[arrival.topic]
        v = buffer.v[topic.v_start :]
        even_us, even_x = even_gaps(topic, arrival.arrival_us, arrival.x)
        context[ARRIVAL_TIME_GAP] = squash(arrival.arrival_us - buffer.previous_us, even_us)
        context[ARRIVAL_MOTION_GAP] = squash(arrival.x - buffer.previous_x, even_x)
        gain = value(v, even_x)
        context[EVEN_VALUE] = topic.weight * gain / max(largest(buffer)[1], TINY)
        context[BEND] = min(merging_loss(v, even_x, gain, even_x, gain) / max(gain, TINY), 1.0)
    context[BUSY] = buffer.busy
    context[LEFT] = buffer.left_fraction
    context[STALLED] = squash(buffer.stalled_us, spread * buffer.period_us)
    context[DEPARTURES] = squash(buffer.departures, 1.0)
    context[DRAIN] = squash(buffer.service_ratio, 1.0)
    context[SOCKET_ASKS] = 0.0 if arriving else 1.0
    context[IN_FLIGHT] = squash(buffer.in_flight, buffer.window)
