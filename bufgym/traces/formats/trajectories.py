"""Camera poses from the trajectory files of public data sets.

| format | a line | used by |
|---|---|---|
| `tum` | `t tx ty tz qx qy qz qw`: s, m, unit quaternion | TUM RGB-D [sturm2012tum]; any odometry |
| `euroc` | `t px py pz qw qx qy qz`: ns, m; a state estimate has 11 or 17 columns | EuRoC [burri2016euroc], VINS |
| `kitti` | a 3x4 matrix row by row, m; the times (one a line) in another file | KITTI [geiger2012kitti] |

Columns of TUM and EuRoC are separated by blanks or commas. The format is recognised by the first lines: 12 numbers are
KITTI's; a header such as `#timestamp [ns]`, or more than 8 columns, EuRoC's. Without such a header `units` finds the
unit of the times. Then 8 columns in seconds, or between blanks, are TUM's, and other 8 are EuRoC's. x does not depend
on the order of a quaternion's four.
"""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Final

import numpy as np

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.geodesy import local_plane
from bufgym.traces.formats.recipes import Recipe, field_of, recipes
from bufgym.traces.formats.rows import BlockReader, RowReader, Rows, read_rows
from bufgym.traces.formats.tables import Columns, Head, cells_of, date_us, head_of, place_of, time_unit
from bufgym.traces.formats.text import MAX_LINE_CHARACTERS, Line, open_text, split_cells
from bufgym.traces.formats.units import UNIT_S, unit_of, warn_of_unit
from bufgym.traces.plausible import check_slow_poses, warn_of_jumps
from bufgym.traces.poses import Poses, normalize, quaternions
from bufgym.traces.trace import US_PER_S, Float64Array, Int64Array
from bufgym.utils.errors import BufgymError, TraceError

POSE_FORMATS: Final = ("tum", "euroc", "kitti")

MAX_POSITION_M: Final = 1e7
NORM_TOLERANCE: Final = 0.01
# Seconds since 1970 until the year 5138; a time in ns exceeds it.
MAX_EPOCH_S: Final = 1e11
_EUROC_HEADER: Final = re.compile(r"#\s*timestamp\s*\[(s|ms|us|ns)\]")
# State estimates continue with the velocity, those of EuRoC's own CSV files also with biases.
_COLUMNS: Final = {"tum": (8,), "euroc": (8, 11, 17)}
MOST_OF_FIX: Final = {"latitude": 90.0, "longitude": 180.0, "altitude": 1e5}
_NO_TURN: Final = [0.0, 0.0, 0.0, 1.0]
_NAMES: Final = {
    "tum": ("time", "tx", "ty", "tz", "qx", "qy", "qz", "qw"),
    "euroc": ("time", "px", "py", "pz", "qw", "qx", "qy", "qz"),
}
_PLACES: Final = (("x", "y", "z"), ("latitude", "longitude", "altitude"))
_TURN: Final = ("qx", "qy", "qz", "qw")
_DAY_S: Final = 86_400
_OWN_UNIT: Final = {"tum": "s", "euroc": "ns"}
_SURE_NORM: Final = NORM_TOLERANCE - 1e-9  # Whatever the rounding of the norm
_PLAIN: Final = b"0123456789+-.eE, \t\r\n"  # A block of other bytes is read line by line


def read_poses(
    path: StrPath,
    *,
    format: str | None = None,
    times: StrPath | None = None,
    columns: Columns | None = None,
    advance: Callable[[int], object] = int,
) -> Poses:
    """Read a trajectory, plain or packed; the first time becomes 0.

    Args:
        path: the file.
        format: one of `POSE_FORMATS`, with times in its own unit; by default both are found (see above).
        times: KITTI's file of times; by default the file of the same name with ``_times`` beside it.
        columns: of any other table, which columns hold what; without `format` and `times`.
        advance: called with the number of lines just read, as a progress bar's update.
    """
    if columns is not None and (format is not None or times is not None):
        raise BufgymError("columns of a table go without format and times")
    named, unit, table = format is not None, _OWN_UNIT.get(format or "", "s"), None
    if not named:
        table = None if times is not None else _of_recipe(path, columns, advance)
        if table is None:
            head = head_of(path)
            table = None if times is not None else _of_table(path, head, columns, advance)
            if table is None:
                format, unit = _detected(path, head, (8, 11, 12, 17))
    if table is None and format not in POSE_FORMATS:
        raise BufgymError(f"format = {format!r}: must be one of {', '.join(POSE_FORMATS)}")
    if format == "kitti":
        poses = _read_kitti(path, times, unit, advance)
    elif times is not None:
        raise BufgymError(f"times = {str(times)!r}: goes with KITTI matrices only, and {path} is in format {format}")
    else:
        if table is None:
            assert format is not None
            row = pose_row({name: k for k, name in enumerate(_NAMES[format])}, _COLUMNS[format], unit)
            rows = read_rows(path, row, read_block=_pose_block(format, unit), what="poses", advance=advance)
            table = rows, format + ("" if unit == _OWN_UNIT[format] else f", times in {unit}")
        rows, about = table
        normalize(rows.values[:, 3:])
        poses = Poses(rows.time_us, rows.values[:, :3], rows.values[:, 3:], about + rows.note, rows.start_us)
    if unit == "s" and format == "tum" and not named:
        check_slow_poses(path, poses)
    warn_of_jumps(path, poses)
    return poses


def _detected(path: StrPath, head: Head, counts: tuple[int, ...]) -> tuple[str, str]:
    """The format and the unit of the times that the file's first lines fit; they have so many columns."""
    if head.first is None:
        raise fault(path, "is empty: must hold a trajectory or a motion recording")
    columns, blanks = len(_cells(head.first)), "," not in head.first.text
    if columns not in counts:
        raise _miscounted(head.first, columns, _COLUMNS["euroc"])
    if columns == 12 and blanks:
        return "kitti", ""
    times, decimals = head.numbers(0)
    if named := next(filter(None, map(_EUROC_HEADER.match, head.remarks)), None):
        warn_of_unit(path, times, named[1], named=True)
        return "euroc", named[1]
    likely = "tum" if blanks and columns <= 8 else "euroc"
    unit = unit_of(path, times, _OWN_UNIT[likely], decimals)
    warn_of_unit(path, times, unit, named=False)
    return ("tum" if unit == "s" and columns <= 8 else likely), unit


def _of_recipe(path: StrPath, columns: Columns | None, advance: Callable[[int], object]) -> tuple[Rows, str] | None:
    """The poses, a position and a quaternion each, of another tool's file, and its name; None if it is none."""
    with open_text(path) as file:
        first = next(file.lines(), None)
    found = (one for one in recipes("poses").values() if first is not None and one.first.fullmatch(first.text))
    recipe = next(found, None) if columns is None else None
    if recipe is None:
        return None
    if recipe.says:
        raise fault(path, recipe.says)
    return _in_metres(read_rows(path, _recipe_row(recipe), what="fixes", advance=advance)), recipe.name


def _of_table(
    path: StrPath, head: Head, columns: Columns | None, advance: Callable[[int], object]
) -> tuple[Rows, str] | None:
    """The same of a table whose header names its columns, or whose columns are chosen.

    It needs a time and x and y, or latitude and longitude. Without z it is flat, without a quaternion it does not turn.
    """
    if not head.rows:
        return None
    (line, cells), names = head.rows[0], head.names
    is_remark = head.header is not None and head.header.text.startswith("#")  # TUM, EuRoC and KITTI have such headers
    if columns is None and (not names or (is_remark and len(cells) in (*_COLUMNS["euroc"], 12))):
        return None
    places = _chosen(line, names or [str(k + 1) for k in range(len(cells))], columns) if columns else _by_names(names)
    if not places:
        return None
    unit = time_unit(columns, names[places["time"]] if names else "")
    times, decimals = head.numbers(places["time"])
    if len(times):
        found = unit or unit_of(path, times, "s", decimals)
        warn_of_unit(path, times, found, named=bool(unit))
        unit = found
    row = pose_row(places, (len(cells),), unit or "s", head.separator)
    rows = read_rows(path, row, skip=head.header.number if head.header else 0, what="poses", advance=advance)
    about = f"columns {', '.join(places)}, times in {unit or 's'}"
    return (_in_metres(rows) if "latitude" in places else rows), about


def _by_names(names: list[str]) -> dict[str, int]:
    """The place of each field, by the first column of such a name; empty without a time and a place."""
    found: dict[str, int] = {}
    for k, name in enumerate(names):
        found.setdefault(field_of(name), k)
    place = next((fields for fields in _PLACES if {"time", *fields[:2]} <= found.keys()), None)
    if place is None:
        return {}
    turn = _TURN if found.keys() >= {*_TURN} and place is _PLACES[0] else ()
    return {field: found[field] for field in ("time", *place, *turn) if field in found}


def _chosen(line: Line, names: list[str], columns: Columns) -> dict[str, int]:
    """The place of each field as chosen."""
    if len(columns.pose) not in (2, 3, 7):
        raise BufgymError(f"pose = {' '.join(columns.pose)}: must be x y, x y z, or x y z qx qy qz qw")
    fields = _PLACES[field_of(columns.pose[0]) == "latitude"]
    wanted = dict(zip((*fields, *_TURN), columns.pose, strict=False))
    return {field: place_of(line, names, name) for field, name in {"time": columns.time, **wanted}.items()}


def _recipe_row(recipe: Recipe) -> RowReader:
    """The reader of a fix of a satellite receiver."""
    above_us = [0]

    def row(line: Line, previous: list[float] | None) -> tuple[str, int, list[float]] | None:
        groups = recipe.groups(line)
        if groups is None:
            return None
        place = []
        for field, most in MOST_OF_FIX.items():
            text, value = groups.get(f"{field}_dm"), float(groups.get(field) or 0)
            if text:  # degrees and two digits of minutes before the point
                at = text.index(".") - 2
                value = int(text[:at]) + float(text[at:]) / 60
            place.append(line.decimal(field, f"{value:.12f}", -most, most))
        place[0] *= -1 if groups.get("ns") == "S" else 1
        place[1] *= -1 if groups.get("ew") == "W" else 1
        if (text := groups.get("date", "")) and (date := date_us(text)) is not None:
            return text, date, [*place, *_NO_TURN]
        if not (text := groups.get("hms", "")):
            raise line.error(line.text, "must hold a time")
        us = round((int(text[:2]) * 3600 + int(text[2:4]) * 60 + float(text[4:])) * US_PER_S)
        while us < above_us[0] - _DAY_S * US_PER_S // 2:
            us += _DAY_S * US_PER_S  # after midnight
        above_us[0] = us
        return text, us, [*place, *_NO_TURN]

    return row


def _in_metres(rows: Rows) -> Rows:
    values = rows.values.copy()
    values[:, :3] = local_plane(values[:, :3])
    return rows._replace(values=values, note=f", positions of a satellite receiver, no orientation{rows.note}")


def seconds(line: Line, text: str) -> int:
    """A time in s, as microseconds."""
    return round(line.decimal("time in s", text, 0, MAX_EPOCH_S) * US_PER_S)


def pose_row(places: dict[str, int], columns: Sequence[int], unit: str, separator: str | None = None) -> RowReader:
    """The reader of a line of so many columns that has a time in this unit, x, y[, z][, a quaternion] in these places.

    Without ``separator``, cells are separated by commas if the line has any, else by blanks, and times are numbers.
    """
    fields = [field for field in places if field != "time"]
    turn = fields[3:]
    place = fields[: 3 if turn or len(fields) == 3 else 2]

    def row(line: Line, previous: list[float] | None) -> tuple[str, int, list[float]]:
        cells = _cells(line) if separator is None else cells_of(line.text, separator)
        if len(cells) not in columns:
            raise _miscounted(line, len(cells), columns)
        text, values = cells[places["time"]], list[float]()
        date = None if separator is None else date_us(text)
        for field in place:
            most = MOST_OF_FIX.get(field, MAX_POSITION_M)
            values.append(line.decimal(field, cells[places[field]], -most, most))
        values += [0.0] * (3 - len(values))
        quaternion = [line.decimal(field, cells[places[field]], -MAX_POSITION_M, MAX_POSITION_M) for field in turn]
        norm = math.hypot(*quaternion) if turn else 1
        if abs(norm - 1) > NORM_TOLERANCE:
            raise line.error(f"{norm:.6g}", "must be 1 within 1 %", "norm of the quaternion")
        return text, time_in_us(line, text, unit) if date is None else date, [*values, *(quaternion or _NO_TURN)]

    return row


def _miscounted(line: Line, has: int, columns: Sequence[int]) -> TraceError:
    more = f" (or {' or '.join(map(str, columns[1:]))} of a state estimate)" if columns[1:] else ""
    rule = f"must have {columns[0]} columns{more}, has {has}: name them with --time COL --pose X Y Z QX QY QZ QW"
    return line.misfit(rule)


def _pose_block(format: str, unit: str) -> BlockReader:
    """The reader of a block of such lines, as `pose_row` reads each."""
    time_type, most = ("f8", MAX_EPOCH_S) if unit == "s" else ("i8", MAX_EPOCH_S / UNIT_S[unit])
    ticks = round(1 / (UNIT_S[unit] * US_PER_S))  # in a microsecond; 0 where the unit is longer

    def block(text: bytes, previous: list[float] | None) -> tuple[Int64Array, Float64Array] | None:
        if text.translate(None, _PLAIN):
            return None
        lines = text.decode("ascii").split("\n")
        columns = len(_cells(Line("", 0, lines[0].strip())))
        if columns not in _COLUMNS[format] or max(map(len, lines)) > MAX_LINE_CHARACTERS:
            return None
        row = np.dtype([("time", time_type), ("values", "f8", (columns - 1,))])
        try:
            content = np.loadtxt(
                lines, row, comments=None, delimiter="," if "," in text[:4096].decode() else None, ndmin=1
            )
        except ValueError:
            return None
        time, values = content["time"], content["values"][:, :7]
        norm = np.linalg.norm(values[:, 3:], axis=1)
        sound = (np.abs(values[:, :3]) <= MAX_POSITION_M).all() and (np.abs(norm - 1) < _SURE_NORM).all()
        if not (sound and time.min() >= 0 and time.max() <= most):
            return None
        if unit == "s":
            return np.rint(time * US_PER_S).astype(np.int64), values
        return (time // ticks if ticks else time * round(UNIT_S[unit] * US_PER_S)), values

    return block


def time_in_us(line: Line, text: str, unit: str) -> int:
    """A time in this unit, as microseconds."""
    if unit == "s":
        return seconds(line, text)
    line.decimal(f"time in {unit}", text, 0, MAX_EPOCH_S / UNIT_S[unit])
    # A float holds such a time to 256 ns only.
    return int(Decimal(text) * Decimal(str(UNIT_S[unit])) * US_PER_S)


def _cells(line: Line) -> list[str]:
    """The cells of a line, which are separated by commas if it has any."""
    return split_cells(line.text) if "," in line.text else line.text.split()


def _read_kitti(path: StrPath, times: StrPath | None, unit: str, advance: Callable[[int], object]) -> Poses:
    times = _times_beside(path) if times is None else times
    stamps = _read_times(times, unit or _detected(times, head_of(times), (1,))[1])

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

    rows = read_rows(path, row, what="poses", advance=advance)
    if next(stamps, None) is not None:
        raise fault(times, f"holds more times than {path} has poses")
    matrices = rows.values.reshape(-1, 3, 4)
    format = f"kitti, times from {Path(times).name}{rows.note}"
    return Poses(rows.time_us, matrices[:, :, 3], quaternions(matrices[:, :, :3]), format, rows.start_us)


def _read_times(path: StrPath, unit: str) -> Iterator[tuple[str, int]]:
    with open_text(path) as file:
        for line in file.lines():
            (text,) = line.columns(1)
            yield text, time_in_us(line, text, unit)


def _times_beside(path: StrPath) -> Path:
    """The file with the times of these matrices: NAME_times.txt beside NAME.txt, gzip'd or not."""
    stem = Path(path).name.removesuffix(".gz").removesuffix(".txt")
    for suffix in (".txt", ".txt.gz"):
        times = Path(path).with_name(f"{stem}_times{suffix}")
        if times.is_file():
            return times
    rule = f"holds KITTI matrices, which carry no time: say where the times are (times=...; no {stem}_times.txt beside)"
    raise fault(path, rule)
