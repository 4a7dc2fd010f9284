"""``bufgym report``: page of a suite's run."""

from __future__ import annotations

import argparse

from bufgym.cli.options import Commands, command
from bufgym.ground.errors import printable


def add(commands: Commands) -> None:
    parser = command(commands, "report", _report, "the page of a suite's run: one HTML file that works offline")
    parser.add_argument("folder", metavar="DIR", help="folder of bench --suite --out")
    parser.add_argument("--markdown", action="store_true", help="print tables for a README instead")


def _report(options: argparse.Namespace) -> None:
    from bufgym.benchmark import report

    text = report.markdown(options.folder) if options.markdown else f"wrote {report.write(options.folder)}"
    print("\n".join(map(printable, text.split("\n"))))
