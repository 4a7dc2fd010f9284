"""The target gap: a distance between sent messages that suits the link, the queue and the messages to come.

    m <- motion per time: since the message dequeued last, and over ``pace_s``
    r <- messages per time that the link sends: its rates over 0.1 s and 2 s, and over ``link_s``
    g <- m T / (r T + L - s)

In the next T the scene moves on by m T, the link sends r T messages and the queue takes L - s more. Their even gap is
g. It is wide if the queue is full, or if the link sends few messages for the motion.

    soon <- whether the socket is free before ``near`` more arrivals
    if a queued message adds nothing: it goes
    elif there is room, and the queue is empty or the socket idle: accept
    elif soon and the message behind the head lies nearer to g than the head: drop the head
    elif the queue is full: what leaves the smallest gap goes, older ones rather
    elif the smallest gap that can be left is at most g: it goes, though there is room
    else: accept

The head is thus checked once more when its turn comes, as the link's rate may have changed. Blackouts in mid-stream are
no exception. On a steady link, where g is known, the even spacing is made behind the head (``thinning``).

A message adds nothing if V is straight from its one neighbour to the other: V(a) + V(b) = V(a + b). A V that saturates
is straight up to where it is flat.

The rule sets no target in four cases:

- Messages come in bursts, where an empty queue would leave the link idle. One long pause counts as a burst for some
  seconds.
- The queue has fewer than ``LEAST`` places.
- Nothing has been sent yet.
- The stream is young: it has not yet run for as long as a full queue takes to be sent. If the robot knows when the
  stream ends, a quarter of that time is enough, and T ends there. For a short queue a stream is young for
  ``SHORT_RUN_US``, too.

Without a target the smallest gap goes, and ``thinning`` says whether it goes with room too.

A queue of up to ``SHORT_QUEUE`` messages holds too little to wait for a target. Its head gets a *last chance*:

    f <- s / L
    S, M <- times to send a message of mean size at the rates over 0.1 s and ``link_s``, at most ``SLOWEST`` arrivals
    if the link is not steady and the socket is free before ``chance`` more arrivals:
        if the head's neighbours lie no farther apart than the scene moves in
           (early + early_full f) arrivals + (slow - slow_full f) S + mean_full f M: drop the head

On a steady link a queue of fewer than ``LEAST`` messages knows at least how far apart the link sends. Its head is asked
by that, and a queue with one place at every arrival:

    e <- motion since the message dequeued last was taken, by time: what comes while the link sends one message
    if the link is steady, and soon or L = 1:
        if the message behind the head lies nearer to e than the head: drop the head

The numbers are the policy's parameters. ``python train.py tune target-gap --on SUITE`` searches them again. The other
constants are structural, and are not tuned.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, Buffer, has_space, motion_gaps, running_mean
from bufgym.model.link import FOREVER
from bufgym.model.observe.on_board import mean_bytes
from bufgym.model.qoi import EXPONENTIAL, SATURATING
from bufgym.policies.gaps import gap_left, smallest_gap
from bufgym.policies.registry import Arrival, Memory, built_in
from bufgym.policies.thinning import places, send_us, spare, steady, within

PARAMETERS = {
    "horizon_s": 5.0,
    "short": 0.25,
    "long": 0.25,
    "link_s": 20.0,
    "paced": 0.4,
    "pace_s": 15.0,
    "near": 1.5,
    "discount": 0.165,
    "chance": 1.02,
    "early": 1.0,
    "early_full": 1.09,
    "slow": 0.76,
    "slow_full": 0.92,
    "mean_full": 0.076,
}
"""T, s; weights of the link's rates over 0.1 s and 2 s in r, the rest being that over ``link_s``; weight in m of the
mean motion over ``pace_s``; ``near``, in arrivals; discount on the gap at the head of the queue, compared with the
tail's; and the numbers of the last chance."""
HORIZON_S, SHORT, LONG, LINK_S, PACED, PACE_S, NEAR, DISCOUNT = range(8)
CHANCE, EARLY, EARLY_FULL, SLOW, SLOW_FULL, MEAN_FULL = range(8, 14)
LEAST = 4
"""Smallest L that follows the target. Structural: with fewer, one message too many is a large part of the queue."""
SHORT_QUEUE, SHORT_RUN_US = 5, 10e6
"""Largest L with a last chance for its head, and how long a stream must have run for it to follow the target, us.
Structural: the last chance was found on the laws of ``switching-v1``, which has L up to 5 and streams of 10 s."""
TOLD = 4.0  # How many times sooner a stream follows the target if the robot knows when it ends
SLOWEST = 16.0  # Most arrivals in S and M. Structural: a link that stands still would make both infinite.
BURSTY, LATE = 1.5, 1 / 32
"""Arrivals are bursty if the mean square of the time between them exceeds ``BURSTY`` times the square of its mean. The
ratio is 2 for a Poisson process and 10 for bursts of ten. The newest time has weight ``LATE`` in both means, so that
a whole burst does not look like an even stream. Structural: a camera's jitter keeps the ratio near 1."""
WITHIN = 1.001  # Factor by which a gap may exceed g through rounding. Structural.

Numbers = NDArray[Any]
"""float64[parameters]: ``PARAMETERS``, and perhaps more behind them."""

RATE, SENT_US, PACE, SEEN_US, PERIOD, SQUARE = range(6)
REMEMBERED = {"rate": 0.0, "sent_us": 0.0, "pace": 0.0, "seen_us": 0.0, "period": 0.0, "square": 0.0}
"""Memory of the policy: the link's ``rate`` over ``link_s``, bytes/us, and how long it has sent, ``sent_us``; ``pace``,
motion per us over ``pace_s``, and how long the stream has run, ``seen_us``; the mean time between arrivals, ``period``
in us, and its mean ``square`` in us^2."""


@kernel
def remember(buffer: Buffer, arrival: Arrival, memory: Memory, numbers: Numbers) -> None:
    """Update the long means; call it at every arrival."""
    if buffer.evictions > 0:
        return
    sent_us = float(buffer.drained_us)
    if sent_us > 0:
        memory[RATE] = running_mean(memory[RATE], buffer.drained_bytes, sent_us, memory[SENT_US], 1e6 * numbers[LINK_S])
        memory[SENT_US] += sent_us
    us = float(arrival.arrival_us - buffer.previous_us)  # since the arrival before
    weight = LATE if memory[PERIOD] > 0 else 1.0
    memory[PERIOD] += weight * (us - memory[PERIOD])
    memory[SQUARE] += weight * (us * us - memory[SQUARE])  # us^2
    if us > 0:
        step = arrival.x - buffer.previous_x  # motion
        memory[PACE] = running_mean(memory[PACE], step, us, memory[SEEN_US], 1e6 * numbers[PACE_S])
        memory[SEEN_US] += us


@kernel
def bursty(memory: Memory) -> bool:
    """Whether messages come in bursts."""
    return bool(memory[SQUARE] > BURSTY * memory[PERIOD] * memory[PERIOD])


@kernel
def link_rate(buffer: Buffer, memory: Memory, numbers: Numbers) -> float:
    """The link's rate by its three means, bytes/us."""
    recent = numbers[SHORT] * buffer.short_rate_bytes_per_s + numbers[LONG] * buffer.long_rate_bytes_per_s
    return float(recent / 1e6 + (1 - numbers[SHORT] - numbers[LONG]) * memory[RATE])


@kernel
def target(buffer: Buffer, arrival: Arrival, memory: Memory, numbers: Numbers) -> float:
    """g, in motion; 0 if unknown (see the module's text)."""
    s, L = len(buffer.slots), places(buffer, arrival)
    elapsed_us = float(arrival.arrival_us - buffer.dequeued_arrival_us)
    if L < LEAST or len(buffer.topics) > 1 or elapsed_us <= 0 or memory[RATE] <= 0 or memory[PACE] <= 0:
        return 0.0
    if bursty(memory) or (L <= SHORT_QUEUE and memory[SEEN_US] < SHORT_RUN_US):
        return 0.0
    r = link_rate(buffer, memory, numbers) / mean_bytes(buffer, arrival)
    if L > (TOLD if buffer.remaining_us < FOREVER else 1.0) * r * memory[SEEN_US]:
        return 0.0
    horizon_us = within(1e6 * numbers[HORIZON_S], buffer)
    m = (1 - numbers[PACED]) * (arrival.x - buffer.dequeued_x) / elapsed_us + numbers[PACED] * memory[PACE]
    return float(m * horizon_us / (r * horizon_us + L - s))


@kernel
def free_soon(buffer: Buffer, arrivals: float) -> bool:
    """Whether the socket is free before so many more arrivals, at the rate over 0.1 s."""
    return bool(buffer.left_bytes * 1e6 < arrivals * buffer.period_us * buffer.short_rate_bytes_per_s)


@kernel
def straight(v: NDArray[np.float64]) -> float:
    """The distance up to which V is straight; 0 for an exponential V."""
    if v[0] == EXPONENTIAL:
        return 0.0
    return float(v[1] if v[0] == SATURATING else v[3])


@kernel
def needless(buffer: Buffer, arrival: Arrival) -> int:
    """The queued message that adds nothing, the one with the smallest gap of several; -1 if each adds something.

    The newcomer is not asked, as nobody knows what follows it.
    """
    s, reach = len(buffer.slots), straight(buffer.v)
    if reach == 0 or s == 0 or not buffer.busy or len(buffer.topics) > 1:
        return -1
    k = smallest_gap(buffer, arrival, False, s, 0.0)
    if gap_left(buffer, arrival, k) > reach:
        return -1
    return k


@kernel
def head_lies_worse(buffer: Buffer, arrival: Arrival, g: float) -> bool:
    """Whether the gap to the message behind the head is nearer to ``g`` than the gap to the head."""
    head, after = motion_gaps(buffer, arrival, 0)
    return bool(abs(head + after - g) < abs(head - g))


@kernel
def approach(buffer: Buffer, arrival: Arrival, g: float, numbers: Numbers) -> int:
    """The decision that brings the gaps to ``g``."""
    s, room = len(buffer.slots), has_space(buffer, arrival)
    if room and (s == 0 or not buffer.busy):
        return ACCEPT
    if s > 0 and free_soon(buffer, numbers[NEAR]) and head_lies_worse(buffer, arrival, g):
        return 0
    victim = smallest_gap(buffer, arrival, False, s + 1, numbers[DISCOUNT])
    if room and gap_left(buffer, arrival, victim) > WITHIN * g:
        return ACCEPT
    return victim


@kernel
def last_chance(buffer: Buffer, arrival: Arrival, memory: Memory, numbers: Numbers) -> bool:
    """Whether the head of a short queue goes before its turn comes, by the rule in the module's text."""
    s, L, rate = len(buffer.slots), places(buffer, arrival), buffer.short_rate_bytes_per_s
    if s == 0 or L == 1 or L > SHORT_QUEUE or not buffer.busy or rate <= 0 or memory[RATE] <= 0:
        return False
    if len(buffer.topics) > 1 or steady(buffer) or bursty(memory) or not free_soon(buffer, numbers[CHANCE]):
        return False
    f, slowest_us, size = s / L, SLOWEST * buffer.period_us, mean_bytes(buffer, arrival)
    us = (numbers[EARLY] + numbers[EARLY_FULL] * f) * buffer.period_us
    us += (numbers[SLOW] - numbers[SLOW_FULL] * f) * min(1e6 * size / rate, slowest_us)
    us += numbers[MEAN_FULL] * f * min(size / memory[RATE], slowest_us)
    return bool(gap_left(buffer, arrival, 0) <= memory[PACE] * us)


@kernel
def falls_behind(buffer: Buffer, arrival: Arrival, memory: Memory, numbers: Numbers) -> bool:
    """Whether the head of a short queue goes since a steady link sends farther apart, by the module's text."""
    L, elapsed_us = places(buffer, arrival), float(arrival.arrival_us - buffer.dequeued_arrival_us)
    if len(buffer.slots) == 0 or L >= LEAST or not buffer.busy or elapsed_us <= 0 or len(buffer.topics) > 1:
        return False
    if not steady(buffer) or bursty(memory) or (L > 1 and not free_soon(buffer, numbers[NEAR])):
        return False
    e = (arrival.x - buffer.dequeued_x) * send_us(buffer, arrival) / elapsed_us
    return head_lies_worse(buffer, arrival, e)


@kernel
def head_goes(buffer: Buffer, arrival: Arrival, memory: Memory, numbers: Numbers) -> bool:
    """Whether the head of a short queue goes, whatever the gaps."""
    return last_chance(buffer, arrival, memory, numbers) or falls_behind(buffer, arrival, memory, numbers)


@kernel
def decide(buffer: Buffer, arrival: Arrival, memory: Memory, numbers: Numbers) -> int:
    """The rule of the module's text, once ``remember`` has been called."""
    extra = needless(buffer, arrival)
    if extra >= 0:
        return extra
    if head_goes(buffer, arrival, memory, numbers):
        return 0
    g = target(buffer, arrival, memory, numbers)
    if g > 0 and not steady(buffer):
        return approach(buffer, arrival, g, numbers)
    victim = smallest_gap(buffer, arrival, False, len(buffer.slots) + 1, 0.0)
    if has_space(buffer, arrival) and (bursty(memory) or not spare(buffer, arrival, victim)):
        return ACCEPT
    return victim


@built_in(
    "target-gap",
    parameters=PARAMETERS,
    memory=REMEMBERED,
    source="own rule: min-motion-gap, towards the gap that link and queue can carry",
    reads_rate=True,
)
def target_gap(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Sends messages as far apart as the link's rate and the room that is left suggest; drops with room, too."""
    remember(buffer, arrival, memory, buffer.parameters)
    return decide(buffer, arrival, memory, buffer.parameters)
