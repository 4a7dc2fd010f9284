"""Camera poses from the trajectory files of public data sets.

| format | a line | used by |
|---|---|---|
| `tum` | `t tx ty tz qx qy qz qw`: s, m, unit quaternion | TUM RGB-D [sturm2012tum]; any odometry |
| `euroc` | `t px py pz qw qx qy qz`: ns, m; a state estimate has 11 or 17 columns | EuRoC [burri2016euroc], VINS |
| `kitti` | a 3x4 matrix row by row, m; the times (one a line) in another file | KITTI [geiger2012kitti] |

Columns of TUM and EuRoC are separated by blanks or commas. The format is recognised by the first lines: 12 numbers are
KITTI's; a header such as `#timestamp [ns]`, or more than 8 columns, EuRoC's. Without such a header `_unit` finds the
unit of the times. Then 8 columns in seconds, or between blanks, are TUM's, and other 8 are EuRoC's. x does not depend
on the order of a quaternion's four.
"""

import math
import re
from array import array
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Final

import numpy as np

from bufgym.ground.errors import BufgymError
from bufgym.traces.formats.faults import StrPath, fault, warn
from bufgym.traces.formats.text import NUMBER, Line, open_text, split_cells
from bufgym.traces.poses import Poses, quaternions
from bufgym.traces.poses import unit as normalized
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S, Float64Array, Int64Array

POSE_FORMATS: Final = ("tum", "euroc", "kitti")

MAX_POSITION_M: Final = 1e7
NORM_TOLERANCE: Final = 0.01
# Seconds since 1970 until the year 5138; a time in ns exceeds it.
_MAX_EPOCH_S: Final = 1e11
_MIN_EPOCH_S: Final = 6e8  # A clock that counts from 1970 shows more, and less than the next
_NEAR_EPOCH_S: Final = 4.2e9
_EUROC_HEADER: Final = re.compile(r"#\s*timestamp\s*\[(s|ms|us|ns)\]")
# State estimates continue with the velocity, those of EuRoC's own CSV files also with biases.
_COLUMNS: Final = {"tum": (8,), "euroc": (8, 11, 17)}
_NAMES: Final = {"tum": ("tx", "ty", "tz", "qx", "qy", "qz", "qw"), "euroc": ("px", "py", "pz", "qw", "qx", "qy", "qz")}
_OWN_UNIT: Final = {"tum": "s", "euroc": "ns"}
_UNIT_S: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_USUAL_STEPS_S: Final = (0.9e-3, 10.0)  # From one pose to the next, where only the steps tell the unit
_LONGEST_STEP_S: Final = 3600  # The same where the times count from 1970
_LEAST_STEP_S: Final = 1e-4  # No camera or robot tells its pose more often
_TIMES_READ: Final = 1000  # Lines by which the unit is found
MAX_SPEED_M_PER_S: Final = 50
_STANDS_M: Final = 1.0  # Shorter ways are no jump at any speed: two poses may be logged within microseconds
_MOST_USUAL_S: Final = 0.1  # So may a car's of a usual step each, which came in a burst; but a slow topic jumps, too

RowReader = Callable[[Line, list[float] | None], tuple[str, int, list[float]]]
"""Parses a line, given the values of the previous one, into the time as it is written, the time in us, and values."""


def read_poses(path: StrPath, *, format: str | None = None, times: StrPath | None = None) -> Poses:
    """Read a trajectory, plain or gzip'd; the first time becomes 0.

    Args:
        path: the file.
        format: one of `POSE_FORMATS`, with times in its own unit; by default both are found (see above).
        times: KITTI's file of times; by default the file of the same name with ``_times`` beside it.

    Raises:
        TraceError: the file cannot be read, or a line breaks a rule: as many finite numbers as the format has,
            positions within 10**7 m, a quaternion of unit norm (a rotation matrix) within 1 %, times that never
            decrease and span at most 10**7 s, at least two lines, most poses 0.1 ms apart or more.
        BufgymError: an unknown format, or `times` with another format than KITTI's.
    """
    unit = _OWN_UNIT.get(format or "", "s")
    if format is None:
        format, unit = _detected(path)
    if format not in POSE_FORMATS:
        raise BufgymError(f"format = {format!r}: must be one of {', '.join(POSE_FORMATS)}")
    if format == "kitti":
        poses = _read_kitti(path, times, unit)
    elif times is not None:
        raise BufgymError(f"times = {str(times)!r}: goes with KITTI matrices only, and {path} is in format {format}")
    else:
        time_us, values = read_rows(path, _pose_row(format, unit))
        note = "" if unit == _OWN_UNIT[format] else f", times in {unit}"
        poses = Poses(time_us, values[:, :3], normalized(values[:, 3:]), f"{format}{note}")
    warn_of_jumps(path, poses)
    return poses


def warn_of_jumps(path: StrPath, poses: Poses) -> None:
    """Warn of poses that no robot can reach from the pose before: localisation was lost, or numbers are wrong."""
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


def _detected(path: StrPath) -> tuple[str, str]:
    """The format and the unit of the times that the file's first lines fit."""
    times: list[float] = []
    columns, blanks = 0, False
    with open_text(path) as file:
        for line in file.lines():
            if line.text.startswith("#"):
                if not columns and (header := _EUROC_HEADER.match(line.text)):
                    return "euroc", header[1]
                continue
            cells = _cells(line)
            if not columns:
                columns, blanks = len(cells), "," not in line.text
            if (columns == 12 and blanks) or len(times) == _TIMES_READ or not re.fullmatch(NUMBER, cells[0]):
                break
            times.append(float(cells[0]))
    if not columns:
        raise fault(path, "is empty: must hold a trajectory or a motion recording")
    if columns == 12 and blanks:
        return "kitti", ""
    likely = "tum" if blanks and columns <= 8 else "euroc"
    unit = _unit(path, np.array(times), _OWN_UNIT[likely])
    return ("tum" if unit == "s" and columns <= 8 else likely), unit


def _unit(path: StrPath, times: Float64Array, own: str) -> str:
    """The unit of a trajectory's times: that in which they are dates, else that in which poses follow each other.

    ``own``, the unit of the format that the columns suggest, goes before another that is as likely.
    """
    with np.errstate(invalid="ignore"):
        steps = np.diff(times)
    steps = steps[(steps > 0) & np.isfinite(steps)]
    if not len(steps):
        return own
    step = float(np.median(steps))
    for unit, unit_s in _UNIT_S.items():
        if _MIN_EPOCH_S <= times[0] * unit_s < _NEAR_EPOCH_S and _LEAST_STEP_S <= step * unit_s <= _LONGEST_STEP_S:
            return unit
    least_s, most_s = _USUAL_STEPS_S
    likely = [unit for unit, unit_s in _UNIT_S.items() if least_s <= step * unit_s <= most_s]
    # Whole steps of 10 are rather ms than one pose in 10 s.
    if not likely or (own in likely and (step * _UNIT_S[own] <= 1 or bool((times % 1).any()))):
        return own
    if len(likely) > 1:
        rule = (
            f"may be {' or '.join(likely)}: say format='tum' or 'kitti' (s) or 'euroc' (ns), and write others in these"
        )
        raise fault(path, rule, value=f"{step:g}", field="median step of the times")
    return likely[0]


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
            check_order(line, "time in s", text, time_us, times)
            if times and time_us == times[-1]:
                rows[-1] = row
                continue
            times.append(time_us)
            rows.append(row)
    if len(times) < 2:
        raise fault(path, f"holds {len(times)} samples: must hold at least 2 of different times")
    time_array = np.asarray(times, np.int64)
    step_s = float(np.median(np.diff(time_array))) / US_PER_S
    if step_s < _LEAST_STEP_S:
        rule = f"must be at least {_LEAST_STEP_S:g} s (are the times in another unit?)"
        raise fault(path, rule, value=f"{step_s:g} s", field="median step of the times")
    return time_array - time_array[0], np.array(rows, np.float64)


def check_order(line: Line, field: str, text: str, time_us: int, times: Sequence[int]) -> None:
    """Check that a time, written as ``text``, is not before the latest of ``times``, nor too far from the first, us."""
    if times and time_us < times[-1]:
        raise line.error(text, f"must not be before the line above ({times[-1] / US_PER_S:.6f})", field)
    if times and time_us - times[0] > MAX_DURATION_S * US_PER_S:
        raise line.error(text, f"must be at most {MAX_DURATION_S} s after the first", field)


def seconds(line: Line, text: str) -> int:
    """A time in s, as microseconds."""
    return round(line.decimal("time in s", text, 0, _MAX_EPOCH_S) * US_PER_S)


def _pose_row(format: str, unit: str) -> RowReader:
    """The reader of a line of TUM or EuRoC with times in this unit."""
    columns, names = _COLUMNS[format], _NAMES[format]
    more = f" (or {' or '.join(map(str, columns[1:]))} of a state estimate)" if columns[1:] else ""

    def row(line: Line, previous: list[float] | None) -> tuple[str, int, list[float]]:
        cells = _cells(line)
        if len(cells) not in columns:
            raise line.misfit(f"must have 8 columns{more}, has {len(cells)}")
        return cells[0], _time_us(line, cells[0], unit), _pose(line, cells[1:8], names)

    return row


def _time_us(line: Line, text: str, unit: str) -> int:
    """A time in this unit, as microseconds."""
    if unit == "s":
        return seconds(line, text)
    line.decimal(f"time in {unit}", text, 0, _MAX_EPOCH_S / _UNIT_S[unit])
    # A float holds such a time to 256 ns only.
    return int(Decimal(text) * Decimal(str(_UNIT_S[unit])) * US_PER_S)


def _cells(line: Line) -> list[str]:
    """The cells of a line, which are separated by commas if it has any."""
    return split_cells(line.text) if "," in line.text else line.text.split()


def _pose(line: Line, cells: list[str], names: tuple[str, ...]) -> list[float]:
    """Position and quaternion."""
    values = [
        line.decimal(name, text, -MAX_POSITION_M, MAX_POSITION_M) for name, text in zip(names, cells, strict=True)
    ]
    norm = math.hypot(*values[3:])
    if abs(norm - 1) > NORM_TOLERANCE:
        raise line.error(f"{norm:.6g}", "must be 1 within 1 %", "norm of the quaternion")
    return values


def _read_kitti(path: StrPath, times: StrPath | None, unit: str) -> Poses:
    times = _times_beside(path) if times is None else times
    stamps = _read_times(times, unit or _detected(times)[1])

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


def _read_times(path: StrPath, unit: str) -> Iterator[tuple[str, int]]:
    with open_text(path) as file:
        for line in file.lines():
            (text,) = line.columns(1)
            yield text, _time_us(line, text, unit)


def _times_beside(path: StrPath) -> Path:
    """The file with the times of these matrices: NAME_times.txt beside NAME.txt, gzip'd or not."""
    stem = Path(path).name.removesuffix(".gz").removesuffix(".txt")
    for suffix in (".txt", ".txt.gz"):
        times = Path(path).with_name(f"{stem}_times{suffix}")
        if times.is_file():
            return times
    rule = f"holds KITTI matrices, which carry no time: say where the times are (times=...; no {stem}_times.txt beside)"
    raise fault(path, rule)
