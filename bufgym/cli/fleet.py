"""``bufgym fleet``: policies side by side on every robot of a fleet that shares one cell."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from bufgym.cli.options import Commands, capacities, command, count, load_policies, policy_file
from bufgym.cli.options import split_policies as split
from bufgym.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.benchmark.fleets import Part
    from bufgym.scenario.suites import FleetSuite

SUITE = "fleet-v1"


def add(commands: Commands) -> None:
    fleet = command(commands, "fleet", _fleet, "run policies side by side on robots that share one cell")
    option = fleet.add_argument_group("frozen episodes").add_argument
    option("--suite", default=SUITE, metavar="NAME", help=f"which (default: {SUITE})")
    option("--split", default="test", metavar="S", help="train, validation or test (default: test)")
    option("--robots", type=count, metavar="N", help="that share the cell, whose capacity grows with N (default: 16)")
    option("--seeds", type=count, metavar="N", help="episodes a trace (default: the suite's)")
    who = fleet.add_argument_group("who runs, on every robot")
    option = who.add_argument
    option(
        "--policy",
        nargs="+",
        metavar="NAME",
        help="policies, with settings as in decimate:every=2 (default: all ranked ones for one queue)",
    )
    option("--capacity", type=capacities, metavar="L,...", help="messages queued by each robot (default: the suite's)")
    policy_file(who)
    option = fleet.add_argument_group("where rows go").add_argument
    option("--out", metavar="FILE", help="write one row a robot and episode to this .csv or .parquet file")


def _fleet(options: argparse.Namespace) -> None:
    from bufgym import policies
    from bufgym.benchmark import fleets, fleets_summary
    from bufgym.benchmark.rows import checked_target, write_rows
    from bufgym.benchmark.table import invalid

    load_policies(options.policy_file)
    wanted = [spec for text in options.policy for spec in split(text)] if options.policy else fleets.default_policies()
    if fleets.BASELINE not in wanted:
        wanted.append(fleets.BASELINE)
    chosen = [policies.get(spec) for spec in wanted]
    if options.out is not None and not checked_target(options.out).absolute().parent.is_dir():
        raise BufgymError(f"{options.out}: no folder to write this file to")
    suite = fleets.get(options.suite)
    parts = fleets.suite_parts(suite, options.split, options.seeds, options.robots)
    rows = fleets.run_parts(chosen, parts, options.capacity or suite.capacities, progress=True)
    unranked = {policy.name: policy.unranked_because for policy in chosen if not policy.ranked}
    found = fleets_summary.summary(rows, unranked=tuple(unranked))
    about = [f"Suite {suite.name}, {options.split}: {suite.about}.", _met(parts, suite)]
    notes = [*(f"note: {name}: {why}" for name, why in unranked.items()), *invalid(rows)]
    print("\n".join([*about, "", fleets_summary.plain(found), "", *_LEGEND, *notes]))
    if options.out is not None:
        print(f"\n{len(rows)} rows in {write_rows(rows, options.out, fleets.ROWS)}")


_LEGEND = (
    "Team QoI: mean of H over the robots. Intervals: 95 %, over episodes, as the robots of one share a link.",
    "Robots above, below: with a larger or smaller H than the same robot under AFR. Fairness: Jain's index of H.",
)


def _met(parts: Sequence[Part], suite: FleetSuite) -> str:
    """How many episodes, and of how many robots."""
    fleet, episodes = parts[0].fleet, sum(len(part.seeds) for part in parts)
    robots = f"{fleet.robots} robot{'s' if fleet.robots > 1 else ''}"
    changed = "" if fleet.robots == suite.robots else f" (not the suite as it is: it has {suite.robots})"
    many = f"{episodes} episode{'s' if episodes > 1 else ''}"
    links = f"{len(parts)} link{'s' if len(parts) > 1 else ''}"
    return f"{many} of {fleet.uplink.duration_s:g} s on {links}, {robots} in a cell{changed}."
