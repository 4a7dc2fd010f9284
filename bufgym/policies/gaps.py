"""Policies that look at the gaps between messages: drop the message whose neighbours replace it best.

Dropping slot k merges its two gaps into one; the smaller the merged gap, the less is lost. Time gaps need a clock only,
motion gaps the robot's odometry.
"""

import numpy as np

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, arrival_gain, gaps, has_space, loss, motion_gaps, suffices
from bufgym.model.qoi import value
from bufgym.policies.registry import Arrival, Memory, built_in

TIE = 1e-12
"""QoI up to which two messages count as equal, so that rounding never decides. Structural: above that of sums of V."""


@kernel
def gap_left(buffer: Buffer, arrival: Arrival, victim: int) -> float:
    """The merged motion gap if ``victim`` goes: a slot, or REJECT for the newcomer."""
    before, after = motion_gaps(buffer, arrival, len(buffer.slots) if victim == REJECT else victim)
    return before + after


@kernel
def discounted(buffer: Buffer, arrival: Arrival, in_time: bool, k: int, discount: float) -> float:
    """The merged gap of slot k of s, in time or motion, less ``discount`` (1 - k / s) of it; slot s is the newcomer."""
    s = len(buffer.slots)
    before_us, after_us, before, after, _ = gaps(buffer, arrival, True, k)
    left = float(before_us + after_us) if in_time else before + after
    return left * (1 - discount * (1 - k / s)) if k < s and discount != 0 else left


@kernel
def smallest_gap(buffer: Buffer, arrival: Arrival, in_time: bool, slots: int, discount: float) -> int:
    """What leaves the smallest ``discounted`` gap, of the first ``slots`` and the oldest if several do.

    The newcomer, slot s, is REJECT. Under B it may take the place of several messages. Then it goes itself, unless
    messages with no larger a gap make room for it. Once one of them has gone, the newcomer stays.
    """
    s, victim, smallest = len(buffer.slots), REJECT, np.inf
    asked = s if buffer.evictions > 0 else slots
    for k in range(asked):
        left = discounted(buffer, arrival, in_time, k, discount)
        if left < smallest:
            victim, smallest = k, left
    if victim < 0 or victim == s:
        return REJECT
    if asked > s and not suffices(buffer, arrival, buffer.slots[victim].size_bytes):
        own, freed_bytes = discounted(buffer, arrival, in_time, s, discount), 0
        for k in range(s):
            if discounted(buffer, arrival, in_time, k, discount) <= own:
                freed_bytes += buffer.slots[k].size_bytes
        if not suffices(buffer, arrival, freed_bytes):
            return REJECT
    return victim


@built_in("min-gap", source="online checkpointing, smallest merged gap")
def min_gap(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A full queue drops what leaves the smallest merged time gap (newcomer included, ties to the oldest)."""
    if has_space(buffer, arrival):
        return ACCEPT
    return smallest_gap(buffer, arrival, True, len(buffer.slots) + 1, 0.0)


@built_in(
    "even-reject",
    parameters={"beta": 1.3},
    source="online checkpointing, a newcomer too close to the tail is rejected (own rule; beta 1.2 to 1.39)",
)
def even_reject(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A full queue rejects a newcomer nearer than beta even gaps T / (s + 1) to the tail, else as min-gap.

    T is the time since the arrival of the message dequeued last. The s queued messages should divide it evenly; s is L
    unless the byte limit B is full.
    """
    beta, s = buffer.parameters[0], len(buffer.slots)
    if has_space(buffer, arrival):
        return ACCEPT
    T = arrival.arrival_us - buffer.dequeued_arrival_us
    near = arrival.arrival_us - buffer.slots[s - 1].arrival_us < beta * T / (s + 1)
    if near and buffer.evictions == 0:
        return REJECT
    return smallest_gap(buffer, arrival, True, s, 0.0)


@built_in("min-motion-gap", source="as min-gap, on the robot's odometry")
def min_motion_gap(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A full queue drops what leaves the smallest merged motion gap (newcomer included, ties to the oldest)."""
    if has_space(buffer, arrival):
        return ACCEPT
    return smallest_gap(buffer, arrival, False, len(buffer.slots) + 1, 0.0)


@built_in(
    "paced-motion-gap",
    parameters={"pace": 0.7, "discount": 0.35},
    source="own rule: min-motion-gap at the pace of an even spacing, older gaps discounted",
)
def paced_motion_gap(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A full queue rejects a newcomer nearer than ``pace`` even spacings to the tail, else drops a small old gap.

    The even spacing is X / (s + 1). X is the motion since the message dequeued last was taken, which the s queued
    messages should divide evenly; s is L unless the byte limit B is full. The victim leaves the smallest merged motion
    gap. The gap of slot k is discounted by ``discount`` (1 - k / s), as the head is soon sent and the tail must last.
    """
    pace, discount = buffer.parameters[0], buffer.parameters[1]
    s = len(buffer.slots)
    if has_space(buffer, arrival):
        return ACCEPT
    even = (arrival.x - buffer.dequeued_x) / (s + 1)
    step, _ = motion_gaps(buffer, arrival, s)
    if step < pace * even and buffer.evictions == 0:
        return REJECT
    return smallest_gap(buffer, arrival, False, s, discount)


@built_in("orbbuf", source="ORBBuf [wang2021orbbuf], released code (Jrdevil-Wang/ORBBuf), with Sim = 1 - V(motion gap)")
def orbbuf(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A full queue drops the message whose neighbours are most similar, first of equals; the newcomer is always kept.

    The head's older neighbour is the message that left last; until one has left, the head stays. The tail stays too,
    except for L < 3, where it goes. Two things differ from the released code. After slot 0 or 1 was dropped, the code
    compares the head with the newest message instead, its `last_frame_`. And its similarity compares images (in a
    random stub); without images, Sim = 1 - V(motion gap).
    """
    L = len(buffer.slots)
    if has_space(buffer, arrival):
        return ACCEPT
    victim, most_similar = L - 1, -np.inf
    for k in range(0 if buffer.dequeued > 0 and L > 2 else 1, L - 1):
        older = buffer.slots[k - 1].x if k > 0 else buffer.dequeued_x
        similar = 1 - value(buffer.v, buffer.slots[k + 1].x - older)
        if similar > most_similar:
            victim, most_similar = k, similar
    return victim


@built_in("greedy-qoi", source="one-step greedy, as a warning")
def greedy_qoi(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A full queue takes the decision that leaves the most information at this moment: a trap.

    Rejecting adds nothing; evicting slot k adds the newcomer's gain less the loss of k. Once the gaps are even,
    replacing the tail costs least at every arrival. So the old prefix stays, and none of the later messages are kept.
    """
    if has_space(buffer, arrival):
        return ACCEPT
    # A newcomer for which a message has gone stays.
    decision, most = REJECT, -np.inf if buffer.evictions > 0 else 0.0
    for k in range(len(buffer.slots)):
        # The tail's loss counts its gap to the newcomer too: together V(a + b) - V(a).
        added = arrival_gain(buffer, arrival) - loss(buffer, arrival, k)
        if added > most + TIE:
            decision, most = k, added
    return decision
