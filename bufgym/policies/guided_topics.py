"""Guided scheduling: an agent moves the numbers of one rule for several topics.

The rule weighs messages. With ``FEATURES`` f, it sends the oldest message of the topic with the largest n f, and drops
the message with the largest m f, once that exceeds the threshold ``room`` or nothing fits.
Robofleet's order is n = 1 for ``priority`` and ``wait`` alone, strict priority is n = 1 for ``priority``. ``PLAIN``
are the plain rule's numbers: high priorities first, then much QoI a byte and long waits; large, old messages of topics
with a low priority, or sent a moment ago, make room.

The numbers are ``BASE`` + W c, linear in the inputs c (``INPUTS``, with lg as in ``guided``). W = 0 is the plain rule.
``no_drop`` messages go first in any case, as in Robofleet, and are lost only if the queue holds nothing else.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, HOLD, REJECT, Buffer, fill, is_first, loss
from bufgym.model.observe.declare import writer
from bufgym.model.observe.topics import largest
from bufgym.model.topics import NO_DEADLINE_US
from bufgym.policies.guided import GuidedWeights, declared, lg
from bufgym.policies.registry import Arrival, Memory, Policy
from bufgym.policies.robofleet import next_no_drop
from bufgym.policies.schedulers import fits, make_room, makes_room, topic_of

FEATURES = {
    "priority": "log of its topic's priority over the highest",
    "gain": "log of what its delivery adds to H, over the largest weight; to drop it: of what is lost",
    "size": "log of its bytes over the mean of all arrivals",
    "wait": "log of the time since its topic was last sent, s",
    "silence": "log of the time since the arrival of its topic's message sent last, s",
    "age": "log of the time since its arrival, s",
    "late": "its age over its topic's deadline, at most 2; 0 without a deadline",
    "queued": "log of 1 + the messages of its topic in the queue",
}
INPUT_FIELDS = (
    declared("one", "always 1", lambda buffer: 1.0),
    declared("fill", "2 fill level - 1", lambda buffer: 2 * fill(buffer) - 1),
    declared("load", "lg(long rate x arrival period, mean bytes of an arrival)",
             lambda buffer: lg(buffer.long_rate_bytes_per_s * buffer.period_us, 1e6 * buffer.arrival_bytes)),
    declared("trend", "lg(short rate, long rate)",
             lambda buffer: lg(buffer.short_rate_bytes_per_s, buffer.long_rate_bytes_per_s)),
    declared("stall", "log(1 + time since a message was dequeued, s)",
             lambda buffer: math.log(1 + max(buffer.stalled_us, 0) / 1e6), high=math.inf),
    declared("drain", "lg(bytes queued, long rate x 1 s)",
             lambda buffer: lg(float(buffer.backlog_bytes), buffer.long_rate_bytes_per_s)),
    declared("service", "2 service_ratio - 1", lambda buffer: 2 * buffer.service_ratio - 1, high=math.inf),
    declared("in_flight", "2 in_flight / n_T - 1", lambda buffer: 2 * buffer.in_flight / buffer.window - 1,
             high=math.inf),
    declared("window", "1 - 2 / n_T", lambda buffer: 1 - 2 / buffer.window),
)  # fmt: skip
INPUTS = {field.name: field for field in INPUT_FIELDS}
MEANINGS = [(field.name, field.meaning) for field in INPUT_FIELDS]
write_inputs = writer(INPUT_FIELDS, "buffer")
N_FEATURES, N_INPUTS = len(FEATURES), len(INPUTS)
DROPS, ROOM = N_FEATURES, 2 * N_FEATURES
OUTPUTS = (*(f"send_{name}" for name in FEATURES), *(f"drop_{name}" for name in FEATURES), "room")
N_OUTPUTS = len(OUTPUTS)
PLAIN = {
    **{"send_priority": 10.0, "send_gain": 2.0, "send_size": -3.0, "send_wait": 2.0, "drop_priority": -8.0},
    **{"drop_gain": -2.5, "drop_size": 5.0, "drop_wait": -8.0, "drop_age": 5.0, "drop_queued": 3.0, "room": 8.0},
}
BASE = np.array([PLAIN.get(name, 0.0) for name in OUTPUTS])
LEAST = 1e-3  # added to a gain, a loss, and a time in s, before their logarithm


@kernel
def set_numbers(buffer: Buffer, numbers: NDArray[Any], c: NDArray[Any]) -> None:
    """Write the rule's numbers at this moment; ``c`` is room for the inputs."""
    write_inputs(buffer, c)
    for o in range(N_OUTPUTS):
        numbers[o] = buffer.parameters[o]
        for i in range(N_INPUTS):
            numbers[o] += buffer.parameters[N_OUTPUTS + o * N_INPUTS + i] * c[i]


@kernel
def weighed(buffer: Buffer, message: Arrival, worth: float, most: tuple[float, float], numbers: NDArray[Any]) -> float:
    """The weighted sum of a message's features; ``worth`` is its gain or loss, ``most`` what ``largest`` says."""
    topic = topic_of(buffer, message)
    age_s = (buffer.now_us - message.arrival_us) / 1e6
    last_us = topic.dequeued_arrival_us if topic.dequeued > 0 else 0
    total = numbers[0] * lg(topic.priority, most[0]) + numbers[1] * math.log(worth / most[1] + LEAST)
    total += numbers[2] * math.log(message.size_bytes / max(buffer.arrival_bytes, 1.0))
    total += numbers[3] * math.log(max(buffer.now_us - topic.last_dequeue_us, 0) / 1e6 + LEAST)
    total += numbers[4] * math.log(max(buffer.now_us - last_us, 0) / 1e6 + LEAST)
    total += numbers[5] * math.log(max(age_s, 0.0) + LEAST)
    if topic.deadline_us < NO_DEADLINE_US:
        total += numbers[6] * min(1e6 * age_s / topic.deadline_us, 2.0)
    return float(total + numbers[7] * math.log(1.0 + topic.queued))


def on_arrival(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A scheduler that weighs gain, bytes, priority and time, by numbers linear in what the client sees."""
    if len(buffer.topics) == 1:
        return make_room(buffer, arrival)  # no topics to tell apart
    numbers, most, s = memory[:N_OUTPUTS], largest(buffer), len(buffer.slots)
    set_numbers(buffer, numbers, memory[N_OUTPUTS:])
    drops = numbers[DROPS:ROOM]
    best, decision, room = -np.inf, REJECT, fits(buffer, arrival)
    for k in range(s):
        if makes_room(buffer, arrival, k):
            dropped = weighed(buffer, buffer.slots[k], loss(buffer, arrival, k), most, drops)
            if dropped > best:
                best, decision = dropped, k
    if buffer.topics[arrival.topic].no_drop == 0:
        dropped = weighed(buffer, arrival, loss(buffer, arrival, s), most, drops)
        if dropped > best:
            best, decision = dropped, REJECT
    return ACCEPT if room and best <= numbers[ROOM] else decision


def on_send(buffer: Buffer, memory: Memory) -> int:
    """The oldest no_drop message if there is one, otherwise the one that weighs most."""
    if len(buffer.topics) == 1:
        return 0
    choice = next_no_drop(buffer, 0)
    if choice != HOLD:
        return choice
    numbers, most, best = memory[:N_OUTPUTS], largest(buffer), -np.inf
    set_numbers(buffer, numbers, memory[N_OUTPUTS:])
    for k in range(len(buffer.slots)):
        if is_first(buffer, k):
            sent = weighed(buffer, buffer.slots[k], buffer.slots[k].gain, most, numbers)
            if sent > best:
                best, choice = sent, k
    return choice


@dataclass(frozen=True)
class SchedulerWeights(GuidedWeights):
    """Weights of a scheduler whose numbers are linear in the inputs, as in a file."""

    CONTEXT_NAMES = tuple(INPUTS)
    NETWORKS = ("scheduler",)
    SHAPE = LIGHT = (N_OUTPUTS, N_INPUTS)
    TABLE: ClassVar[list[Any]] = [list(FEATURES.items()), MEANINGS, OUTPUTS, PLAIN]

    def policy(self, name: str, about: str = "", source: str = "") -> Policy:
        """Make the policy of these weights, for any topics and every L."""
        numbers = self.numbers(name, BASE)
        policy = Policy(name, on_arrival, on_send=on_send, weights=numbers, compile=True, reads_rate=True)
        return replace(policy, about=about, source=source, for_topics=True, work=(N_OUTPUTS + N_INPUTS, 0))
