"""Rules that see bytes: ``price-dp`` sends what its bytes are worth, ``gap-price`` is ``target-gap`` for equal sizes.

A byte sent now is not there for a later message. So bytes have a price, in QoI per byte, which the target gap g sets:

    lambda <- kappa (2 V(g) - V(2 g)) / mean bytes of the queue and the newcomer

At the gap g the message between two gaps is worth 2 V(g) - V(2 g); kappa times that is the price of a mean message. It
is the *unit* below. Where g is unknown, g is the even gap that the queue has now, (x_new - x_dequeued) / (s + 1).
``chains`` finds the *advantage* of dropping each message at that price. Chains end ``tail`` g behind the newcomer.

    if a queued message adds nothing: it goes
    elif there is room, and the queue is empty or the socket idle: accept
    elif the socket is free before ``price_near`` more arrivals, and dropping the head has an advantage: drop the head
    elif the queue is full: the largest advantage goes
    elif the largest advantage exceeds ``price_threshold`` units: it goes, though there is room
    else: accept

On light and steady links this is worse than ``target-gap``, and with equal sizes mostly so. With unequal sizes it is
better almost everywhere, as a gap says nothing of bytes. So ``gap-price`` mixes both by a share a of price-dp that
follows the spread of sizes, which is 0 for equal ones:

    sd <- standard deviation of the logarithm of bytes, over the last arrivals
    a  <- 1 / (1 + exp(share_low - share_steep sd)), but 0 below ``LEAST_SHARE``

Where V is straight at g, a message between two gaps g adds nothing, so bytes have no price: a is 0, and gaps decide.

Each candidate is then worth (1 - a) (threshold g - its discounted gap) / g, as target-gap has it, plus a (its advantage
in units - price_threshold); the best candidate goes, the oldest of equal ones. The head is asked likewise, with
target-gap's wish for it. A share by load, too, was better on random links, worse in outages and on light links.

Under B a newcomer in the place of several messages goes itself, unless better candidates make room for it.
"""

import math
from typing import Any

import numpy as np

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, has_space, motion_gaps, newcomer_stays
from bufgym.model.observe.declare import TINY
from bufgym.model.observe.on_board import mean_bytes
from bufgym.model.qoi import merging_loss, value
from bufgym.policies import chains, target_gap
from bufgym.policies.gaps import TIE, discounted, gap_left
from bufgym.policies.registry import Arrival, Memory, built_in
from bufgym.policies.target_gap import DISCOUNT, NEAR, Numbers, bursty, free_soon, needless, remember, target
from bufgym.policies.thinning import spare_us, steady

PARAMETERS = {
    **target_gap.PARAMETERS,
    "threshold": 1.001,
    "head": 1.0,
    "bias": 1.0,
    "kappa": 0.48,
    "tail": 0.8,
    "price_threshold": 0.43,
    "price_near": 3.66,
    "share_low": 5.0,
    "share_steep": 60.0,
}
"""Those of target-gap; the gap that may be left with room, in g; the head's own target, in g, and the weight of the gap
that it would leave; the numbers of the price; those of the share."""
THRESHOLD, HEAD, BIAS, KAPPA, TAIL, PRICE_THRESHOLD, PRICE_NEAR, SHARE_LOW, SHARE_STEEP = range(14, 23)
LEAST_SHARE = 0.06
"""Smallest a that is not 0. Structural: equal sizes have 0.007, and are to be ``target-gap`` exactly."""
UNPRICED = 1e-6
"""V is straight at g if a unit is at most so much of V(g). Structural: above rounding, below what a bent V has."""

LOG_BYTES, VARIANCE, SIZES = range(6, 9)
REMEMBERED = {**target_gap.REMEMBERED, "log_bytes": 0.0, "variance": 0.0, "sizes": 0.0}
"""Memory: what target-gap remembers; mean and variance of the logarithm of bytes; arrivals so far."""
ENTRIES = len(REMEMBERED)
SIZES_WEIGHT = 1 / 64
"""Weight of the newest arrival in mean and variance, once so many have come. Structural: two seconds of a camera, more
than one group of pictures."""


@kernel
def remember_sizes(buffer: Buffer, arrival: Arrival, memory: Memory) -> None:
    """Update mean and variance of the logarithm of bytes; call it at every arrival."""
    if buffer.evictions > 0:
        return
    memory[SIZES] += 1
    weight = max(1 / memory[SIZES], SIZES_WEIGHT)
    off = math.log(arrival.size_bytes) - memory[LOG_BYTES]
    memory[LOG_BYTES] += weight * off
    memory[VARIANCE] = (1 - weight) * (memory[VARIANCE] + weight * off * off)


@kernel
def share(memory: Memory, numbers: Numbers) -> float:
    """The share of price-dp, a."""
    a = 1 / (1 + math.exp(numbers[SHARE_LOW] - numbers[SHARE_STEEP] * math.sqrt(memory[VARIANCE])))
    return a if a >= LEAST_SHARE else 0.0


@kernel
def decide(buffer: Buffer, arrival: Arrival, memory: Memory, numbers: Numbers, a: float) -> int:
    """The decision of both rules mixed, with a share ``a`` of price-dp, once ``remember`` has been called."""
    extra = needless(buffer, arrival)
    if extra >= 0:
        return extra
    s, room, scratch = len(buffer.slots), has_space(buffer, arrival), memory[ENTRIES:]
    if room and (s == 0 or not buffer.busy):
        return ACCEPT
    g = target(buffer, arrival, memory, numbers)
    known = g > 0 and not steady(buffer)
    if g <= 0:
        g = (arrival.x - buffer.dequeued_x) / (s + 1)
    even = value(buffer.v, g)
    unit = numbers[KAPPA] * merging_loss(buffer.v, g, even, g, even)
    if unit <= UNPRICED * even:
        a = 0.0
    longest, discount = numbers[THRESHOLD] * g, numbers[DISCOUNT]
    if not known:
        longest, discount = -g if a > 0 else -max(g, TINY), 0.0
        each_us, elapsed_us = spare_us(buffer, arrival), arrival.arrival_us - buffer.dequeued_arrival_us
        if each_us > 0 and not bursty(memory):
            longest = (arrival.x - buffer.dequeued_x) * each_us / elapsed_us
    per_unit, tie, per_gap = 0.0, 0.0, (1 - a) / max(g, TINY)
    if a > 0:
        chains.weigh(buffer, arrival, unit / mean_bytes(buffer, arrival), arrival.x + numbers[TAIL] * g, scratch)
        per_unit, tie = a / unit, a * TIE / unit
    if s > 0 and free_soon(buffer, numbers[NEAR] + a * (numbers[PRICE_NEAR] - numbers[NEAR])):
        gain = per_unit * chains.advantage(scratch, 0) if a > 0 else 0.0
        if known:
            head, after = motion_gaps(buffer, arrival, 0)
            wish = numbers[HEAD] * g
            gain += per_gap / numbers[HEAD] * (abs(head - wish) - numbers[BIAS] * abs(head + after - wish))
        if gain > tie:
            return 0
    own = per_gap * (longest - discounted(buffer, arrival, False, s, discount))
    if a > 0:
        own += per_unit * chains.advantage(scratch, s)
    victim, best, freed_bytes = -1, -np.inf, 0
    for k in range(s):
        gain = per_gap * (longest - discounted(buffer, arrival, False, k, discount))
        if a > 0:
            gain += per_unit * chains.advantage(scratch, k)
        if gain >= own - tie:
            freed_bytes += buffer.slots[k].size_bytes
        if gain > best + tie:
            victim, best = k, gain
    if room:
        if a == 0 and gap_left(buffer, arrival, victim if best >= own - tie else REJECT) > longest:  # not discounted
            return ACCEPT
        if max(own, best) < a * numbers[PRICE_THRESHOLD]:
            return ACCEPT
        return victim if best >= own - tie else REJECT
    return victim if newcomer_stays(buffer, arrival, best >= own - tie, freed_bytes) else REJECT


BOTH: Any = {"parameters": PARAMETERS, "memory": REMEMBERED, "work": chains.SCRATCH, "reads_rate": True}
"""What both rules are registered with."""


@built_in(
    "price-dp",
    **BOTH,
    source="own rule: Lagrangian price of bytes [fisher1981lagrangian], best chains through the queue",
)
def price_dp(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Sends the messages that are worth their bytes at the price that link, queue and motion set."""
    remember(buffer, arrival, memory, buffer.parameters)
    return decide(buffer, arrival, memory, buffer.parameters, 1.0)


@built_in("gap-price", **BOTH, source="own rule: target-gap for equal sizes, price-dp for unequal ones")
def gap_price(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Target-gap for messages of equal size, price-dp for unequal ones, mixed by the spread of their sizes."""
    remember(buffer, arrival, memory, buffer.parameters)
    remember_sizes(buffer, arrival, memory)
    a = share(memory, buffer.parameters)
    if a == 0:
        return target_gap.decide(buffer, arrival, memory, buffer.parameters)
    return decide(buffer, arrival, memory, buffer.parameters, a)
