"""Online checkpointing: keep L of a growing stream, as evenly as can be without knowing where it ends.

`linear-alpha` is AFR with gaps that grow within a pass: the kept times are proportional to i^alpha. In the worst case
its largest gap is 1.59 times the even one as L grows (alpha = 1.302), where AFR's (alpha = 1) is 2 times that; ln 4 is
the least that any rule can reach (Bringmann et al., arXiv 1302.4216; Bar-On et al., arXiv 1704.02659).

`steady` writes the n-th arrival as n = m 2^h with m odd, and keeps the last few of each m: those with the largest h.
"""

from __future__ import annotations

from bufgym.kernel import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, fill, has_space
from bufgym.policies.afr import MEMORY, C, P, R, afr_departure, thin
from bufgym.policies.classic import keep_last
from bufgym.policies.registry import Arrival, Memory, register


@kernel
def full_length(buffer: Buffer, arrival: Arrival) -> int:
    """How many messages a full queue holds: L, or if B has less room than that, as many like these as it has for."""
    like_these = float(buffer.max_bytes) * (len(buffer.slots) + 1) / (buffer.backlog_bytes + arrival.size_bytes)
    return int(min(float(buffer.capacity), like_these))


@kernel
def growing_gap(r: float, p: float, L: int, alpha: float) -> float:
    """Arrivals from kept message r (L + p) to the next one kept, r (L + p + 1); message i is kept at L (i / L)^alpha.

    Written so that it is exactly r for alpha = 1.
    """
    return float(r**alpha * L ** (1 - alpha) * ((L + p + 1) ** alpha - (L + p) ** alpha))


@register(
    "linear-alpha",
    parameters={"alpha": 1.302},
    memory=MEMORY,
    on_departure=afr_departure,
    source="LINEAR, Bringmann et al. [bringmann2015checkpointing]",
    compile=True,
)
def linear_alpha(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """LINEAR: evicts 1, 3, 5, ... pass after pass as AFR does, but keeps arrivals at times i^alpha."""
    r, c, p, alpha = memory[R], memory[C], memory[P], buffer.parameters[0]
    lowered = r > 1 and buffer.evictions == 0 and fill(buffer) <= 2 / 3
    if lowered:
        r = r / 2
    gap = growing_gap(r, p, full_length(buffer, arrival), alpha)
    if lowered:
        c = c % gap
    if r == 1 and has_space(
        buffer, arrival
    ):  # the paper's stream never drains; here, with every pass undone, what finds room is kept
        memory[R], memory[C] = r, 0.0
        return ACCEPT
    return thin(r, c, p, gap, buffer, arrival, memory)


@kernel
def site(n: int, s: int) -> int:
    """Where the steady algorithm stores the n-th item, n >= 1, of 2^s sites; -1: nowhere.

    n = m 2^h with m = 2i + 1. The first segment of sites belongs to m = 1 and is s + 1 wide; then come 1, 2, 4, ...
    segments of s - 1, s - 2, s - 3, ... sites for the next m. Within its segment, h goes round as in a ring.
    """
    h = 0
    while n % 2 == 0:
        n, h = n // 2, h + 1
    i = n // 2
    if i == 0:
        return h % (s + 1)
    level, first = 0, 1  # first = 2^level <= i < 2^(level + 1)
    while 2 * first <= i:
        level, first = level + 1, 2 * first
    width = s - 1 - level
    if width < 1:
        return -1
    return first * (s + 1 - level) + (i - first) * width + h % width


FIRST = 0


@register(
    "steady",
    memory={"first": 0.0},
    source="steady algorithm, Moreno et al. [moreno2024downsampling], as in the package downstream (PyPI)",
    compile=True,
)
def steady(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Steady curation: the n-th arrival since the queue was empty has a fixed site, or none; S = 2^s <= L sites."""
    L = buffer.capacity
    if len(buffer.slots) == 0:
        memory[FIRST] = arrival.seq
    first = int(memory[FIRST])
    s = 0
    while 2 ** (s + 1) <= L:
        s += 1
    place = site(arrival.seq - first + 1, s)
    if place < 0:
        return REJECT
    for k in range(len(buffer.slots)):
        if site(buffer.slots[k].seq - first + 1, s) == place:
            return k
    # Every site is some message's only where some were queued unasked, or bytes are short: then the head makes room.
    return keep_last(buffer, arrival, L)
