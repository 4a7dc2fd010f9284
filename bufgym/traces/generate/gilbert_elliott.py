"""A link of two states, good and bad, each left with a fixed chance a step.

E. N. Gilbert, "Capacity of a burst-noise channel", Bell System Technical Journal 39(5), 1960; E. O. Elliott,
"Estimates of error rates for codes on burst-noise channels", ibid. 42(5), 1963. They model bit errors; here a state
has a capacity, because TCP turns lost packets into a lower rate.
"""

from __future__ import annotations

import numpy as np

from bufgym.ground.errors import BufgymError
from bufgym.traces.generate.draws import stream
from bufgym.traces.generate.ranges import checked
from bufgym.traces.trace import US_PER_S, Trace

_MAX_STEPS = 10**7


def gilbert_elliott(
    seed: int,
    duration_s: float = 300.0,
    *,
    good_bytes_per_s: float = 10e6,
    bad_bytes_per_s: float = 0.0,
    mean_good_s: float = 20.0,
    mean_bad_s: float = 2.0,
    step_s: float = 0.1,
) -> Trace:
    """A trace in steps of `step_s`, which loops.

    The share of time in the bad state tends to mean_bad_s / (mean_good_s + mean_bad_s); the first state is drawn with
    that chance.

    Args:
        seed: >= 0.
        duration_s: rounded to whole steps, of which there must be 1 to 10**7.
        good_bytes_per_s, bad_bytes_per_s: capacity in each state, 0 to 10**10, good >= bad.
        mean_good_s, mean_bad_s: mean stay in each, at least a step.
        step_s: from 0.001 to 3600.

    Raises:
        BufgymError: an argument out of its range; a trace without any capacity (see `Trace`).
    """
    checked("step_s", step_s, 0.001, 3600)
    checked("duration_s", duration_s, step_s, _MAX_STEPS * step_s)
    checked("good_bytes_per_s", good_bytes_per_s, 0, 1e10)
    checked("bad_bytes_per_s", bad_bytes_per_s, 0, 1e10)
    checked("mean_good_s", mean_good_s, step_s, 1e9)
    checked("mean_bad_s", mean_bad_s, step_s, 1e9)
    if bad_bytes_per_s > good_bytes_per_s:
        raise BufgymError(f"bad_bytes_per_s = {bad_bytes_per_s}: must be at most good_bytes_per_s = {good_bytes_per_s}")
    leave_chances = (step_s / mean_good_s, step_s / mean_bad_s)
    uniforms = stream(seed).random(max(1, round(duration_s / step_s))).tolist()
    bad = uniforms[0] < mean_bad_s / (mean_good_s + mean_bad_s)
    states = [bad]
    for uniform in uniforms[1:]:
        bad ^= uniform < leave_chances[bad]
        states.append(bad)
    step_us = round(step_s * US_PER_S)
    step_bytes = np.array([round(rate * step_s) for rate in (good_bytes_per_s, bad_bytes_per_s)], np.int64)
    return Trace.from_intervals(
        np.full(len(states), step_us),
        step_bytes[np.array(states, np.int64)],
        name=f"gilbert-elliott-{seed}",
        source=f"gilbert_elliott(seed={seed}, {duration_s:g} s, good {mean_good_s:g} s, bad {mean_bad_s:g} s)",
    )
