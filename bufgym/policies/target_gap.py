"""The target gap: a distance between sent messages that suits the link, the queue and the messages to come.

    m <- motion per time: since the message dequeued last, and over ``PACE_US``
    r <- messages per time that the link sends: its rates over 0.1 s and 2 s, and over ``LINK_US``
    g <- m T / (r T + L - s)

In the next T the scene moves on by m T, the link sends r T messages and the queue takes L - s more. Their even gap is
g. It is wide if the queue is full, or if the link sends few messages for the motion.

    soon <- whether the socket is free before ``NEAR`` more arrivals
    if there is room, and the queue is empty or the socket idle: accept
    elif soon and the message behind the head lies nearer to g than the head: the head goes
    elif the queue is full: what leaves the smallest gap goes, older ones rather
    elif the smallest gap that can be left is at most g: it goes, though there is room
    else: accept

The head is thus checked once more when its turn comes, as the link's rate may have changed. Blackouts in mid-stream are
no exception. On a steady link, where g is known, the even spacing is made behind the head (``thinning``).

No target is set while the past does not predict the future. In bursts an empty queue would leave the link idle; one
long pause counts as a burst for some seconds. Nor is there a target for queues of fewer than ``LEAST`` messages, before
anything has been sent, or until the stream has run for as long as a full queue takes to be sent. Then the smallest gap
goes, and ``thinning`` says whether it goes with room too.
"""

from __future__ import annotations

from bufgym.ground.kernel import kernel
from bufgym.model.buffer import ACCEPT, Buffer, has_space, motion_gaps, running_mean
from bufgym.model.observe.on_board import mean_bytes
from bufgym.policies.gaps import gap_left, smallest_gap
from bufgym.policies.registry import Arrival, Memory, built_in
from bufgym.policies.thinning import places, spare, steady

HORIZON_US = 5e6
"""T, us."""
SHORT, LONG = 0.25, 0.25
"""Weights of the link's rates over 0.1 s and 2 s in r; the rest is that of the rate over ``LINK_US``."""
REST = 1 - SHORT - LONG
LINK_US = 20e6
PACED, PACE_US = 0.4, 15e6
"""Weight in m of the mean motion over ``PACE_US``."""
NEAR = 1.5
"""Arrivals."""
DISCOUNT = 0.165
"""Discount on the gap at the head of the queue, compared with the tail's."""
LEAST = 4
"""Smallest L that follows the target."""
BURSTY, LATE = 1.5, 1 / 32
"""Arrivals are bursty if the mean square of the time between them exceeds ``BURSTY`` times the square of its mean. The
ratio is 2 for a Poisson process and 10 for bursts of ten. The newest time has weight ``LATE`` in both means, so that
a whole burst does not look like an even stream."""
WITHIN = 1.001
"""Factor by which a gap may exceed g through rounding."""

RATE, SENT_US, PACE, SEEN_US, PERIOD, SQUARE = range(6)
REMEMBERED = {"rate": 0.0, "sent_us": 0.0, "pace": 0.0, "seen_us": 0.0, "period": 0.0, "square": 0.0}
"""Memory of the policy: the link's rate over ``LINK_US`` (bytes/us) and how long it has sent; motion per us
over ``PACE_US`` and how long the stream has run; the mean time between arrivals and its mean square."""


@kernel
def remember(buffer: Buffer, arrival: Arrival, memory: Memory) -> None:
    """Update the long means; call it at every arrival."""
    if buffer.evictions > 0:
        return
    sent_us = float(buffer.drained_us)
    if sent_us > 0:
        memory[RATE] = running_mean(memory[RATE], buffer.drained_bytes, sent_us, memory[SENT_US], LINK_US)
        memory[SENT_US] += sent_us
    us = float(arrival.arrival_us - buffer.previous_us)
    weight = LATE if memory[PERIOD] > 0 else 1.0
    memory[PERIOD] += weight * (us - memory[PERIOD])
    memory[SQUARE] += weight * (us * us - memory[SQUARE])
    if us > 0:
        step = arrival.x - buffer.previous_x
        memory[PACE] = running_mean(memory[PACE], step, us, memory[SEEN_US], PACE_US)
        memory[SEEN_US] += us


@kernel
def bursty(memory: Memory) -> bool:
    """Whether messages come in bursts."""
    return bool(memory[SQUARE] > BURSTY * memory[PERIOD] * memory[PERIOD])


@kernel
def link_rate(buffer: Buffer, memory: Memory) -> float:
    """The expected rate, bytes/us."""
    recent = SHORT * buffer.short_rate_bytes_per_s + LONG * buffer.long_rate_bytes_per_s
    return float(recent / 1e6 + REST * memory[RATE])


@kernel
def target(buffer: Buffer, arrival: Arrival, memory: Memory) -> float:
    """g, in motion; 0 if unknown (see the module's text)."""
    s, L = len(buffer.slots), places(buffer, arrival)
    elapsed_us = float(arrival.arrival_us - buffer.dequeued_arrival_us)
    if L < LEAST or len(buffer.topics) > 1 or elapsed_us <= 0 or memory[RATE] <= 0 or memory[PACE] <= 0:
        return 0.0
    if bursty(memory):
        return 0.0
    r = link_rate(buffer, memory) / mean_bytes(buffer, arrival)
    if L > r * memory[SEEN_US]:
        return 0.0
    m = (1 - PACED) * (arrival.x - buffer.dequeued_x) / elapsed_us + PACED * memory[PACE]
    return float(m * HORIZON_US / (r * HORIZON_US + L - s))


@kernel
def approach(buffer: Buffer, arrival: Arrival, g: float) -> int:
    """The decision that brings the gaps to ``g``."""
    s, room = len(buffer.slots), has_space(buffer, arrival)
    if room and (s == 0 or not buffer.busy):
        return ACCEPT
    if s > 0 and buffer.left_bytes * 1e6 < NEAR * buffer.period_us * buffer.short_rate_bytes_per_s:
        head, after = motion_gaps(buffer, arrival, 0)
        if abs(head + after - g) < abs(head - g):
            return 0
    victim = smallest_gap(buffer, arrival, False, s + 1, DISCOUNT)
    if room and gap_left(buffer, arrival, victim) > WITHIN * g:
        return ACCEPT
    return victim


@built_in(
    "target-gap",
    memory=REMEMBERED,
    source="own rule: min-motion-gap, towards the gap that link and queue can carry",
    reads_rate=True,
)
def target_gap(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Sends messages as far apart as the link's rate and the room that is left suggest; drops with room, too."""
    remember(buffer, arrival, memory)
    g = target(buffer, arrival, memory)
    if g > 0 and not steady(buffer):
        return approach(buffer, arrival, g)
    victim = smallest_gap(buffer, arrival, False, len(buffer.slots) + 1, 0.0)
    if has_space(buffer, arrival) and (bursty(memory) or not spare(buffer, arrival, victim)):
        return ACCEPT
    return victim
