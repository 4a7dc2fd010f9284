"""Motion from files: camera trajectories (see `trajectories`), or CSV of finished coordinates, header `t_s,motion`."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from bufgym.traces.formats.faults import StrPath, heard, warn
from bufgym.traces.formats.links import trace_name
from bufgym.traces.formats.pose_tables import PoseColumns
from bufgym.traces.formats.rows import read_rows
from bufgym.traces.formats.splits import refuse_recording
from bufgym.traces.formats.text import MAX_LINE_CHARACTERS, Line, decimals, is_header, open_text, write_text
from bufgym.traces.formats.trajectories import MAX_EPOCH_S, PLAIN, read_poses, seconds
from bufgym.traces.motion import Motion, MotionSettings, motion_from_poses
from bufgym.traces.sheet import Sheet, time_facts
from bufgym.traces.trace import US_PER_S, Float64Array, Int64Array

MOTION_HEADER: Final = "t_s,motion"

MAX_COORDINATE: Final = 1e9


def read_motion(
    path: StrPath,
    settings: MotionSettings | None = None,
    *,
    format: str | None = None,
    times: StrPath | None = None,
    columns: PoseColumns | None = None,
    advance: Callable[[int], object] = int,
) -> Motion:
    """Read a trajectory (TUM, EuRoC, KITTI) or a `t_s,motion` CSV, plain or gzip'd, recognised by the first line.

    The first time becomes 0. A CSV holds finished coordinates, which are used as they are, minus the first. Stretches
    without a pose are bridged and listed in `Motion.gaps`.

    A trajectory is read as by `trajectories.read_poses`, and its motion measured by `motion_from_poses`. ``advance`` is
    called with the number of lines just read.
    """
    refuse_recording(path, "must be a trajectory (motion in it is taken with --odom)")
    with open_text(path) as file:
        first = next((line for line in file.lines() if not line.text.startswith("#")), None)
    chosen = format is not None or times is not None or columns is not None
    if first is not None and not chosen and is_header(first.text, MOTION_HEADER):
        with heard() as doubts:
            rows = read_rows(path, _motion_row, skip=first.number, read_block=_motion_block, advance=advance)
        moved, source = rows.values[:, 0] - rows.values[0, 0], f"{path} ({MOTION_HEADER}{rows.note})"
        sheet = Sheet(time_facts("samples", rows.time_us, rows.start_us), tuple(doubts))
        return Motion(trace_name(path), rows.time_us, moved, source, sheet=sheet)
    with heard() as doubts:
        poses = read_poses(path, format=format, times=times, columns=columns, advance=advance)
        source = f"{path} (trajectory, format {poses.format})"
        motion = motion_from_poses(poses, settings, name=trace_name(path), source=source)
        for doubt in motion.sheet.doubts:
            warn(path, doubt)
    return replace(motion, sheet=Sheet(motion.sheet.facts, tuple(doubts)))


def write_motion_csv(motion: Motion, path: StrPath) -> None:
    """Write `t_s,motion`; `read_motion` gives back the same times and coordinates, bit for bit."""
    rows = (
        f"{decimals(t, 6)},{x!r}\n" for t, x in zip(motion.time_us.tolist(), motion.coordinate.tolist(), strict=True)
    )
    write_text(path, [MOTION_HEADER + "\n"], rows)


def _motion_row(line: Line, previous: list[float] | None) -> tuple[str, int, list[float]]:
    """Time, then the coordinate."""
    time, text = line.columns(2, ",")
    return time, seconds(line, time), [coordinate(line, "motion", text, previous[0] if previous else 0.0)]


def _motion_block(text: bytes, previous: list[float] | None) -> tuple[Int64Array, Float64Array] | None:
    """The lines of a block, as `_motion_row` reads each."""
    lines = text.decode("latin-1").split("\n")
    if text.translate(None, PLAIN) or not text.strip() or max(map(len, lines)) > MAX_LINE_CHARACTERS:
        return None
    try:
        content = np.loadtxt(lines, comments=None, delimiter=",", ndmin=2)
    except ValueError:
        return None
    if content.shape[1] != 2:
        return None
    time, values = content[:, 0], content[:, 1:]
    rises = values[0] >= (previous or [0.0])[0] and (values[1:] >= values[:-1]).all()
    if not (rises and values[-1] <= MAX_COORDINATE and time.min() >= 0 and time.max() <= MAX_EPOCH_S):
        return None
    return np.rint(time * US_PER_S).astype(np.int64), values


def coordinate(line: Line, field: str, text: str, previous: float) -> float:
    """A coordinate that is not below that of the line above, which is 0 for the first line."""
    value = line.decimal(field, text, 0, MAX_COORDINATE)
    if value < previous:
        raise line.error(text, f"must not be below the line above ({previous!r})", field)
    return value
