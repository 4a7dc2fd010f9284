"""A fleet: one agent decides on every robot's buffer. Its objective is team QoI (mean H over robots) minus AFR's.

The robots of a cell share its capacity, so bytes that one sends another cannot; each still sees its own buffer alone.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from agents.constants import UNTAUGHT
from agents.objectives.objective import Objective
from agents.report import Report, Trained, report_rows
from agents.settings import Settings
from agents.tasks import Suites
from bufgym import policies
from bufgym.benchmark import tasks
from bufgym.benchmark.sweep import Sweep
from bufgym.envs import FleetVecEnv
from bufgym.policies import Policy
from bufgym.sb3 import GymVecEnv
from bufgym.scenario import FleetEpisode, FleetScenario, suites
from bufgym.scenario.numbered import draw
from bufgym.sim import Senders
from bufgym.sim.cell import Fleet
from bufgym.utils.errors import BufgymError

VALIDATION_EPISODES = 4
"""Validation episodes per link, of the suite's own length."""


def fleet_of(chosen: Suites, split: str) -> FleetScenario:
    """The robots of the one suite on all links of one split."""
    (name,) = chosen.names
    found = suites.get(name).settings(split, chosen.data)
    if len(found) > 1:
        raise BufgymError(f"suite {name}: an agent for a fleet learns from one scenario, this has {len(found)}")
    (setting,) = found.values()
    fleet: FleetScenario = setting.scenario
    return fleet


class FleetEpisodes:
    """Cells full of robots with one L, with AFR's result on every robot."""

    def __init__(self, fleet: FleetScenario, episodes: Sequence[FleetEpisode], capacity: int) -> None:
        self.episodes = episodes
        self.decisions = sum(len(arrivals) for episode in episodes for arrivals in episode.arrivals)
        """Decisions of a candidate, one per arrival."""
        rows, messages = fleet.robots * len(episodes), fleet.max_messages
        self.fleet = Fleet(Senders(rows, capacity, fleet.value, max_messages=messages), fleet.robots)
        self.rival = self.team_qoi(policies.get(tasks.TASKS["fleet"].baseline))

    def team_qoi(self, policy: Policy) -> float:
        """Mean over robots and episodes of H."""
        for c, episode in enumerate(self.episodes):
            self.fleet.load(c, episode)
        self.fleet.run(policy)
        sender = self.fleet.senders.batch.senders
        return float((sender["delivered_gain"] + (sender["transmitted"] > 0)).mean())

    def measure(self, policy: Policy) -> float:
        """AFR's team QoI less the policy's."""
        return self.rival - self.team_qoi(policy)


def validation_episodes(settings: Settings) -> list[FleetEpisodes]:
    """The validation episodes at every L, the same for every seed."""
    (suite,), capacities = settings.suites.names, settings.suites.capacities_of(settings.suites.names[0])
    cells = len(capacities) * len(fleet_of(settings.suites, "validation").uplink.traces)
    seeds = settings.validations(VALIDATION_EPISODES, cells)
    sweep = Sweep(suite, (), "validation", seeds=seeds, data=settings.suites.data).checked()
    drawn = [(sweep.setting(shard.label, shard.trace).scenario, shard.seeds) for shard in sweep.shards()]
    episodes = [draw(robots, seed) for robots, seeds in drawn for seed in seeds]
    return [FleetEpisodes(drawn[0][0], episodes, L) for L in capacities]


class FleetObjective(Objective):
    """The robots of one suite."""

    columns = ("gain",)
    best = max
    message = "team QoI {:+.4f} over AFR's on validation"

    @functools.cached_property
    def judges(self) -> list[FleetEpisodes]:
        """Episodes of ``validation_episodes``."""
        return validation_episodes(self.settings)

    def validate(self, agent: Policy) -> tuple[float, ...]:
        """Team QoI above AFR's on the validation episodes."""
        return (-float(np.mean([part.measure(agent) for part in self.judges])),)

    def env(self, num_envs: int, reward: str, **options: Any) -> VecEnv:
        """Robots as rows, each rewarded for its own information, at the middle L; the agent serves every L."""
        chosen = self.settings.suites
        fleet, capacities = fleet_of(chosen, "train"), chosen.capacities_of(chosen.names[0])
        batch = FleetVecEnv(
            max(1, num_envs // fleet.robots),
            fleet.robots,
            fleet.uplink,
            capacities[len(capacities) // 2],
            reward="own",
            term=reward,
            autoreset_mode="SameStep",
            actions="candidates",
            **options,
        )
        return GymVecEnv(batch)

    def report(self, trained: Trained) -> Report:
        """A row of the benchmark for each agent and fixed policy in each episode of the test split."""
        fixed = map(policies.get, tasks.TASKS["fleet"].default_policies())
        return report_rows(trained, [*UNTAUGHT, *fixed])
