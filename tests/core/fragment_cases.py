"""A queue of frames at 30 Hz, for the tests of the rules that look at gaps."""

import numpy as np
from cases import newcomer, queue_of


def waiting(*frames, sent=0, now=8, per_frame=1.0, **known):
    """Frames of 1000 bytes at 30 Hz are queued, frame ``sent`` is in the socket, frame ``now`` arrives; x is
    ``per_frame`` times the number of the frame. At 7500 bytes/s the link sends one frame every four."""
    buffer = queue_of(len(frames), 8)
    for name, scale in (("arrival_us", 33_333), ("x", per_frame), ("seq", 1)):
        buffer.slots[name] = scale * np.array(frames)
    arrival = newcomer()
    arrival["arrival_us"], arrival["x"], arrival["seq"], arrival["size_bytes"] = (
        33_333 * now,
        per_frame * now,
        now,
        1000,
    )
    seen = {"busy": 1, "left_bytes": 1000, "backlog_bytes": 1000 * len(frames), "period_us": 33_333.0}
    seen |= {"dequeued_arrival_us": 33_333 * sent, "dequeued_x": per_frame * sent, "dequeued_seq": sent}
    seen |= {"previous_us": 33_333 * (now - 1), "previous_x": per_frame * (now - 1)}
    return buffer._replace(**seen | known), arrival
