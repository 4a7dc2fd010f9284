"""``bufgym leaderboard`` and ``bufgym validate``: a file of results that anybody can check."""

from __future__ import annotations

import argparse
from pathlib import Path

from bufgym.cli.options import Commands, command
from bufgym.ground.errors import BufgymError

DEFAULT = "docs/leaderboard.csv"


def add(commands: Commands) -> None:
    make = command(commands, "leaderboard", _leaderboard, "run suites and write the leaderboard, CSV and Markdown")
    make.add_argument("suites", nargs="*", metavar="SUITE", help="which (default: all that need no recordings)")
    check = command(commands, "validate", _validate, "run one row of the leaderboard again and compare")
    check.add_argument("row", metavar="SUITE/POLICY", help="which row")
    for parser in (make, check):
        parser.add_argument("--file", default=DEFAULT, metavar="FILE.csv", help="the leaderboard (%(default)s)")
        parser.add_argument("--data", metavar="DIR", help="folder of recordings, for suites over real links")
        parser.add_argument("--jobs", type=int, metavar="N", help="processes side by side (one a core)")


def _leaderboard(options: argparse.Namespace) -> None:
    from bufgym.benchmark import leaderboard
    from bufgym.scenario import suites

    names = options.suites or [name for name, suite in suites.SUITES.items() if not suite.needs or options.data]
    specs = {name: leaderboard.task_of(name).default_policies(name) for name in names}
    board = leaderboard.make(Path(options.file), names, specs, data=options.data, jobs=options.jobs)
    print(f"{len(board)} rows in {options.file}, as Markdown in {Path(options.file).with_suffix('.md')}")


def _validate(options: argparse.Namespace) -> None:
    from bufgym.benchmark import leaderboard

    if not Path(options.file).exists():
        whose = f"{DEFAULT} is that of bufgym's repository" if options.file == DEFAULT else "as --file says"
        raise BufgymError(f"{options.file}: no such file ({whose}); bufgym leaderboard --file FILE.csv writes one")
    entry = leaderboard.find(Path(options.file), options.row)
    again = leaderboard.validate(entry, data=options.data, jobs=options.jobs)
    print(f"{entry.name}: holds")
    for key, (stated, low, high) in entry.values.items():
        print(f"  {key}: {again.values[key].value:.6f} now, {stated:.6f} [{low:.6f}, {high:.6f}] in {options.file}")
