"""A check after a run that a policy did not change the records of its sender.

Compiled policies see the sender's own records, which spares a copy at every decision, but Numba lets them write there.
So every benchmark run is checked at its end: a policy that changed a message or a topic's rules has no result.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from bufgym.ground.errors import BufgymError
from bufgym.ground.kernel import at, item, kernel
from bufgym.model.qoi import value
from bufgym.sim.state import NEVER, Batch

_ARRIVAL, _QUEUED, _BYTES, _LOG, _TOPIC, _QOI = range(1, 7)
_ROUNDING = 1e-9
"""Tolerance: H is added up in another order here."""
_FOUND = {
    _ARRIVAL: "a message that arrived is not as the episode has it",
    _QUEUED: "a queued message is not as it arrived",
    _BYTES: "the queue's bytes are not those of its messages",
    _LOG: "not every message was sent, dropped or queued exactly once",
    _TOPIC: "a topic's rules are not as they were",
    _QOI: "H is not that of the messages that were received",
}


def check_untouched(batch: Batch, i: int, arrivals: NDArray[Any], topics: NDArray[Any], policy: str) -> None:
    """Raise if sender ``i``'s finished run does not agree with its episode, MESSAGE[n] and TOPIC[topics]."""
    found = _touched(batch, i, arrivals, topics)
    if found:
        raise BufgymError(
            f"policy {policy}: wrote to what it may only read: {_FOUND[found]} (run {i + 1} of the batch)"
        )


@kernel
def _same(a: Any, b: Any) -> bool:
    """Whether two MESSAGE records are the same message."""
    return bool(
        a.seq == b.seq
        and a.arrival_us == b.arrival_us
        and a.size_bytes == b.size_bytes
        and a.topic == b.topic
        and a.x == b.x
        and a.uniform == b.uniform
    )


@kernel
def _touched(batch: Batch, i: int, arrivals: NDArray[Any], topics: NDArray[Any]) -> int:
    """A code for the record that does not agree, or 0."""
    sender = batch.senders[i]
    dequeued, dropped, backlog_bytes, last = 0, 0, 0, -1
    for k in range(len(arrivals)):
        if not _same(at(batch.arrivals, i, k), item(arrivals, k)):
            return _ARRIVAL
        entry = at(batch.log, i, k)
        dequeued += entry.dequeued_us != NEVER
        dropped += entry.dropped_us != NEVER
        if entry.dequeued_us != NEVER and (
            entry.dropped_us != NEVER or entry.dequeued_us < item(arrivals, k).arrival_us
        ):
            return _LOG
    for k in range(sender.occupancy):
        slot = at(batch.slots, i, sender.first + k)
        if not (last < slot.seq < len(arrivals) and _same(slot, item(arrivals, slot.seq))):
            return _QUEUED
        entry = at(batch.log, i, slot.seq)
        if entry.dequeued_us != NEVER or entry.dropped_us != NEVER:
            return _QUEUED
        backlog_bytes += slot.size_bytes
        last = slot.seq
    if backlog_bytes != sender.backlog_bytes:
        return _BYTES
    # Each event writes one entry: as many entries as events means that no two were about one message.
    counted = dequeued == sender.dequeued and dropped == sender.evicted + sender.rejected
    if not counted or dequeued + dropped + sender.occupancy != sender.next:
        return _LOG
    for k in range(len(topics)):
        now, then = at(batch.topics, i, k), item(topics, k)
        if (
            now.priority != then.priority
            or now.weight != then.weight
            or now.period_us != then.period_us
            or now.limit != then.limit
            or now.no_drop != then.no_drop
            or now.deadline_us != then.deadline_us
            or now.v_start != then.v_start
        ):
            return _TOPIC
    gained = 0.0
    for topic in range(sender.topics):
        gained += _gained(batch, i, arrivals, topic)
    if abs(gained - sender.delivered_gain) > _ROUNDING * max(1.0, gained):
        return _QOI
    return 0


@kernel
def _gained(batch: Batch, i: int, arrivals: NDArray[Any], topic: int) -> float:
    """Gain of sender ``i`` from the received messages of one topic, or of its one queue, without the 1."""
    sender, gained, before = batch.senders[i], 0.0, -1
    several = sender.topics > 1
    weight, v_start = 1.0, sender.v_start
    if several:
        weight, v_start = at(batch.topics, i, topic).weight, at(batch.topics, i, topic).v_start
    for k in range(sender.credited):
        seq = at(batch.order, i, k)
        if several and item(arrivals, seq).topic != topic:
            continue
        if before >= 0:
            gained += weight * value(batch.v[v_start:], item(arrivals, seq).x - item(arrivals, before).x)
        before = seq
    return gained
