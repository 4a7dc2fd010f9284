"""Where agents of a fleet are tried: cells full of robots, and the validation that says which agent to keep.

An agent is worth its team QoI (the mean over robots of H) minus that of AFR on every robot, on the same episodes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agents.callbacks import Record
from agents.evolution import MODEL
from agents.worlds import capacities_of
from bufgym import policies
from bufgym.benchmark import fleets
from bufgym.benchmark.fleets import BASELINE
from bufgym.policies import Policy, learned, weights
from bufgym.policies.learned import Weights
from bufgym.scenario import FleetEpisode, FleetScenario
from bufgym.scenario.suites import FleetSuite
from bufgym.sim import Senders
from bufgym.sim.cell import Fleet

if TYPE_CHECKING:
    from train import Arguments

EPISODES, EPISODE_S = 2, 30.0
"""Training episodes of a generation, each on another link and at every capacity, and how long they are."""
PARTS = 12
"""So many samples of that kind, one a generation in turn: of fleet-v1's training links each comes once."""
JUDGES = 4
"""Validation episodes a link, of the suite's own length."""


def suite_of(arguments: Arguments) -> FleetSuite:
    """The suite, at the capacities that were asked for."""
    suite, given = fleets.get(arguments.suite), arguments.capacities
    return replace(suite, capacities=capacities_of(suite.of, given)) if given else suite


class Ground:
    """Cells full of robots with one L, and what AFR on every robot makes of them."""

    def __init__(self, fleet: FleetScenario, episodes: Sequence[FleetEpisode], capacity: int) -> None:
        self.episodes = episodes
        rows, most = fleet.robots * len(episodes), fleet.max_messages
        self.fleet = Fleet(Senders(rows, capacity, fleet.value, max_messages=most), fleet.robots)
        self.rival = self.team(policies.get(BASELINE))

    @property
    def decisions(self) -> int:
        """How many a candidate is asked for: one an arrival."""
        return sum(len(arrivals) for episode in self.episodes for arrivals in episode.arrivals)

    def team(self, policy: Policy) -> float:
        """Team QoI, mean over the episodes."""
        for c, episode in enumerate(self.episodes):
            self.fleet.load(c, episode)
        self.fleet.run(policy)
        sender = self.fleet.senders.batch.senders
        return float((sender["delivered_gain"] + (sender["transmitted"] > 0)).mean())


def gain(policy: Policy, grounds: Sequence[Ground]) -> float:
    """Team QoI above AFR's, mean over the grounds."""
    return float(np.mean([ground.team(policy) - ground.rival for ground in grounds]))


def samples(suite: FleetSuite, seed: int) -> list[list[Ground]]:
    """``PARTS`` samples of the training episodes, a ground for each L: links in turn, ``EPISODES`` a sample."""
    rng, fleet = np.random.default_rng(seed), FleetScenario(suite.robots, suite.uplink("train"))
    links = [part.fleet for part in fleets.fleet_parts("", fleet, [()] * len(fleet.uplink.traces))]
    waiting: list[int] = []
    made = []
    for _ in range(PARTS):
        while len(waiting) < EPISODES:
            waiting += rng.permutation(len(links)).tolist()
        chosen, waiting = [links[k] for k in waiting[:EPISODES]], waiting[EPISODES:]
        short = [replace(link, uplink=replace(link.uplink, duration_s=EPISODE_S)) for link in chosen]
        episodes = [fleets.draw(link, int(rng.integers(10**6))) for link in short]
        made.append([Ground(short[0], episodes, L) for L in suite.capacities])
    return made


def judges(suite: FleetSuite) -> list[Ground]:
    """The validation episodes, the same for every seed."""
    parts = fleets.suite_parts(suite, "validation", JUDGES)
    episodes = [fleets.draw(part.fleet, seed) for part in parts for seed in part.seeds]
    return [Ground(parts[0].fleet, episodes, L) for L in suite.capacities]


class Validation:
    """Every so many steps the validation episodes are played; what did best there is kept as ``model.safetensors``."""

    def __init__(self, arguments: Arguments, home: Path, seed: int, steps: int) -> None:
        self.arguments, self.home, self.seed = arguments, home, seed
        self.grounds = judges(suite_of(arguments))
        self.record = Record(home / "validation.csv", ("steps", "seconds", "gain"), steps)

    def due(self, steps: int) -> bool:
        """Whether it is time again; at the beginning and at the end it always is."""
        rows = self.record.rows
        if not rows:
            return True
        end = steps >= self.arguments.steps and steps > rows[-1][0]
        return end or steps - rows[-1][0] >= self.arguments.validate_every

    def judge(self, made: Weights, steps: int, seconds: float) -> None:
        """Play, and keep these weights if none did better."""
        reached = gain(learned.policy("fleet", made), self.grounds)
        if not self.record.rows or reached > self.best:
            noted = {"suite": self.arguments.suite, "seeds": [self.seed], "algo": self.arguments.algo}
            weights.save(self.home / MODEL, made, {"name": "fleet", **noted})
        self.record.append(steps, round(seconds, 3), reached)
        if not sys.stderr.isatty():
            print(f"seed {self.seed}: {steps:,} of {self.arguments.steps:,} steps, {self.told()}", flush=True)

    @property
    def best(self) -> float:
        return max(row[-1] for row in self.record.rows)

    def told(self) -> str:
        """The latest, for people."""
        return f"team QoI {self.record.rows[-1][-1]:+.4f} over AFR's on validation"
