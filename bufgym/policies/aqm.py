"""Active queue management of the Internet, CoDel and RED, designed to keep a router's queue short.

Both drop early to tell TCP senders to slow down. A camera does not, so here they show the cost of early drops.
"""

import math

from bufgym.jit import kernel
from bufgym.model.buffer import REJECT, Buffer
from bufgym.policies.classic import keep_first
from bufgym.policies.registry import Arrival, Memory, built_in

TARGET_MS, INTERVAL_MS = range(2)  # indices of CoDel's parameters
STATE = ("first_above_us", "drop_next_us", "count", "lastcount", "dropping", "again", "maxpacket_bytes")  # its memory
FIRST_ABOVE, DROP_NEXT, DROPS, LAST_DROPS, DROPPING, AGAIN, MAX_PACKET = range(7)  # indices of it


@kernel
def control_law(t_us: float, count: float, interval_us: float) -> float:
    """Time of the next drop, us: the more drops so far, the sooner."""
    return t_us + interval_us / math.sqrt(count)


@kernel
def ok_to_drop(buffer: Buffer, memory: Memory) -> bool:
    """Whether sojourn times have been above target for a whole interval (RFC 8289, 5.6, dodequeue).

    The answer is no while at most one "maxpacket", the largest message seen, waits behind the head: the link must not
    starve.
    """
    now_us, head = buffer.now_us, buffer.slots[0]
    memory[MAX_PACKET] = max(memory[MAX_PACKET], head.size_bytes)
    sojourn_us, behind_bytes = now_us - head.arrival_us, buffer.backlog_bytes - head.size_bytes
    if sojourn_us < 1e3 * buffer.parameters[TARGET_MS] or behind_bytes <= memory[MAX_PACKET]:
        memory[FIRST_ABOVE] = 0.0
        return False
    if memory[FIRST_ABOVE] == 0:
        memory[FIRST_ABOVE] = now_us + 1e3 * buffer.parameters[INTERVAL_MS]
        return False
    return bool(now_us >= memory[FIRST_ABOVE])


def codel_dequeue(buffer: Buffer, memory: Memory) -> bool:
    """RFC 8289, 5.5 (dequeue), for one head a call; the RFC's loop goes on while the answer is True.

    ``AGAIN`` marks that the loop has just dropped the previous head. After the first drop of a dropping state the RFC
    sends the next packet without looking at drop_next; here it is sent because drop_next still lies ahead.
    """
    now_us, interval_us = buffer.now_us, 1e3 * buffer.parameters[INTERVAL_MS]
    ok, again = ok_to_drop(buffer, memory), memory[AGAIN] == 1
    memory[AGAIN] = 0.0
    if memory[DROPPING] == 1:
        if not ok:
            memory[DROPPING] = 0.0
            return False
        if again:
            memory[DROP_NEXT] = control_law(memory[DROP_NEXT], memory[DROPS], interval_us)
        if now_us < memory[DROP_NEXT]:
            return False
        memory[DROPS] += 1
        memory[AGAIN] = 1.0
        return True
    if ok:
        memory[DROPPING] = 1.0
        # Soon after the last dropping state, the rate that controlled the queue then is a good start.
        delta = memory[DROPS] - memory[LAST_DROPS]
        memory[DROPS] = delta if delta > 1 and now_us - memory[DROP_NEXT] < 16 * interval_us else 1.0
        memory[DROP_NEXT] = control_law(now_us, memory[DROPS], interval_us)
        memory[LAST_DROPS] = memory[DROPS]
    return ok


@built_in(
    "codel",
    parameters={"target_ms": 5.0, "interval_ms": 100.0},
    memory=dict.fromkeys(STATE, 0.0),
    on_dequeue=codel_dequeue,
    source="CoDel, RFC 8289 [nichols2018codel]",
)
def codel(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """CoDel: drops heads while sojourn times stay above `target_ms` for `interval_ms`; a full queue drops the tail.

    The defaults are the RFC's, for packets of 1500 bytes. For messages, choose a target of at least the time that
    one of them takes to transmit (200 kB at 6 MB/s: 33 ms), and an interval in proportion.
    """
    return keep_first(buffer, arrival)


MIN_TH, MAX_TH, MAX_P, WEIGHT = range(4)  # indices of RED's parameters
AVERAGE, COUNT = range(2)  # indices of its memory


@built_in(
    "red",
    parameters={"min_th": 0.25, "max_th": 0.75, "max_p": 0.1, "weight": 0.2},
    memory={"average": 0.0, "count": -1.0},
    source="Random Early Detection, Floyd and Jacobson 1993 [floyd1993red]",
)
def red(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """RED: rejects at random, the more often the higher the average occupancy; a full queue drops the tail.

    Thresholds are fractions of L, or of B if bytes fill it more. The paper's term for idle times needs the link's
    bandwidth and is left out: an arrival at an empty queue is one sample of 0.
    """
    min_th, max_th, max_p = buffer.parameters[MIN_TH], buffer.parameters[MAX_TH], buffer.parameters[MAX_P]
    occupancy = max(len(buffer.slots), buffer.capacity * (buffer.backlog_bytes / buffer.max_bytes))
    memory[AVERAGE] += buffer.parameters[WEIGHT] * (occupancy - memory[AVERAGE])
    average = memory[AVERAGE] / buffer.capacity
    if min_th <= average < max_th:
        memory[COUNT] += 1  # arrivals since the last drop: spreads the drops evenly
        p_b = max_p * (average - min_th) / (max_th - min_th)
        if arrival.uniform * (1 - memory[COUNT] * p_b) < p_b:  # with probability p_b / (1 - count p_b)
            memory[COUNT] = 0.0
            return REJECT
    elif max_th <= average:
        memory[COUNT] = 0.0
        return REJECT
    else:
        memory[COUNT] = -1.0
    return keep_first(buffer, arrival)
