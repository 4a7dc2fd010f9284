"""How far the scene has moved on: a recording's coordinate over time, from a camera trajectory.

The coordinate is the fraction of the field of view that is new, summed over successive poses: rotation angle / field of
view + translation / scene scale. One unit is a view that shows nothing of the old one. A robot's odometry can compute
it on board, and it is the scalar over which Quantity of Information is counted.
"""

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from bufgym.jit import kernel
from bufgym.traces.plausible import NOISE, NOISE_POSES, doubt_of_noise
from bufgym.traces.poses import Poses, angles, gaps_between, longest_s, unit
from bufgym.traces.sheet import NONE, Facts, Sheet, time_facts
from bufgym.traces.trace import US_PER_S, Float64Array, Int64Array, first_true, freeze
from bufgym.utils.errors import BufgymError


@dataclass(frozen=True)
class MotionSettings:
    """How motion is measured."""

    fov_deg: float = 60.0
    """Horizontal field of view of the camera, degrees: Kinect of the TUM sequences 57, RealSense D435 69."""
    scene_scale_m: float = 2.0
    """Distance at which things are seen indoors, m; moving this far shows a new scene."""
    rate_hz: float = 30.0
    """Greatest rate at which poses are compared, 1/s: that of a camera. Motion capture at 100-300 Hz jitters by a
    fraction of a mm, and summing over every sample would count that as motion."""
    max_gap_s: float = 1.0
    """Longer times between poses are gaps, s. Motion across one counts as the straight way, the least possible."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0):
                raise BufgymError(f"{field.name} = {value}: must be a finite number above 0")


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion recording, checked when it is made; its arrays are read-only."""

    name: str
    """What to call it in tables."""
    time_us: Int64Array
    """int64[M], M >= 2, microseconds, strictly increasing from 0."""
    coordinate: Float64Array
    """float64[M], fraction of the field of view that is new, summed; non-decreasing from 0."""
    source: str = ""
    """Where it comes from, in words."""
    gaps: tuple[tuple[int, int], ...] = ()
    """(start, end) in microseconds of stretches without a pose, across which motion is taken as even."""
    sheet: Sheet = NONE
    """Facts and doubts."""

    def __post_init__(self) -> None:
        time_us = np.array(self.time_us)
        coordinate = np.array(self.coordinate, dtype=np.float64)
        if time_us.dtype != np.int64 or time_us.ndim != 1 or time_us.shape != coordinate.shape or time_us.size < 2:
            raise self._broken("time_us must be int64[M] and coordinate float64[M], with M >= 2")
        if not np.isfinite(coordinate).all() or time_us[0] != 0 or coordinate[0] != 0:
            raise self._broken("coordinate must be finite numbers, and both must begin with 0")
        for rule, broken in (
            ("time_us must increase", time_us[1:] <= time_us[:-1]),
            ("coordinate must not decrease", coordinate[1:] < coordinate[:-1]),
        ):
            if (k := first_true(broken)) is not None:
                raise self._broken(f"{rule} at index {k + 1}")
        freeze(self, time_us=time_us, coordinate=coordinate)

    def _broken(self, what: str) -> BufgymError:
        return BufgymError(f"motion {self.name!r}: {what}")

    @property
    def duration_us(self) -> int:
        """Time of the last sample, microseconds."""
        return int(self.time_us[-1])

    @property
    def total(self) -> float:
        """Coordinate at the end."""
        return float(self.coordinate[-1])

    @property
    def longest_gap_s(self) -> float:
        """The longest stretch in `gaps`, s; 0 if there is none."""
        return longest_s(self.gaps)

    def at(self, time_us: npt.ArrayLike) -> Float64Array:
        """Coordinate at each time (int64 microseconds, any shape), linear between samples.

        Past the end the recording begins again and its total is carried on, so the coordinate never decreases.
        """
        times = np.asarray(time_us, np.int64)
        coordinate = np.empty(times.shape)
        self.follow(times.ravel(), 0, coordinate.ravel())
        return coordinate

    def follow(self, time_us: Int64Array, start_us: int, coordinate: Float64Array) -> None:
        """Write the coordinate at each of ``time_us``, counted from ``start_us`` on, into ``coordinate``."""
        if (negative := _follow(self.time_us, self.coordinate, time_us, start_us, coordinate)) < 0:
            raise self._broken(f"time_us = {negative}: must be >= 0")


@kernel
def _before(knot_us: Int64Array, t: int) -> int:
    """Index of the last knot at or before ``t``; at least one is."""
    low, high = 0, len(knot_us)
    while high - low > 1:
        middle = (low + high) // 2
        if knot_us[middle] <= t:
            low = middle
        else:
            high = middle
    return low


@kernel
def _follow(knot_us: Int64Array, y: Float64Array, time_us: Int64Array, start_us: int, coordinate: Float64Array) -> int:
    """Do what ``Motion.follow`` says; return the first negative time, or 0."""
    duration_us, j = knot_us[-1], 0
    for k in range(len(time_us)):
        t, gone = start_us + time_us[k], 0.0
        if t < 0:
            return int(t)
        if t >= duration_us:
            gone = t // duration_us * y[-1]
            t %= duration_us
        if t >= knot_us[j + 1]:
            j += 1  # the usual case: times in order, about as far apart as the samples
        if not knot_us[j] <= t < knot_us[j + 1]:
            j = _before(knot_us, t)
        slope = (y[j + 1] - y[j]) / (knot_us[j + 1] - knot_us[j])
        coordinate[k] = gone + (slope * (t - knot_us[j]) + y[j])
    return 0


def motion_from_poses(
    poses: Poses, settings: MotionSettings | None = None, *, name: str = "motion", source: str = ""
) -> Motion:
    """Sum rotation / field of view + translation / scene scale over successive poses.

    Poses that come faster than the settings' rate (by their median distance) are first resampled to it: positions along
    a line, orientations along the shortest arc (slerp). Slower ones are used as they are. Quaternions need not be
    exactly of norm 1.
    """
    settings = settings or MotionSettings()
    gaps, recorded = gaps_between(poses.time_us, settings.max_gap_s), poses
    # A recording at just this rate jitters by some percent, and must not be resampled for that.
    if np.median(np.diff(poses.time_us)) < 0.9 * US_PER_S / settings.rate_hz:
        poses = poses.resampled(settings.rate_hz)
    else:
        poses = replace(poses, quaternion=unit(poses.quaternion))
    turned, moved = _steps(poses, settings)
    motion = Motion(name, poses.time_us, np.append(0.0, np.cumsum(turned + moved)), source, gaps)
    shares = {} if not motion.total else {k: _share(poses, settings, k) / motion.total for k in _compared(poses)}
    doubt = doubt_of_noise(shares, motion.total)
    facts = _facts(recorded, motion, settings, turned, moved)
    share_fact = ("x of every second", f"{shares.get(2, 1):.2f} of x, of {len(poses.time_us):,} poses compared")
    return replace(motion, sheet=Sheet((*facts, share_fact), (doubt,) if doubt else ()))


def _compared(poses: Poses) -> list[int]:
    """Every how many poses x is summed again: those of the noise rule that are at most a second, and 2."""
    most = US_PER_S / float(np.median(np.diff(poses.time_us)))
    return [k for k in NOISE if k == min(NOISE) or k <= most] if len(poses.time_us) >= NOISE_POSES else []


def _share(poses: Poses, settings: MotionSettings, k: int) -> float:
    """Motion by every ``k``-th pose alone."""
    some = Poses(poses.time_us[::k], poses.position_m[::k], poses.quaternion[::k])
    return float(sum(part.sum() for part in _steps(some, settings)))


def _steps(poses: Poses, settings: MotionSettings) -> tuple[Float64Array, Float64Array]:
    """Rotation / field of view and translation / scene scale from each pose to the next, float64[n-1] each."""
    turned = [angles(piece.quaternion[:-1], piece.quaternion[1:]) for piece in poses.pieces()]
    moved = [np.linalg.norm(np.diff(piece.position_m, axis=0), axis=1) for piece in poses.pieces()]
    return np.concatenate(turned) / math.radians(settings.fov_deg), np.concatenate(moved) / settings.scene_scale_m


def _facts(poses: Poses, motion: Motion, settings: MotionSettings, turned: Float64Array, moved: Float64Array) -> Facts:
    """Facts of recorded poses, and of both parts of x from each compared pose to the next."""
    steps_s, duration_s = np.diff(motion.time_us) / US_PER_S, motion.duration_us / US_PER_S
    path_m, turned_deg, moved_m = poses.path_m(), turned * settings.fov_deg, moved * settings.scene_scale_m
    even = steps_s >= 0.5 * float(np.median(steps_s))  # the last step of a grid may be short
    fastest, turning = (float((parts / steps_s)[even].max()) for parts in (moved_m, turned_deg))
    return (
        *time_facts("poses", poses.time_us, poses.start_us),
        ("path", f"{path_m:,.6g} m, {moved_m.sum() / duration_s:.4g} m/s (mean), at most {fastest:.4g}"),
        (
            "turned",
            f"{turned_deg.sum():,.6g} degrees, {turned_deg.sum() / duration_s:.4g} a second, at most {turning:.4g}",
        ),
        ("x", f"{moved.sum():.3f} by translation, {turned.sum():.3f} by rotation"),
    )
