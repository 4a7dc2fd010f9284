"""``bufgym topics`` and ``bufgym fleet``, short for ``bufgym bench`` with a suite of that kind."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Group, Parameter

from bufgym.cli.options import (
    RESULTS,
    Count,
    OutOptions,
    Positive,
    SuiteOptions,
    Whole,
    WhoOptions,
    given,
    load_policies,
    loaded,
    refuse,
)
from bufgym.cli.suite import run_suite
from bufgym.ground.errors import BufgymError, printable

SUITE = "topics-v1"
CAPACITY = 32
"""L of a configuration file's client, messages."""
SEEDS = 5
"""Episodes on each trace of a configuration file's client."""


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
    by_topic: Annotated[str | None, Parameter(group=RESULTS)] = None,
) -> None:
    """Run policies side by side on several topics over one uplink.

    Args:
        by_topic: Also print each topic's numbers under this policy.
    """
    from bufgym import policies
    from bufgym.benchmark.tasks import TASKS
    from bufgym.benchmark.tasks import topics as tables

    load_policies(who.policy_file)
    task = TASKS["topics"]
    specs = loaded(who.policies)[0] or task.default_policies(SUITE)
    names = [policies.get(spec).name for spec in dict.fromkeys([*specs, task.baseline])]
    by_name = None if by_topic is None else policies.get(by_topic).name
    if by_name is not None and by_name not in names:
        raise BufgymError(f"--by-topic {by_topic}: not among the policies that run")
    if client.config is None:
        refuse(given(client), "needs --config: a suite's episodes are frozen")
        rows = run_suite("topics", suite, who, out, given(send), default=SUITE, kind="topics")
    else:
        refuse(given(suite) | given(out, "format"), "cannot go with --config")
        rows = _own_client(client.config, client, send, specs, who, out)
    if by_name is not None:
        print(f"\n{by_name}, topic by topic: means over episodes\n{tables.by_topic(rows, by_name)}")


def _own_client(
    config: str, options: ClientOptions, send: SendOptions, specs: list[str], who: WhoOptions, out: OutOptions
) -> list[dict[str, Any]]:
    """Run the client of a configuration file and print its summary; the rows."""
    from bufgym import policies
    from bufgym.benchmark.rows import write_rows
    from bufgym.benchmark.run import run
    from bufgym.benchmark.summary import plain
    from bufgym.benchmark.table import apart, invalid
    from bufgym.benchmark.tasks import TASKS
    from bufgym.scenario import read_client

    task, file = TASKS["topics"], out.file()
    if out.out is not None and file is None:
        raise BufgymError(f"{out.out}: with --config rows are written to .csv or .parquet files")
    links: dict[str, Any] = {} if options.trace is None else {"traces": options.trace}
    # What the user typed does not go through ``read_client``, whose errors name the file.
    client = replace(read_client(config), **links, **given(options, "motion", "scale"), **given(send))
    chosen = [policies.get(spec) for spec in (specs if task.baseline in specs else [*specs, task.baseline])]
    seeds, label = who.seeds or SEEDS, Path(config).stem
    rows = run(chosen, client, who.capacity or (CAPACITY,), seeds, label=label, progress=True)
    unranked = apart(chosen)
    scaled = f" x {client.scale:g}" if client.scale != 1 else ""
    link = client.traces[0].name if len(client.traces) == 1 else f"{len(client.traces)} links"
    about = f"{len(client.topics)} topic{'' if len(client.topics) == 1 else 's'} over {link}{scaled}"
    print(f"The client of {printable(config)}.\n{task.describe([client], seeds * len(client.traces))}\n")
    print(plain(task.summary(rows, unranked), {label: about}) + "\n")
    notes = [f"{name} has no rank: {reason}." for name, reason in unranked.items()]
    print("\n".join([*task.legend, *notes, *invalid(task.senders(rows))]))
    if file is not None:
        print(f"\n{len(rows)} rows in {write_rows(rows, file, task.layout)}")
    return rows


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
    load_policies(who.policy_file)
    changes = {} if robots is None else {"robots": robots}
    run_suite("fleet", suite, who, out, changes, default="fleet-v1", kind="fleet")
