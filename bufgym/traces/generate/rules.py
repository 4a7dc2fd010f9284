"""Links by rule, without randomness: steady, a linear ramp, a tunnel.

The ramp of Robofleet's Fig. 5 is `ramp(100e6 / 8, 4e6 / 8, 15)`: 100 to 4 Mbit/s in 15 s [sikand2021robofleet].
"""

from collections.abc import Sequence
from fractions import Fraction
from typing import Final

import numpy as np

from bufgym.traces.generate.draws import checked
from bufgym.traces.trace import US_PER_S, After, Trace
from bufgym.utils.errors import BufgymError

# A linear change is cut into steps of this length; each carries the bytes of the line.
STEP_US: Final = 100_000
_MAX_S: Final = 10**5


def steady(bytes_per_s: float, duration_s: float = 300.0) -> Trace:
    """One rate throughout; it loops.

    Raises:
        BufgymError: a rate that is not from 1 to 10**10, a duration that is not from 0.001 to 10**5 s.
    """
    checked("bytes_per_s", bytes_per_s, 1, 1e10)
    return _lines([(checked("duration_s", duration_s, 1e-3, _MAX_S), bytes_per_s, bytes_per_s)], "steady", "loop")


def ramp(start_bytes_per_s: float, end_bytes_per_s: float, duration_s: float = 15.0, after: After = "hold") -> Trace:
    """A rate that changes linearly from start to end; by default the rate of the last step then continues.

    Raises:
        BufgymError: a rate not from 0 to 10**10, a duration not from 0.001 to 10**5 s, an unknown `after`.
    """
    checked("start_bytes_per_s", start_bytes_per_s, 0, 1e10)
    checked("end_bytes_per_s", end_bytes_per_s, 0, 1e10)
    checked("duration_s", duration_s, 1e-3, _MAX_S)
    return _lines([(duration_s, start_bytes_per_s, end_bytes_per_s)], "ramp", after)


def tunnel(
    bytes_per_s: float = 10e6,
    *,
    before_s: float = 20.0,
    fade_s: float = 3.0,
    blackout_s: float = 10.0,
    recover_s: float = 2.0,
    after_s: float = 20.0,
) -> Trace:
    """A drive through a tunnel: steady, a fade to nothing, a blackout, a fade in, steady again; it loops.

    Args:
        bytes_per_s: rate outside the tunnel, 1 to 10**10.
        before_s, fade_s, blackout_s, recover_s, after_s: length of each part, 0 to 10**5 s; the parts with capacity
            must not all be 0.
    """
    checked("bytes_per_s", bytes_per_s, 1, 1e10)
    parts = [
        (checked("before_s", before_s, 0, _MAX_S), bytes_per_s, bytes_per_s),
        (checked("fade_s", fade_s, 0, _MAX_S), bytes_per_s, 0.0),
        (checked("blackout_s", blackout_s, 0, _MAX_S), 0.0, 0.0),
        (checked("recover_s", recover_s, 0, _MAX_S), 0.0, bytes_per_s),
        (checked("after_s", after_s, 0, _MAX_S), bytes_per_s, bytes_per_s),
    ]
    return _lines(parts, "tunnel", "loop")


def _lines(parts: Sequence[tuple[float, float, float]], name: str, after: After) -> Trace:
    """Rates linear in time, each part as (seconds, bytes/s at its start, bytes/s at its end).

    Cumulative bytes at each knot are the integral, in exact fractions, rounded to whole bytes.
    """
    knots_us, knots_bytes = [0], [0]
    start_us, start_bytes = 0, Fraction(0)
    for seconds, first, last in parts:
        length_us = round(seconds * US_PER_S)
        from_rate, change = Fraction(first) / US_PER_S, (Fraction(last) - Fraction(first)) / US_PER_S
        for elapsed_us in [*range(STEP_US, length_us, STEP_US), length_us] if length_us else []:
            area = from_rate * elapsed_us + change * elapsed_us * elapsed_us / (2 * length_us)
            knots_us.append(start_us + elapsed_us)
            knots_bytes.append(round(start_bytes + area))
        start_us += length_us
        start_bytes += (from_rate + change / 2) * length_us
    if len(knots_us) < 2:
        raise BufgymError(f"{name}: lasts 0 s: must be longer")
    return Trace(name, np.array(knots_us, np.int64), np.array(knots_bytes, np.int64), after, f"{name}, made by rule")
