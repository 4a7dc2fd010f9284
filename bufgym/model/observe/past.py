"""Fields of the past of link and camera, as ``bufgym.model.past`` remembers it; for one queue.

None shows how long the stream has run: that is worth something only where all streams last equally long.
"""

from typing import Any

from bufgym.jit import kernel
from bufgym.model import past as p
from bufgym.model.buffer import Buffer
from bufgym.model.observe.declare import Field, Function, squash

SHORTEST_RUN_US = 15e6
"""Time over which stalls a minute are counted at least, us."""


@kernel
def since(buffer: Buffer, entry: int, reference_us: float) -> float:
    """Time since this entry of the past, beside the reference."""
    return squash(max(buffer.now_us - buffer.past[entry], 0.0), reference_us)


@kernel
def over_mean(buffer: Buffer) -> float:
    """The rate over 2 s beside the mean of the whole run."""
    past = buffer.past
    return squash(buffer.long_rate_bytes_per_s * past[p.SENDING_US], 1e6 * past[p.SENT_BYTES])


@kernel
def stalls_per_minute(buffer: Buffer) -> float:
    """Stalls so far beside four a minute."""
    return squash(15e6 * buffer.past[p.N_STALLS], max(buffer.now_us - buffer.past[p.BEGAN_US], SHORTEST_RUN_US))


@kernel
def correlation(buffer: Buffer) -> float:
    """Correlation of samples of the log rate with the sample before each, from -1 to 1 mapped to 0 to 1."""
    past = buffer.past
    if past[p.VARIANCE] < 1e-6:
        return 0.5
    return float(0.5 + 0.5 * min(max(past[p.COVARIANCE] / past[p.VARIANCE], -1.0), 1.0))


@kernel
def pace_now(buffer: Buffer, arrival: Any) -> float:
    """Motion since the arrival before, in its time, beside the mean pace of the whole run."""
    past, us = buffer.past, arrival.arrival_us - buffer.previous_us
    if us <= 0:
        return 0.5
    return squash(
        (arrival.x - buffer.previous_x) * (arrival.arrival_us - past[p.BEGAN_US]), (arrival.x - past[p.BEGAN_X]) * us
    )


def _declared(name: str, group: str, unit: str, meaning: str, function: Function) -> Field:
    return Field(name, "context", group, unit, meaning, function)


PAST_FIELDS = (
    _declared("since_change", "link", "g/(g+r), r = 2 s",
              "time since the link's rate last changed by over 10 %; 0 before any",
              lambda buffer, arrival: since(buffer, p.CHANGED_US, 2e6) if buffer.past[p.CHANGED_US] > 0 else 0.0),
    _declared("rate_over_mean", "link", "g/(g+r), r = mean of the whole run", "the link's rate over 2 s",
              lambda buffer, arrival: over_mean(buffer)),
    _declared("top_rate", "link", "g/(g+r), r = rate over 2 s", "the highest rate over 0.5 s so far",
              lambda buffer, arrival: squash(buffer.past[p.TOP], buffer.long_rate_bytes_per_s)),
    _declared("stall_now", "link", "g/(g+r), r = 0.5 s",
              "how long the link has stalled, carrying under 3 % of its mean; 0 while it does not",
              lambda buffer, arrival: squash(buffer.past[p.STALLED_US], 0.5e6)),
    _declared("stall_last", "link", "g/(g+r), r = 1 s", "length of the last stall of at least 0.25 s; 0 for none",
              lambda buffer, arrival: squash(buffer.past[p.STALL_LAST_US], 1e6)),
    _declared("stall_before", "link", "g/(g+r), r = 1 s", "length of the stall before that; 0 for none",
              lambda buffer, arrival: squash(buffer.past[p.STALL_BEFORE_US], 1e6)),
    _declared("since_stall", "link", "g/(g+r), r = 4 s", "time since the last stall ended; 1 for none",
              lambda buffer, arrival: since(buffer, p.STALL_ENDED_US, 4e6) if buffer.past[p.N_STALLS] > 0 else 1.0),
    _declared("stalls_per_minute", "link", "g/(g+r), r = 4 a minute", "stalls so far, over 15 s at least",
              lambda buffer, arrival: stalls_per_minute(buffer)),
    _declared("rate_correlation", "link", "(1 + c) / 2, c = correlation",
              "of the logarithm of the rate, from one second to the next, in about the last 12; 0.5 = unknown",
              lambda buffer, arrival: correlation(buffer)),
    _declared("pace_now", "motion", "g/(g+r), r = mean of the whole run",
              "the camera's pace since the arrival before: 0.5 = as ever",
              lambda buffer, arrival: pace_now(buffer, arrival)),
    _declared("since_stop", "motion", "g/(g+r), r = 4 s",
              "time since the camera's pace was last at most 5 % of its mean; 1 for never",
              lambda buffer, arrival: since(buffer, p.STOPPED_US, 4e6) if buffer.past[p.STOPPED_US] >= 0 else 1.0),
)  # fmt: skip
"""Context fields of the past."""
