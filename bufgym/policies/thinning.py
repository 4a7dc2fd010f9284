"""Thinning to the link: a queue with room drops what the link could not send in time anyway.

On a steady link this is all that is done with room; on others where there is no target yet (``target_gap``).

Messages leave a slow link every so many arrivals. Where those queued lie closer together, the server gets a run of near
neighbours, and later a hole as long as it took to send them. So a message goes at once, room or not, if its neighbours
then still lie no farther apart than the link sends, at the fastest of its rates of late; then no transmission is lost.
The room that is left is to be filled in ``HORIZON_US``, since what waits when the stream ends is sent as well: so they
lie a little nearer.

On a small link, exactly solved, most of what the best policy gains it gains by dropping early (``bufgym reproduce
small-link``).
"""

from __future__ import annotations

from bufgym.kernel import kernel
from bufgym.model.buffer import Buffer
from bufgym.observe.on_board import mean_bytes
from bufgym.policies.gaps import come, gap_left
from bufgym.policies.registry import Arrival

WAITING = 3
"""Messages that must wait, so that the link never waits for one."""
SOON_US = 4e6
"""A queue is thinned where all L would be sent within so long: else too much is given up that would be sent when the
stream ends."""
HORIZON_US = 60e6
"""Of 20, 40 and 80 s and no end at all, tried on the train links of ``sustained-v1``, 40 and 80 s were best."""
STEADY = 0.01
"""A link is steady while its rate over 0.5 s differs from that over 2 s by at most this part of it, that over 0.1 s by
at most twice as much."""


@kernel
def steady(buffer: Buffer) -> bool:
    """Whether the link carries messages at one and the same rate."""
    mean = buffer.long_rate_bytes_per_s
    near = abs(buffer.medium_rate_bytes_per_s - mean) <= STEADY * mean
    level = near and abs(buffer.short_rate_bytes_per_s - mean) <= 2 * STEADY * mean
    return bool(level and mean > 0 and buffer.drained_us > 0)


@kernel
def send_us(buffer: Buffer, arrival: Arrival) -> float:
    """Time in which the link sends a message of mean size, at the fastest of its rates over 0.1 s, 0.5 s and 2 s, us;
    0 while there is no rate."""
    rate = max(buffer.short_rate_bytes_per_s, buffer.medium_rate_bytes_per_s, buffer.long_rate_bytes_per_s)
    return 1e6 * mean_bytes(buffer, arrival) / rate if rate > 0 else 0.0


@kernel
def places(buffer: Buffer, arrival: Arrival) -> int:
    """How many messages of mean size the queue can hold: L, or what B lets in; no fewer than are queued."""
    return max(int(min(buffer.capacity, buffer.max_bytes / mean_bytes(buffer, arrival))), len(buffer.slots))


@kernel
def spare(buffer: Buffer, arrival: Arrival, victim: int, measured_in: int) -> bool:
    """Whether a queue with room can spare ``victim`` (a slot, or REJECT): see the module's text.

    How far apart the link sends: what has come since the message dequeued last arrived, in proportion to time.
    """
    s, elapsed_us = len(buffer.slots), arrival.arrival_us - buffer.dequeued_arrival_us
    if s < WAITING or not buffer.busy or elapsed_us <= 0 or len(buffer.topics) > 1:
        return False
    each_us, L = send_us(buffer, arrival), places(buffer, arrival)
    if each_us <= 0 or L * each_us > SOON_US:
        return False
    each_us = HORIZON_US / (HORIZON_US / each_us + L - s)
    left = gap_left(buffer, arrival, victim, measured_in)
    return bool(left * elapsed_us <= come(buffer, arrival, measured_in) * each_us)
