"""Thinning to the link: a queue with room drops messages that the link could not send in time anyway.

On a steady link this is the only rule for a queue with room, on others until there is a target (``target_gap``).

Messages leave a slow link every so many arrivals. If queued messages lie closer together than that, the server gets a
run of near neighbours, and later a hole as long as they took to send. So a message goes at once, room or not, if its
neighbours then still lie no farther apart than the link sends at the fastest of its recent rates. No transmission is
lost this way. The remaining room should fill up within ``HORIZON_US``, since messages waiting at the end of the stream
are sent too; so the messages lie a little closer. If the robot knows that the stream ends earlier, they do by then.
"""

from bufgym.jit import kernel
from bufgym.model.buffer import Buffer
from bufgym.model.observe.on_board import mean_bytes
from bufgym.policies.gaps import gap_left
from bufgym.policies.registry import Arrival

WAITING = 3
"""Messages that must wait, so that the link never waits for one. Structural: one leaves, one follows, one is spare."""
SOON_US = 4e6
"""Longest time in which all L messages would be sent, us, for a queue to be thinned. A slower queue would give up too
many messages that are sent after the stream's end. Structural: a queue of some seconds at most."""
HORIZON_US = 60e6  # 40 and 80 s were best of 20, 40, 80 s and no end at all, on the train links of ``sustained-v1``
STEADY = 0.01
"""Tolerance of a steady link: its rate over 0.5 s differs from its rate over 2 s by at most this fraction, its rate
over 0.1 s by at most twice as much. Structural: above rounding, below what a radio link ever holds."""


@kernel
def steady(buffer: Buffer) -> bool:
    """Whether the link carries messages at a constant rate."""
    mean = buffer.long_rate_bytes_per_s
    near = abs(buffer.medium_rate_bytes_per_s - mean) <= STEADY * mean
    level = near and abs(buffer.short_rate_bytes_per_s - mean) <= 2 * STEADY * mean
    return bool(level and mean > 0 and buffer.drained_us > 0)


@kernel
def send_us(buffer: Buffer, arrival: Arrival) -> float:
    """Time to send a message of mean size, us, at the fastest rate over 0.1 s, 0.5 s or 2 s; 0 without a rate."""
    rate = max(buffer.short_rate_bytes_per_s, buffer.medium_rate_bytes_per_s, buffer.long_rate_bytes_per_s)
    return 1e6 * mean_bytes(buffer, arrival) / rate if rate > 0 else 0.0


@kernel
def places(buffer: Buffer, arrival: Arrival) -> int:
    """Messages of mean size that the queue can hold under L and B; at least those queued now."""
    return max(int(min(buffer.capacity, buffer.max_bytes / mean_bytes(buffer, arrival))), len(buffer.slots))


@kernel
def within(horizon_us: float, buffer: Buffer) -> float:
    """This horizon, or the time until the stream ends if that is known and less.

    A stream that goes on beyond the end that was told may end at any time: the horizon is then as if nothing was told.
    """
    return min(horizon_us, float(buffer.remaining_us)) if buffer.remaining_us > 0 else horizon_us


@kernel
def spare_us(buffer: Buffer, arrival: Arrival) -> float:
    """Time between messages that the link sends, by the rule in the module's text, us; 0 where none may be spared."""
    s, elapsed_us = len(buffer.slots), arrival.arrival_us - buffer.dequeued_arrival_us
    if s < WAITING or not buffer.busy or elapsed_us <= 0 or len(buffer.topics) > 1:
        return 0.0
    each_us, L = send_us(buffer, arrival), places(buffer, arrival)
    if each_us <= 0 or L * each_us > SOON_US:
        return 0.0
    horizon_us = within(HORIZON_US, buffer)
    return float(horizon_us / (horizon_us / each_us + L - s))


@kernel
def spare(buffer: Buffer, arrival: Arrival, victim: int) -> bool:
    """Whether a queue with room can spare ``victim`` (a slot, or REJECT).

    The link's spacing is the motion since the arrival of the message dequeued last, in proportion to time.
    """
    each_us, elapsed_us = spare_us(buffer, arrival), arrival.arrival_us - buffer.dequeued_arrival_us
    left = gap_left(buffer, arrival, victim)
    return bool(each_us > 0 and left * elapsed_us <= (arrival.x - buffer.dequeued_x) * each_us)
