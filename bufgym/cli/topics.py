"""``bufgym topics``, short for ``bufgym bench`` with a topics suite: policies compared on clients with topics."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from bufgym.cli.options import Commands, command, given, load_policies, loaded, positive, refuse
from bufgym.cli.suite import SUITE_OPTIONS, out_options, run_suite, suite_options, target, who_options
from bufgym.ground.errors import BufgymError, printable

SUITE = "topics-v1"
CAPACITY = 32
"""L of a configuration file's client, messages."""
SEEDS = 5
"""Episodes on each trace of a configuration file's client."""
CHANGES = ("window", "consumers")
"""Options that change parameters of the clients."""


def add(commands: Commands) -> None:
    topics = command(commands, "topics", _topics, "run policies side by side on several topics over one uplink")
    suite_options(topics, SUITE)
    option = topics.add_argument_group("or a client of your own").add_argument
    option("--config", metavar="FILE.toml", help="its topics and their rules, as in examples/client.toml")
    option("--trace", nargs="+", metavar="FILE", help="bandwidth traces, files or shipped names (default: shipped LTE)")
    option("--scale", type=positive, metavar="X", help="the traces' capacity times X (default: 1)")
    option("--motion", nargs="+", metavar="FILE", help="motion recordings, likewise (default: shipped); or 'none'")
    option = topics.add_argument_group("how the client sends").add_argument
    option("--consumers", type=int, metavar="N", help="how many want each message; native ROS sends each a copy")
    option("--window", type=int, metavar="N", help="n_T: messages sent and not yet acknowledged, at most")
    who_options(
        topics,
        "all made for topics, drop-oldest, rosbridge",
        f"all topics together; default: {CAPACITY}",
        f"default: {SEEDS}, or the suite's",
    )
    out_options(topics).add_argument(
        "--by-topic", metavar="NAME", help="also print each topic's numbers under this policy"
    )


def _topics(options: argparse.Namespace) -> None:
    from bufgym import policies
    from bufgym.benchmark.tasks import TASKS
    from bufgym.benchmark.tasks.topics import by_topic

    load_policies(options.policy_file)
    task = TASKS["topics"]
    specs = loaded(options.policies)[0] or task.default_policies(SUITE)
    names = [policies.get(spec).name for spec in dict.fromkeys([*specs, task.baseline])]
    by_name = None if options.by_topic is None else policies.get(options.by_topic).name
    if by_name is not None and by_name not in names:
        raise BufgymError(f"--by-topic {options.by_topic}: not among the policies that run")
    if options.config is None:
        refuse(options, ("trace", "motion", "scale"), "needs --config: a suite's episodes are frozen")
        options.suite = options.suite or SUITE
        rows = run_suite(options, "topics", CHANGES, "topics")
    else:
        refuse(options, ("suite", *SUITE_OPTIONS, "format"), "cannot go with --config")
        rows = _own_client(options, specs)
    if by_name is not None:
        print(f"\n{by_name}, topic by topic: means over episodes\n{by_topic(rows, by_name)}")


def _own_client(options: argparse.Namespace, specs: list[str]) -> list[dict[str, Any]]:
    """Run the client of a configuration file and print its summary; the rows."""
    from bufgym import policies, traces
    from bufgym.benchmark.rows import write_rows
    from bufgym.benchmark.run import run
    from bufgym.benchmark.summary import plain
    from bufgym.benchmark.table import invalid
    from bufgym.benchmark.tasks import TASKS
    from bufgym.scenario import read_client

    task, file = TASKS["topics"], target(options)
    if options.out is not None and file is None:
        raise BufgymError(f"{options.out}: with --config rows are written to .csv or .parquet files")
    shipped = traces.shipped()
    links = options.trace or [name for name in shipped if name.startswith("lte-")]
    motions = options.motion or [name for name in shipped if name.startswith("drive-")]
    client = read_client(
        options.config,
        traces=tuple(traces.load(name) for name in links),
        motion=() if motions == ["none"] else tuple(traces.load_motion(name) for name in motions),
        scale=options.scale or 1.0,
    )
    # Outside the file's own block, whose error would name the file.
    client = replace(client, **given(options, CHANGES))
    chosen = [policies.get(spec) for spec in (specs if task.baseline in specs else [*specs, task.baseline])]
    seeds, label = options.seeds or SEEDS, Path(options.config).stem
    rows = run(chosen, client, options.capacity or [CAPACITY], seeds, label=label, progress=True)
    unranked = {policy.name: policy.unranked_because for policy in chosen if not policy.ranked}
    scaled = f" x {client.scale:g}" if client.scale != 1 else ""
    link = client.traces[0].name if len(client.traces) == 1 else f"{len(client.traces)} links"
    about = f"{len(client.topics)} topic{'' if len(client.topics) == 1 else 's'} over {link}{scaled}"
    print(f"The client of {printable(options.config)}.\n{task.describe([client], seeds * len(client.traces))}\n")
    print(plain(task.summary(rows, unranked), {label: about}) + "\n")
    notes = [f"{name} has no rank: {reason}." for name, reason in unranked.items()]
    print("\n".join([*task.legend, *notes, *invalid(task.senders(rows))]))
    if file is not None:
        print(f"\n{len(rows)} rows in {write_rows(rows, file, task.layout)}")
    return rows
