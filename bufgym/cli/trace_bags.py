"""``bufgym trace from-bag`` and ``from-poses``: a robot's recording as a workload, a trajectory as motion.

Also the options, shared with ``bench``, that choose a part of a recording and say how its motion is measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from bufgym.cli.options import Positive, columns, given, refuse
from bufgym.utils.errors import BufgymError, printable
from bufgym.utils.progress import bar
from bufgym.utils.tables import aligned

if TYPE_CHECKING:
    from bufgym.traces import MotionSettings, Workload
    from bufgym.traces.formats.bags import Bag
    from bufgym.traces.workload import TopicSummary


@Parameter(name="*")
@dataclass(frozen=True)
class MotionOptions:
    # A test compares these defaults with those of MotionSettings, which is not imported for a help text.
    fov_deg: Positive | None = None
    """Field of view of a camera that moves like this, degrees (default: 60)."""
    scene_scale_m: Positive | None = None
    """Moving this far shows a new scene, m (default: 2)."""
    rate_hz: Positive | None = None
    """Compare poses at most so often, 1/s; less is less noise (default: 30)."""

    def settings(self) -> MotionSettings | None:
        """How motion is measured; None if none of the options was given."""
        from bufgym.traces import MotionSettings

        values = given(self)
        return MotionSettings(**values) if values else None


@Parameter(name="*")
@dataclass(frozen=True)
class RecordingOptions:
    topics: list[str] | None = None
    """Topics, by name or pattern ('/camera/*'); default: all."""
    odom: str | None = None
    """Take x from the motion on this topic, of several frames: TOPIC:FRAME, of tf: TOPIC:PARENT:CHILD (default: x is
    the message's index)."""
    bridge_gaps: bool = False
    """Take motion across gaps in it as even."""
    clock: str | None = None
    """Arrivals by a recording's log times ("log", the default), or by the clock of its header stamps ("stamps")."""

    def arguments(self, measured: MotionOptions | None = None) -> dict[str, Any]:
        """Collect those given for ``read_workload``, whose odometry becomes motion as ``measured`` says."""
        arguments: dict[str, Any] = given(self, "clock")
        if self.topics is not None:
            arguments["topics"] = [name for text in self.topics for name in text.split(",") if name]
        if self.odom is not None:
            arguments.update(odom=self.odom, bridge_gaps=self.bridge_gaps)
            arguments["settings"] = None if measured is None else measured.settings()
        elif self.bridge_gaps:
            raise BufgymError("--bridge-gaps needs --odom")
        return arguments


def workload_lines(workload: Workload) -> list[str]:
    cells = [["topic", "messages", "rate (1/s)", "bytes", "mean bytes", "share"]]
    for topic in workload.summary():
        messages, rate, total_bytes, share = _summary_cells(topic)
        mean = f"{topic.total_bytes / topic.messages:,.0f}"
        cells.append([topic.topic or "(no name)", messages, rate, total_bytes, mean, share])
    duration_s, total = workload.duration_us / 1e6, int(workload.size_bytes.sum())
    rate = f", {total / duration_s:,.0f} bytes/s" if duration_s > 0 else ""
    facts = columns(workload.sheet.facts) if workload.sheet.facts else ""
    lines = [
        *aligned(cells),
        *facts.splitlines(),
        f"{len(workload):,} messages, {total:,} bytes in {duration_s:.3f} s{rate}",
    ]
    if workload.x is not None:
        lines.append(f"x: camera motion of {workload.x[-1]:.3f} fields of view")
    if workload.gaps:
        count = f"{len(workload.gaps)} gaps" if len(workload.gaps) > 1 else "1 gap"
        lines.append(f"note: {count} without a pose, the longest {workload.longest_gap_s:.1f} s: motion taken as even")
    return lines


def from_bag(
    files: list[str],
    /,
    *,
    recording: RecordingOptions = RecordingOptions(),
    measured: MotionOptions = MotionOptions(),
    out: Annotated[Path | None, Parameter(alias="-o")] = None,
) -> None:
    """Take messages and motion from a robot's recording (extra 'ros').

    Args:
        files: MCAP, ROS 1 bag, rosbag2 folder or .db3, also packed; several are one drive. Alone: topics are listed.
        out: Write the workload to this CSV file (time_s,bytes,topic[,x]).
    """
    from bufgym.traces import read_bag, workload_from_bag, write_workload_csv

    arguments = recording.arguments(measured)
    if recording.odom is None:
        refuse(given(measured), "needs --odom")
    with bar(None, True, "message") as advance:
        bag = read_bag(files, arguments.pop("odom", None), advance, arguments.pop("clock", "log"))
    if recording.topics is None and out is None and recording.odom is None:
        print(printable(f"{bag.path} ({bag.kind})") + "\n")
        workload = workload_from_bag(bag) if len(bag.time_ns) else None
        print("\n".join(_listed(bag, workload.summary() if workload else [])))
        if workload:
            print(columns(workload.sheet.facts))
        print("\nchoose with --topics, take motion with --odom, write with -o")
        return
    workload = workload_from_bag(bag, **arguments)
    print(printable(workload.source) + "\n")
    print("\n".join(workload_lines(workload)))
    if out is not None:
        write_workload_csv(workload, out)
        print(f"wrote {out}")


def from_poses(
    file: str,
    /,
    *,
    format: Literal["tum", "euroc", "kitti"] | None = None,
    times: str | None = None,
    time: str | None = None,
    pose: list[str] | None = None,
    time_unit: str = "",
    measured: MotionOptions = MotionOptions(),
    bridge_gaps: bool = False,
    out: Annotated[Path | None, Parameter(alias="-o")] = None,
) -> None:
    """Take camera motion from a trajectory: TUM, EuRoC, KITTI, NMEA or any table.

    Args:
        file: The trajectory, plain or gzip'd.
        format: Its format (default: recognised by its first line).
        times: KITTI's times (default: NAME_times.txt beside NAME.txt).
        time: Of any table: the column of times, by name or number; with --pose.
        pose: The columns of x y [z [qx qy qz qw]], or latitude longitude [altitude].
        time_unit: Unit of the times: s, ms, us, ns (default: that in the column's name, else by the steps).
        bridge_gaps: Write it in spite of gaps.
        out: Write the motion to this CSV file (t_s,motion).
    """
    from bufgym.traces import Columns, read_motion, write_motion_csv

    if (time is None) != (pose is None):
        raise BufgymError("--time and --pose go together")
    chosen = None if time is None or pose is None else Columns(time, pose=tuple(pose), time_unit=time_unit)
    with bar(None, True, "line") as advance:
        motion = read_motion(file, measured.settings(), format=format, times=times, columns=chosen, advance=advance)
    seconds = motion.duration_us / 1e6
    print(f"{printable(motion.name)}\n  source  {printable(motion.source)}")
    print(f"  motion  {motion.total:.3f} fields of view in {seconds:.3f} s")
    count = len(motion.gaps)
    print(f"  gaps    {count}" + (f", the longest {motion.longest_gap_s:.1f} s" if count else ""))
    if motion.sheet.facts:
        print(columns(motion.sheet.facts))
    if out is None:
        return
    if motion.gaps and not bridge_gaps:
        raise BufgymError(f"{file}: has gaps: say --bridge-gaps to take motion across them as even")
    write_motion_csv(motion, out)
    print(f"wrote {out}")


def _listed(bag: Bag, summary: Sequence[TopicSummary]) -> list[str]:
    """List every topic of a recording with its type, topics without messages last."""
    from bufgym.traces.formats.bag_files import BETWEEN_TYPES
    from bufgym.traces.formats.bag_poses import carries_motion

    cells = [["topic", "messages", "rate (1/s)", "bytes", "share", "for --odom", "type"]]
    for topic in summary:
        type = bag.topics[topic.topic]
        poses = any(carries_motion(topic.topic, one) for one in type.split(BETWEEN_TYPES))
        cells.append([topic.topic, *_summary_cells(topic), "yes" if poses else "", type])
    with_messages = {topic.topic for topic in summary}
    cells += [[name, "0", "-", "0", "-", "", type] for name, type in bag.topics.items() if name not in with_messages]
    return aligned(cells)


def _summary_cells(topic: TopicSummary) -> list[str]:
    rate = "-" if math.isnan(topic.rate_hz) else f"{topic.rate_hz:.3f}"
    return [f"{topic.messages:,}", rate, f"{topic.total_bytes:,}", f"{topic.share:.1%}"]
