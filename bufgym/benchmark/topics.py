"""The experiment of ``bufgym topics``: clients with several topics, every policy on the same episodes.

Each run becomes one row a topic. As in ``run``, seed s stands for one episode, whatever the policy and the capacity
(common random numbers). ``topics_summary`` makes statistics of the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from typing import Any, NamedTuple

import numpy as np

from bufgym import policies as registry
from bufgym.benchmark.rows import Layout, Row
from bufgym.benchmark.run import bar, batches, cells, checked, draw
from bufgym.benchmark.sweep import seeds_a_trace, seeds_of
from bufgym.benchmark.table import mean
from bufgym.errors import BufgymError
from bufgym.policies import Policy
from bufgym.scenario import Client, suites
from bufgym.sim import Senders
from bufgym.sim import run as run_policy
from bufgym.sim.metrics import TopicOutcome, received, topic_outcomes, weighted_qoi

BASELINE = "robofleet"
"""What the others are measured against: Robofleet's client as published."""

_RIVALS = ("drop-oldest", "rosbridge")
"""Made for one queue, but what a robot's topics meet today."""

_OF_A_TOPIC = tuple(f.name for f in fields(TopicOutcome))

ROWS = Layout(
    columns=(
        *("scenario", "trace", "seed", "window", "consumers", "policy", "capacity"),
        *("topic", "priority", "weight", "no_drop", "deadline_s"),
        *_OF_A_TOPIC[1:],
        *("weighted_qoi", "seconds", "invalid"),
    ),
    text=("scenario", "trace", "policy", "topic"),
    whole=("seed", "window", "consumers", "capacity", "arrived", "invalid"),
    yes_no=("no_drop",),
)
"""One row a topic and run, in this order.

The rules of the topic (``deadline_s`` is None where it has none), its ``TopicOutcome`` (means over the consumers where
each gets a copy of its own, and so perhaps no whole numbers), and of the run as a whole: ``weighted_qoi``, the sum of
weight x H over the topics; ``seconds``, its length until the last arrival or the last receipt, whichever is later;
``invalid``, decisions that could not be carried out.
"""


def default_policies() -> list[str]:
    """Who runs unless the caller says otherwise: all that are made for topics, and what is in use without them."""
    return [*_RIVALS, *registry.names(for_topics=True)]


class Part(NamedTuple):
    """One client on one trace, and the seeds of its episodes."""

    scenario: str
    trace: str
    client: Client
    seeds: Sequence[int]


def run(
    policies: Sequence[Policy],
    client: Client,
    capacities: Sequence[int],
    seeds: int | Sequence[int],
    *,
    label: str = "",
    progress: bool = False,
) -> list[Row]:
    """Every policy at every capacity on every trace of the client and every seed; the rows of ``ROWS``.

    Args:
        policies: see ``bufgym.policies.get``.
        client: each of its traces is a cell of its own.
        capacities: L, messages, shared by all topics.
        seeds: so many (0, 1, ...), or these.
        label: what the rows call the scenario.
        progress: show a bar on stderr, where that is a terminal and tqdm is installed.
    """
    if not isinstance(client, Client):
        raise BufgymError(f"{type(client).__name__}: must be a bufgym.scenario.Client, which has topics")
    return run_parts(policies, client_parts(label, client, seeds), capacities, progress=progress)


def client_parts(label: str, client: Client, seeds: int | Sequence[int]) -> list[Part]:
    """A client's episodes: the same seeds on each of its traces."""
    chosen = range(seeds) if isinstance(seeds, int) else seeds
    return _parts(label, client, [chosen] * len(client.traces))


def suite_parts(suite: suites.Suite, split: str, seeds: int | None = None, **changed: Any) -> list[Part]:
    """A suite's episodes, ``seeds`` a trace; ``changed``: parameters of its clients that it has otherwise."""
    if suite.name not in suites.TOPIC_SUITES:
        raise BufgymError(f"suite {suite.name} has one queue, not topics: bufgym bench --suite {suite.name}")
    made = []
    for label, setting in suite.settings(split).items():
        if not isinstance(setting.scenario, Client):
            raise BufgymError(f"suite {suite.name}: {label} is not a client with topics")
        client = replace(setting.scenario, **changed)
        numbers = [seeds_of(k, seeds_a_trace(suite, seeds)) for k in range(len(client.traces))]
        made += _parts(label, client, numbers)
    return made


def _parts(label: str, client: Client, seeds: Sequence[Sequence[int]]) -> list[Part]:
    found = zip(cells(client), seeds, strict=True)
    return [Part(label, trace, cell, numbers) for (trace, cell), numbers in found if isinstance(cell, Client)]


def run_parts(
    policies: Sequence[Policy], parts: Sequence[Part], capacities: Sequence[int], *, progress: bool = False
) -> list[Row]:
    """Every policy at every capacity on all episodes of the parts. Arguments as for ``run``."""
    for policy in policies:
        if policy.privileged is not None:
            raise BufgymError(f"policy {policy.name}: it plans with a queue of its own, which no topic of a client has")
    rows: list[Row] = []
    with bar(sum(len(part.seeds) for part in parts) * len(capacities) * len(policies), progress) as advance:
        for part in parts:
            checked(policies, capacities, part.seeds)
            client = part.client
            for batch in batches(part.seeds, client.max_messages * client.consumers):
                episodes = [draw(client, seed) for seed in batch]
                for capacity in capacities:
                    for policy in policies:
                        senders = run_policy(policy, episodes, capacity, client.value, topics=client.topics)
                        for i, seed in enumerate(batch):
                            key = {"scenario": part.scenario, "trace": part.trace, "seed": seed}
                            rows += run_rows(key, policy, capacity, client, senders, i)
                        advance(len(batch))
    return rows


def one_a_run(rows: Sequence[Row]) -> list[Row]:
    """The row of one topic of each run: for what is the same in all of them."""
    names = ("scenario", "trace", "seed", "policy", "capacity")
    return list({tuple(row[name] for name in names): row for row in rows}.values())


def run_rows(key: Row, policy: Policy, capacity: int, client: Client, senders: Senders, i: int) -> list[Row]:
    """What became of each topic at sender ``i``, for the episode that ``key`` names."""
    sender, got = np.asarray(senders.batch.senders)[i], received(senders, i)
    log = np.asarray(senders.batch.log[i])
    last_us = int(np.asarray(senders.batch.arrivals[i])["arrival_us"][sender["arrivals"] - 1])
    if len(got):
        last_us = max(last_us, int(log["transmitted_us"][got["seq"][-1]] + sender["propagation_us"]))
    of_the_run = {
        "weighted_qoi": weighted_qoi(senders, i, got),
        "seconds": last_us / 1e6,
        "invalid": int(sender["invalid"]),
    }
    outcomes = topic_outcomes(senders, i)
    made = []
    for k, topic in enumerate(client.topics):
        row = {
            **key,
            "window": client.window,
            "consumers": client.consumers,
            "policy": policy.name,
            "capacity": capacity,
            "topic": topic.name,
            "priority": float(topic.priority),
            "weight": float(topic.share),
            "no_drop": topic.no_drop,
            "deadline_s": None if topic.deadline_s is None else float(topic.deadline_s),
            # Where each consumer gets a copy, copy c of topic k is topic c x (number of topics) + k.
            **_folded(outcomes[k :: len(client.topics)]),
            **of_the_run,
        }
        made.append({name: row[name] for name in ROWS.columns})
    return made


def _folded(copies: Sequence[TopicOutcome]) -> Row:
    """The means of a topic's copies, one a consumer."""
    each = [asdict(outcome) for outcome in copies]
    found: Row = {name: mean([one[name] for one in each]) for name in _OF_A_TOPIC[1:]}
    return {**found, "arrived": int(found["arrived"])}
