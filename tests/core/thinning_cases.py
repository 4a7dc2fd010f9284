"""The slow twin of ``bufgym.policies.thinning``."""

from __future__ import annotations

from bufgym.policies import REJECT


def spared(buffer, arrival, victim, measured_in):
    """Whether a queue with room can spare ``victim``; gaps in ``x`` (motion) or ``seq`` (messages)."""
    waiting = [(message["arrival_us"], message[measured_in]) for message in buffer.slots]
    if len(waiting) < 2 or not buffer.busy or len(buffer.topics) > 1:
        return False
    last = {"x": buffer.dequeued_x, "seq": buffer.dequeued_seq}[measured_in]
    come = [last, *(at for _, at in waiting), arrival[measured_in]]
    # One more step like the last is expected after the newcomer.
    come.append(arrival["x"] + (arrival["x"] - buffer.previous_x) if measured_in == "x" else arrival["seq"] + 1)
    k = len(waiting) if victim == REJECT else victim
    left = float(come[k + 1] - come[k]) + float(come[k + 2] - come[k + 1])
    elapsed_us = arrival["arrival_us"] - buffer.dequeued_arrival_us
    mean_bytes = (buffer.backlog_bytes + arrival["size_bytes"]) / (len(waiting) + 1)
    rate = max(getattr(buffer, f"{span}_rate_bytes_per_s") for span in ("short", "medium", "long"))
    send_us = 1e6 * mean_bytes / rate if rate > 0 else 0.0
    return elapsed_us > 0 and left * elapsed_us <= float(arrival[measured_in] - last) * send_us
