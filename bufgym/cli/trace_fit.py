"""``bufgym trace fit`` and ``trace generate``: link parameters from recordings; links and motions from a seed."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from bufgym.cli.options import Commands, Parser, columns, command, count, least_0, natural, number, positive
from bufgym.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.traces import Motion, Trace
    from bufgym.traces.trace import Float64Array


def add(commands: Commands) -> None:
    """Add both verbs below ``bufgym trace``."""
    fit = command(commands, "fit", _fit, "fit the parameters of generated links to recordings")
    fit.add_argument("files", nargs="+", metavar="FILE", help="recordings; their names say the mode (report_car_2.csv)")
    fit.add_argument("--mode", metavar="NAME", help="all files are of this mode, whatever their names")
    fit.add_argument("-o", "--out", required=True, metavar="FILE", help="the parameters to write (.json)")
    fit.add_argument("--page", metavar="FILE.md", help="also write a page that compares recordings and generated links")
    fit.add_argument(
        "--sets",
        type=count,
        default=199,
        metavar="N",
        help="generated sets for the page (%(default)s; the p-values are multiples of 1 / (N + 1))",
    )
    generate = commands.add_parser(
        "generate",
        help="make a link, a motion or frame sizes from a seed",
        description="Make a link, a motion or frame sizes from a seed, as CSV.",
    )
    kinds = generate.add_subparsers(title="kinds", metavar="KIND", required=True)
    _add_links(kinds)
    _add_rules(kinds)
    _add_motion(kinds)


# --- fit -------------------------------------------------------------------------------------------------------------


def _fit(options: argparse.Namespace) -> None:
    from bufgym.traces.generate.fit import LOW_BYTES_PER_S, fit_links, mode_of, rates_of
    from bufgym.traces.generate.page import check_page, write_page
    from bufgym.traces.generate.parameters import write_links

    if options.page is not None:
        check_page(Path(options.page))
    rows: dict[str, list[Float64Array]] = {}
    for file in sorted(set(options.files)):
        mode = options.mode or mode_of(file)
        rows.setdefault(mode, []).append(rates_of(file))
    rows = {mode: rows[mode] for mode in sorted(rows)}
    links = fit_links(rows)
    write_links(links, options.out, LOW_BYTES_PER_S, _command(options))
    print(columns([(mode, f"{link.recordings} recordings", f"{link.seconds} s") for mode, link in links.items()]))
    print(f"wrote {options.out}")
    if options.page is not None:
        write_page(
            links, rows, Path(options.page), f"{_command(options)} --page {Path(options.page).name}", options.sets
        )
        print(f"wrote {options.page}")


def _command(options: argparse.Namespace) -> str:
    """The command as it can be typed again, each folder's files as a pattern, below what all have in common."""
    folders = {(Path(file).resolve().parent, Path(file).suffix) for file in options.files}
    top = Path(os.path.commonpath([folder for folder, _ in folders]))
    top = top.parent if (top in {folder for folder, _ in folders}) else top
    patterns = {f"{folder.relative_to(top).as_posix()}/*{suffix}" for folder, suffix in folders}
    parts = ["bufgym trace fit", *sorted(patterns)]
    parts += [f"--mode {options.mode}"] if options.mode else []
    return " ".join([*parts, f"-o {Path(options.out).name}"])


# --- generate --------------------------------------------------------------------------------------------------------


def _add_links(kinds: Commands) -> None:
    link = _kind(kinds, "link", _link, "a mobile link as recorded in trams, trains, ... (or in WiFi)")
    link.add_argument("--mode", required=True, metavar="NAME", help="foot, bicycle, bus, tram, train, car, wifi-...")
    link.add_argument("--mean", type=positive, metavar="BYTES/S", help="scale to this mean (default: as recorded)")
    link.add_argument("--links", metavar="FILE", help="parameters made by 'bufgym trace fit' (default: bufgym's own)")
    states = _kind(kinds, "gilbert-elliott", _gilbert_elliott, "a link of two states, good and bad")
    states.add_argument("--good", type=least_0, default=10e6, metavar="BYTES/S", help="(%(default)s)")
    states.add_argument("--bad", type=least_0, default=0.0, metavar="BYTES/S", help="(%(default)s)")
    states.add_argument("--mean-good", type=positive, default=20.0, metavar="S", help="mean stay (%(default)s)")
    states.add_argument("--mean-bad", type=positive, default=2.0, metavar="S", help="mean stay (%(default)s)")
    path = _kind(kinds, "roaming", _roaming, "WiFi past access points, with hand-overs")
    path.add_argument("--access-points", type=count, default=4, metavar="N", help="in a row (%(default)s)")
    path.add_argument("--spacing", type=positive, default=50.0, metavar="M", help="between them (%(default)s)")
    path.add_argument("--speed", type=positive, default=1.0, metavar="M/S", help="of the robot (%(default)s)")
    path.add_argument(
        "--gap", type=least_0, default=1.0, metavar="S", help="without a link at a hand-over (%(default)s)"
    )


def _add_rules(kinds: Commands) -> None:
    same = _kind(kinds, "steady", _steady, "one rate throughout", seeded=False)
    same.add_argument("--rate", type=positive, default=10e6, metavar="BYTES/S", help="(%(default)s)")
    line = _kind(
        kinds, "ramp", _ramp, "a rate that changes evenly (default: Robofleet's 100 to 4 Mbit/s)", seeded=False
    )
    line.set_defaults(duration=15.0)
    line.add_argument("--start", type=least_0, default=12.5e6, metavar="BYTES/S", help="(%(default)s)")
    line.add_argument("--end", type=least_0, default=0.5e6, metavar="BYTES/S", help="(%(default)s)")
    through = command(kinds, "tunnel", _tunnel, "steady, fade, blackout, fade in, steady")
    through.add_argument("-o", "--out", required=True, metavar="FILE", help="the CSV to write")
    through.add_argument("--rate", type=positive, default=10e6, metavar="BYTES/S", help="outside (%(default)s)")
    for name, seconds in (("before", 20.0), ("fade", 3.0), ("blackout", 10.0), ("recover", 2.0), ("after", 20.0)):
        through.add_argument(f"--{name}", type=least_0, default=seconds, metavar="S", help="its length (%(default)s)")


def _add_motion(kinds: Commands) -> None:
    drive = _kind(kinds, "drive", _drive, "the motion of a robot that cruises, turns in place and stops")
    drive.add_argument("--cruise", type=_range, metavar="LOW,HIGH", help="speeds, m/s (0.5,1.5)")
    drive.add_argument("--turn", type=_range, metavar="LOW,HIGH", help="turn rates in place, degrees/s (30,60)")
    sizes = _kind(kinds, "frames", _frames, "RGB-D frames whose sizes follow motion and detail (time_s,bytes,x)")
    sizes.add_argument("--motion", metavar="FILE", help="a motion or trajectory, or a shipped name (default: drive)")
    sizes.add_argument("--rate-hz", type=positive, default=30.0, metavar="HZ", help="frames a second (%(default)s)")
    sizes.add_argument("--base", type=positive, default=230_000.0, metavar="BYTES", help="at rest (%(default)s)")


def _kind(kinds: Commands, name: str, make: object, help: str, seeded: bool = True) -> Parser:
    assert callable(make)
    made = command(kinds, name, make, help)
    if seeded:
        made.add_argument("--seed", type=natural, default=0, metavar="N", help="whole number >= 0 (%(default)s)")
    made.add_argument("--duration", type=positive, default=300.0, metavar="S", help="length in s (%(default)s)")
    made.add_argument("-o", "--out", required=True, metavar="FILE", help="the CSV to write")
    return made


def _range(text: str) -> tuple[float, float]:
    """Two numbers, the first not above the second."""
    parts = text.split(",")
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f"{text!r}: must be two numbers, LOW,HIGH")
    low, high = number(parts[0]), number(parts[1])
    if low > high:
        raise argparse.ArgumentTypeError(f"{text}: the first must not be above the second")
    return low, high


def _link(options: argparse.Namespace) -> None:
    from bufgym.traces.generate import markov_link, read_links

    links = None if options.links is None else read_links(options.links)
    made = markov_link(options.mode, options.seed, options.duration, mean_bytes_per_s=options.mean, links=links)
    _write_trace(made, options.out)


def _gilbert_elliott(options: argparse.Namespace) -> None:
    from bufgym.traces.generate import gilbert_elliott

    made = gilbert_elliott(
        options.seed,
        options.duration,
        good_bytes_per_s=options.good,
        bad_bytes_per_s=options.bad,
        mean_good_s=options.mean_good,
        mean_bad_s=options.mean_bad,
    )
    _write_trace(made, options.out)


def _roaming(options: argparse.Namespace) -> None:
    from bufgym.traces.generate import Corridor, roaming

    corridor = Corridor(
        access_points=options.access_points,
        spacing_m=options.spacing,
        speed_m_per_s=options.speed,
        gap_s=options.gap,
    )
    _write_trace(roaming(options.seed, options.duration, corridor), options.out)


def _steady(options: argparse.Namespace) -> None:
    from bufgym.traces.generate import steady

    _write_trace(steady(options.rate, options.duration), options.out)


def _ramp(options: argparse.Namespace) -> None:
    from bufgym.traces.generate import ramp

    _write_trace(ramp(options.start, options.end, options.duration), options.out)


def _tunnel(options: argparse.Namespace) -> None:
    from bufgym.traces.generate import tunnel

    made = tunnel(
        options.rate,
        before_s=options.before,
        fade_s=options.fade,
        blackout_s=options.blackout,
        recover_s=options.recover,
        after_s=options.after,
    )
    _write_trace(made, options.out)


def _write_trace(made: Trace, out: str) -> None:
    from bufgym.traces import write_csv

    write_csv(made, out)
    print(f"wrote {out}: {made.source}, mean {made.mean_bytes_per_s / 1e6:.3f} MB/s")


def _driven(options: argparse.Namespace) -> Motion:
    from bufgym.traces.synthetic import Driving, drive_motion

    given = {"cruise_m_per_s": options.cruise, "turn_deg_per_s": options.turn}
    driving = Driving(**{name: value for name, value in given.items() if value is not None})
    return drive_motion(options.seed, options.duration, driving)


def _drive(options: argparse.Namespace) -> None:
    from bufgym.traces import write_motion_csv

    made = _driven(options)
    write_motion_csv(made, options.out)
    print(f"wrote {options.out}: {made.source}, {made.total:.3f} views")


def _frames(options: argparse.Namespace) -> None:
    import numpy as np

    from bufgym.traces import FrameModel, Workload, drive_motion, frame_sizes, load_motion, write_workload_csv

    frames = options.duration * options.rate_hz
    if not 1 <= frames <= 1e7:
        raise BufgymError(f"--duration x --rate-hz = {frames:g} frames: must be from 1 to 1e7")
    motion = drive_motion(options.seed, options.duration) if options.motion is None else load_motion(options.motion)
    arrival_us = np.rint(np.arange(int(frames)) * (1e6 / options.rate_hz)).astype(np.int64)
    sizes = frame_sizes(arrival_us, motion, options.seed, FrameModel(base_bytes=options.base))
    x = motion.at(arrival_us)
    write_workload_csv(Workload("frames", arrival_us, sizes, x=x - x[0]), options.out)
    print(f"wrote {options.out}: {len(sizes)} frames, mean {sizes.mean() / 1e3:.1f} kB")
