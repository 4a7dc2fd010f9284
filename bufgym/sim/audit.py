"""A check after a run that a policy did not change the records of its sender.

Compiled policies see the sender's own records, which spares a copy at every decision, but they can write there.
So every benchmark run is checked at its end: a policy that changed a message or a topic's rules has no result.
"""

from typing import Any

from numpy.typing import NDArray

from bufgym.jit import kernel, unchecked_at, unchecked_item
from bufgym.model.qoi import value
from bufgym.scenario import Episode
from bufgym.sim.state import NEVER, Batch

ARRIVAL, QUEUED, BYTES, LOG, TOPIC, QOI = range(1, 7)
FAULTS = {
    0: "",
    ARRIVAL: "a message that arrived is not as the episode has it",
    QUEUED: "a queued message is not as it arrived",
    BYTES: "the queue's bytes are not those of its messages",
    LOG: "not every message was sent, dropped or queued exactly once",
    TOPIC: "a topic's rules are not as they were",
    QOI: "H is not that of the messages that were received",
}
_ROUNDING = 1e-9  # Tolerance: H is added up in another order here


def touched(batch: Batch, i: int, episode: Episode, topic_table: NDArray[Any]) -> str:
    """What does not agree with the episode or the topics' rules in sender ``i``'s finished run; empty if all does."""
    return FAULTS[_fault(batch, i, episode.arrivals, topic_table)]


@kernel
def _fault(batch: Batch, i: int, arrivals: NDArray[Any], rules: NDArray[Any]) -> int:
    """The fault that is found first, a key of ``FAULTS``; 0 for none. ``arrivals`` and ``rules`` are as given."""
    sender, n = batch.senders[i], len(arrivals)
    sent, dropped = 0, 0
    for k in range(n):
        if not _agree(unchecked_at(batch.arrivals, i, k), unchecked_item(arrivals, k)):
            return ARRIVAL
        entry = unchecked_at(batch.log, i, k)
        if entry.dequeued_us != NEVER:
            sent += 1
            if entry.dropped_us != NEVER or entry.dequeued_us < unchecked_item(arrivals, k).arrival_us:
                return LOG
        if entry.dropped_us != NEVER:
            dropped += 1
    before, queued_bytes = -1, 0
    for k in range(sender.first, sender.first + sender.occupancy):
        message = batch.slots[i, k]
        if not before < message.seq < n or not _agree(message, unchecked_item(arrivals, message.seq)):
            return QUEUED
        before = message.seq
        entry = unchecked_at(batch.log, i, before)
        if entry.dequeued_us != NEVER or entry.dropped_us != NEVER:
            return QUEUED
        queued_bytes += message.size_bytes
    if queued_bytes != sender.backlog_bytes:
        return BYTES
    # Each event writes one entry: as many entries as events means that no two were about one message.
    if sent != sender.dequeued or dropped != sender.evicted + sender.rejected:
        return LOG
    if sent + dropped + sender.occupancy != sender.next:
        return LOG
    gained = 0.0
    for t in range(batch.topics.shape[1]):
        now, given = unchecked_at(batch.topics, i, t), unchecked_item(rules, t)
        if now.priority != given.priority or now.weight != given.weight or now.no_drop != given.no_drop:
            return TOPIC
        if now.period_us != given.period_us or now.limit != given.limit or now.deadline_us != given.deadline_us:
            return TOPIC
        if now.v_start != given.v_start:
            return TOPIC
        several, received, x = batch.topics.shape[1] > 1, 0, 0.0
        own_v = batch.v[given.v_start if several else sender.v_start :]
        for k in range(sender.credited):
            message = unchecked_item(arrivals, unchecked_at(batch.order, i, k))
            if several and message.topic != t:
                continue
            if received > 0:
                gained += (given.weight if several else 1.0) * value(own_v, message.x - x)
            received, x = received + 1, message.x
    return QOI if abs(gained - sender.delivered_gain) > _ROUNDING * max(1.0, gained) else 0


@kernel
def _agree(a: Any, b: Any) -> bool:
    """Whether these messages agree in all that an episode gives."""
    if a.seq != b.seq or a.arrival_us != b.arrival_us or a.size_bytes != b.size_bytes or a.topic != b.topic:
        return False
    return bool(a.x == b.x and a.uniform == b.uniform)
