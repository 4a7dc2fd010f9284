"""Online checkpointing: keep L messages of a growing stream, as evenly as possible without knowing its end.

`linear-alpha` is AFR with gaps that grow within a pass: kept times are proportional to i^alpha. Its largest gap is in
the worst case 1.59 times the even one as L grows, with alpha = 1.302. AFR has alpha = 1 and reaches 2 times. No rule
can stay below ln 4 (Bringmann et al., arXiv 1302.4216; Bar-On et al., arXiv 1704.02659).

`steady` writes the n-th arrival as n = m 2^h with m odd, and for each m keeps the last few, with the largest h.
"""

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, fill, has_space
from bufgym.policies.afr import MEMORY, C, P, R, afr_departure, thin
from bufgym.policies.classic import keep_last
from bufgym.policies.registry import Arrival, Memory, built_in


@kernel
def growing_gap(buffer: Buffer, arrival: Arrival, r: float, p: float, alpha: float) -> float:
    """Arrivals from kept message r (L + p) to the next one kept, r (L + p + 1); message i is kept at L (i / L)^alpha.

    Here L is that of a full queue, or as many like those now waiting as fit into B, if fewer. The form of the
    expression gives exactly r for alpha = 1.
    """
    like_these = float(buffer.max_bytes) * (len(buffer.slots) + 1) / (buffer.backlog_bytes + arrival.size_bytes)
    L = int(min(float(buffer.capacity), like_these))
    return float(r**alpha * L ** (1 - alpha) * ((L + p + 1) ** alpha - (L + p) ** alpha))


@built_in(
    "linear-alpha",
    parameters={"alpha": 1.302},
    memory=MEMORY,
    on_departure=afr_departure,
    source="LINEAR, Bringmann et al. [bringmann2015checkpointing]",
)
def linear_alpha(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """LINEAR: evicts 1, 3, 5, ... pass after pass as AFR does, but keeps arrivals at times i^alpha."""
    r, c, p, alpha = memory[R], memory[C], memory[P], buffer.parameters[0]
    lowered = r > 1 and buffer.evictions == 0 and fill(buffer) <= 2 / 3
    if lowered:
        r = r / 2
    gap = growing_gap(buffer, arrival, r, p, alpha)
    if lowered:
        c = c % gap
    # Unlike the paper's stream this queue drains: with every pass undone, an arrival that finds room is kept.
    if r == 1 and has_space(buffer, arrival):
        memory[R], memory[C] = r, 0.0
        return ACCEPT
    return thin(r, c, p, gap, buffer, arrival, memory)


@kernel
def site(n: int, s: int) -> int:
    """The index of the site, of 2^s, where the steady algorithm stores the n-th item (n >= 1), or -1 for none.

    n = m 2^h with m = 2i + 1. The first segment of sites belongs to m = 1 and is s + 1 wide. Then come 1, 2, 4, ...
    segments of s - 1, s - 2, s - 3, ... sites for the next m. Each segment is a ring that h goes round.
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


@built_in(
    "steady",
    memory={"first": 0.0},
    source="steady algorithm, Moreno et al. [moreno2024downsampling], as in the package downstream (PyPI)",
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
    # The sites can only run out if some messages were queued unasked or bytes are short: then the head makes room.
    return keep_last(buffer, arrival, L)
