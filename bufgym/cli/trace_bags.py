"""``bufgym trace from-bag`` and ``from-poses``: a robot's recording as a workload, a trajectory as motion.

And the options that say which part of a recording counts, and what its motion is measured by.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bufgym.cli.options import Commands, command, positive
from bufgym.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.traces.workload import Workload

MOTION_OPTIONS = ("fov_deg", "scene_scale_m", "max_gap_s")
WORKLOAD_OPTIONS = ("topics", "odom", "bridge_gaps", *MOTION_OPTIONS)


def add(commands: Commands) -> None:
    """Declare ``from-bag`` and ``from-poses`` among the commands of ``bufgym trace``."""
    made = command(commands, "from-bag", _from_bag, "messages and motion out of a robot's recording (extra 'ros')")
    made.add_argument(
        "file", metavar="FILE", help="MCAP, ROS 1 bag, rosbag2 folder or .db3; alone: its topics are listed"
    )
    workload_options(made)
    made.add_argument("-o", "--out", metavar="OUT.csv", help="write the workload there (time_s,bytes,topic[,x])")
    made = command(commands, "from-poses", _from_poses, "camera motion out of a trajectory: TUM, EuRoC or KITTI")
    made.add_argument("file", metavar="FILE", help="the trajectory, plain or gzip'd")
    made.add_argument(
        "--format", choices=("tum", "euroc", "kitti"), help="its format (default: told from its first line)"
    )
    made.add_argument("--times", metavar="FILE", help="KITTI's times (default: NAME_times.txt beside NAME.txt)")
    _motion_options(made)
    made.add_argument("--bridge-gaps", action="store_true", help="write it in spite of gaps")
    made.add_argument("-o", "--out", metavar="OUT.csv", help="write the motion there (t_s,motion)")


def workload_options(parser: argparse._ActionsContainer) -> None:
    """Add the options that ``given`` reads."""
    option = parser.add_argument
    option("--topics", nargs="+", metavar="T", help="topics, by name or pattern ('/camera/*'); default: all")
    option("--odom", metavar="TOPIC", help="take x from the motion on this topic (of tf: TOPIC:PARENT:CHILD)")
    option("--bridge-gaps", action="store_true", default=None, help="take motion across gaps in it as even")
    _motion_options(parser)


def _motion_options(parser: argparse._ActionsContainer) -> None:
    # A test holds these defaults to those of bufgym.traces.motion, which is not loaded for a help text.
    option = parser.add_argument
    option("--fov-deg", type=positive, metavar="DEG", help="field of view of a camera that moves so (default: 60)")
    option("--scene-scale-m", type=positive, metavar="M", help="moving so far shows a new scene, m (default: 2)")
    option("--max-gap-s", type=positive, metavar="S", help="longer times without a pose are gaps, s (default: 1)")


def given_motion(options: argparse.Namespace) -> dict[str, Any]:
    """The options on how motion is measured that were given, as arguments of ``read_motion``."""
    return {name: getattr(options, name) for name in MOTION_OPTIONS if getattr(options, name) is not None}


def given(options: argparse.Namespace) -> dict[str, Any]:
    """The workload options that were given, as arguments of ``read_workload``; on motion only where it has odometry."""
    found: dict[str, Any] = {}
    if options.topics is not None:
        found["topics"] = [name for text in options.topics for name in text.split(",") if name]
    if options.odom is not None:
        found.update(odom=options.odom, bridge_gaps=bool(options.bridge_gaps), **given_motion(options))
    elif options.bridge_gaps:
        raise BufgymError("--bridge-gaps needs --odom")
    return found


def refuse_motion(options: argparse.Namespace, why: str) -> None:
    """An error if an option on how motion is measured was given."""
    for name in given_motion(options):
        raise BufgymError(f"--{name.replace('_', '-')} {why}")


def workload_lines(workload: Workload) -> list[str]:
    """A table of its topics, and what is to be known of its motion."""
    from bufgym.benchmark.table import aligned

    cells = [["topic", "messages", "rate (1/s)", "bytes", "mean bytes", "share"]]
    for line in workload.summary():
        rate = "-" if math.isnan(line.rate_hz) else f"{line.rate_hz:.3f}"
        mean = f"{line.total_bytes / line.messages:,.0f}"
        name = line.topic or "(no name)"
        cells.append([name, f"{line.messages:,}", rate, f"{line.total_bytes:,}", mean, f"{line.share:.1%}"])
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
    from bufgym.traces import bags
    from bufgym.traces.recordings import workload_from_bag
    from bufgym.traces.workload import write_workload_csv

    arguments = given(options)
    if options.odom is None:
        refuse_motion(options, "needs --odom")
    bag = bags.read_bag(options.file, arguments.pop("odom", None))
    if options.topics is None and options.out is None and options.odom is None:
        print(f"{bag.path} ({bag.kind})\n")
        print("\n".join(_listed(bag, workload_from_bag(bag).summary() if len(bag.time_ns) else [])))
        print("\nchoose with --topics, take motion with --odom, write with -o")
        return
    workload = workload_from_bag(bag, **arguments)
    print(workload.source + "\n")
    print("\n".join(workload_lines(workload)))
    if options.out is not None:
        write_workload_csv(workload, Path(options.out))
        print(f"wrote {options.out}")


def _from_poses(options: argparse.Namespace) -> None:
    from bufgym.traces.motion import read_motion, write_motion_csv

    motion = read_motion(options.file, format=options.format, times=options.times, **given_motion(options))
    seconds = motion.duration_us / 1e6
    print(f"{motion.name}\n  source  {motion.source}\n  motion  {motion.total:.3f} fields of view in {seconds:.3f} s")
    count = len(motion.gaps)
    print(f"  gaps    {count}" + (f", the longest {motion.longest_gap_s:.1f} s" if count else ""))
    if options.out is None:
        return
    if motion.gaps and not options.bridge_gaps:
        raise BufgymError(f"{options.file}: has gaps: say --bridge-gaps to take motion across them as even")
    write_motion_csv(motion, Path(options.out))
    print(f"wrote {options.out}")


def _listed(bag: Any, summary: Sequence[Any]) -> list[str]:
    """Every topic of a recording with its type, those without messages at the end."""
    from bufgym.benchmark.table import aligned
    from bufgym.traces.bag_poses import carries_poses

    cells = [["topic", "messages", "rate (1/s)", "bytes", "share", "for --odom", "type"]]
    for line in summary:
        type = bag.topics[line.topic]
        rate = "-" if math.isnan(line.rate_hz) else f"{line.rate_hz:.3f}"
        poses = "yes" if carries_poses(type) else ""
        numbers = [f"{line.messages:,}", rate, f"{line.total_bytes:,}", f"{line.share:.1%}"]
        cells.append([line.topic, *numbers, poses, type])
    met = {line.topic for line in summary}
    cells += [[name, "0", "-", "0", "-", "", type] for name, type in bag.topics.items() if name not in met]
    return aligned(cells)
