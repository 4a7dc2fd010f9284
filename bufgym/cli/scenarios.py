"""The scenario that options describe: a stream over traces, or one interruption."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from bufgym.cli.options import count, least_0, positive
from bufgym.cli.trace_bags import (
    WORKLOAD_OPTIONS,
    motion_settings,
    refuse_motion,
    workload_arguments,
    workload_lines,
    workload_options,
)
from bufgym.errors import BufgymError, printable

if TYPE_CHECKING:
    from bufgym.scenario import Scenario
    from bufgym.traces import Motion, Trace

DEFAULTS = {
    "fps": 30.0,
    "bytes": 230_000,
    "seconds": 60.0,
    "jitter": 0.1,
    "size_cv": 0.0,
    "scale": 1.0,
    "t_min": 1,
    "t_max": 400,
    "t_mean": 100.0,
    "law": "log-uniform",
}
"""What holds where an option is not given (fps 1/s, bytes and seconds as named, t_* messages)."""

_UPLINK_ONLY = ("trace", "motion", "seconds", "jitter", "size_cv", "scale", "workload", *WORKLOAD_OPTIONS)
_STREAM_ONLY = ("fps", "bytes", "size_cv", "seconds", "jitter")
_INTERRUPTION_ONLY = ("t_min", "t_max", "t_mean", "law")


def scenario_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that ``scenario`` reads, ``--seeds`` apart."""
    add = parser.add_argument_group("the stream and its link").add_argument
    add("--trace", nargs="+", metavar="FILE", help="bandwidth traces, files or shipped names (default: shipped LTE)")
    add("--motion", nargs="+", metavar="FILE", help="motion recordings, likewise; 'none': x is the frame index")
    add("--fps", type=positive, help=f"messages a second (default: {DEFAULTS['fps']:g})")
    add("--bytes", type=count, help=f"mean message size, bytes (default: {DEFAULTS['bytes']})")
    add("--size-cv", type=least_0, help="coefficient of variation of the size (default: 0, all equal)")
    add("--seconds", type=positive, help=f"length of an episode, s (default: {DEFAULTS['seconds']:g})")
    add("--jitter", type=least_0, help=f"arrivals move by up to this part of a period (default: {DEFAULTS['jitter']})")
    add("--scale", type=positive, help="multiply the link's capacity (default: 1)")
    add(
        "--value",
        metavar="V",
        help="V of the QoI: exponential:BASE or saturating:DISTANCE"
        " (default: exponential:0.367879 over motion, exponential:0.618 over frame indices)",
    )
    group = parser.add_argument_group("a recording of a robot in place of the stream")
    what = "MCAP, ROS 1 bag, rosbag2 (extra 'ros') or CSV; alone, played once from the start of each trace"
    group.add_argument("--workload", metavar="FILE", help=what)
    workload_options(group)
    add = parser.add_argument_group("one interruption of unknown length T instead").add_argument
    add("--interruption", action="store_true", help="this scenario, and regret against its oracle")
    add("--law", help="of T: fixed (t-max), uniform, log-uniform, geometric (default: log-uniform)")
    add("--t-min", type=count, metavar="T", help="shortest, messages (default: 1)")
    add("--t-max", type=count, metavar="T", help="longest, messages (default: 400)")
    add("--t-mean", type=positive, metavar="T", help="mean of the geometric law (default: 100)")


def scenario(options: argparse.Namespace) -> tuple[Scenario, str]:
    """The scenario that the options describe, and a few lines about it."""
    unused = _UPLINK_ONLY if options.interruption else _INTERRUPTION_ONLY
    for name in unused:
        if getattr(options, name) is not None:
            only = "cannot go with" if options.interruption else "needs"
            raise BufgymError(f"--{name.replace('_', '-')} {only} --interruption")
    take = {
        name: default if getattr(options, name) is None else getattr(options, name)
        for name, default in DEFAULTS.items()
    }
    if options.interruption:
        return _interruption(options, take)
    if options.workload is not None:
        return _recording(options, take)
    for name in ("topics", "odom", "bridge_gaps"):
        if getattr(options, name) is not None:
            raise BufgymError(f"--{name.replace('_', '-')} needs --workload")
    if options.motion is None:
        refuse_motion(options, "needs --motion, or --workload with --odom")
    return _uplink(options, take)


def _interruption(options: argparse.Namespace, take: dict[str, Any]) -> tuple[Scenario, str]:
    from bufgym.model import qoi
    from bufgym.scenario import Interruption

    made = Interruption(
        law=take["law"],
        t_min=take["t_min"],
        t_max=take["t_max"],
        t_mean=take["t_mean"],
        rate_hz=take["fps"],
        size_bytes=take["bytes"],
        value=qoi.parse(options.value) if options.value is not None else qoi.exponential(),
    )
    length = f"T = {made.t_max}" if made.law == "fixed" else f"T {made.law} on {made.t_min}..{made.t_max}"
    about = f"One interruption of T messages, {length}; V = {made.value.name} over frame indices."
    return made, f"{about}\nMeans over {options.seeds} seeds. Regret = 1 - (QoI - 1) / oracle."


def _uplink(options: argparse.Namespace, take: dict[str, Any]) -> tuple[Scenario, str]:
    from bufgym import traces
    from bufgym.model import qoi
    from bufgym.scenario import Uplink

    names = traces.shipped()
    motions = options.motion if options.motion is not None else [name for name in names if name.startswith("drive-")]
    if motions == ["none"]:
        motions = []
    default = qoi.exponential(math.exp(-1)) if motions else qoi.exponential()
    made = Uplink(
        traces=_links(options),
        motion=tuple(_motion(name, options) for name in motions),
        rate_hz=take["fps"],
        jitter=take["jitter"],
        size_bytes=take["bytes"],
        size_cv=take["size_cv"],
        duration_s=take["seconds"],
        scale=(take["scale"],),
        value=qoi.parse(options.value) if options.value is not None else default,
    )
    recorded = _some([_with_gaps(motion) for motion in made.motion])
    over = f"the camera's motion, in fields of view, from {recorded}" if motions else "the frame index"
    scaled = f" x {take['scale']:g}" if take["scale"] != 1 else ""
    about = [
        f"{take['fps']:g} messages/s of {take['bytes']} bytes for {take['seconds']:g} s"
        f" over {_some([trace.name for trace in made.traces])}{scaled}, from random offsets.",
        f"QoI = 1 + sum of V(step in x) over the messages received; V = {made.value.name}.",
        f"x is {over}.",
        f"Means over {len(made.traces)} {'trace' if len(made.traces) == 1 else 'traces'} x {options.seeds} seeds;"
        " every policy meets the same episodes.",
    ]
    return made, "\n".join(about)


def _recording(options: argparse.Namespace, take: dict[str, Any]) -> tuple[Scenario, str]:
    """A workload as it was recorded; with --seeds, from random places on each trace."""
    from bufgym.model import qoi
    from bufgym.scenario import Uplink
    from bufgym.traces import read_workload

    for name in _STREAM_ONLY:
        if getattr(options, name) is not None:
            raise BufgymError(f"--{name.replace('_', '-')} cannot go with --workload: a recording has its own")
    workload = read_workload(options.workload, **workload_arguments(options))
    motions = [] if options.motion in (None, ["none"]) else [_motion(name, options) for name in options.motion]
    if options.odom is None and not motions:
        refuse_motion(options, "needs --odom or --motion")
    by_motion = bool(motions) or workload.x is not None
    default = qoi.exponential(math.exp(-1)) if by_motion else qoi.exponential()
    random_offset = options.seeds is not None
    options.seeds = options.seeds or 1
    made = Uplink(
        traces=_links(options),
        motion=tuple(motions),
        scale=(take["scale"],),
        random_offset=random_offset,
        value=qoi.parse(options.value) if options.value is not None else default,
        workload=workload,
    )
    x = f"motion, from {_some([_with_gaps(motion) for motion in motions])}" if motions else "motion, as recorded"
    where = f"{options.seeds} random places each" if random_offset else "from the trace's start"
    scaled = f" x {take['scale']:g}" if take["scale"] != 1 else ""
    shared = "; all topics share one queue" if len(workload.topics) > 1 else ""
    about = [
        printable(workload.source),
        "",
        *workload_lines(workload),
        "",
        f"Played over {_some([trace.name for trace in made.traces])}{scaled}, {where}{shared}.",
        f"QoI = 1 + sum of V(step in x) over the messages received; V = {made.value.name}.",
        f"x is {f'the {x}, in fields of view' if by_motion else 'the number of the message'}.",
    ]
    return made, "\n".join(about)


def _links(options: argparse.Namespace) -> tuple[Trace, ...]:
    from bufgym import traces

    names = options.trace
    if names is None:
        names = [name for name in traces.shipped() if name.startswith("lte-")]
    return tuple(traces.load(name) for name in names)


def _motion(name: str, options: argparse.Namespace) -> Motion:
    """A motion by its shipped name or from a file, measured as the options say."""
    from bufgym import traces
    from bufgym.traces.formats.motions import MOTION_HEADER

    settings = motion_settings(options)
    if settings is None:
        return traces.load_motion(name)
    motion = traces.read_motion(traces.shipped().get(name, name), settings)
    if motion.source.endswith(f"({MOTION_HEADER})"):
        refuse_motion(options, f"cannot go with {name}, which holds finished coordinates")
    return motion


def _with_gaps(motion: Motion) -> str:
    """Its name, and how much of it is guessed."""
    if not motion.gaps:
        return motion.name
    return f"{motion.name} (gaps bridged: {len(motion.gaps)}, the longest {motion.longest_gap_s:.1f} s)"


def _some(names: Sequence[str]) -> str:
    return printable(", ".join(names) if len(names) <= 3 else f"{names[0]} .. {names[-1]}")
