"""The slow twin of ``bufgym.policies.thinning``; gaps in ``x`` (motion) or ``seq`` (messages)."""

import itertools

from bufgym.policies import REJECT
from bufgym.policies.thinning import SOON_US


def gaps_left(buffer, arrival, measured_in):
    """The gap that each queued message, and last the newcomer, would leave."""
    come = [{"x": buffer.dequeued_x, "seq": buffer.dequeued_seq}[measured_in]]
    come += [message[measured_in] for message in buffer.slots]
    come.append(arrival[measured_in])
    # One more step like the last is expected after the newcomer.
    come.append(arrival["x"] + (arrival["x"] - buffer.previous_x) if measured_in == "x" else arrival["seq"] + 1)
    steps = [float(after - before) for before, after in itertools.pairwise(come)]
    return list(map(sum, itertools.pairwise(steps)))


def least_gap(buffer, arrival, measured_in, discount=0.0):
    """What leaves the smallest gap; of equals the oldest. Slot k of s counts ``discount`` (1 - k / s) less."""
    *queued, newcomer = gaps_left(buffer, arrival, measured_in)
    gaps = [gap * (1 - discount * (1 - k / len(queued))) for k, gap in enumerate(queued)] + [newcomer]
    k = gaps.index(min(gaps))
    return k if k < len(queued) else REJECT


def fits(buffer, arrival):
    """Whether the newcomer fits as the queue is, by messages and by bytes."""
    return len(buffer.slots) < buffer.capacity and buffer.backlog_bytes + arrival["size_bytes"] <= buffer.max_bytes


def places(buffer, arrival):
    """How many messages of mean size there is room for in all: L, or what B lets in; no fewer than are queued."""
    sizes = [message["size_bytes"] for message in buffer.slots] + [arrival["size_bytes"]]
    return max(len(buffer.slots), min(buffer.capacity, int(buffer.max_bytes / (sum(map(int, sizes)) / len(sizes)))))


def level(buffer):
    """Whether the link is steady: the rates over 0.1 s and 0.5 s are that over 2 s, but for 2 % and 1 %."""
    short, medium, long = (getattr(buffer, f"{span}_rate_bytes_per_s") for span in ("short", "medium", "long"))
    near = abs(short - long) <= 0.02 * long and abs(medium - long) <= 0.01 * long
    return bool(near and long > 0 and buffer.drained_us > 0)


def spared(buffer, arrival, victim, measured_in):
    """Whether a queue with room can spare ``victim``."""
    s, elapsed_us = len(buffer.slots), arrival["arrival_us"] - buffer.dequeued_arrival_us
    mean_bytes = (buffer.backlog_bytes + arrival["size_bytes"]) / (s + 1)
    rate = max(getattr(buffer, f"{span}_rate_bytes_per_s") for span in ("short", "medium", "long"))
    if s < 3 or not buffer.busy or len(buffer.topics) > 1 or rate == 0 or elapsed_us <= 0:
        return False
    send_us = 1e6 * mean_bytes / rate
    last = {"x": buffer.dequeued_x, "seq": buffer.dequeued_seq}[measured_in]
    left = gaps_left(buffer, arrival, measured_in)[s if victim == REJECT else victim]
    L = places(buffer, arrival)
    soon = L * send_us <= SOON_US
    room_us = 60e6 / (60e6 / send_us + L - s)  # a minute's messages, and those for which there is room
    return soon and left * elapsed_us <= float(arrival[measured_in] - last) * room_us
