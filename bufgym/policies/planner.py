"""The planner: at each decision the queue's programme, solved in futures of the link that the past alone suggests.

    rate of the link, its means over 0.1 s, 2 s and 20 s <- what left the socket
    for each future f of the link (``futures``):
        H_f(0) <- the most that can be reached if nothing goes, where there is room (``hindsight``)
        for each message j, queued or new: H_f(j) <- the most that can be reached without j
    drop the j with the largest mean of H_f(j), less a little for its merged motion gap; none if H_f(0) has it

A queue with room is asked too, while the socket is busy: what it holds is sent, and takes the place of something else
on the link. The head goes where what follows it deserves the next transmission more (``bufgym reproduce small-link``:
without that even the best policy loses half of what it could gain). An idle socket takes the newcomer at once.

Each future is solved as if it were known, which flatters plans that wait for news; while a link stands still that is
all there is to decide, and ``min-motion-gap`` does it.
"""

from __future__ import annotations

import math

import numpy as np

from bufgym.kernel import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, has_space, motion_gaps, running_mean
from bufgym.policies.futures import FUTURES, MEAN_S, Grid, Link, sample
from bufgym.policies.gaps import min_motion_gap
from bufgym.policies.hindsight import collect, divide, prepare, room, sweep
from bufgym.policies.registry import Arrival, Memory, register

POINTS, POINTS_EACH = 24, 3
"""Points of the grid of arrivals to come: so many, and so many more for each of L + 1 candidates."""
PER_MESSAGE = 3.0
"""Points of the grid to each message that the link is expected to carry."""
WORK_PER_US = 120.0
"""Steps of the programme that count as a microsecond: a budget is one of work, so that every machine decides alike."""
STEP_WEIGHT = 1 / 16
"""Of the newest motion step in the mean that is expected to go on."""
GAP_WEIGHT, AGE_WEIGHT = 0.00001, 0.35
"""Many plans are worth the same: among them the smallest merged motion gap goes, in even gaps, the older the sooner."""
STEP, MEAN, SEEN_US, REMEMBERED = 0, 1, 2, 3
_min_motion_gap = kernel(min_motion_gap)


@kernel
def remember(buffer: Buffer, arrival: Arrival, memory: Memory) -> None:
    """Renew the mean motion step and m, the link's rate over ``MEAN_S`` of sending time (bytes/us)."""
    step = arrival.x - buffer.previous_x
    memory[STEP] += (STEP_WEIGHT if memory[STEP] > 0 else 1.0) * (step - memory[STEP])
    us = buffer.drained_us
    if us > 0:
        memory[MEAN] = running_mean(memory[MEAN], buffer.drained_bytes, us, memory[SEEN_US], MEAN_S * 1e6)
        memory[SEEN_US] += us


@kernel
def grid_for(buffer: Buffer, rate: float, size_bytes: float) -> Grid:
    """So fine that ``PER_MESSAGE`` points come between two messages sent at this rate (bytes/us)."""
    periods = max(1.0, math.floor(size_bytes / (rate * buffer.period_us * PER_MESSAGE)))
    return Grid(POINTS + POINTS_EACH * (buffer.capacity + 1), min(periods, 64.0) * buffer.period_us)


@register(
    "planner",
    parameters={"budget_us": 200, "standstill_s": 1.0},
    memory={"step": 0.0, "mean": 0.0, "seen_us": 0.0},
    work=room(POINTS_EACH, POINTS),
    source="hindsight planning over sampled futures (own)",
    reads_rate=True,
    named_only=True,
    compile=True,
)
def planner(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Drops what can be spared best in futures of the link that its rate suggests, even where there is room."""
    if buffer.evictions == 0:
        remember(buffer, arrival, memory)
    full = not has_space(buffer, arrival)
    if not full and not buffer.busy:
        return ACCEPT
    s, budget = len(buffer.slots), buffer.parameters[0] * WORK_PER_US
    size_bytes, rate = (buffer.backlog_bytes + arrival.size_bytes) / (s + 1), buffer.medium_rate_bytes_per_s / 1e6
    slow = rate < 0.1 * memory[MEAN] or rate * (s + 1) * buffer.period_us < size_bytes
    still = slow and buffer.stalled_us > buffer.parameters[1] * 1e6
    if len(buffer.topics) > 1 or still or memory[MEAN] <= 0 or buffer.period_us <= 0 or memory[STEP] <= 0:
        return _min_motion_gap(buffer, arrival, memory)
    waits, capacity = (s, s) if full else (s + 1, buffer.capacity)
    mean = memory[MEAN]
    long_rate = max(buffer.long_rate_bytes_per_s / 1e6, 0.02 * mean)
    short_rate = max(buffer.short_rate_bytes_per_s / 1e6, 0.02 * mean)
    link = Link(
        mean,
        math.log(long_rate / mean),
        math.log(short_rate / long_rate),
        float(buffer.left_bytes),
        size_bytes,
        waits,
        buffer.period_us,
    )
    grid = grid_for(buffer, math.sqrt(mean * long_rate), size_bytes)
    tables = divide(memory[REMEMBERED:], grid.points, buffer.capacity)
    prepare(buffer, arrival, memory[STEP] * grid.step_us / buffer.period_us, grid, tables)
    work, number = 0, 0
    while number < FUTURES and (number == 0 or work + work / number <= budget):
        taken = sample(link, grid, number, tables.dequeue_us)
        work += 2 * grid.points + sweep(s + 1, capacity, grid, taken, tables)
        collect(s + 1, taken > 0 and tables.dequeue_us[1] <= buffer.period_us, tables)
        number += 1
    victim, best = ACCEPT, -np.inf if full else tables.total[0] / number
    even = max((arrival.x - buffer.dequeued_x) / (s + 1), 1e-30)
    for k in range(s + 1):
        before, after = motion_gaps(buffer, arrival, k)
        kept_longer = 1 - AGE_WEIGHT * (1 - k / (s + 1))
        worth = tables.total[k + 1] / number - GAP_WEIGHT * kept_longer * (before + after) / even
        if worth > best:
            victim, best = k, worth
    return victim if victim < s else REJECT
