"""``bufgym trace generate``: links, motions and frame sizes from a seed.

The options of a link have the names of its generator's parameters (`dest`), and are passed on to it.
"""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Callable
from typing import Any

from bufgym.cli.options import Commands, Parser, command, count, least_0, natural, number, positive
from bufgym.errors import BufgymError


def add(commands: Commands) -> None:
    """Declare ``generate`` among the commands of ``bufgym trace``."""
    generate = commands.add_parser(
        "generate",
        help="make a link, a motion or frame sizes from a seed",
        description="Make a link, a motion or frame sizes from a seed, as CSV.",
    )
    kinds = generate.add_subparsers(title="kinds", metavar="KIND", required=True)
    _add_links(kinds)
    _add_rules(kinds)
    _add_motion(kinds)


def _add_links(kinds: Commands) -> None:
    link = _kind(kinds, "link", _link, "a mobile link as recorded in trams, trains, ... (or in WiFi)", "markov_link")
    link.add_argument("--mode", required=True, metavar="NAME", help="foot, bicycle, bus, tram, train, car, wifi-...")
    link.add_argument(
        "--mean",
        type=positive,
        dest="mean_bytes_per_s",
        metavar="BYTES/S",
        help="scale to this mean (default: as recorded)",
    )
    link.add_argument("--links", metavar="FILE", help="parameters made by 'bufgym trace fit' (default: bufgym's own)")
    states = _kind(kinds, "gilbert-elliott", _generate, "a link of two states, good and bad", "gilbert_elliott")
    for state, bytes_per_s, mean_s in (("good", 10e6, 20.0), ("bad", 0.0, 2.0)):
        name = f"{state}_bytes_per_s"
        states.add_argument(
            f"--{state}", type=least_0, dest=name, default=bytes_per_s, metavar="BYTES/S", help="(%(default)s)"
        )
        name = f"mean_{state}_s"
        states.add_argument(
            f"--mean-{state}", type=positive, dest=name, default=mean_s, metavar="S", help="mean stay (%(default)s)"
        )
    path = _kind(kinds, "roaming", _roaming, "WiFi past access points, with hand-overs", "roaming")
    path.add_argument("--access-points", type=count, default=4, metavar="N", help="in a row (%(default)s)")
    path.add_argument("--spacing", type=positive, default=50.0, metavar="M", help="between them (%(default)s)")
    path.add_argument("--speed", type=positive, default=1.0, metavar="M/S", help="of the robot (%(default)s)")
    path.add_argument(
        "--gap", type=least_0, default=1.0, metavar="S", help="without a link at a hand-over (%(default)s)"
    )


def _add_rules(kinds: Commands) -> None:
    rate: dict[str, Any] = {"type": positive, "dest": "bytes_per_s", "default": 10e6, "metavar": "BYTES/S"}
    steady = _kind(kinds, "steady", _generate, "one rate throughout", "steady", seeded=False)
    steady.add_argument("--rate", **rate, help="(%(default)s)")
    help = "a rate that changes evenly (default: Robofleet's 100 to 4 Mbit/s)"
    ramp = _kind(kinds, "ramp", _generate, help, "ramp", seeded=False)
    ramp.set_defaults(duration_s=15.0)
    for name, bytes_per_s in (("start", 12.5e6), ("end", 0.5e6)):
        ramp.add_argument(
            f"--{name}",
            type=least_0,
            dest=f"{name}_bytes_per_s",
            default=bytes_per_s,
            metavar="BYTES/S",
            help="(%(default)s)",
        )
    tunnel = command(kinds, "tunnel", _generate, "steady, fade, blackout, fade in, steady")
    tunnel.set_defaults(generator="tunnel")
    tunnel.add_argument("-o", "--out", required=True, metavar="FILE", help="the CSV to write")
    tunnel.add_argument("--rate", **rate, help="outside (%(default)s)")
    for name, seconds in (("before", 20.0), ("fade", 3.0), ("blackout", 10.0), ("recover", 2.0), ("after", 20.0)):
        tunnel.add_argument(
            f"--{name}", type=least_0, dest=f"{name}_s", default=seconds, metavar="S", help="its length (%(default)s)"
        )


def _add_motion(kinds: Commands) -> None:
    drive = _kind(kinds, "drive", _drive, "the motion of a robot that cruises, turns in place and stops")
    drive.add_argument("--cruise", type=_range, metavar="LOW,HIGH", help="speeds, m/s (0.5,1.5)")
    drive.add_argument("--turn", type=_range, metavar="LOW,HIGH", help="turn rates in place, degrees/s (30,60)")
    frames = _kind(kinds, "frames", _frames, "RGB-D frames whose sizes follow motion and detail (time_s,bytes,x)")
    frames.add_argument("--motion", metavar="FILE", help="a motion or trajectory, or a shipped name (default: drive)")
    frames.add_argument("--rate-hz", type=positive, default=30.0, metavar="HZ", help="frames a second (%(default)s)")
    frames.add_argument("--base", type=positive, default=230_000.0, metavar="BYTES", help="at rest (%(default)s)")


def _kind(
    kinds: Commands,
    name: str,
    function: Callable[[argparse.Namespace], None],
    help: str,
    generator: str | None = None,
    *,
    seeded: bool = True,
) -> Parser:
    parser = command(kinds, name, function, help)
    parser.set_defaults(generator=generator)
    if seeded:
        parser.add_argument("--seed", type=natural, default=0, metavar="N", help="whole number >= 0 (%(default)s)")
    parser.add_argument(
        "--duration", type=positive, dest="duration_s", default=300.0, metavar="S", help="length in s (%(default)s)"
    )
    parser.add_argument("-o", "--out", required=True, metavar="FILE", help="the CSV to write")
    return parser


def _range(text: str) -> tuple[float, float]:
    """Two numbers, the first not above the second."""
    parts = text.split(",")
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f"{text!r}: must be two numbers, LOW,HIGH")
    low, high = number(parts[0]), number(parts[1])
    if low > high:
        raise argparse.ArgumentTypeError(f"{text}: the first must not be above the second")
    return low, high


# --- links -----------------------------------------------------------------------------------------------------------


def _generate(options: argparse.Namespace) -> None:
    """Write the link that `options.generator` makes of the options that bear its parameters' names."""
    from bufgym import traces

    generator = getattr(traces, options.generator)
    parameters = inspect.signature(generator).parameters
    trace = generator(**{name: value for name, value in vars(options).items() if name in parameters})
    traces.write_csv(trace, options.out)
    print(f"wrote {options.out}: {trace.source}, mean {trace.mean_bytes_per_s / 1e6:.3f} MB/s")


def _link(options: argparse.Namespace) -> None:
    from bufgym.traces import read_links

    options.links = None if options.links is None else read_links(options.links)
    _generate(options)


def _roaming(options: argparse.Namespace) -> None:
    from bufgym.traces import Corridor

    options.corridor = Corridor(
        access_points=options.access_points,
        spacing_m=options.spacing,
        speed_m_per_s=options.speed,
        gap_s=options.gap,
    )
    _generate(options)


# --- motion and frames -----------------------------------------------------------------------------------------------


def _drive(options: argparse.Namespace) -> None:
    from bufgym.traces import Driving, drive_motion, write_motion_csv

    ranges = {"cruise_m_per_s": options.cruise, "turn_deg_per_s": options.turn}
    driving = Driving(**{name: limits for name, limits in ranges.items() if limits is not None})
    motion = drive_motion(options.seed, options.duration_s, driving)
    write_motion_csv(motion, options.out)
    print(f"wrote {options.out}: {motion.source}, {motion.total:.3f} views")


def _frames(options: argparse.Namespace) -> None:
    import numpy as np

    from bufgym.traces import FrameModel, Workload, drive_motion, frame_sizes, load_motion, write_workload_csv

    frames = options.duration_s * options.rate_hz
    if not 1 <= frames <= 1e7:
        raise BufgymError(f"--duration x --rate-hz = {frames:g} frames: must be from 1 to 1e7")
    motion = load_motion(options.motion) if options.motion else drive_motion(options.seed, options.duration_s)
    arrival_us = np.rint(np.arange(int(frames)) * (1e6 / options.rate_hz)).astype(np.int64)
    sizes = frame_sizes(arrival_us, motion, options.seed, FrameModel(base_bytes=options.base))
    x = motion.at(arrival_us)
    write_workload_csv(Workload("frames", arrival_us, sizes, x=x - x[0]), options.out)
    print(f"wrote {options.out}: {len(sizes)} frames, mean {sizes.mean() / 1e3:.1f} kB")
