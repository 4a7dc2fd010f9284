"""``bufgym topics`` and ``bufgym fleet``: names for ``bufgym bench`` with a suite of that kind, or one's own client."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from cyclopts import Group, Parameter

from bufgym.cli.bench import bench
from bufgym.cli.options import ByTopic, Count, OutOptions, Positive, SuiteOptions, Whole, WhoOptions, given, refuse
from bufgym.cli.scenarios import OwnOptions, SharedOptions, StreamOptions
from bufgym.ground.errors import BufgymError


@Parameter(name="*", group=Group.create_ordered("Or a client of your own"))
@dataclass(frozen=True)
class ClientOptions:
    config: str | None = None
    """Its topics and their rules, as in examples/client.toml."""
    trace: list[str] | None = None
    """Bandwidth traces, files or shipped names (default: shipped LTE)."""
    scale: Positive | None = None
    """The traces' capacity times this (default: 1)."""
    motion: list[str] | None = None
    """Motion recordings, likewise (default: shipped); or 'none'."""


@Parameter(name="*", group=Group.create_ordered("How the client sends"))
@dataclass(frozen=True)
class SendOptions:
    consumers: Whole | None = None
    """How many want each message; native ROS sends each a copy."""
    window: Whole | None = None
    """n_T: messages sent and not yet acknowledged, at most."""


def topics(
    *,
    suite: SuiteOptions = SuiteOptions(),
    client: ClientOptions = ClientOptions(),
    send: SendOptions = SendOptions(),
    who: WhoOptions = WhoOptions(),
    out: OutOptions = OutOptions(),
    by_topic: ByTopic = None,
) -> None:
    """Run policies side by side on several topics over one uplink."""
    links = given(client, "trace", "scale", "motion")
    if client.config is None:
        refuse(links, "needs --config: a suite's episodes are frozen")
        suite = _of(suite, "topics", "topics-v1")
    else:
        refuse(given(suite), "cannot go with --config")
    own, shared = OwnOptions(config=client.config), SharedOptions(**given(send))
    bench(suite=suite, stream=StreamOptions(**links), own=own, shared=shared, who=who, out=out, by_topic=by_topic)


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
    bench(suite=_of(suite, "fleet", "fleet-v1"), shared=SharedOptions(robots=robots), who=who, out=out)


def _of(options: SuiteOptions, kind: str, default: str) -> SuiteOptions:
    """The options with a suite of this kind."""
    from bufgym.scenario import suites

    suite = suites.get(options.suite or default)
    if suite.kind != kind:
        raise BufgymError(f"suite {suite.name} is not one of {kind}: bufgym bench --suite {suite.name}")
    return replace(options, suite=suite.name)
