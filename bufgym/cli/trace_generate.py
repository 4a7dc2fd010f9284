"""``bufgym trace generate``: links and motions from a seed.

A link's options have its generator's parameter names as `dest` and are passed on to the generator.
"""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Callable

from bufgym.cli.options import Commands, Parser, command, least_0, natural, positive


def add(commands: Commands) -> None:
    """Declare ``generate`` among the commands of ``bufgym trace``."""
    generate = commands.add_parser(
        "generate",
        help="make a link or a motion from a seed",
        description="Make a link or a motion from a seed, as CSV.",
    )
    kinds = generate.add_subparsers(title="kinds", metavar="KIND", required=True)
    _add_links(kinds)
    _add_rules(kinds)
    _add_motion(kinds)


def _add_links(kinds: Commands) -> None:
    link = _kind(kinds, "link", _link, "a mobile link as recorded in trams, trains, ... (or in WiFi)", "markov_link")
    link.add_argument("--mode", required=True, metavar="NAME", help="foot, bicycle, bus, tram, train, car, wifi-...")
    help = "scale to this mean (default: as recorded)"
    link.add_argument("--mean", dest="mean_bytes_per_s", type=positive, metavar="BYTES/S", help=help)
    link.add_argument("--links", metavar="FILE", help="parameters made by 'bufgym trace fit' (default: bufgym's own)")


def _add_rules(kinds: Commands) -> None:
    steady = _kind(kinds, "steady", _generate, "one rate throughout", "steady", seeded=False)
    _option(steady, "--rate", "bytes_per_s", positive, 10e6, "BYTES/S")
    help = "a rate that changes evenly (default: Robofleet's 100 to 4 Mbit/s)"
    ramp = _kind(kinds, "ramp", _generate, help, "ramp", seeded=False)
    ramp.set_defaults(duration_s=15.0)
    _option(ramp, "--start", "start_bytes_per_s", least_0, 12.5e6, "BYTES/S")
    _option(ramp, "--end", "end_bytes_per_s", least_0, 0.5e6, "BYTES/S")
    tunnel = command(kinds, "tunnel", _generate, "steady, fade, blackout, fade in, steady")
    tunnel.set_defaults(generator="tunnel")
    tunnel.add_argument("-o", "--out", required=True, metavar="FILE", help="the CSV to write")
    _option(tunnel, "--rate", "bytes_per_s", positive, 10e6, "BYTES/S", "outside")
    for part, seconds in (("before", 20.0), ("fade", 3.0), ("blackout", 10.0), ("recover", 2.0), ("after", 20.0)):
        _option(tunnel, f"--{part}", f"{part}_s", least_0, seconds, "S", "its length")


def _add_motion(kinds: Commands) -> None:
    _kind(kinds, "drive", _drive, "the motion of a robot that cruises, turns in place and stops")


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
        _option(parser, "--seed", "seed", natural, 0, "N", "whole number >= 0")
    _option(parser, "--duration", "duration_s", positive, 300.0, "S", "length in s")
    parser.add_argument("-o", "--out", required=True, metavar="FILE", help="the CSV to write")
    return parser


def _option(
    parser: Parser, flag: str, dest: str, type: Callable[[str], float], default: float, unit: str, help: str = ""
) -> None:
    """Add the option of a number, with its default stated in the help text."""
    help = f"{help} (%(default)s)".strip()
    parser.add_argument(flag, dest=dest, type=type, default=default, metavar=unit, help=help)


# --- links -----------------------------------------------------------------------------------------------------------


def _generate(options: argparse.Namespace) -> None:
    """Write the link that `options.generator` makes from the options named like its parameters."""
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


# --- motion ----------------------------------------------------------------------------------------------------------


def _drive(options: argparse.Namespace) -> None:
    from bufgym.traces import drive_motion, write_motion_csv

    motion = drive_motion(options.seed, options.duration_s)
    write_motion_csv(motion, options.out)
    print(f"wrote {options.out}: {motion.source}, {motion.total:.3f} views")
