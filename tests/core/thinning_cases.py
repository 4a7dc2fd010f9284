"""The slow twin of ``bufgym.policies.thinning``; gaps in ``x`` (motion) or ``seq`` (messages)."""

from __future__ import annotations

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


def least_gap(buffer, arrival, measured_in):
    """What leaves the smallest gap; of equals the oldest."""
    gaps = gaps_left(buffer, arrival, measured_in)
    k = gaps.index(min(gaps))
    return k if k < len(buffer.slots) else REJECT


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
    soon = buffer.capacity * send_us <= SOON_US
    return soon and left * elapsed_us <= float(arrival[measured_in] - last) * send_us
