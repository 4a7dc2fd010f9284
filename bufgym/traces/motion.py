"""How far the scene has moved on: a recording's coordinate over time, from a camera trajectory.

The coordinate is the fraction of the field of view that is new, summed over successive poses:
rotation angle / field of view + translation / scene scale. One unit is a view with nothing left of the old
one. It is what a robot's odometry can tell on board, and the scalar over which Quantity of Information is
counted.

Trajectories come in the formats of `poses.py` (TUM, EuRoC, KITTI), as ground truth or from any odometry. Finished
coordinates are kept in CSV files with the header `t_s,motion`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from bufgym.errors import BufgymError, TraceError, where
from bufgym.traces.files import Line, StrPath, TextFile, write_text
from bufgym.traces.poses import Poses, angles, read_poses, read_rows, seconds
from bufgym.traces.readers import trace_name
from bufgym.traces.trace import US_PER_S, Float64Array, Int64Array

MOTION_HEADER: Final = "t_s,motion"

# Horizontal field of view of the cameras in question: Kinect of the TUM sequences 57 degrees, RealSense D435
# 69.
DEFAULT_FOV_DEG: Final = 60.0
# Distance at which things are seen indoors; moving by as much shows a new scene.
DEFAULT_SCENE_SCALE_M: Final = 2.0
# Camera rate. Motion capture at 100-300 Hz jitters by a fraction of a mm; adding up every sample counts that
# as motion.
DEFAULT_RATE_HZ: Final = 30.0
DEFAULT_MAX_GAP_S: Final = 1.0

MAX_COORDINATE: Final = 1e9


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion recording, checked when it is made; its arrays are read-only.

    Attributes:
        name: what to call it in tables.
        time_us: int64[M], M >= 2, microseconds, strictly increasing from 0.
        coordinate: float64[M], fraction of the field of view that is new, summed; non-decreasing from 0.
        source: where it comes from, in words.
        gaps: (start, end) in microseconds of stretches without a pose, across which motion is taken as even.

    Raises:
        BufgymError: an array breaks one of these rules.
    """

    name: str
    time_us: Int64Array
    coordinate: Float64Array
    source: str = ""
    gaps: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        time_us = np.array(self.time_us)
        coordinate = np.array(self.coordinate, dtype=np.float64)
        if time_us.dtype != np.int64 or time_us.ndim != 1 or time_us.shape != coordinate.shape or time_us.size < 2:
            raise self._broken("time_us must be int64[M] and coordinate float64[M], with M >= 2")
        if not np.isfinite(coordinate).all() or time_us[0] != 0 or coordinate[0] != 0:
            raise self._broken("coordinate must be finite numbers, and both must begin with 0")
        for what, bad in (
            ("time_us must increase", time_us[1:] <= time_us[:-1]),
            ("coordinate must not decrease", coordinate[1:] < coordinate[:-1]),
        ):
            if bad.any():
                raise self._broken(f"{what} at index {int(np.argmax(bad)) + 1}")
        for field, values in (("time_us", time_us), ("coordinate", coordinate)):
            values.flags.writeable = False
            object.__setattr__(self, field, values)

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
        """The longest stretch in `gaps`, s; 0 where there is none."""
        return max((end - start for start, end in self.gaps), default=0) / US_PER_S

    def at(self, time_us: npt.ArrayLike) -> Float64Array:
        """Coordinate at each time (int64 microseconds, any shape), linear between samples.

        Past the end the recording begins again and its total is carried on, so the coordinate never
        decreases.

        Raises:
            BufgymError: a time before 0.
        """
        times = np.asarray(time_us, dtype=np.int64)
        if (times < 0).any():
            raise self._broken(f"time_us = {times.min()}: must be >= 0")
        laps, inside = np.divmod(times, self.duration_us)
        return np.asarray(laps * self.total + np.interp(inside, self.time_us, self.coordinate), dtype=np.float64)


def read_motion(
    path: StrPath,
    *,
    fov_deg: float = DEFAULT_FOV_DEG,
    scene_scale_m: float = DEFAULT_SCENE_SCALE_M,
    rate_hz: float = DEFAULT_RATE_HZ,
    max_gap_s: float = DEFAULT_MAX_GAP_S,
    format: str | None = None,
    times: StrPath | None = None,
) -> Motion:
    """Read a trajectory (TUM, EuRoC, KITTI) or a `t_s,motion` CSV, plain or gzip'd, told apart by the first line.

    The first time becomes 0. The other arguments are for trajectories (see `motion_from_poses`; `poses.read_poses`
    for ``format`` and ``times``); a CSV holds finished coordinates, which are taken as they are, less the first.
    Stretches without a pose are bridged and listed in `Motion.gaps`.

    Raises:
        TraceError: the file cannot be read, or a line breaks a rule of its format. The message names the file, the
            line, the value and the rule.
        BufgymError: an argument that is not a finite number above 0, or a format that does not exist.
    """
    with TextFile(path) as file:
        first = next((line for line in file.lines() if not line.text.startswith("#")), None)
    if first is None:
        raise TraceError(where(path, None, None, "is empty: must hold a trajectory or a motion recording"))
    if format is None and times is None and _is_header(first.text):
        time_us, values = read_rows(path, _motion_row, skip=first.number)
        return Motion(trace_name(path), time_us, values[:, 0] - values[0, 0], f"{path} ({MOTION_HEADER})")
    poses = read_poses(path, format=format, times=times)
    return motion_from_poses(
        poses.time_us,
        poses.position_m,
        poses.quaternion,
        fov_deg=fov_deg,
        scene_scale_m=scene_scale_m,
        rate_hz=rate_hz,
        max_gap_s=max_gap_s,
        name=trace_name(path),
        source=f"{path} (trajectory, format {poses.format})",
    )


def motion_from_poses(
    time_us: Int64Array,
    position_m: Float64Array,
    quaternion: Float64Array,
    *,
    fov_deg: float = DEFAULT_FOV_DEG,
    scene_scale_m: float = DEFAULT_SCENE_SCALE_M,
    rate_hz: float = DEFAULT_RATE_HZ,
    max_gap_s: float = DEFAULT_MAX_GAP_S,
    name: str = "motion",
    source: str = "",
) -> Motion:
    """Sum rotation / field of view + translation / scene scale over successive poses.

    Poses that come faster than `rate_hz` (by their median distance) are first resampled to it: positions
    along a line, orientations along the shortest arc (slerp). Slower ones are used as they are.

    Args:
        time_us: int64[n], n >= 2, microseconds, increasing from 0.
        position_m: float64[n, 3].
        quaternion: float64[n, 4], any order of the four, norm near 1; q and -q are the same orientation.
        fov_deg: field of view, degrees.
        scene_scale_m: distance after which the scene is a new one, m.
        rate_hz: greatest rate at which poses are compared, 1/s.
        max_gap_s: longer times between poses are listed in `Motion.gaps`, s. Motion across a gap counts as
            the straight way from its first pose to its last, the least that can have happened.

    Raises:
        BufgymError: an argument that is not a finite number above 0.
    """
    for what, value in (
        ("fov_deg", fov_deg),
        ("scene_scale_m", scene_scale_m),
        ("rate_hz", rate_hz),
        ("max_gap_s", max_gap_s),
    ):
        if not (math.isfinite(value) and value > 0):
            raise BufgymError(f"{what} = {value}: must be a finite number above 0")
    unit = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    poses = Poses(time_us, position_m, unit)
    gaps = poses.gaps(max_gap_s)
    # A recording at the wanted rate jitters by some percent, and must not be resampled for that.
    if np.median(np.diff(time_us)) < 0.9 * US_PER_S / rate_hz:
        poses = poses.resampled(rate_hz)
    turned_rad = angles(poses.quaternion[:-1], poses.quaternion[1:])
    moved_m = np.linalg.norm(np.diff(poses.position_m, axis=0), axis=1)
    steps = turned_rad / math.radians(fov_deg) + moved_m / scene_scale_m
    return Motion(name, poses.time_us, np.append(0.0, np.cumsum(steps)), source, gaps)


def write_motion_csv(motion: Motion, path: StrPath) -> None:
    """Write `t_s,motion`; `read_motion` gives back the same times and coordinates, bit for bit.

    Raises:
        TraceError: the file cannot be written.
    """
    rows = (
        f"{t // US_PER_S}.{t % US_PER_S:06d}".rstrip("0").rstrip(".") + f",{x!r}\n"
        for t, x in zip(motion.time_us.tolist(), motion.coordinate.tolist(), strict=True)
    )
    write_text(path, [MOTION_HEADER + "\n"], rows)


def _is_header(text: str) -> bool:
    return ",".join(cell.strip() for cell in text.split(",")) == MOTION_HEADER


def _motion_row(line: Line, previous: list[float] | None) -> tuple[str, int, list[float]]:
    """Time, then the coordinate, which must not decrease."""
    time, text = line.columns(2, ",")
    value = line.decimal("motion", text, 0, MAX_COORDINATE)
    if previous is not None and value < previous[0]:
        raise line.error(text, f"must not be below the line above ({previous[0]!r})", "motion")
    return time, seconds(line, time), [value]
