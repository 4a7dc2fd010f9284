"""WiFi along a path: a robot moves back and forth past access points and is handed over from one to the next.

Received power falls with the logarithm of the distance (exponent 3, indoors with few walls; T. S. Rappaport, "Wireless
Communications", 2nd ed., ch. 4), with shadow fading of 4 dB that changes over metres (M. Gudmundson, "Correlation model
for shadow fading in mobile radio systems", Electronics Letters 27(23), 1991). It determines the modulation by the
minimum sensitivities of IEEE 802.11n, 20 MHz, one stream. As phones and laptops commonly do, a station leaves its
access point under -70 dBm for one that is 8 dB better, and has no link during the hand-over.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np

from bufgym.traces.generate.draws import NORMAL_UNIFORMS, nearly_normal, stream
from bufgym.traces.generate.ranges import Between, check_ranges, checked
from bufgym.traces.trace import US_PER_S, Trace

STEP_US: Final = 100_000
_STEPS_PER_S: Final = US_PER_S // STEP_US

# IEEE 802.11-2016, table 19-23 and section 19.5: least dBm for each rate, and the rates in Mbit/s (long guard
# interval).
SENSITIVITY_DBM: Final = (-82, -79, -77, -74, -70, -66, -65, -64)
PHY_MBIT_PER_S: Final = (6.5, 13.0, 19.5, 26.0, 39.0, 52.0, 58.5, 65.0)


@dataclass(frozen=True)
class Corridor:
    """Access points in a row, and the robot's path past them.

    Raises:
        BufgymError: a value out of its range.
    """

    access_points: Annotated[int, Between(1, 100)] = 4
    """The path runs from the first to the last (with one, `spacing_m` beyond it)."""
    spacing_m: Annotated[float, Between(1, 1e4)] = 50.0
    """Distance between neighbours, m."""
    offset_m: Annotated[float, Between(1, 1e4)] = 4.0
    """Distance of the path from them, m."""
    speed_m_per_s: Annotated[float, Between(0.001, 100)] = 1.0
    """Speed of the robot."""
    power_1m_dbm: Annotated[float, Between(-80, 30)] = -30.0
    """Power received 1 m away: 20 dBm sent at 5 GHz, less 46 dB, less 4 dB for antennas."""
    exponent: Annotated[float, Between(1, 6)] = 3.0
    """Exponent of the path loss."""
    shadow_db: Annotated[float, Between(0, 20)] = 4.0
    """Standard deviation of shadows."""
    shadow_m: Annotated[float, Between(0.1, 1000)] = 5.0
    """Distance over which the correlation of shadows falls to 1/e, m."""
    roam_below_dbm: Annotated[float, Between(-100, 0)] = -70.0
    """Received power under which a station looks for another access point."""
    roam_gain_db: Annotated[float, Between(0, 50)] = 8.0
    """How much better the other access point must be."""
    gap_s: Annotated[float, Between(0, 60)] = 1.0
    """Time without a link at a hand-over, s; full authentication takes some tenths of a second to seconds."""
    useful_share: Annotated[float, Between(0.01, 1)] = 0.6
    """Share of the physical rate that TCP gets."""

    def __post_init__(self) -> None:
        check_ranges(self)


def roaming(seed: int, duration_s: float = 300.0, corridor: Corridor | None = None) -> Trace:
    """A trace in steps of 100 ms, which loops.

    Args:
        seed: >= 0, of the shadows.
        duration_s: rounded to whole tenths, 0.1 to 10**5.
        corridor: by default `Corridor()`.

    Raises:
        BufgymError: an argument out of its range; a corridor without any capacity (see `Trace`).
    """
    checked("duration_s", duration_s, 0.1, 1e5)
    c = Corridor() if corridor is None else corridor
    count = round(duration_s * _STEPS_PER_S)
    step_bytes = [round(c.useful_share * mbit * 1e6 / 8 / _STEPS_PER_S) for mbit in PHY_MBIT_PER_S]
    counts, serving, gap_steps = [], -1, 0
    for powers in _powers_dbm(c, seed, count):
        best = max(range(len(powers)), key=powers.__getitem__)
        if serving < 0:
            serving = best
        elif not gap_steps and powers[serving] < c.roam_below_dbm and powers[best] >= powers[serving] + c.roam_gain_db:
            serving, gap_steps = best, round(c.gap_s * _STEPS_PER_S)
        rate = bisect_right(SENSITIVITY_DBM, powers[serving]) - 1
        counts.append(0 if gap_steps or rate < 0 else step_bytes[rate])
        gap_steps = max(0, gap_steps - 1)
    source = f"roaming(seed={seed}, {duration_s:g} s, {c.access_points} access points)"
    return Trace.from_intervals(
        np.full(count, STEP_US), np.array(counts, np.int64), name=f"roaming-{seed}", source=source
    )


def _powers_dbm(c: Corridor, seed: int, count: int) -> Iterator[list[float]]:
    """Power received from each access point at each step, dBm."""
    random = stream(seed)
    n = int(c.access_points)
    length_m = c.spacing_m * max(1, n - 1)
    memory = math.exp(-c.speed_m_per_s / _STEPS_PER_S / c.shadow_m)
    fresh_share = math.sqrt(1 - memory**2)
    shadow = [0.0] * n
    for step in range(count):
        shocks = nearly_normal(random.random((n, NORMAL_UNIFORMS))).tolist()
        shadow = [memory * s + fresh_share * e for s, e in zip(shadow, shocks, strict=True)] if step else shocks
        travelled_m = math.fmod(step * c.speed_m_per_s / _STEPS_PER_S, 2 * length_m)
        x_m = min(travelled_m, 2 * length_m - travelled_m)
        yield [
            c.power_1m_dbm
            - 5 * c.exponent * math.log10(c.offset_m**2 + (x_m - k * c.spacing_m) ** 2)
            + c.shadow_db * shadow[k]
            for k in range(n)
        ]
