"""``bufgym trace from-bag`` and ``from-poses``: a robot's recording as a workload, a trajectory as motion.

Also the options, shared with ``bench``, that choose a part of a recording and say how its motion is measured.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bufgym.cli.options import Commands, command, positive
from bufgym.ground.errors import BufgymError, printable

if TYPE_CHECKING:
    from bufgym.traces import MotionSettings, Workload
    from bufgym.traces.formats.bags import Bag
    from bufgym.traces.workload import TopicSummary

MOTION_OPTIONS = ("fov_deg", "scene_scale_m", "max_gap_s")
WORKLOAD_OPTIONS = ("topics", "odom", "bridge_gaps", *MOTION_OPTIONS)


def add(commands: Commands) -> None:
    """Declare ``from-bag`` and ``from-poses`` among the commands of ``bufgym trace``."""
    bag = command(commands, "from-bag", _from_bag, "messages and motion from a robot's recording (extra 'ros')")
    bag.add_argument(
        "file", metavar="FILE", help="MCAP, ROS 1 bag, rosbag2 folder or .db3; alone: its topics are listed"
    )
    workload_options(bag)
    bag.add_argument("-o", "--out", metavar="OUT.csv", help="write the workload there (time_s,bytes,topic[,x])")
    poses = command(commands, "from-poses", _from_poses, "camera motion from a trajectory: TUM, EuRoC or KITTI")
    poses.add_argument("file", metavar="FILE", help="the trajectory, plain or gzip'd")
    poses.add_argument(
        "--format", choices=("tum", "euroc", "kitti"), help="its format (default: recognised by its first line)"
    )
    poses.add_argument("--times", metavar="FILE", help="KITTI's times (default: NAME_times.txt beside NAME.txt)")
    _motion_options(poses)
    poses.add_argument("--bridge-gaps", action="store_true", help="write it in spite of gaps")
    poses.add_argument("-o", "--out", metavar="OUT.csv", help="write the motion there (t_s,motion)")


def workload_options(parser: argparse._ActionsContainer) -> None:
    """Add the options that ``workload_arguments`` reads."""
    option = parser.add_argument
    option("--topics", nargs="+", metavar="T", help="topics, by name or pattern ('/camera/*'); default: all")
    option("--odom", metavar="TOPIC", help="take x from the motion on this topic (of tf: TOPIC:PARENT:CHILD)")
    option("--bridge-gaps", action="store_true", default=None, help="take motion across gaps in it as even")
    _motion_options(parser)


def _motion_options(parser: argparse._ActionsContainer) -> None:
    # A test compares these defaults with those of MotionSettings, which is not imported for a help text.
    option = parser.add_argument
    option(
        "--fov-deg", type=positive, metavar="DEG", help="field of view of a camera that moves like this (default: 60)"
    )
    option("--scene-scale-m", type=positive, metavar="M", help="moving this far shows a new scene, m (default: 2)")
    option("--max-gap-s", type=positive, metavar="S", help="longer times without a pose are gaps, s (default: 1)")


def motion_settings(options: argparse.Namespace) -> MotionSettings | None:
    """Read the options for measuring motion; None if none was given."""
    from bufgym.traces import MotionSettings

    values = {name: getattr(options, name) for name in MOTION_OPTIONS if getattr(options, name) is not None}
    return MotionSettings(**values) if values else None


def workload_arguments(options: argparse.Namespace) -> dict[str, Any]:
    """Collect the given workload options for ``read_workload``; motion options need odometry."""
    arguments: dict[str, Any] = {}
    if options.topics is not None:
        arguments["topics"] = [name for text in options.topics for name in text.split(",") if name]
    if options.odom is not None:
        arguments.update(odom=options.odom, bridge_gaps=bool(options.bridge_gaps), settings=motion_settings(options))
    elif options.bridge_gaps:
        raise BufgymError("--bridge-gaps needs --odom")
    return arguments


def refuse_motion(options: argparse.Namespace, why: str) -> None:
    """Raise an error if an option on how motion is measured was given."""
    for name in MOTION_OPTIONS:
        if getattr(options, name) is not None:
            raise BufgymError(f"--{name.replace('_', '-')} {why}")


def workload_lines(workload: Workload) -> list[str]:
    """Write a table of its topics and a description of its motion."""
    from bufgym.benchmark.table import aligned

    cells = [["topic", "messages", "rate (1/s)", "bytes", "mean bytes", "share"]]
    for topic in workload.summary():
        messages, rate, total_bytes, share = _summary_cells(topic)
        mean = f"{topic.total_bytes / topic.messages:,.0f}"
        cells.append([topic.topic or "(no name)", messages, rate, total_bytes, mean, share])
    duration_s, total = workload.duration_us / 1e6, int(workload.size_bytes.sum())
    rate = f", {total / duration_s:,.0f} bytes/s" if duration_s > 0 else ""
    lines = [*aligned(cells), f"{len(workload):,} messages, {total:,} bytes in {duration_s:.3f} s{rate}"]
    if workload.x is not None:
        lines.append(f"x: camera motion of {workload.x[-1]:.3f} fields of view")
    if workload.gaps:
        count = f"{len(workload.gaps)} gaps" if len(workload.gaps) > 1 else "1 gap"
        lines.append(f"note: {count} without a pose, the longest {workload.longest_gap_s:.1f} s: motion taken as even")
    return lines


def _from_bag(options: argparse.Namespace) -> None:
    from bufgym.traces import read_bag, workload_from_bag, write_workload_csv

    arguments = workload_arguments(options)
    if options.odom is None:
        refuse_motion(options, "needs --odom")
    bag = read_bag(options.file, arguments.pop("odom", None))
    if options.topics is None and options.out is None and options.odom is None:
        print(printable(f"{bag.path} ({bag.kind})") + "\n")
        print("\n".join(_listed(bag, workload_from_bag(bag).summary() if len(bag.time_ns) else [])))
        print("\nchoose with --topics, take motion with --odom, write with -o")
        return
    workload = workload_from_bag(bag, **arguments)
    print(printable(workload.source) + "\n")
    print("\n".join(workload_lines(workload)))
    if options.out is not None:
        write_workload_csv(workload, Path(options.out))
        print(f"wrote {options.out}")


def _from_poses(options: argparse.Namespace) -> None:
    from bufgym.traces import read_motion, write_motion_csv

    motion = read_motion(options.file, motion_settings(options), format=options.format, times=options.times)
    seconds = motion.duration_us / 1e6
    print(f"{printable(motion.name)}\n  source  {printable(motion.source)}")
    print(f"  motion  {motion.total:.3f} fields of view in {seconds:.3f} s")
    count = len(motion.gaps)
    print(f"  gaps    {count}" + (f", the longest {motion.longest_gap_s:.1f} s" if count else ""))
    if options.out is None:
        return
    if motion.gaps and not options.bridge_gaps:
        raise BufgymError(f"{options.file}: has gaps: say --bridge-gaps to take motion across them as even")
    write_motion_csv(motion, Path(options.out))
    print(f"wrote {options.out}")


def _listed(bag: Bag, summary: Sequence[TopicSummary]) -> list[str]:
    """List every topic of a recording with its type, topics without messages last."""
    from bufgym.benchmark.table import aligned
    from bufgym.traces.formats.bag_poses import carries_poses

    cells = [["topic", "messages", "rate (1/s)", "bytes", "share", "for --odom", "type"]]
    for topic in summary:
        type = bag.topics[topic.topic]
        cells.append([topic.topic, *_summary_cells(topic), "yes" if carries_poses(type) else "", type])
    with_messages = {topic.topic for topic in summary}
    cells += [[name, "0", "-", "0", "-", "", type] for name, type in bag.topics.items() if name not in with_messages]
    return aligned(cells)


def _summary_cells(topic: TopicSummary) -> list[str]:
    """Messages, rate, bytes and share of a topic."""
    rate = "-" if math.isnan(topic.rate_hz) else f"{topic.rate_hz:.3f}"
    return [f"{topic.messages:,}", rate, f"{topic.total_bytes:,}", f"{topic.share:.1%}"]
