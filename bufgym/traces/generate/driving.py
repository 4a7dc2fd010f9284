"""Motion of a robot that drives around, from a seed: uniform doubles only, rounded to millionths (see `draws`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np

from bufgym.ground.errors import BufgymError
from bufgym.traces.generate.draws import stream
from bufgym.traces.motion import Motion, MotionSettings
from bufgym.traces.trace import US_PER_S

Limits: TypeAlias = tuple[float, float]
"""(least, greatest) of a range from which values are drawn uniformly."""

_STEP_US: Final = 100_000


@dataclass(frozen=True)
class Driving:
    """How a robot drives, by default a small delivery or survey robot.

    Raises:
        BufgymError: a range that is not in order within its limits, or chances that are negative or sum to over 1.
    """

    cruise_m_per_s: Limits = (0.5, 1.5)
    """Speed when driving on."""
    cruise_turn_deg_per_s: Limits = (0.0, 10.0)
    """Turn rate when driving on."""
    cruise_s: Limits = (4.0, 15.0)
    """How long it drives on at one speed."""
    turn_deg_per_s: Limits = (30.0, 60.0)
    """Turn rate of a turn in place."""
    turn_s: Limits = (1.0, 4.0)
    """How long a turn in place lasts."""
    stop_s: Limits = (2.0, 8.0)
    """How long a stop lasts."""
    turn_chance: float = 0.55
    """Chance that a turn in place follows a stretch of driving."""
    stop_chance: float = 0.25
    """Chance that a stop follows; otherwise the robot drives on at another speed."""

    def __post_init__(self) -> None:
        for name, most in (("cruise_m_per_s", 100.0), ("cruise_turn_deg_per_s", 1e4), ("turn_deg_per_s", 1e4)):
            self._check(name, 0.0, most)
        for name in ("cruise_s", "turn_s", "stop_s"):
            self._check(name, _STEP_US / US_PER_S, 1e6)
        if not (0 <= self.turn_chance <= 1 and 0 <= self.stop_chance <= 1 - self.turn_chance):
            chances = f"turn_chance = {self.turn_chance}, stop_chance = {self.stop_chance}"
            raise BufgymError(f"{chances}: must be >= 0 and at most 1 together")

    def _check(self, name: str, least: float, most: float) -> None:
        low, high = getattr(self, name)
        if not least <= low <= high <= most:
            raise BufgymError(f"{name} = ({low}, {high}): must be in order and from {least:g} to {most:g}")


def drive_motion(seed: int, duration_s: float = 300.0, driving: Driving | None = None) -> Motion:
    """Motion of a robot that cruises, turns in place and stops, 10 samples a second.

    The coordinate is that of `MotionSettings()`, with a field of view of 60 degrees and a scene scale of 2 m: cruising
    at 1 m/s adds 0.5 a second, turning in place at 45 degrees/s 0.75, stopping nothing. Each sample's step is a whole
    number of millionths. Changes of speed are instant.

    Args:
        seed: >= 0.
        duration_s: rounded to whole tenths; 0.1 to 10**6.
        driving: by default `Driving()`.
    """
    driving = Driving() if driving is None else driving
    if not 0.1 <= duration_s <= 1e6:
        raise BufgymError(f"duration_s = {duration_s}: must be from 0.1 to 1e6")
    random = stream(seed)
    scale = MotionSettings()
    count = round(duration_s * US_PER_S / _STEP_US)
    step_s = _STEP_US / US_PER_S
    steps: list[int] = []
    phase: Literal["cruise", "turn", "stop"] = "cruise"
    while len(steps) < count:
        speed_m_per_s = turn_deg_per_s = 0.0
        if phase == "cruise":
            speed_m_per_s = _drawn(random, driving.cruise_m_per_s)
            turn_deg_per_s = _drawn(random, driving.cruise_turn_deg_per_s)
            lasts_s = _drawn(random, driving.cruise_s)
        elif phase == "turn":
            turn_deg_per_s = _drawn(random, driving.turn_deg_per_s)
            lasts_s = _drawn(random, driving.turn_s)
        else:
            lasts_s = _drawn(random, driving.stop_s)
        per_s = speed_m_per_s / scale.scene_scale_m + turn_deg_per_s / scale.fov_deg
        steps += [round(per_s * step_s * 1e6)] * max(1, round(lasts_s / step_s))
        uniform = float(random.random())
        if phase != "cruise" or uniform >= driving.turn_chance + driving.stop_chance:
            phase = "cruise"
        else:
            phase = "turn" if uniform < driving.turn_chance else "stop"
    millionths = np.append(0, np.cumsum(steps[:count]))
    time_us = np.arange(count + 1, dtype=np.int64) * _STEP_US
    return Motion(f"drive-{seed}", time_us, millionths / 1e6, f"drive_motion(seed={seed}, {duration_s:g} s)")


def _drawn(random: np.random.Generator, limits: Limits) -> float:
    return limits[0] + (limits[1] - limits[0]) * float(random.random())
