"""Messages of a recording that a policy would have dropped, one by one and by topic."""

import csv
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bufgym.benchmark.tasks import QueueTask
from bufgym.policies import Policy
from bufgym.scenario import Uplink
from bufgym.scenario.numbered import by_trace, draw
from bufgym.sim.state import NEVER
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import replaced
from bufgym.utils.tables import Table

# Most topics for a readable table; the CSV file has all.
_SHOWN_TOPICS = 6


class Drop(NamedTuple):
    """One dropped message; the fields are the columns of the CSV file. Times are s since the recording's first message.

    ``bytes`` is as recorded. ``dropped_s`` is the arrival time of a rejected message; an evicted one is later.
    """

    policy: str
    capacity: int
    trace: str
    seed: int
    message: int
    time_s: float
    topic: str
    bytes: int
    x: float
    dropped_s: float


def drops(
    policies: Sequence[Policy], scenario: Uplink, capacities: Sequence[int], seeds: int, **settings: Any
) -> Iterator[Drop]:
    """Yield in time order every message that each policy drops in the runs of ``run.run`` with these arguments."""
    workload, task = scenario.workload, QueueTask(**settings)
    if workload is None:
        raise BufgymError("drops: the scenario must play a recording (workload=...)")
    for trace, part in by_trace(scenario):
        for seed in range(seeds):
            episode = draw(part, seed)
            arrivals = np.asarray(episode.arrivals)
            for capacity in capacities:
                for policy in policies:
                    senders = task.meet(policy, [episode], capacity, part)
                    dropped_us = np.asarray(senders.batch.log[0])["dropped_us"][: len(arrivals)]
                    for k in np.flatnonzero(dropped_us != NEVER).tolist():
                        arrival = arrivals[k]
                        message = k, int(arrival["arrival_us"]) / 1e6, workload.topic_of(k), int(arrival["size_bytes"])
                        moved, dropped_s = float(arrival["x"]), int(dropped_us[k]) / 1e6
                        yield Drop(policy.name, capacity, trace, seed, *message, moved, dropped_s)


def write_drops(drops: Iterable[Drop], path: Path | None) -> Counter[tuple[str, int, str]]:
    """Write drops as CSV, or nowhere if ``path`` is None; count them by policy, capacity and topic."""
    counts: Counter[tuple[str, int, str]] = Counter()
    with (
        nullcontext() if path is None else replaced(path) as target,
        open(target or os.devnull, "w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Drop._fields)
        for drop in drops:
            counts[drop.policy, drop.capacity, drop.topic] += 1
            writer.writerow(drop)
    return counts


def by_topic(counts: Counter[tuple[str, int, str]], scenario: Uplink, policies: Sequence[str], runs: int) -> str:
    """Tabulate the share of each topic's messages that each policy dropped, over ``runs`` episodes per capacity."""
    assert scenario.workload is not None
    summary = sorted(scenario.workload.summary(), key=lambda line: (-line.messages, line.topic))[:_SHOWN_TOPICS]
    lines = []
    for capacity in sorted({capacity for _, capacity, _ in counts}):
        for policy in policies:
            shares = [counts[policy, capacity, line.topic] / (runs * line.messages) for line in summary]
            lines.append([policy, str(capacity), *(f"{share:.1%}" for share in shares)])
    return Table(["dropped of", "L", *(line.topic for line in summary)], [("", lines)]).plain()
