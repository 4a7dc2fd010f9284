"""The scenario that options describe: a stream over traces, or one interruption."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from bufgym.cli.options import count, least_0, positive
from bufgym.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.scenario import Scenario

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

_UPLINK_ONLY = ("trace", "motion", "seconds", "jitter", "size_cv", "scale")
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
    return _interruption(options, take) if options.interruption else _uplink(options, take)


def _interruption(options: argparse.Namespace, take: dict[str, Any]) -> tuple[Scenario, str]:
    from bufgym import qoi
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
    from bufgym import qoi, traces
    from bufgym.scenario import Uplink

    names = traces.shipped()
    links = options.trace if options.trace is not None else [name for name in names if name.startswith("lte-")]
    motions = options.motion if options.motion is not None else [name for name in names if name.startswith("drive-")]
    if motions == ["none"]:
        motions = []
    default = qoi.exponential(math.exp(-1)) if motions else qoi.exponential()
    made = Uplink(
        traces=tuple(traces.load(name) for name in links),
        motion=tuple(traces.load_motion(name) for name in motions),
        rate_hz=take["fps"],
        jitter=take["jitter"],
        size_bytes=take["bytes"],
        size_cv=take["size_cv"],
        duration_s=take["seconds"],
        scale=(take["scale"],),
        value=qoi.parse(options.value) if options.value is not None else default,
    )
    recorded = _some([motion.name for motion in made.motion])
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


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 3 else f"{names[0]} .. {names[-1]}"
