"""``bufgym fleet``, short for ``bufgym bench`` with a fleet suite: policies compared on robots that share one cell."""

from __future__ import annotations

import argparse

from bufgym.cli.options import Commands, command, count, load_policies
from bufgym.cli.suite import out_options, run_suite, suite_options, who_options

SUITE = "fleet-v1"


def add(commands: Commands) -> None:
    fleet = command(commands, "fleet", _fleet, "run policies side by side on robots that share one cell")
    suite_options(fleet, SUITE)
    option = fleet.add_argument_group("the cell").add_argument
    option("--robots", type=count, metavar="N", help="that share the cell, whose capacity grows with N (default: 16)")
    who_options(
        fleet,
        "all ranked ones for one queue, on every robot",
        "of each robot; default: the suite's",
        "default: the suite's",
    )
    out_options(fleet)


def _fleet(options: argparse.Namespace) -> None:
    load_policies(options.policy_file)
    options.suite = options.suite or SUITE
    run_suite(options, "fleet", ("robots",), "fleet")
