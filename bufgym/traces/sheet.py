"""Fact sheet of a recording: what a person looks at before trusting a number made from it."""

from datetime import UTC, datetime
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

_DATES_US: Final = (9.4e14, 2.84e15)  # Microseconds since 1970 from 2000 until 2059

Facts = tuple[tuple[str, str], ...]
"""Name and value, in words."""


class Sheet(NamedTuple):
    """Facts of a recording, and doubts about it, each a sentence that names the file."""

    facts: Facts = ()
    doubts: tuple[str, ...] = ()


NONE: Final = Sheet()
"""Of a recording that was made, not read."""


def time_facts(what: str, time_us: npt.NDArray[np.int64], start_us: int) -> Facts:
    """Start if it is a date, then number and steps of samples at these times, int64[n], us from ``start_us`` on."""
    facts = []
    if _DATES_US[0] <= start_us < _DATES_US[1]:
        facts.append(("start", f"{datetime.fromtimestamp(start_us // 1_000_000, UTC):%Y-%m-%d %H:%M:%S} UTC"))
    facts.append((what, f"{len(time_us):,} in {(time_us[-1] - time_us[0]) / 1e6:,.3f} s"))
    steps_s = np.diff(time_us) / 1e6
    if len(steps_s):
        least, median, most = (f"{function(steps_s):.6g}" for function in (np.min, np.median, np.max))
        facts.append(("step", f"{median} s (median), {least} to {most}"))
    return tuple(facts)
