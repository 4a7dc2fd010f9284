"""Where a camera or a robot was: poses over time, from the trajectory files of public data sets, and their geometry.

| format | a line | where found |
|---|---|---|
| `tum` | `t tx ty tz qx qy qz qw`: s, m, unit quaternion | TUM RGB-D (Sturm et al., IROS 2012); any odometry |
| `euroc` | `t px py pz qw qx qy qz`: ns, m; blanks or commas | EuRoC (Burri et al., IJRR 2016) |
| `kitti` | a 3x4 matrix row by row, m; the times (s, one a line) in another file | KITTI (Geiger et al., CVPR 2012) |

The format is told from the first line: 12 numbers are KITTI's; a header with `timestamp [ns]`, or commas, EuRoC's;
anything else must be TUM's. Between two poses the position moves along a line and the orientation along the shortest
arc (slerp; K. Shoemake, "Animating Rotation with Quaternion Curves", SIGGRAPH 1985).
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Final

import numpy as np

from bufgym.errors import BufgymError, TraceError, where
from bufgym.traces.files import Line, StrPath, TextFile
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S, Float64Array, Int64Array

POSE_FORMATS: Final = ("tum", "euroc", "kitti")

MAX_POSITION_M: Final = 1e7
NORM_TOLERANCE: Final = 0.01
# Seconds since 1970 until the year 5138; a time in ns is caught by it.
_MAX_EPOCH_S: Final = 1e11
_EUROC_HEADER: Final = re.compile(r"#\s*timestamp\s*\[ns\]")
# The state estimates of EuRoC's own CSV files go on with velocity and biases.
_EUROC_COLUMNS: Final = (8, 17)

RowReader = Callable[[Line, list[float] | None], tuple[str, int, list[float]]]
"""Takes a line apart, given the values of the one before: time as it stands, time in us, values."""


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses over time; times increase from 0.

    Attributes:
        time_us: int64[n], n >= 2, microseconds.
        position_m: float64[n, 3].
        quaternion: float64[n, 4], unit; any order of the four, q and -q being one orientation.
        format: what they were read from.
    """

    time_us: Int64Array
    position_m: Float64Array
    quaternion: Float64Array
    format: str = ""

    def gaps(self, max_gap_s: float) -> tuple[tuple[int, int], ...]:
        """(start, end) in us of each stretch longer than ``max_gap_s`` without a pose."""
        long = np.flatnonzero(np.diff(self.time_us) > max_gap_s * US_PER_S)
        return tuple((int(self.time_us[k]), int(self.time_us[k + 1])) for k in long)

    def at(self, time_us: Int64Array) -> Poses:
        """The poses at these times, int64[m] within the recording: position linear, orientation by slerp."""
        k = np.clip(np.searchsorted(self.time_us, time_us, side="right") - 1, 0, self.time_us.size - 2)
        share = ((time_us - self.time_us[k]) / (self.time_us[k + 1] - self.time_us[k]))[:, None]
        position = self.position_m[k] + share * (self.position_m[k + 1] - self.position_m[k])
        return Poses(time_us, position, slerp(self.quaternion[k], self.quaternion[k + 1], share), self.format)

    def resampled(self, rate_hz: float) -> Poses:
        """The poses at multiples of 1 / rate_hz and at the end."""
        end_us = self.time_us[-1]
        grid_us = np.rint(np.arange(int(end_us * rate_hz / US_PER_S) + 1) * (US_PER_S / rate_hz)).astype(np.int64)
        return self.at(np.append(grid_us[grid_us < end_us], end_us))


# --- geometry --------------------------------------------------------------------------------------------------------


def slerp(start: Float64Array, end: Float64Array, share: Float64Array) -> Float64Array:
    """Unit quaternions on the shortest arc from start to end, each float64[m, 4]; share is float64[m, 1]."""
    cosine = np.sum(start * end, axis=1, keepdims=True)
    end = np.where(cosine < 0, -end, end)
    half = 2 * np.arctan2(np.linalg.norm(end - start, axis=1), np.linalg.norm(end + start, axis=1))[:, None]
    sine = np.sin(half)
    near = sine < 1e-9  # so close that arc and chord are one
    safe = np.where(near, 1.0, sine)
    mixed = np.where(
        near,
        (1 - share) * start + share * end,
        (np.sin((1 - share) * half) * start + np.sin(share * half) * end) / safe,
    )
    return np.asarray(mixed / np.linalg.norm(mixed, axis=1, keepdims=True), dtype=np.float64)


def angles(a: Float64Array, b: Float64Array) -> Float64Array:
    """Rotation angle in rad, 0..pi, between unit quaternions float64[m, 4].

    By the half-angle's tangent: an arc cosine would lose the small angles between neighbouring poses.
    """
    b = np.where(np.sum(a * b, axis=1, keepdims=True) < 0, -b, b)
    half = 2 * np.arctan2(np.linalg.norm(b - a, axis=1), np.linalg.norm(b + a, axis=1))
    return np.asarray(2 * half, dtype=np.float64)


def quaternions(rotation: Float64Array) -> Float64Array:
    """Unit quaternions (x, y, z, w), float64[m, 4], of rotation matrices float64[m, 3, 3].

    Each from the largest of its four components, which is 0.5 at least, so that nothing small is divided by (S. W.
    Shepperd, "Quaternion from Rotation Matrix", J. Guidance and Control 1978).
    """
    r = rotation
    trace = r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2]
    # Row i of each symmetric matrix is 4 q_i (x, y, z, w).
    rows = np.empty((len(r), 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rows[:, i, i] = 1 + 2 * r[:, i, i] - trace
        rows[:, i, j] = rows[:, j, i] = r[:, i, j] + r[:, j, i]
        rows[:, i, 3] = rows[:, 3, i] = r[:, k, j] - r[:, j, k]
    rows[:, 3, 3] = 1 + trace
    largest = np.argmax(np.diagonal(rows, axis1=1, axis2=2), axis=1)
    found = rows[np.arange(len(r)), largest]
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True), dtype=np.float64)


# --- trajectory files ------------------------------------------------------------------------------------------------


def read_poses(path: StrPath, *, format: str | None = None, times: StrPath | None = None) -> Poses:
    """Read a trajectory, plain or gzip'd; the first time becomes 0.

    Args:
        path: the file.
        format: one of `POSE_FORMATS`; by default told from the first line.
        times: KITTI's file of times; by default the file of the same name with ``_times`` beside it.

    Raises:
        TraceError: the file cannot be read, or a line breaks a rule: as many finite numbers as the format has,
            positions within 10**7 m, a quaternion of unit norm (a rotation matrix) within 1 %, times that never go
            back and span at most 10**7 s, two lines at least. The message names file, line, value and rule.
        BufgymError: an unknown format, or ``times`` for another than KITTI's.
    """
    format = format or detect_pose_format(path)
    if format not in POSE_FORMATS:
        raise BufgymError(f"format = {format!r}: must be one of {', '.join(POSE_FORMATS)}")
    if format == "kitti":
        return _read_kitti(path, times)
    if times is not None:
        raise BufgymError(f"times = {str(times)!r}: goes with KITTI matrices only, and {path} is in format {format}")
    time_us, values = read_rows(path, _tum_row if format == "tum" else _euroc_row)
    return Poses(time_us, values[:, :3], _units(values[:, 3:]), format)


def detect_pose_format(path: StrPath) -> str:
    """The format that the file's first lines fit (see above)."""
    with TextFile(path) as file:
        for line in file.lines():
            if line.text.startswith("#"):
                if _EUROC_HEADER.match(line.text):
                    return "euroc"
            elif "," in line.text:
                return "euroc"
            else:
                return "kitti" if len(line.text.split()) == 12 else "tum"
    raise TraceError(where(path, None, None, "is empty: must hold a trajectory or a motion recording"))


def read_rows(path: StrPath, read_row: RowReader, skip: int = 0) -> tuple[Int64Array, Float64Array]:
    """Times int64[n] in microseconds from 0, values float64[n, columns], of the lines after number `skip`.

    Of lines with one and the same time (freiburg2_desk has some) the last counts.
    """
    times = array("q")
    rows: list[list[float]] = []
    with TextFile(path) as file:
        for line in file.lines():
            if line.number <= skip or line.text.startswith("#"):
                continue
            text, time_us, row = read_row(line, rows[-1] if rows else None)
            if times and time_us < times[-1]:
                rule = f"must not be before the line above ({times[-1] / US_PER_S:.6f})"
                raise line.error(text, rule, "time in s")
            if times and time_us - times[0] > MAX_DURATION_S * US_PER_S:
                raise line.error(text, f"must be at most {MAX_DURATION_S} s after the first", "time in s")
            if times and time_us == times[-1]:
                rows[-1] = row
                continue
            times.append(time_us)
            rows.append(row)
    if len(times) < 2:
        raise TraceError(where(path, None, None, f"holds {len(times)} samples: must hold at least 2"))
    time_array = np.asarray(times, np.int64)
    return time_array - time_array[0], np.array(rows, np.float64)


def seconds(line: Line, text: str) -> int:
    """A time in s, as microseconds."""
    return round(line.decimal("time in s", text, 0, _MAX_EPOCH_S) * US_PER_S)


def _tum_row(line: Line, previous: list[float] | None) -> tuple[str, int, list[float]]:
    cells = line.columns(8)
    values = _pose(line, cells[1:], ("tx", "ty", "tz", "qx", "qy", "qz", "qw"))
    return cells[0], seconds(line, cells[0]), values


def _euroc_row(line: Line, previous: list[float] | None) -> tuple[str, int, list[float]]:
    cells = [cell.strip() for cell in line.text.split("," if "," in line.text else None)]
    if len(cells) not in _EUROC_COLUMNS:
        raise line.error(line.text, f"must have 8 columns (or the 17 of a state estimate), has {len(cells)}")
    line.decimal("time in ns", cells[0], 0, _MAX_EPOCH_S * 1e9)
    # A float holds such a time to 256 ns only.
    time_us = int(Decimal(cells[0])) // 1000
    return cells[0], time_us, _pose(line, cells[1:8], ("px", "py", "pz", "qw", "qx", "qy", "qz"))


def _pose(line: Line, cells: list[str], names: tuple[str, ...]) -> list[float]:
    """Position and quaternion."""
    values = [
        line.decimal(name, text, -MAX_POSITION_M, MAX_POSITION_M) for name, text in zip(names, cells, strict=True)
    ]
    norm = math.hypot(*values[3:])
    if abs(norm - 1) > NORM_TOLERANCE:
        raise line.error(f"{norm:.6g}", "must be 1 within 1 %", "norm of the quaternion")
    return values


def _units(quaternion: Float64Array) -> Float64Array:
    return np.asarray(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True), dtype=np.float64)


def _read_kitti(path: StrPath, times: StrPath | None) -> Poses:
    times = _times_beside(path) if times is None else times
    known = _read_times(times)

    def row(line: Line, previous: list[float] | None) -> tuple[str, int, list[float]]:
        cells = line.columns(12)
        values = [line.decimal(f"number {k + 1}", t, -MAX_POSITION_M, MAX_POSITION_M) for k, t in enumerate(cells)]
        rotation = np.array(values).reshape(3, 4)[:, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > NORM_TOLERANCE or np.linalg.det(rotation) < 0:
            raise line.error(line.text, "its left 3x3 part must be a rotation within 1 %")
        text, time_us = next(known, ("", -1))
        if time_us < 0:
            raise line.error(None, f"must have a time, but {times} has no more")
        return text, time_us, values

    time_us, values = read_rows(path, row)
    if next(known, None) is not None:
        raise TraceError(where(times, None, None, f"holds more times than {path} has poses"))
    matrices = values.reshape(-1, 3, 4)
    return Poses(time_us, matrices[:, :, 3], quaternions(matrices[:, :, :3]), f"kitti, times from {Path(times).name}")


def _read_times(path: StrPath) -> Iterator[tuple[str, int]]:
    with TextFile(path) as file:
        for line in file.lines():
            (text,) = line.columns(1)
            yield text, seconds(line, text)


def _times_beside(path: StrPath) -> Path:
    """The file with the times of these matrices: NAME_times.txt beside NAME.txt, gzip'd or not."""
    stem = Path(path).name.removesuffix(".gz").removesuffix(".txt")
    for ending in (".txt", ".txt.gz"):
        found = Path(path).with_name(f"{stem}_times{ending}")
        if found.is_file():
            return found
    rule = f"holds KITTI matrices, which carry no time: say where the times are (times=...; no {stem}_times.txt beside)"
    raise TraceError(where(path, None, None, rule))
