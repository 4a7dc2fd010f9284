"""``bufgym topics`` and ``bufgym fleet``: names for ``bufgym bench`` with a suite of that kind, or one's own client."""

from dataclasses import replace
from typing import Annotated

from cyclopts import Group, Parameter

from bufgym.cli.bench import bench
from bufgym.cli.options import Count, OutOptions, SuiteOptions, WhoOptions, given, refuse
from bufgym.cli.scenarios import LinkOptions, OwnOptions, SendOptions, SharedOptions, StreamOptions
from bufgym.ground.errors import BufgymError

CLIENT = Group.create_ordered("Or a client of your own")


def topics(
    *,
    suite: SuiteOptions = SuiteOptions(),
    config: Annotated[str | None, Parameter(group=CLIENT)] = None,
    link: Annotated[LinkOptions, Parameter(group=CLIENT)] = LinkOptions(),
    send: Annotated[SendOptions, Parameter(group=Group.create_ordered("How the client sends"))] = SendOptions(),
    who: WhoOptions = WhoOptions(),
    out: OutOptions = OutOptions(),
) -> None:
    """Run policies side by side on several topics over one uplink.

    Args:
        config: Its topics and their rules, as in examples/client.toml.
    """
    if config is None:
        refuse(given(link), "needs --config: a suite's episodes are frozen")
        suite = _suite_of(suite, "topics", "topics-v1")
    else:
        refuse(given(suite), "cannot go with --config")
    stream, shared = StreamOptions(**vars(link)), SharedOptions(**vars(send))
    bench(suite=suite, stream=stream, own=OwnOptions(config=config), shared=shared, who=who, out=out)


def fleet(
    *,
    suite: SuiteOptions = SuiteOptions(),
    robots: Annotated[Count | None, Parameter(group=Group.create_ordered("The cell"))] = None,
    who: WhoOptions = WhoOptions(),
    out: OutOptions = OutOptions(),
) -> None:
    """Run policies side by side on robots that share one cell.

    Args:
        robots: That share the cell, whose capacity grows with them (default: 16).
    """
    bench(suite=_suite_of(suite, "fleet", "fleet-v1"), shared=SharedOptions(robots=robots), who=who, out=out)


def _suite_of(options: SuiteOptions, kind: str, default: str) -> SuiteOptions:
    from bufgym.scenario import suites

    suite = suites.get(options.suite or default)
    if suite.kind != kind:
        raise BufgymError(f"suite {suite.name} is not one of {kind}: bufgym bench --suite {suite.name}")
    return replace(options, suite=suite.name)
