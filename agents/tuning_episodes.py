"""Episodes that a rule is tuned on: of one queue, of several topics and of a fleet, each with a measure to make small.

A task has many training parts, one a generation in turn, so that many episodes cost no more than a few.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from agents.evaluation import qoi_of
from agents.objectives.fleet import FleetEpisodes
from agents.tasks import Place
from agents.topics import AMPLE, ClientEpisodes, varied
from bufgym import scenario as scenarios
from bufgym.benchmark import tasks
from bufgym.benchmark.own_suite import suite_named
from bufgym.cli.scenarios import StreamOptions, WorkloadOptions, recorded
from bufgym.policies import Policy
from bufgym.scenario import suites
from bufgym.scenario.numbered import draw
from bufgym.sim import Senders

PARTS, CELLS = 24, 8
"""Parts of the training episodes, and most scenarios and capacities of a part."""
EPISODE_S = 30.0
"""Length of training episodes with topics and in a fleet, s."""
VALIDATION_SEED = 2_000_000_000
"""Training episodes have smaller seeds, those of ``compare`` begin at 0."""
VALIDATED = {"queue": 4, "topics": 6, "fleet": 4}
"""Validation episodes of a scenario at each L."""


class Episodes(Protocol):
    """Episodes of one scenario at one L."""

    @property
    def decisions(self) -> int:
        """Decisions of a candidate, about one per arrival."""

    def measure(self, policy: Policy) -> float:
        """The less the better."""


class QueueEpisodes:
    """Episodes of one queue; measured is the share of the plain rule's H, negative."""

    def __init__(self, scenario: Any, capacity: int, seeds: Sequence[int], rule: Policy) -> None:
        self.episodes = [draw(scenario, seed) for seed in seeds]
        self.decisions = sum(len(episode.arrivals) for episode in self.episodes)
        self._senders = Senders(len(seeds), capacity, scenario.value, max_messages=scenario.max_messages)
        self._plain = qoi_of(rule, self._senders, self.episodes)

    def measure(self, policy: Policy) -> float:
        """Minus the mean of H over the plain rule's."""
        return -float(np.mean(qoi_of(policy, self._senders, self.episodes) / self._plain))


@dataclass(frozen=True)
class Task:
    """What a rule is tuned on: scenarios of one kind, each at every L, by split."""

    on: Any
    """A suite's name or a scenario, as ``bufgym.compare`` takes it."""
    kind: str
    """"queue", "topics" or "fleet"."""
    splits: dict[str, list[Any]]
    """"train" and "validation" -> scenarios."""
    capacities: tuple[int, ...]
    rule: Policy
    is_once: bool = False
    """Whether there is one episode alone: a recording from its beginning on one link."""

    @staticmethod
    def of(place: Place, rule: Policy) -> Task:
        """The task of these options."""
        if name := suite_named(place.on):
            suite = suites.get(name)
            splits = {
                split: [setting.scenario for setting in suite.settings(split, place.data).values()]
                for split in ("train", "validation")
            }
            return Task(name, suite.kind, splits, place.capacity or suite.capacities, rule)
        if place.workload is not None:
            stream = StreamOptions(trace=list(place.trace) or None)
            found = recorded([place.workload], stream, WorkloadOptions(workload=[place.workload]), None).scenario
            is_once = len(found.traces) == 1
        else:
            changes = {"traces": place.trace} if place.trace else {}
            found, is_once = scenarios.get(place.on, **changes), False
        task = tasks.task_for(found)
        return Task(found, task.kind, {split: [found] for split in ("train", "validation")},
                    place.capacity or (task.capacity,), rule, is_once)  # fmt: skip

    def training(self, seed: int) -> list[list[Episodes]]:
        """``PARTS`` parts; one alone where there is one episode alone."""
        rng = np.random.default_rng(seed)
        cells = [(scenario, L) for scenario in self.splits["train"] for L in self.capacities]
        parts = []
        for part in range(1 if self.is_once else PARTS):
            chosen = [cells[k] for k in rng.permutation(len(cells))[:CELLS].tolist()]
            parts.append([self._episodes(self._short(on, part, rng), L, 1, rng) for on, L in chosen])
        return parts

    def _short(self, scenario: Any, part: int, rng: np.random.Generator) -> Any:
        """The scenario in training: shorter with topics and in a fleet; a suite's clients vary in every second part."""
        if self.kind == "topics":
            short = replace(scenario, duration_s=min(scenario.duration_s, EPISODE_S))
            # One's own client is the one that is meant; a suite's stand for others too.
            return varied(short, rng) if part % 2 == 0 and isinstance(self.on, str) else short
        if self.kind == "fleet":
            uplink = replace(scenario.uplink, duration_s=min(scenario.uplink.duration_s, EPISODE_S))
            return replace(scenario, uplink=uplink)
        return scenario

    def validation(self) -> list[Episodes]:
        """Other episodes, on the suite's validation links; with topics also on links ``AMPLE`` times as fast."""
        rng = np.random.default_rng(VALIDATION_SEED)
        count = 1 if self.is_once else VALIDATED[self.kind]
        cells = [(scenario, L) for scenario in self.splits["validation"] for L in self.capacities]
        if self.kind == "topics" and isinstance(self.on, str):
            cells += [(replace(scenario, scale=AMPLE * scenario.scale), L) for scenario, L in cells]
        return [self._episodes(scenario, L, count, rng) for scenario, L in cells]

    def _episodes(self, scenario: Any, L: int, count: int, rng: np.random.Generator) -> Episodes:
        if self.kind == "topics":
            return ClientEpisodes(scenario, L, count, rng)
        seeds = rng.integers(VALIDATION_SEED, size=count).tolist()
        if self.kind == "fleet":
            return FleetEpisodes(scenario, [draw(scenario, seed) for seed in seeds], L)
        return QueueEpisodes(scenario, L, seeds, self.rule)
