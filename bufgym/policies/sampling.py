"""Policies that sample the stream, whatever the queue holds."""

from bufgym.model.buffer import ACCEPT, REJECT, Buffer, has_space
from bufgym.policies.classic import keep_last, uniform_draw
from bufgym.policies.registry import Arrival, Memory, built_in

SEEN = 0


def reservoir_departure(buffer: Buffer, memory: Memory) -> None:
    """Start anew when the link moves again: the messages still queued are the first sample of the next interruption."""
    memory[SEEN] = len(buffer.slots)


@built_in(
    "reservoir",
    memory={"seen": 0.0},
    on_departure=reservoir_departure,
    source="Vitter, Random sampling with a reservoir, 1985 [vitter1985reservoir] (algorithm R)",
)
def reservoir(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Reservoir sampling: every arrival of the interruption is kept with the same probability.

    If one place has too few bytes for it, further messages of the sample, drawn alike, go as well.
    """
    s = len(buffer.slots)
    candidates = float(s)
    if buffer.evictions == 0:
        # With decide_at="overflow" messages enter unasked; all of them are still queued at the first decision.
        memory[SEEN] = max(memory[SEEN], s) + 1
        candidates = memory[SEEN]
    if has_space(buffer, arrival):
        return ACCEPT
    place = int(uniform_draw(buffer, arrival) * candidates)
    return place if place < s else REJECT


COUNT = 0


@built_in(
    "decimate",
    parameters={"every": 3.0},
    memory={"count": 0.0},
    source="fixed decimation, 30 to 10 frames/s (Golodetz et al. 2018 [golodetz2018collaborative])",
)
def decimate(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Fixed decimation: of the arrivals it is asked about, one in `every` is queued; drop-oldest when full."""
    n, every = memory[COUNT], buffer.parameters[0]
    if buffer.evictions == 0:
        memory[COUNT] += 1
        if n > 0 and n // every == (n - 1) // every:
            return REJECT
    return keep_last(buffer, arrival, buffer.capacity)


@built_in(
    "keyframe",
    parameters={"step": 0.05},
    source="motion keyframes of collaborative mapping, a threshold on distance or angle",
)
def keyframe(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """Motion keyframes: accepts messages `step` in x beyond the last keyframe; drop-oldest when full."""
    s, step = len(buffer.slots), buffer.parameters[0]
    last_x = buffer.slots[s - 1].x if s > 0 else buffer.dequeued_x  # the tail is never dropped before the head
    if s + buffer.dequeued > 0 and arrival.x - last_x < step:
        return REJECT
    return keep_last(buffer, arrival, buffer.capacity)
