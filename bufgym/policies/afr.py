"""AFR, Adaptive Frame Rate [wang2022afr]: thin the queue to an even, adaptive frame rate.

Variables are the paper's: dropping rate r, counter c, dropping position p, capacity L, queued messages s. AFR keeps one
arrival in r. Whenever the queue is full it evicts every second of the messages kept before r grew, oldest pair first.

Under a byte limit B the queue is full when the newcomer does not fit, and a pass ends at its last message. r halves
when at most 2/3 of L and of B are taken. If AFR is asked again about an arrival, it goes on with the pass and counts
the arrival once.

`afr` is the released code (github Jrdevil-Wang/AFR, transport_subscriber_link.cpp), `afr-paper` the literal text of the
paper. They differ in the bound for halving r: 3s <= 2L in the code, s/L < 2/3 in the text. At departures the code moves
p along with the queue; the text does not mention p.
"""

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, fill, has_space
from bufgym.policies.registry import Arrival, Memory, built_in

R, C, P = range(3)  # where r, c and p lie in the memory
MEMORY = {"r": 1.0, "c": 0.0, "p": 0.0}


@kernel
def thin(r: float, c: float, p: float, gap: float, buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Count the arrival, and evict at p when full. Code and text share this part, which follows the halving of r.

    ``gap`` is the number of arrivals until the next one is kept: r in AFR, another in ``checkpointing.py``.
    """
    s = len(buffer.slots)
    if buffer.evictions == 0:
        c += 1
        if c < gap:
            memory[R], memory[C], memory[P] = r, c, p
            return REJECT  # even when there is room: only one arrival in r is kept
        c = (c - gap) % 1.0  # 0 in AFR; a fractional gap carries its fraction on
    decision = ACCEPT
    if not has_space(buffer, arrival):
        if p >= s:  # only under B, if fewer messages are queued than when this pass began
            r, p = 2 * r, 0.0
        decision = int(p)
        p += 1
        if p >= s:  # the pass is done: every second message is gone, half the rate is left
            r, p = 2 * r, 0.0
    memory[R], memory[C], memory[P] = r, c, p
    return decision


def afr_departure(buffer: Buffer, memory: Memory) -> None:
    """Follow the departure of the head: the same message is now one slot further to the front."""
    memory[P] = max(0.0, memory[P] - 1)


@built_in(
    "afr", memory=MEMORY, on_departure=afr_departure, source="AFR [wang2022afr], released code (Jrdevil-Wang/AFR)"
)
def afr(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Adaptive Frame Rate as released: an even, adaptive frame rate."""
    r, c, p = memory[R], memory[C], memory[P]
    if r > 1 and buffer.evictions == 0 and fill(buffer) <= 2 / 3:
        r = r / 2
        c = c % r
    return thin(r, c, p, r, buffer, arrival, memory)


@built_in("afr-paper", memory=MEMORY, source="AFR [wang2022afr], Sec. IV-A, Algorithm 1 (literal text)")
def afr_paper(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Adaptive Frame Rate by the letter of the paper: s/L < 2/3, p not moved at departures."""
    r, c, p = memory[R], memory[C], memory[P]
    if r > 1 and buffer.evictions == 0 and fill(buffer) < 2 / 3:
        r = r / 2
        c = c % r
    return thin(r, c, p, r, buffer, arrival, memory)
