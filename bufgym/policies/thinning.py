"""Thinning to the link: a queue with room drops what the link could not send in time anyway.

Messages leave a slow link every so many arrivals. Where those queued lie closer together, the server gets a run of near
neighbours, and later a hole as long as it took to send them. So a message goes at once, room or not, if its neighbours
then still lie no farther apart than the link sends, at the fastest of its rates of late; then no transmission is lost.

On a small link, exactly solved, most of what the best policy gains it gains by dropping early (``bufgym reproduce
small-link``).
"""

from __future__ import annotations

from bufgym.kernel import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, has_space
from bufgym.observe.on_board import mean_bytes
from bufgym.policies.gaps import MESSAGES, MOTION, gap_left, smallest_gap
from bufgym.policies.registry import Arrival, Memory, register

WAITING = 3
"""Messages that must wait, so that the link never waits for one."""
SOON_US = 4e6
"""A queue is thinned where all L would be sent within so long: else too much is given up that would be sent when the
stream ends."""


@kernel
def send_us(buffer: Buffer, arrival: Arrival) -> float:
    """Time in which the link sends a message of mean size, at the fastest of its rates over 0.1 s, 0.5 s and 2 s, us;
    0 while there is no rate."""
    rate = max(buffer.short_rate_bytes_per_s, buffer.medium_rate_bytes_per_s, buffer.long_rate_bytes_per_s)
    return 1e6 * mean_bytes(buffer, arrival) / rate if rate > 0 else 0.0


@kernel
def spare(buffer: Buffer, arrival: Arrival, victim: int, measured_in: int) -> bool:
    """Whether a queue with room can spare ``victim`` (a slot, or REJECT): see the module's text.

    How far apart the link sends: what has come since the message dequeued last arrived, in proportion to time.
    """
    s, elapsed_us = len(buffer.slots), arrival.arrival_us - buffer.dequeued_arrival_us
    if s < WAITING or not buffer.busy or elapsed_us <= 0 or len(buffer.topics) > 1:
        return False
    each_us = send_us(buffer, arrival)
    if each_us <= 0 or buffer.capacity * each_us > SOON_US:
        return False
    come = float(arrival.seq - buffer.dequeued_seq) if measured_in == MESSAGES else arrival.x - buffer.dequeued_x
    left = gap_left(buffer, arrival, s if victim == REJECT else victim, measured_in)
    return bool(left * elapsed_us <= come * each_us)


@register(
    "thinned-motion-gap",
    source="own rule: min-motion-gap, thinned to what the link sends",
    reads_rate=True,
    named_only=True,
    compile=True,
)
def thinned_motion_gap(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """As min-motion-gap, and with room too where the gap left is no longer than the link sends."""
    victim = smallest_gap(buffer, arrival, MOTION)
    if has_space(buffer, arrival) and not spare(buffer, arrival, victim, MOTION):
        return ACCEPT
    return victim
