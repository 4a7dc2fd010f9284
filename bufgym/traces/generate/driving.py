"""Motion of a robot that drives around, from a seed: uniform doubles only, rounded to millionths (see `draws`)."""

from typing import Final, TypeAlias

import numpy as np

from bufgym.traces.generate.draws import checked, stream
from bufgym.traces.motion import Motion, MotionSettings
from bufgym.traces.trace import US_PER_S

Limits: TypeAlias = tuple[float, float]
"""(least, greatest) of a range from which values are drawn uniformly."""

_STEP_US: Final = 100_000


# How a small delivery or survey robot drives: limits of its speed in m/s, its turning in degrees/s and the time in s.
_NOTHING: Final[Limits] = (0.0, 0.0)
PHASES: Final[dict[str, tuple[Limits, Limits, Limits]]] = {
    "cruise": ((0.5, 1.5), (0.0, 10.0), (4.0, 15.0)),
    "turn": (_NOTHING, (30.0, 60.0), (1.0, 4.0)),
    "stop": (_NOTHING, _NOTHING, (2.0, 8.0)),
}
# What follows a stretch of driving; otherwise the robot drives on at another speed.
TURN_CHANCE: Final = 0.55
STOP_CHANCE: Final = 0.25


def drive_motion(seed: int, duration_s: float = 300.0) -> Motion:
    """Motion of a robot that cruises, turns in place and stops, 10 samples a second.

    The coordinate is that of `MotionSettings()`, with a field of view of 60 degrees and a scene scale of 2 m: cruising
    at 1 m/s adds 0.5 a second, turning in place at 45 degrees/s 0.75, stopping nothing. Each sample's step is a whole
    number of millionths. Changes of speed are instant. The duration, 0.1 to 10**6 s, is rounded to whole tenths.
    """
    checked("duration_s", duration_s, 0.1, 1e6)
    random = stream(seed)
    scale = MotionSettings()
    count = round(duration_s * US_PER_S / _STEP_US)
    step_s = _STEP_US / US_PER_S
    steps: list[int] = []
    phase = "cruise"
    while len(steps) < count:
        speed_m_per_s, turn_deg_per_s, lasts_s = (_drawn(random, limits) for limits in PHASES[phase])
        per_s = speed_m_per_s / scale.scene_scale_m + turn_deg_per_s / scale.fov_deg
        steps += [round(per_s * step_s * 1e6)] * max(1, round(lasts_s / step_s))
        uniform = float(random.random())
        if phase != "cruise" or uniform >= TURN_CHANCE + STOP_CHANCE:
            phase = "cruise"
        else:
            phase = "turn" if uniform < TURN_CHANCE else "stop"
    millionths = np.append(0, np.cumsum(steps[:count]))
    time_us = np.arange(count + 1, dtype=np.int64) * _STEP_US
    return Motion(f"drive-{seed}", time_us, millionths / 1e6, f"drive_motion(seed={seed}, {duration_s:g} s)")


def _drawn(random: np.random.Generator, limits: Limits) -> float:
    if limits == _NOTHING:
        return 0.0  # takes nothing from the stream
    return limits[0] + (limits[1] - limits[0]) * float(random.random())
