"""Rules of topics: each has gaps, limits and rights of its own. A single queue is one topic without limits.

A topic's messages are sent in the order of their arrival. ``no_drop`` messages are neither evicted nor rejected while
anything else could make room for them. Rate limits, ``no_drop`` and the in-flight window come from Robofleet (github
ut-amrl/robofleet_client_lib). The published and the released client differ, and both are settings here.

A single queue ignores the messages' topic numbers and reads row 0 of the topic table. It keeps no score in that row, so
its limits never bind; the sender's record has the score instead. That saves a tenth of a rollout's time.
"""

from typing import Any

from bufgym.jit import kernel, unchecked_at, unchecked_slice
from bufgym.model.buffer import could_fit, of_topic
from bufgym.model.qoi import value
from bufgym.model.topics import age_between
from bufgym.sim.state import Batch


@kernel
def gain_behind(batch: Batch, i: int, k: int, topic: int, x: float) -> float:
    """Weight times V of the gap to ``x`` from the message kept before slot ``k``; 0 for a topic's first message."""
    sender = batch.senders[i]
    if batch.several is None:  # slot -1 holds the message dequeued last
        if k == 0 and sender.dequeued == 0:
            return 0.0
        return value(batch.v[sender.v_start :], x - unchecked_at(batch.slots, i, sender.first + k - 1).x)
    rules = unchecked_at(batch.topics, i, topic)
    j = of_topic(unchecked_slice(batch.slots, i, sender.first, sender.occupancy), k, topic, -1)
    if j < 0 and rules.dequeued == 0:
        return 0.0
    before_x = unchecked_at(batch.slots, i, sender.first + j).x if j >= 0 else rules.dequeued_x
    return float(rules.weight * value(batch.v[rules.v_start :], x - before_x))


@kernel
def arrived_on_topic(batch: Batch, i: int, message: Any, enqueued: bool) -> None:
    """Record that ``message`` has arrived, and was enqueued or not."""
    topic = unchecked_at(batch.topics, i, message.topic)
    if topic.arrived > 0:
        topic.step_us, topic.step_x = message.arrival_us - topic.previous_us, message.x - topic.previous_x
    else:
        topic.step_us, topic.step_x = 0, 0.0
        topic.aged_us, topic.newest_us = message.arrival_us, message.arrival_us
        begin_ageing(batch, i, topic.weight, message.arrival_us)
    if enqueued:
        if topic.dequeued + topic.queued == 0:
            # until one is sent, spacing counts from here
            topic.dequeued_arrival_us, topic.dequeued_x = message.arrival_us, message.x
        topic.queued += 1
        topic.kept_us = message.arrival_us
    topic.previous_us, topic.previous_x = message.arrival_us, message.x
    topic.arrived += 1


@kernel
def dequeued_on_topic(batch: Batch, i: int, message: Any) -> None:
    """Record that the socket has dequeued ``message``."""
    topic = unchecked_at(batch.topics, i, message.topic)
    topic.queued -= 1
    topic.dequeued += 1
    topic.dequeued_arrival_us, topic.dequeued_x = message.arrival_us, message.x
    topic.last_dequeue_us = batch.senders[i].now_us


@kernel
def received_on_topic(batch: Batch, i: int, message: Any, received_us: int) -> None:
    """Record that ``message`` has reached the server: its topic is younger again, and it may be late."""
    age_until(batch, i, received_us)
    age_topic_until(batch, i, message.topic, received_us)
    topic, sender = unchecked_at(batch.topics, i, message.topic), batch.senders[i]
    if topic.received == 0:
        sender.heard += topic.weight
    topic.received += 1
    sender.newest_s += topic.weight * max(message.arrival_us - topic.newest_us, 0) / 1e6
    topic.newest_us = max(topic.newest_us, message.arrival_us)
    if received_us - message.arrival_us > topic.deadline_us:
        sender.late += topic.weight


@kernel
def begin_ageing(batch: Batch, i: int, weight: float, at_us: int) -> None:
    """Let the age of one more topic's information count from ``at_us`` on, the topic's first arrival."""
    sender = batch.senders[i]
    sender.ageing += weight
    sender.newest_s += weight * at_us / 1e6
    # ``age_until`` goes on from ``aged_us``, and would count the time until then as an age below 0.
    sender.aged += weight * ((at_us - sender.aged_us) / 1e6) ** 2 / 2


@kernel
def age_until(batch: Batch, i: int, until_us: int) -> None:
    """Count the ages of all topics' information at the server up to ``until_us``, each times its weight.

    A topic's age at time t is t minus a constant, so all of them together are ``ageing`` x t - ``newest_s``, however
    many topics there are. Counting begins with a topic's first arrival and ends with the episode's last, whatever a
    policy does.
    """
    sender = batch.senders[i]
    until_us = counted_until(batch, i, until_us)
    if until_us > sender.aged_us:
        from_s, until_s = sender.aged_us / 1e6, until_us / 1e6
        sender.aged += (until_s - from_s) * ((from_s + until_s) / 2 * sender.ageing - sender.newest_s)
        sender.aged_us = until_us


@kernel
def counted_until(batch: Batch, i: int, until_us: int) -> int:
    """``until_us``, but no later than the episode's last arrival.

    Otherwise a policy that keeps the link busy for longer would pay for a longer time.
    """
    return int(min(until_us, unchecked_at(batch.arrivals, i, batch.senders[i].arrivals - 1).arrival_us))


@kernel
def age_topic_until(batch: Batch, i: int, topic: int, until_us: int) -> None:
    """Count the age of one topic's information as ``age_until`` does for all of them together, without its weight."""
    rules = unchecked_at(batch.topics, i, topic)
    until_us = counted_until(batch, i, until_us)
    if rules.arrived > 0 and until_us > rules.aged_us:
        rules.aged += age_between(rules.newest_us, rules.aged_us, until_us)
        rules.aged_us = until_us


@kernel
def too_soon(batch: Batch, i: int, topic: int) -> bool:
    """Whether the present arrival is too close to its topic's last message kept (or sent) for the rate limit."""
    sender = batch.senders[i]
    rules = unchecked_at(batch.topics, i, topic)
    if sender.limit_since_sent == 1:
        return bool(rules.dequeued > 0 and sender.now_us - rules.last_dequeue_us < rules.period_us)
    return bool(rules.kept_us >= 0 and sender.now_us - rules.kept_us < rules.period_us)


@kernel
def at_limit(batch: Batch, i: int, topic: int) -> bool:
    """Whether this topic has as many queued messages as it may have."""
    if batch.several is None:
        return False
    rules = unchecked_at(batch.topics, i, topic)
    return bool(rules.queued >= rules.limit)


@kernel
def no_drop(batch: Batch, i: int, topic: int) -> bool:
    """Whether messages of this topic may not be dropped."""
    if batch.several is None:
        return False
    return bool(unchecked_at(batch.topics, i, topic).no_drop == 1)


@kernel
def can_fit(batch: Batch, i: int) -> bool:
    """Whether the present arrival's bytes would fit if every droppable message went."""
    sender = batch.senders[i]
    spare_bytes = sender.max_bytes - sender.backlog_bytes - unchecked_at(batch.arrivals, i, sender.next).size_bytes
    return could_fit(
        spare_bytes,
        unchecked_slice(batch.slots, i, sender.first, sender.occupancy),
        unchecked_slice(batch.topics, i, 0, sender.topics),
    )


@kernel
def last_resort_victim(batch: Batch, i: int) -> int:
    """The slot to evict for a no_drop message as a last resort: lowest priority, oldest; -1 if none may go."""
    sender = batch.senders[i]
    best = -1
    lowest = 0.0
    if not can_fit(batch, i):
        return best
    for k in range(sender.occupancy):
        slot = unchecked_at(batch.slots, i, sender.first + k)
        priority = unchecked_at(batch.topics, i, slot.topic).priority
        if not no_drop(batch, i, slot.topic) and (best < 0 or priority < lowest):
            best, lowest = k, priority
    return best


@kernel
def sendable(batch: Batch, i: int, k: int) -> bool:
    """Whether slot ``k`` may be sent by the window and, if rate limits hold back at the socket, by its own.

    Limits at the socket spare ``no_drop`` topics, as in Robofleet's released client.
    """
    sender = batch.senders[i]
    full = sender.dequeued - sender.acked >= sender.window
    if batch.several is None:
        return not full
    rules = unchecked_at(batch.topics, i, unchecked_at(batch.slots, i, sender.first + k).topic)
    if full and not (sender.flush_no_drop == 1 and rules.no_drop == 1):
        return False
    if sender.limit_at_send == 0 or rules.no_drop == 1 or rules.dequeued == 0:
        return True
    return bool(sender.now_us - rules.last_dequeue_us >= rules.period_us)
