"""``bufgym perf``: bufgym's own speed."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from bufgym.cli.options import Commands, command, count


def add(commands: Commands) -> None:
    perf = command(commands, "perf", _perf, "measure bufgym's own speed on this machine")
    perf.add_argument("--json", metavar="FILE", help="also write the figures to FILE")
    perf.add_argument("--repeats", type=count, default=3, help="best of so many (%(default)s)")
    perf.add_argument("--queue", action="store_true", help="measure a live queue's cost to a robot instead")
    perf.add_argument("--quick", action="store_true", help="tiny sizes: does it run at all?")


def _perf(options: argparse.Namespace) -> None:
    from bufgym.benchmark import perf

    sizes = perf.Sizes(repeats=options.repeats)
    if options.quick:
        sizes = perf.Sizes(4, 4, 20, 5, 20, 1, options.repeats)
    elif sys.stderr.isatty():
        print("measuring; this takes about half a minute ...", file=sys.stderr)
    if options.queue:
        from bufgym.robot import cost

        print(cost.report(1 if options.quick else 20))
        return
    figures = perf.measure(sizes)
    print(perf.report(figures, sizes.repeats))
    if options.json is not None:
        perf.write_json(figures, sizes, Path(options.json))
