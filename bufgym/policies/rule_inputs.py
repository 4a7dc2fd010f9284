"""What the rule ``gap-price`` knows, as numbers that a network may look at: logarithms of ratios, mostly. With

    lg(a, b) <- log(a / b), at most ``MOST`` either way
    r <- the rule's link rate;  size <- mean bytes of the queue and the newcomer
    come <- x_new - x_dequeued;  g <- the target gap, or come / (s + 1) where it is unknown

``INPUTS`` are their meanings. ``recall`` keeps the rule's memory and the spread of the link's rate up to date.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import Buffer
from bufgym.model.observe.declare import Field, Function, writer
from bufgym.model.observe.on_board import mean_bytes
from bufgym.model.qoi import value
from bufgym.policies import price_dp
from bufgym.policies.gaps import gap_left
from bufgym.policies.price_dp import VARIANCE, remember_sizes, share
from bufgym.policies.registry import Arrival, Memory
from bufgym.policies.target_gap import SEEN_US, Numbers, bursty, link_rate, remember, target
from bufgym.policies.thinning import places, steady

MOST = 3.0  # Largest input, either way
SPREAD_US = 10e6  # Time over which the spread of the link's rate is measured, us

LOG_RATE, LOG_RATE_VARIANCE, RULE = range(3)  # Own entries of the memory, before those of the rule
REMEMBERED = {"log_rate": 0.0, "log_rate_variance": 0.0, **price_dp.REMEMBERED}
"""Memory: mean and variance of the log of the link's rate, bytes/s; what the rule keeps."""
BASE = np.array(list(price_dp.PARAMETERS.values()))  # The rule's numbers as they stand


@kernel
def lg(a: float, b: float) -> float:
    """The logarithm of a / b, at most ``MOST`` either way; 0 if both are 0."""
    if a > 0 and b > 0:
        return min(max(math.log(a / b), -MOST), MOST)
    if a <= 0 and b <= 0:
        return 0.0
    return MOST if a > 0 else -MOST


class Known(NamedTuple):
    """What the inputs are made of besides the buffer."""

    size: float  # mean bytes of the queue and the newcomer
    newcomer_bytes: float
    messages: int  # s + 1, the newcomer being one
    rate: float  # the rule's link rate r, bytes/us
    head_age_us: int  # time from the head's arrival to the newcomer's, us; 0 for an empty queue
    come: float  # motion since the message dequeued last
    has_target: bool  # whether the target gap is known
    gap: float  # the target gap g, or come / (s + 1) where it is unknown
    gain: float  # V(g)
    head_gap: float  # the gap left if the head is dropped; 0 for an empty queue
    log_rate_variance: float  # of the logarithm of the link's rate
    log_bytes_variance: float  # of the logarithm of bytes
    share: float  # a, the share of price-dp in the plain rule
    is_plain: bool  # whether the rule is best left alone


def declared(name: str, meaning: str, function: Function, low: float = -4.0, high: float = 4.0) -> Field:
    """Declare an input: a field of the context whose meaning says how it is scaled."""
    return Field(name, "context", "link", "see its meaning", meaning, function, low, high)


INPUT_FIELDS = (
    declared("short", "lg(rate over 0.1 s, rate over 2 s)",
             lambda buffer, known: lg(buffer.short_rate_bytes_per_s, buffer.long_rate_bytes_per_s)),
    declared("medium", "lg(rate over 0.5 s, rate over 2 s)",
             lambda buffer, known: lg(buffer.medium_rate_bytes_per_s, buffer.long_rate_bytes_per_s)),
    declared("load", "lg(r x arrival period, size): how much more the link carries than one message an arrival",
             lambda buffer, known: lg(known.rate * buffer.period_us, known.size)),
    declared("bend", "2 (2 V(g) - V(2 g)) / V(g) - 1: -1 where V is straight, 1 where it is flat",
             lambda buffer, known:
             2 * (2 * known.gain - value(buffer.v, 2 * known.gap)) / known.gain - 1 if known.gain > 0 else -1.0),
    declared("spread", "2 (sd - 0.6), sd being that of the logarithm of the rate over 0.5 s, in the last 10 s",
             lambda buffer, known: min(2 * (math.sqrt(known.log_rate_variance) - 0.6), MOST)),
    declared("head_age", "lg(r x the head's age + 0.1 size, (s + 1) size): 0.1 alone for an empty queue",
             lambda buffer, known: lg(known.rate * known.head_age_us + 0.1 * known.size, known.messages * known.size)),
    declared("newcomer", "lg(come, (s + 1) g)", lambda buffer, known: lg(known.come, known.messages * known.gap)),
    declared("stall", "log(1 + r x time since a message was dequeued / size) - 0.5",
             lambda buffer, known: min(math.log(1 + known.rate * max(buffer.stalled_us, 0) / known.size) - 0.5, MOST)),
    declared("size_spread", "2 min(1, standard deviation of the logarithm of bytes over the last arrivals)",
             lambda buffer, known: 2 * min(math.sqrt(known.log_bytes_variance), 1.0)),
    declared("bytes", "lg(the newcomer's bytes, size)", lambda buffer, known: lg(known.newcomer_bytes, known.size)),
    declared("fill", "2 s / L - 1", lambda buffer, known: 2 * len(buffer.slots) / buffer.capacity - 1),
    declared("unknown", "1 where the target gap is unknown, otherwise 0",
             lambda buffer, known: 0.0 if known.has_target else 1.0),
    declared("one", "always 1", lambda buffer, known: 1.0),
    declared("head_gap", "lg(the gap left if the head goes, g); 0 for an empty queue",
             lambda buffer, known: lg(known.head_gap, known.gap) if known.messages > 1 else 0.0),
    declared("share", "a, the share of price-dp in the plain rule", lambda buffer, known: known.share),
    declared("plain",
             "1 on a measured steady link, in bursts if there are two places, and until the link has carried anything",
             lambda buffer, known: 1.0 if known.is_plain else 0.0),
)  # fmt: skip
INPUTS = {field.name: field for field in INPUT_FIELDS}
MEANINGS = [(field.name, field.meaning) for field in INPUT_FIELDS]
N_INPUTS = len(INPUTS)
write_inputs = writer(INPUT_FIELDS, "buffer, known")


@kernel
def recall(buffer: Buffer, arrival: Arrival, memory: Memory, numbers: Numbers) -> None:
    """Update the memory; call it at every arrival."""
    rule = memory[RULE:]
    remember(buffer, arrival, rule, numbers)
    remember_sizes(buffer, arrival, rule)
    us, rate = float(arrival.arrival_us - buffer.previous_us), buffer.medium_rate_bytes_per_s
    if buffer.evictions > 0 or us <= 0 or rate <= 0:
        return
    level = math.log(max(rate, 1.0))
    weight = us / min(us + SPREAD_US, rule[SEEN_US]) if memory[LOG_RATE] > 0 else 1.0
    off = level - memory[LOG_RATE]
    memory[LOG_RATE] += weight * off
    memory[LOG_RATE_VARIANCE] = (1 - weight) * (memory[LOG_RATE_VARIANCE] + weight * off * off)


@kernel
def inputs(buffer: Buffer, arrival: Arrival, memory: Memory, numbers: Numbers, out: NDArray[Any]) -> None:
    """Write ``INPUTS`` into ``out``, once ``recall`` has been called; ``numbers`` are the plain rule's."""
    rule, s, come = memory[RULE:], len(buffer.slots), arrival.x - buffer.dequeued_x
    rate, g = link_rate(buffer, rule, numbers), target(buffer, arrival, rule, numbers)
    has_target = g > 0
    if not has_target:
        g = come / (s + 1)
    known = Known(
        size=mean_bytes(buffer, arrival),
        newcomer_bytes=float(arrival.size_bytes),
        messages=s + 1,
        rate=rate,
        head_age_us=arrival.arrival_us - buffer.slots[0].arrival_us if s > 0 else 0,
        come=come,
        has_target=has_target,
        gap=g,
        gain=value(buffer.v, g),
        head_gap=gap_left(buffer, arrival, 0) if s > 0 else 0.0,
        log_rate_variance=memory[LOG_RATE_VARIANCE],
        log_bytes_variance=rule[VARIANCE],
        share=share(rule, numbers),
        is_plain=steady(buffer) or (bursty(rule) and places(buffer, arrival) > 1) or rate <= 0,
    )
    write_inputs(buffer, known, out)
