"""Poses that no robot can reach from the pose before: jumps, and the hops of two tracks in one stream."""

from typing import Final

import numpy as np
import numpy.typing as npt

from bufgym.traces.formats.faults import StrPath, warn
from bufgym.traces.motion import MotionSettings, motion_steps
from bufgym.traces.poses import Poses
from bufgym.traces.trace import US_PER_S, Float64Array, Int64Array

MAX_SPEED_M_PER_S: Final = 50
_STANDS_M: Final = 1.0  # Shorter ways are no jump at any speed: two poses may be logged within microseconds
_MOST_USUAL_S: Final = 0.1  # So may a car's of a usual step each, which came in a burst; but a slow topic jumps, too

_LEAST_HOP: Final = 0.02  # Fields of view, 4 cm: less is the noise of localisation
_BACK: Final = 0.25  # Of a hop: so near to an earlier pose is the one after it
_BURST: Final = 8  # Poses within which a stream comes back to a track
_HOP_PER_S: Final = 0.5  # Least speed of a hop that is not the very next pose's, fields of view a second
_FEWEST: Final = 5  # Hops
_SHARE: Final = 0.25  # Of all motion, in hops


def warn_of_leaps(path: StrPath, poses: Poses) -> None:
    """Warn of jumps, and of two tracks."""
    _warn_of_jumps(path, poses)
    _warn_of_tracks(path, poses)


def _warn_of_jumps(path: StrPath, poses: Poses) -> None:
    """Warn of poses that no robot can reach from the pose before: localisation was lost, or numbers are wrong."""
    moved_m = np.concatenate([np.linalg.norm(np.diff(piece.position_m, axis=0), axis=1) for piece in poses.pieces()])
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


def _warn_of_tracks(path: StrPath, poses: Poses) -> None:
    """Warn of poses that hop to and fro between two tracks, as those of two publishers of one topic do."""
    settings = MotionSettings()
    steps = motion_steps(poses, settings)
    far = np.flatnonzero(steps > _LEAST_HOP)
    if len(far) < _FEWEST or steps[far].sum() < _SHARE * steps.sum():
        return
    hops = far[_comes_back(poses, far, steps[far])]
    if len(hops) < _FEWEST or steps[hops].sum() < _SHARE * steps.sum():
        return
    k = int(hops[0])
    apart_m = float(np.median(np.linalg.norm(poses.position_m[hops + 1] - poses.position_m[hops], axis=1)))
    warn(
        path,
        f"{len(hops)} of {len(poses.time_us)} poses ({poses.format}) hop between two tracks that are {apart_m:.3g} m "
        f"apart (median), first pose {k + 2}, {poses.time_us[k + 1] / US_PER_S:.3f} s after the first: two sources in "
        "one stream? x counts each hop as motion (choose another topic or frame, or record one source alone)",
    )


def _comes_back(poses: Poses, far: Int64Array, hop: Float64Array) -> npt.NDArray[np.bool_]:
    """Whether the pose after each of these steps is near to one that came shortly before the step."""
    settings = MotionSettings()
    fast = hop * US_PER_S > _HOP_PER_S * (poses.time_us[far + 1] - poses.time_us[far])
    back = np.zeros(len(far), np.bool_)
    for lag in range(2, _BURST + 1):
        there = far + 1 - lag >= 0
        ends = np.stack([far[there] + 1 - lag, far[there] + 1], axis=1).ravel()
        picked = Poses(ends, poses.position_m[ends], poses.quaternion[ends])
        near = motion_steps(picked, settings)[::2] < _BACK * hop[there]
        back[there] |= near & (fast[there] | (lag == 2))
    return back
