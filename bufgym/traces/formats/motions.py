"""Motion from files: camera trajectories (see `trajectories`), or CSV of finished coordinates, header `t_s,motion`."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from bufgym.traces.formats.faults import StrPath, heard, warn
from bufgym.traces.formats.links import trace_name
from bufgym.traces.formats.rows import read_rows
from bufgym.traces.formats.splits import refuse_recording
from bufgym.traces.formats.tables import Columns
from bufgym.traces.formats.text import Line, decimals, is_header, open_text, write_text
from bufgym.traces.formats.trajectories import read_poses, seconds
from bufgym.traces.motion import Motion, MotionSettings, motion_from_poses
from bufgym.traces.sheet import Sheet, time_facts

MOTION_HEADER: Final = "t_s,motion"

MAX_COORDINATE: Final = 1e9


def read_motion(
    path: StrPath,
    settings: MotionSettings | None = None,
    *,
    format: str | None = None,
    times: StrPath | None = None,
    columns: Columns | None = None,
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
            rows = read_rows(path, _motion_row, skip=first.number, advance=advance)
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


def coordinate(line: Line, field: str, text: str, previous: float) -> float:
    """A coordinate that is not below that of the line above, which is 0 for the first line."""
    value = line.decimal(field, text, 0, MAX_COORDINATE)
    if value < previous:
        raise line.error(text, f"must not be below the line above ({previous!r})", field)
    return value
