"""``bufgym topics``: policies side by side on clients with several topics."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from bufgym.cli.options import Commands, capacities, command, count, load_policies, policy_file, positive
from bufgym.cli.options import split_policies as split
from bufgym.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.benchmark.topics import Part

SUITE = "topics-v1"
CAPACITY = 32
"""L of a configuration file's client, messages."""
SEEDS = 5
"""Episodes a trace, likewise."""


def add(commands: Commands) -> None:
    topics = command(commands, "topics", _topics, "run policies side by side on several topics over one uplink")
    option = topics.add_argument_group("a suite: frozen episodes").add_argument
    option("--suite", metavar="NAME", help=f"which (default: {SUITE})")
    option("--split", metavar="S", help="train, validation or test (default: test)")
    option = topics.add_argument_group("or a client of your own").add_argument
    option("--config", metavar="FILE.toml", help="its topics and what each wants, as in examples/client.toml")
    option("--trace", nargs="+", metavar="FILE", help="bandwidth traces, files or shipped names (default: shipped LTE)")
    option("--scale", type=positive, metavar="X", help="the traces' capacity times X (default: 1)")
    option("--motion", nargs="+", metavar="FILE", help="motion recordings, likewise (default: shipped); or 'none'")
    who = topics.add_argument_group("who runs, and how")
    option = who.add_argument
    option(
        "--policy",
        nargs="+",
        metavar="NAME",
        help="policies, with settings as in decimate:every=2 (default: all made for topics, drop-oldest, rosbridge)",
    )
    option("--capacity", type=capacities, metavar="L,...", help="messages queued, all topics together (default: 32)")
    option("--seeds", type=count, metavar="N", help=f"episodes a trace (default: {SEEDS}, or the suite's)")
    option("--consumers", type=int, metavar="N", help="how many want each message; native ROS sends each a copy")
    option("--window", type=int, metavar="N", help="n_T: messages sent and not yet answered by a pong, at most")
    policy_file(who)
    option = topics.add_argument_group("what is shown, and where rows go").add_argument
    option("--by-topic", metavar="NAME", help="also each topic's numbers under this policy")
    option("--out", metavar="FILE", help="write one row a topic and run to this .csv or .parquet file")


def _topics(options: argparse.Namespace) -> None:
    from bufgym import policies
    from bufgym.benchmark import topics, topics_summary
    from bufgym.benchmark.rows import checked_target, write_rows
    from bufgym.benchmark.table import invalid

    load_policies(options.policy_file)
    wanted = [spec for text in options.policy for spec in split(text)] if options.policy else topics.default_policies()
    specs = wanted if topics.BASELINE in wanted else [*wanted, topics.BASELINE]
    chosen = [policies.get(spec) for spec in specs]
    shown = None if options.by_topic is None else policies.get(options.by_topic).name
    if shown is not None and shown not in [policy.name for policy in chosen]:
        raise BufgymError(f"--by-topic {options.by_topic}: not among the policies that run")
    if options.out is not None and not checked_target(options.out).absolute().parent.is_dir():
        raise BufgymError(f"{options.out}: no folder to write this file to")
    meets = _suite(options) if options.config is None else _own_client(options)
    rows = topics.run_parts(chosen, meets.parts, meets.capacities, progress=True)
    unranked = {policy.name: policy.unranked_because for policy in chosen if not policy.ranked}
    found = topics_summary.summary(rows, unranked=tuple(unranked))
    notes = [f"note: {name}: {why}; its QoI counts what arrives long after" for name, why in unranked.items()]
    notes += invalid(topics.one_a_run(rows))
    print("\n".join([*meets.about, "", topics_summary.plain(found, meets.scenarios), "", *_LEGEND, *notes]))
    if shown is not None:
        print(f"\n{shown}, topic by topic: means over episodes\n{topics_summary.by_topic(rows, shown)}")
    if options.out is not None:
        print(f"\n{len(rows)} rows in {write_rows(rows, options.out, topics.ROWS)}")


_LEGEND = (
    "QoI: sum over topics of weight x H, mean over episodes; [low, high]: 95 % intervals, resampling episodes.",
    "no_drop lost: messages, all episodes together. Age: of information, at the server, mean over topics and time.",
    "Late: of what was delivered on topics with a deadline. Delivered a second: until the last arrival or receipt.",
)


class _Meets(NamedTuple):
    """What the policies meet."""

    parts: list[Part]
    capacities: Sequence[int]
    scenarios: dict[str, str]
    """What each is, by its label."""
    about: list[str]


def _suite(options: argparse.Namespace) -> _Meets:
    from bufgym.benchmark.topics import suite_parts
    from bufgym.scenario import suites

    for name in ("trace", "motion", "scale"):
        if getattr(options, name) is not None:
            raise BufgymError(f"--{name} needs --config: a suite's episodes are frozen")
    suite = suites.get(options.suite or SUITE)
    split = options.split or "test"
    parts = suite_parts(suite, split, options.seeds, **_given(options))
    scenarios = {label: setting.about for label, setting in suite.settings(split).items()}
    about = [f"Suite {suite.name}, {split}: {suite.about}.", _met(parts)]
    if _given(options):
        about.append("Not the suite as it is: " + " and ".join(f"--{name}" for name in _given(options)) + " given.")
    return _Meets(parts, options.capacity or suite.capacities, scenarios, about)


def _own_client(options: argparse.Namespace) -> _Meets:
    from bufgym import traces
    from bufgym.benchmark.topics import client_parts
    from bufgym.scenario import read_client

    for name in ("suite", "split"):
        if getattr(options, name) is not None:
            raise BufgymError(f"--{name} cannot go with --config")
    shipped = traces.shipped()
    links = options.trace or [name for name in shipped if name.startswith("lte-")]
    motions = options.motion or [name for name in shipped if name.startswith("drive-")]
    client = read_client(
        options.config,
        traces=tuple(traces.load(name) for name in links),
        motion=() if motions == ["none"] else tuple(traces.load_motion(name) for name in motions),
        scale=options.scale or 1.0,
    )
    # Not with the file's own, whose name an error would blame.
    client = replace(client, **_given(options))
    label = Path(options.config).stem
    parts = client_parts(label, client, options.seeds or SEEDS)
    scaled = f" x {client.scale:g}" if client.scale != 1 else ""
    link = client.traces[0].name if len(client.traces) == 1 else f"{len(client.traces)} links"
    over = f"{_counted(len(client.topics), 'topic')} over {link}{scaled}"
    return _Meets(
        parts, options.capacity or [CAPACITY], {label: over}, [f"The client of {options.config}.", _met(parts)]
    )


def _given(options: argparse.Namespace) -> dict[str, Any]:
    """What the user would have otherwise than the client has it."""
    return {name: getattr(options, name) for name in ("window", "consumers") if getattr(options, name) is not None}


def _met(parts: Sequence[Part]) -> str:
    """How many episodes, and how the client sends."""
    client, episodes = parts[0].client, sum(len(part.seeds) for part in parts)
    windows = " and ".join(f"{n}" for n in dict.fromkeys(part.client.window for part in parts))
    ack = f"pongs {client.ack_delay_us / 1000:g} ms after a message has crossed"
    many, consumers = _counted(episodes, "episode"), _counted(client.consumers, "consumer")
    return f"{many} of {client.duration_s:g} s; n_T = {windows}, {ack}, {consumers}."


def _counted(n: int, thing: str) -> str:
    return f"{n} {thing}{'' if n == 1 else 's'}"
