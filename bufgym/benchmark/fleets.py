"""The experiment of ``bufgym fleet``: robots that share a cell, each policy on all of them and on the same episodes.

Each robot's run becomes one row. As in ``run``, seed s stands for one episode of the whole cell, whatever the policy
and the capacity (common random numbers). ``fleets_summary`` makes statistics of the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import NamedTuple

from bufgym import policies as registry
from bufgym.benchmark.rows import TEXT, WHOLE, Layout, Row
from bufgym.benchmark.run import bar, batches, cells, checked
from bufgym.benchmark.sweep import seeds_a_trace, seeds_of
from bufgym.errors import BufgymError
from bufgym.policies import Policy
from bufgym.scenario import FleetEpisode, FleetScenario, Streams, Uplink, suites
from bufgym.scenario.suites import FleetSuite
from bufgym.sim.cell import run_fleet
from bufgym.sim.metrics import METRICS, outcome

BASELINE = "afr"
"""What the others are measured against: AFR on every robot's buffer."""

ROWS = Layout(
    columns=("scenario", "trace", "seed", "robots", "policy", "capacity", "robot", *METRICS),
    text=TEXT,
    whole=(*WHOLE, "robots", "robot"),
)
"""One row a robot and episode: which one, of how many, and its ``Outcome``."""


SUITES = suites.FLEET_SUITES


def suite_parts(suite: FleetSuite, split: str, seeds: int | None = None, robots: int | None = None) -> list[Part]:
    """The episodes of a split; ``seeds`` a trace and ``robots`` a cell, or as many as the suite says."""
    each = seeds_a_trace(suites.get(suite.of), suite.seeds if seeds is None else seeds)
    fleet = FleetScenario(suite.robots if robots is None else robots, suite.uplink(split))
    return fleet_parts(suite.setting, fleet, [seeds_of(k, each) for k in range(len(fleet.uplink.traces))])


def get(name: str) -> FleetSuite:
    """The fleet's suite of that name."""
    if name not in SUITES:
        if name in suites.SUITES or name in suites.TOPIC_SUITES:
            command = "bench" if name in suites.SUITES else "topics"
            raise BufgymError(f"suite {name} has one robot, not a fleet: bufgym {command} --suite {name}")
        raise BufgymError(f"unknown suite {name!r} of a fleet; known: {', '.join(SUITES)}")
    return SUITES[name]


def default_policies() -> list[str]:
    """Who runs unless the caller says otherwise: the ranked policies for one queue."""
    return [name for name in registry.names(for_topics=False) if registry.get(name).ranked]


class Part(NamedTuple):
    """One fleet on one trace, and the seeds of its episodes."""

    scenario: str
    trace: str
    fleet: FleetScenario
    seeds: Sequence[int]


def fleet_parts(label: str, fleet: FleetScenario, seeds: Sequence[Sequence[int]]) -> list[Part]:
    """A part for each trace of the fleet, with these seeds on each."""
    found = zip(cells(fleet.uplink), seeds, strict=True)
    return [
        Part(label, trace, replace(fleet, uplink=uplink), numbers)
        for (trace, uplink), numbers in found
        if isinstance(uplink, Uplink)
    ]


def draw(fleet: FleetScenario, seed: int) -> FleetEpisode:
    """The episode of this seed, with the luck of randomised policies."""
    streams = Streams.seeded(seed)
    return fleet.draw(streams).with_uniforms(streams.policy)


def run_parts(
    policies: Sequence[Policy], parts: Sequence[Part], capacities: Sequence[int], *, progress: bool = False
) -> list[Row]:
    """Every policy, at every capacity, on all robots of all episodes of the parts; the rows of ``ROWS``.

    Args:
        policies: see ``bufgym.policies.get``; none that plans with a link of its own (the clairvoyant).
        parts: see ``FleetSuite.parts``.
        capacities: L of each robot, messages.
        progress: show a bar on stderr, where that is a terminal and tqdm is installed.
    """
    for policy in policies:
        if policy.privileged is not None:
            raise BufgymError(f"policy {policy.name}: it plans with a link of its own, which no robot in a cell has")
    rows: list[Row] = []
    total = sum(len(part.seeds) for part in parts) * len(capacities) * len(policies)
    with bar(total, progress, unit="cell") as advance:
        for part in parts:
            checked(policies, capacities, part.seeds)
            fleet = part.fleet
            for batch in batches(part.seeds, fleet.max_messages * fleet.robots):
                episodes = [draw(fleet, seed) for seed in batch]
                for capacity in capacities:
                    for policy in policies:
                        done = run_fleet(policy, episodes, capacity, fleet.value)
                        for c, seed in enumerate(batch):
                            key = {"scenario": part.scenario, "trace": part.trace, "seed": seed}
                            key |= {"robots": fleet.robots, "policy": policy.name, "capacity": capacity}
                            rows += [
                                {**key, "robot": robot, **asdict(outcome(done.senders, i))}
                                for robot, i in enumerate(done.rows(c))
                            ]
                        advance(len(batch))
    return rows
