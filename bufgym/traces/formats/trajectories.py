"""Camera poses from the trajectory files of public data sets.

| format | a line | used by |
|---|---|---|
| `tum` | `t tx ty tz qx qy qz qw`: s, m, unit quaternion | TUM RGB-D [sturm2012tum]; any odometry |
| `euroc` | `t px py pz qw qx qy qz`: ns, m; blanks or commas | EuRoC [burri2016euroc] |
| `kitti` | a 3x4 matrix row by row, m; the times (s, one a line) in another file | KITTI [geiger2012kitti] |

The format is recognised by the first line: 12 numbers are KITTI's; a header with `timestamp [ns]`, or commas, EuRoC's;
anything else must be TUM's.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Callable, Iterator
from decimal import Decimal
from pathlib import Path
from typing import Final

import numpy as np

from bufgym.ground.errors import BufgymError
from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.text import Line, open_text, split_cells
from bufgym.traces.poses import Poses, quaternions, unit
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S, Float64Array, Int64Array

POSE_FORMATS: Final = ("tum", "euroc", "kitti")

MAX_POSITION_M: Final = 1e7
NORM_TOLERANCE: Final = 0.01
# Seconds since 1970 until the year 5138; a time in ns exceeds it.
_MAX_EPOCH_S: Final = 1e11
_EUROC_HEADER: Final = re.compile(r"#\s*timestamp\s*\[ns\]")
# The state estimates of EuRoC's own CSV files continue with velocity and biases.
_EUROC_COLUMNS: Final = (8, 17)

RowReader = Callable[[Line, list[float] | None], tuple[str, int, list[float]]]
"""Parses a line, given the values of the previous one, into the time as it is written, the time in us, and values."""


def read_poses(path: StrPath, *, format: str | None = None, times: StrPath | None = None) -> Poses:
    """Read a trajectory, plain or gzip'd; the first time becomes 0.

    Args:
        path: the file.
        format: one of `POSE_FORMATS`; by default recognised by the first line.
        times: KITTI's file of times; by default the file of the same name with ``_times`` beside it.

    Raises:
        TraceError: the file cannot be read, or a line breaks a rule: as many finite numbers as the format has,
            positions within 10**7 m, a quaternion of unit norm (a rotation matrix) within 1 %, times that never
            decrease and span at most 10**7 s, at least two lines. The message names file, line, value and rule.
        BufgymError: an unknown format, or `times` with another format than KITTI's.
    """
    format = format or detect_pose_format(path)
    if format not in POSE_FORMATS:
        raise BufgymError(f"format = {format!r}: must be one of {', '.join(POSE_FORMATS)}")
    if format == "kitti":
        return _read_kitti(path, times)
    if times is not None:
        raise BufgymError(f"times = {str(times)!r}: goes with KITTI matrices only, and {path} is in format {format}")
    time_us, values = read_rows(path, _tum_row if format == "tum" else _euroc_row)
    return Poses(time_us, values[:, :3], unit(values[:, 3:]), format)


def detect_pose_format(path: StrPath) -> str:
    """The format that the file's first lines fit (see above)."""
    with open_text(path) as file:
        for line in file.lines():
            if line.text.startswith("#"):
                if _EUROC_HEADER.match(line.text):
                    return "euroc"
            elif "," in line.text:
                return "euroc"
            else:
                return "kitti" if len(line.text.split()) == 12 else "tum"
    raise fault(path, "is empty: must hold a trajectory or a motion recording")


def read_rows(path: StrPath, read_row: RowReader, skip: int = 0) -> tuple[Int64Array, Float64Array]:
    """Times int64[n] in microseconds from 0, and values float64[n, columns], of the lines after number `skip`.

    If several lines have the same time, as in freiburg2_desk, the last counts.
    """
    times = array("q")
    rows: list[list[float]] = []
    with open_text(path) as file:
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
        raise fault(path, f"holds {len(times)} samples: must hold at least 2")
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
    cells = split_cells(line.text) if "," in line.text else line.text.split()
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


def _read_kitti(path: StrPath, times: StrPath | None) -> Poses:
    times = _times_beside(path) if times is None else times
    stamps = _read_times(times)

    def row(line: Line, previous: list[float] | None) -> tuple[str, int, list[float]]:
        cells = line.columns(12)
        values = [line.decimal(f"number {k + 1}", t, -MAX_POSITION_M, MAX_POSITION_M) for k, t in enumerate(cells)]
        rotation = np.array(values).reshape(3, 4)[:, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > NORM_TOLERANCE or np.linalg.det(rotation) < 0:
            raise line.error(line.text, "its left 3x3 part must be a rotation within 1 %")
        text, time_us = next(stamps, ("", -1))
        if time_us < 0:
            raise line.error(None, f"must have a time, but {times} has no more")
        return text, time_us, values

    time_us, values = read_rows(path, row)
    if next(stamps, None) is not None:
        raise fault(times, f"holds more times than {path} has poses")
    matrices = values.reshape(-1, 3, 4)
    return Poses(time_us, matrices[:, :, 3], quaternions(matrices[:, :, :3]), f"kitti, times from {Path(times).name}")


def _read_times(path: StrPath) -> Iterator[tuple[str, int]]:
    with open_text(path) as file:
        for line in file.lines():
            (text,) = line.columns(1)
            yield text, seconds(line, text)


def _times_beside(path: StrPath) -> Path:
    """The file with the times of these matrices: NAME_times.txt beside NAME.txt, gzip'd or not."""
    stem = Path(path).name.removesuffix(".gz").removesuffix(".txt")
    for suffix in (".txt", ".txt.gz"):
        times = Path(path).with_name(f"{stem}_times{suffix}")
        if times.is_file():
            return times
    rule = f"holds KITTI matrices, which carry no time: say where the times are (times=...; no {stem}_times.txt beside)"
    raise fault(path, rule)
