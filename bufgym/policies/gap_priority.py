"""The rule ``gap-priority`` for several topics: a message's priority, what it adds to H, its bytes and its waits.

The free socket takes the oldest message of the topic where this sum is largest, with weights ``send_...``:

    + priority x log(its topic's priority / the highest)
    + gain x log(what its delivery adds to H / the largest weight)
    - size x log(its bytes / the mean bytes of arrivals)
    + wait x log(time since its topic was last sent)
    + silence x log(time since the arrival of its topic's message sent last)
    + queued x log(1 + messages of its topic in the queue)

What makes room is the message where this sum is largest, with weights ``drop_...``; the newcomer is one of them:

    - priority, gain, size and wait as above, size with a plus, and in place of the gain what H loses without it
    + age x log(time since its arrival)
    + queued as above

``no_drop`` messages go first, as in Robofleet, and are lost only if the queue holds nothing else.

**A message that finds room is kept as long as the link carries what comes.** Otherwise the queue fills anyway, and the
message with the largest sum goes early, once that exceeds ``room``: what is sent next is then found among better ones.
With the link's rate r, a mean over 2 s of sending, and the bytes that come in a time, d, a mean over ``OVER_US``, the
link carries what comes while r >= d, and until it has carried anything.

``python train.py tune gap-priority`` finds the numbers for other topics, weights and links.
"""

import math

import numpy as np

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, HOLD, REJECT, Buffer, is_first, loss, running_mean
from bufgym.model.observe.topics import largest
from bufgym.policies.registry import Arrival, Memory, built_in
from bufgym.policies.robofleet import next_no_drop
from bufgym.policies.schedulers import fits, make_room, makes_room, topic_of

PARAMETERS = {
    **{"send_priority": 29.0, "send_gain": 0.685, "send_size": 3.53, "send_wait": 9.7, "send_silence": 7.31},
    **{"send_queued": 0.769, "drop_priority": 9.51, "drop_gain": 6.16, "drop_size": 6.68, "drop_wait": 8.98},
    **{"drop_age": 7.8, "drop_queued": 1.02, "room": 6.59},
}
"""The weights, and the sum beyond which a message goes though there is room."""
(SEND_PRIORITY, SEND_GAIN, SEND_SIZE, SEND_WAIT, SEND_SILENCE, SEND_QUEUED,
 DROP_PRIORITY, DROP_GAIN, DROP_SIZE, DROP_WAIT, DROP_AGE, DROP_QUEUED, ROOM) = range(len(PARAMETERS))  # fmt: skip
OVER_US = 5e6
"""Time over which what comes is averaged, us: several periods of slow topics. Structural, as what follows."""
LEAST = 1e-3
"""Added to a gain, a loss, and a time in s, before their logarithm."""
LOWEST = -3.0
"""The least logarithm of a topic's priority over the highest."""
COMES, PREVIOUS_US = range(2)


@kernel
def log_priority(buffer: Buffer, message: Arrival, highest: float) -> float:
    """Logarithm of its topic's priority over the highest, at least ``LOWEST``."""
    priority = topic_of(buffer, message).priority
    return max(math.log(priority / highest), LOWEST) if priority > 0 else LOWEST


@kernel
def log_bytes(buffer: Buffer, message: Arrival) -> float:
    """Logarithm of its bytes over the mean of arrivals."""
    return math.log(message.size_bytes / max(buffer.arrival_bytes, 1.0))


@kernel
def log_s(us: float) -> float:
    """Logarithm of a time, s."""
    return math.log(max(us, 0.0) * 1e-6 + LEAST)


@kernel
def sends(buffer: Buffer, k: int, highest: float, weight: float) -> float:
    """How much speaks for sending slot ``k`` next; ``highest`` priority and largest ``weight`` as ``largest`` says."""
    message, p = buffer.slots[k], buffer.parameters
    topic = topic_of(buffer, message)
    last_us = topic.dequeued_arrival_us if topic.dequeued > 0 else 0
    total = p[SEND_PRIORITY] * log_priority(buffer, message, highest)
    total += p[SEND_GAIN] * math.log(message.gain / weight + LEAST)
    total -= p[SEND_SIZE] * log_bytes(buffer, message)
    total += p[SEND_WAIT] * log_s(float(buffer.now_us - topic.last_dequeue_us))
    total += p[SEND_SILENCE] * log_s(float(buffer.now_us - last_us))
    return float(total + p[SEND_QUEUED] * math.log(1.0 + topic.queued))


@kernel
def drops(buffer: Buffer, message: Arrival, lost: float, highest: float, weight: float) -> float:
    """How much speaks for dropping a message, without which H loses ``lost``."""
    topic, p = topic_of(buffer, message), buffer.parameters
    total = -p[DROP_PRIORITY] * log_priority(buffer, message, highest)
    total -= p[DROP_GAIN] * math.log(lost / weight + LEAST)
    total += p[DROP_SIZE] * log_bytes(buffer, message)
    total -= p[DROP_WAIT] * log_s(float(buffer.now_us - topic.last_dequeue_us))
    total += p[DROP_AGE] * log_s(float(buffer.now_us - message.arrival_us))
    return float(total + p[DROP_QUEUED] * math.log(1.0 + topic.queued))


@kernel
def carries_all(buffer: Buffer, memory: Memory) -> bool:
    """Whether the link carries what comes, as far as is known."""
    rate = 1e-6 * buffer.long_rate_bytes_per_s
    return bool(rate <= 0 or rate >= memory[COMES])


def on_send(buffer: Buffer, memory: Memory) -> int:
    """The oldest no_drop message if there is one, otherwise the one that most speaks for."""
    if len(buffer.topics) == 1:
        return 0
    choice = next_no_drop(buffer, 0)
    if choice != HOLD:
        return choice
    best = -np.inf
    highest, weight = largest(buffer)
    for k in range(len(buffer.slots)):
        if is_first(buffer, k):
            total = sends(buffer, k, highest, weight)
            if total > best:
                best, choice = total, k
    return choice


@built_in(
    "gap-priority",
    parameters=PARAMETERS,
    memory={"comes": 0.0, "previous_us": 0.0},
    on_send=on_send,
    for_topics=True,
    reads_rate=True,
    source="bufgym; no_drop messages first as in Robofleet [sikand2021robofleet]",
)
def gap_priority(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Weighs priority, QoI, bytes and waits; what finds room is kept while the link carries what comes."""
    if len(buffer.topics) == 1:
        return make_room(buffer, arrival)  # no topics to tell apart
    if buffer.evictions == 0:
        us = buffer.now_us - memory[PREVIOUS_US]
        memory[COMES] = running_mean(memory[COMES], float(arrival.size_bytes), us, OVER_US, OVER_US)
        memory[PREVIOUS_US] = float(buffer.now_us)
    room = fits(buffer, arrival)
    if room and carries_all(buffer, memory):
        return ACCEPT
    best, decision = -np.inf, REJECT
    highest, weight = largest(buffer)
    for k in range(len(buffer.slots)):
        if makes_room(buffer, arrival, k):
            total = drops(buffer, buffer.slots[k], loss(buffer, arrival, k), highest, weight)
            if total > best:
                best, decision = total, k
    if buffer.topics[arrival.topic].no_drop == 0:
        total = drops(buffer, arrival, loss(buffer, arrival, len(buffer.slots)), highest, weight)
        if total > best:
            best, decision = total, REJECT
    return ACCEPT if room and best <= buffer.parameters[ROOM] else decision
