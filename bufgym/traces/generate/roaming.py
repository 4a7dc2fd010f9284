"""WiFi along a path: a robot goes to and fro past access points and hands over from one to the next.

Power received falls with the logarithm of the distance (exponent 3, indoors with few walls; T. S. Rappaport,
"Wireless Communications", 2nd ed., ch. 4) and has shadows of 4 dB that change over metres (M. Gudmundson,
"Correlation model for shadow fading in mobile radio systems", Electronics Letters 27(23), 1991). Power picks the
modulation by the least sensitivities of IEEE 802.11n, 20 MHz, one stream. A station leaves its access point, as
phones and laptops commonly do, under -70 dBm and for one that is 8 dB better, and is deaf meanwhile.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from bufgym.traces.generate.chance import NORMAL_UNIFORMS, checked, nearly_normal, stream
from bufgym.traces.trace import US_PER_S, Trace

STEP_US: Final = 100_000
_STEPS_PER_S: Final = US_PER_S // STEP_US

# IEEE 802.11-2016, table 19-23 and section 19.5: dBm from which each rate works, and Mbit/s (long guard interval).
SENSITIVITY_DBM: Final = (-82, -79, -77, -74, -70, -66, -65, -64)
PHY_MBIT_PER_S: Final = (6.5, 13.0, 19.5, 26.0, 39.0, 52.0, 58.5, 65.0)


@dataclass(frozen=True)
class Corridor:
    """Access points in a row, and the robot's way past them.

    Attributes:
        access_points: 1 to 100; the path runs from the first to the last (with one, `spacing_m` beyond it).
        spacing_m: from one to the next, m.
        offset_m: distance of the path from them, m.
        speed_m_per_s: of the robot.
        power_1m_dbm: received 1 m away: 20 dBm sent at 5 GHz, less 46 dB, less 4 dB for antennas.
        exponent: of the path loss.
        shadow_db, shadow_m: standard deviation of shadows, and the distance over which they are correlated by 1/e.
        roam_below_dbm, roam_gain_db: when a station looks for another access point, and how much better it must be.
        gap_s: time without a link at a hand-over; full authentication takes some tenths of a second to seconds.
        useful_share: part of the physical rate that TCP gets.
    """

    access_points: int = 4
    spacing_m: float = 50.0
    offset_m: float = 4.0
    speed_m_per_s: float = 1.0
    power_1m_dbm: float = -30.0
    exponent: float = 3.0
    shadow_db: float = 4.0
    shadow_m: float = 5.0
    roam_below_dbm: float = -70.0
    roam_gain_db: float = 8.0
    gap_s: float = 1.0
    useful_share: float = 0.6

    def __post_init__(self) -> None:
        checked("access_points", self.access_points, 1, 100)
        checked("spacing_m", self.spacing_m, 1, 1e4)
        checked("offset_m", self.offset_m, 1, 1e4)
        checked("speed_m_per_s", self.speed_m_per_s, 0.001, 100)
        checked("power_1m_dbm", self.power_1m_dbm, -80, 30)
        checked("exponent", self.exponent, 1, 6)
        checked("shadow_db", self.shadow_db, 0, 20)
        checked("shadow_m", self.shadow_m, 0.1, 1000)
        checked("roam_below_dbm", self.roam_below_dbm, -100, 0)
        checked("roam_gain_db", self.roam_gain_db, 0, 50)
        checked("gap_s", self.gap_s, 0, 60)
        checked("useful_share", self.useful_share, 0.01, 1)


def roaming(seed: int, duration_s: float = 300.0, corridor: Corridor | None = None) -> Trace:
    """A trace in steps of 100 ms, which loops.

    Args:
        seed: >= 0; it draws the shadows.
        duration_s: rounded to whole tenths, 0.1 to 10**5.
        corridor: by default `Corridor()`.

    Raises:
        BufgymError: an argument out of its range; a corridor without any capacity (see `Trace`).
    """
    checked("duration_s", duration_s, 0.1, 1e5)
    c = Corridor() if corridor is None else corridor
    count = round(duration_s * _STEPS_PER_S)
    step_bytes = [round(c.useful_share * mbit * 1e6 / 8 / _STEPS_PER_S) for mbit in PHY_MBIT_PER_S]
    counts, serving, deaf = [], -1, 0
    for powers in _powers_dbm(c, seed, count):
        best = max(range(len(powers)), key=powers.__getitem__)
        if serving < 0:
            serving = best
        elif not deaf and powers[serving] < c.roam_below_dbm and powers[best] >= powers[serving] + c.roam_gain_db:
            serving, deaf = best, round(c.gap_s * _STEPS_PER_S)
        rate = bisect_right(SENSITIVITY_DBM, powers[serving]) - 1
        counts.append(0 if deaf or rate < 0 else step_bytes[rate])
        deaf = max(0, deaf - 1)
    source = f"roaming(seed={seed}, {duration_s:g} s, {c.access_points} access points)"
    return Trace.from_intervals(
        np.full(count, STEP_US), np.array(counts, np.int64), name=f"roaming-{seed}", source=source
    )


def _powers_dbm(c: Corridor, seed: int, count: int) -> Iterator[list[float]]:
    """Power received from each access point, step by step."""
    random = stream(seed)
    n = int(c.access_points)
    length_m = c.spacing_m * max(1, n - 1)
    memory = math.exp(-c.speed_m_per_s / _STEPS_PER_S / c.shadow_m)
    fresh = math.sqrt(1 - memory**2)
    shadow = [0.0] * n
    for step in range(count):
        shocks = nearly_normal(random.random((n, NORMAL_UNIFORMS))).tolist()
        shadow = [memory * s + fresh * e for s, e in zip(shadow, shocks, strict=True)] if step else shocks
        way_m = math.fmod(step * c.speed_m_per_s / _STEPS_PER_S, 2 * length_m)
        x_m = min(way_m, 2 * length_m - way_m)
        yield [
            c.power_1m_dbm
            - 5 * c.exponent * math.log10(c.offset_m**2 + (x_m - k * c.spacing_m) ** 2)
            + c.shadow_db * shadow[k]
            for k in range(n)
        ]
