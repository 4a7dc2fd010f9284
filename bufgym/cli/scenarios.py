"""Scenario that options describe: a stream over traces, or one interruption."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from bufgym.cli.options import count, given, least_0, positive, refuse
from bufgym.cli.trace_bags import (
    WORKLOAD_OPTIONS,
    motion_settings,
    refuse_motion,
    workload_arguments,
    workload_lines,
    workload_options,
)
from bufgym.ground import modules
from bufgym.ground.errors import BufgymError, printable

if TYPE_CHECKING:
    from bufgym.model.qoi import Value
    from bufgym.scenario import Scenario, Uplink
    from bufgym.traces import Motion, Trace

_UPLINK_ONLY = ("trace", "motion", "seconds", "jitter", "size_cv", "scale", "workload", *WORKLOAD_OPTIONS)
_STREAM_ONLY = ("fps", "bytes", "size_cv", "seconds", "jitter")
OWN = ("scenario_file", "scenario")
"""Options that name a user's scenario, which replaces all other options."""
_INTERRUPTION_ONLY = ("t_min", "t_max", "t_mean", "law")

SCORE = "Score: 0 is Drop Oldest, 1 the clairvoyant; regret = 1 - QoI / the clairvoyant's."
"""Legend of the table's first columns."""

_PARAMETERS = {"fps": "rate_hz", "bytes": "size_bytes", "seconds": "duration_s"}
"""Options whose scenario parameter has another name. Options not given take the scenario's defaults."""


def scenario_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that ``scenario`` reads, except ``--seeds``."""
    about = "what is not given is as in bufgym/Uplink-v0; the first lines of the output say how that is"
    add = parser.add_argument_group("the stream and its link", about).add_argument
    links = "bandwidth traces: files, shipped names, or module:function, a seed -> Trace (default: shipped LTE)"
    add("--trace", nargs="+", metavar="FILE", help=links)
    add("--motion", nargs="+", metavar="FILE", help="motion recordings, likewise; 'none': x is the frame index")
    add("--fps", type=positive, help="messages a second")
    add("--bytes", type=count, help="mean message size, bytes")
    add("--size-cv", type=least_0, help="coefficient of variation of the size; 0: all equal")
    add("--seconds", type=positive, help="length of an episode, s")
    add("--jitter", type=least_0, help="arrivals move by up to this part of a period")
    add("--scale", type=positive, help="multiply the link's capacity (default: 1)")
    add(
        "--value",
        metavar="V",
        help="V of the QoI: exponential:BASE, saturating:DISTANCE, tabulated:D=V,..., or module:function of your own"
        " (default: exponential:0.05 over motion, exponential:0.367879 over a recording's motion,"
        " exponential:0.618 over frame indices)",
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
    add = parser.add_argument_group("a scenario of your own instead").add_argument
    add("--scenario-file", metavar="FILE.py", help="a Python file that registers it; its code is run")
    add("--scenario", metavar="NAME", help="which; also any other in 'bufgym list scenarios', or module:function")


def scenario(options: argparse.Namespace) -> tuple[Scenario, str]:
    """Make the scenario that the options describe, and a few lines about it."""
    if given(options, OWN):
        return _own(options)
    unused = _UPLINK_ONLY if options.interruption else _INTERRUPTION_ONLY
    refuse(options, unused, "cannot go with --interruption" if options.interruption else "needs --interruption")
    if options.interruption:
        return _interruption(options)
    if options.workload is not None:
        return _recording(options)
    refuse(options, ("topics", "odom", "bridge_gaps"), "needs --workload")
    if options.motion is None:
        refuse_motion(options, "needs --motion, or --workload with --odom")
    return _uplink(options)


def _given(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Select the options that the user gave, as parameters of the scenario."""
    return {_PARAMETERS.get(name, name): value for name, value in given(options, names).items()}


def _own(options: argparse.Namespace) -> tuple[Scenario, str]:
    """Find a scenario by name after running the file that registers it."""
    from bufgym import scenario as scenarios
    from bufgym.benchmark.run import by_trace

    described = ("interruption", "value", *_UPLINK_ONLY, *_STREAM_ONLY, *_INTERRUPTION_ONLY)
    refuse(options, described, "cannot go with a scenario of your own, which says it itself")
    before, name = dict(scenarios.SCENARIOS), options.scenario
    if options.scenario_file is not None:
        modules.run_file(options.scenario_file, "--scenario-file")
    added = [key for key, entry in scenarios.SCENARIOS.items() if before.get(key) is not entry]
    if name is None and len(added) != 1:
        names = f"registers {', '.join(added)}: choose by --scenario" if added else "registers no scenario"
        raise BufgymError(f"{options.scenario_file}: {names}")
    name = name or added[0]
    found = scenarios.get(name)
    if found.topics:
        raise BufgymError(f"scenario {name}: has several topics; bufgym bench runs those of one queue")
    what = scenarios.SCENARIOS[name][1] if name in scenarios.SCENARIOS else type(found).__name__
    traces = len(by_trace(found))
    met = "" if traces == 1 else f"{traces} traces x "
    return found, "\n".join(
        [
            f"Scenario {printable(name)}: {printable(what)}",
            f"QoI = 1 + sum of V(step in x) over the messages received; V = {printable(found.value.name)}.",
            f"Means over {met}{options.seeds} seeds; every policy meets the same episodes.",
            SCORE,
        ]
    )


def _interruption(options: argparse.Namespace) -> tuple[Scenario, str]:
    from bufgym.scenario import Interruption

    settings = _given(options, "fps", "bytes", *_INTERRUPTION_ONLY)
    interruption = Interruption(**settings, value=_value(options, by_motion=False))
    law, t_min, t_max = interruption.law, interruption.t_min, interruption.t_max
    length = f"T = {t_max}" if law == "fixed" else f"T {law} on {t_min}..{t_max}"
    about = f"One interruption of T messages, {length}; V = {interruption.value.name} over frame indices."
    return interruption, f"{about}\nMeans over {options.seeds} seeds. {SCORE}"


def _uplink(options: argparse.Namespace) -> tuple[Scenario, str]:
    from bufgym import scenario, traces
    from bufgym.scenario import Uplink

    settings = _given(options, *_STREAM_ONLY)
    motions = options.motion
    if motions is None:
        motions = [name for name in traces.shipped() if name.startswith("drive-")]
    if options.value is not None or motions == ["none"]:
        settings["value"] = _value(options, by_motion=False)
    links, scale = _links(options), (options.scale or 1.0,)
    uplink = scenario.get("lte", traces=links, motion=_motions(motions, options), scale=scale, **settings)
    assert isinstance(uplink, Uplink)
    recorded = _some([_with_gaps(motion) for motion in uplink.motion])
    x = f"the camera's motion, in fields of view, from {recorded}" if uplink.motion else "the frame index"
    traces_met = f"{len(uplink.traces)} {'trace' if len(uplink.traces) == 1 else 'traces'}"
    about = [
        f"{uplink.rate_hz:g} messages/s of {uplink.size_bytes} bytes for {uplink.duration_s:g} s"
        f" over {_over(uplink)}, from random offsets.",
        *_measured(uplink, x),
        f"Means over {traces_met} x {options.seeds} seeds; every policy meets the same episodes.",
        SCORE,
    ]
    return uplink, "\n".join(about)


def _recording(options: argparse.Namespace) -> tuple[Scenario, str]:
    """Make a workload as recorded; with --seeds it starts at random places of each trace."""
    from bufgym.scenario import Uplink
    from bufgym.traces import read_workload

    refuse(options, _STREAM_ONLY, "cannot go with --workload: a recording has its own")
    workload = read_workload(options.workload, **workload_arguments(options))
    motions = _motions(options.motion or [], options)
    if options.odom is None and not motions:
        refuse_motion(options, "needs --odom or --motion")
    by_motion = bool(motions) or workload.x is not None
    random_offset = options.seeds is not None
    options.seeds = options.seeds or 1
    uplink = Uplink(
        traces=_links(options),
        motion=motions,
        scale=(options.scale or 1.0,),
        random_offset=random_offset,
        value=_value(options, by_motion),
        workload=workload,
    )
    source = f"from {_some([_with_gaps(motion) for motion in motions])}" if motions else "as recorded"
    places = f"{options.seeds} random places each" if random_offset else "from the trace's start"
    shared = "; all topics share one queue" if len(workload.topics) > 1 else ""
    about = [
        *(printable(workload.source), "", *workload_lines(workload), ""),
        f"Played over {_over(uplink)}, {places}{shared}.",
        *_measured(uplink, f"the motion, {source}, in fields of view" if by_motion else "the number of the message"),
    ]
    return uplink, "\n".join([*about, SCORE])


def _value(options: argparse.Namespace, by_motion: bool) -> Value:
    """Choose V by the options, or the default over a recording's motion or over frame indices."""
    from bufgym.model import qoi

    if options.value is not None:
        return qoi.load(options.value)
    return qoi.exponential(math.exp(-1)) if by_motion else qoi.exponential()


def _over(uplink: Uplink) -> str:
    scaled = f" x {uplink.scale[0]:g}" if uplink.scale != (1.0,) else ""
    return _some([trace.name for trace in uplink.traces]) + scaled


def _measured(uplink: Uplink, x: str) -> list[str]:
    return [
        f"QoI = 1 + sum of V(step in x) over the messages received; V = {uplink.value.name}.",
        f"x is {x}.",
    ]


def _links(options: argparse.Namespace) -> tuple[Trace, ...]:
    from bufgym import traces
    from bufgym.scenario.checks import links

    names = options.trace
    if names is None:
        names = [name for name in traces.shipped() if name.startswith("lte-")]
    return tuple(trace for name in names for trace in links(name))


def _motions(names: Sequence[str], options: argparse.Namespace) -> tuple[Motion, ...]:
    """Load motions by shipped name or from files; ``["none"]`` gives none."""
    return () if list(names) == ["none"] else tuple(_motion(name, options) for name in names)


def _motion(name: str, options: argparse.Namespace) -> Motion:
    """Load a motion by shipped name or from a file, measured as the options say."""
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
    """Write its name and the interpolated share."""
    if not motion.gaps:
        return motion.name
    return f"{motion.name} (gaps bridged: {len(motion.gaps)}, the longest {motion.longest_gap_s:.1f} s)"


def _some(names: Sequence[str]) -> str:
    return printable(", ".join(names) if len(names) <= 3 else f"{names[0]} .. {names[-1]}")
