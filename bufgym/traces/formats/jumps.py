"""Poses that no robot can reach from the pose before: localisation was lost or set anew, or numbers are wrong."""

from typing import Final

import numpy as np

from bufgym.traces.formats.faults import StrPath, warn
from bufgym.traces.poses import Poses
from bufgym.traces.trace import US_PER_S

MAX_SPEED_M_PER_S: Final = 50
_STANDS_M: Final = 1.0  # Shorter ways are no jump at any speed: two poses may be logged within microseconds
_MOST_USUAL_S: Final = 0.1  # So may a car's of a usual step each, which came in a burst; but a slow topic jumps, too


def warn_of_jumps(path: StrPath, poses: Poses) -> None:
    """Warn of poses that no robot can reach from the pose before."""
    moved_m = np.linalg.norm(np.diff(poses.position_m, axis=0), axis=1)
    step_s = np.diff(poses.time_us) / US_PER_S
    usual_s = min(float(step_s.mean()), _MOST_USUAL_S)
    jumps = np.flatnonzero((moved_m > _STANDS_M) & (moved_m > MAX_SPEED_M_PER_S * np.maximum(step_s, usual_s)))
    if not len(jumps):
        return
    k = int(jumps[0])
    more = f", the first of {len(jumps)} jumps" if len(jumps) > 1 else ""
    warn(
        path,
        f"pose {k + 2} of {len(poses.time_us)} ({poses.format}), {poses.time_us[k + 1] / US_PER_S:.3f} s after the "
        f"first, is {moved_m[k]:.6g} m from the one {step_s[k]:.6g} s before{more}: no robot is faster than "
        f"{MAX_SPEED_M_PER_S} m/s, and x counts it as motion",
    )
