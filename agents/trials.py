"""A suite's episodes to validate and test agents on, with what the fixed policies and the clairvoyant made of them.

The episodes, and the rows of the fixed policies, are those of ``bufgym bench`` on the same split.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.evaluate import Agent
from agents.worlds import World, capacities_of, cells
from bufgym.benchmark import run as bench
from bufgym.benchmark.rows import Row
from bufgym.benchmark.score import BASELINE, DISCRIMINATIVE, normalised_score, regret
from bufgym.benchmark.sweep import Plan, cell, run_sweep, shards
from bufgym.errors import BufgymError
from bufgym.policies import Policy
from bufgym.scenario import Episode, suites
from bufgym.sim import run
from bufgym.sim.metrics import Outcome, outcome

if TYPE_CHECKING:
    from train import Arguments

Numbers = NDArray[np.float64]


class Verdict(NamedTuple):
    """What an agent reached on the trials: means over the cells that bite (as ``benchmark.score`` has it)."""

    score: float
    """0 is Drop Oldest, 1 the clairvoyant."""
    regret: float
    over_afr: float
    """Regret over AFR's regret."""


class Trials:
    """Every episode of the plan's split at every capacity; the rows of its fixed policies lie in ``folder``."""

    def __init__(self, plan: Plan, folder: Path, *, progress: bool = False) -> None:
        self.plan = plan = plan.checked()
        jobs = -1 if importlib.util.find_spec("joblib") else 1
        self.rows = run_sweep(plan, folder, jobs=jobs, progress=progress)
        settings = suites.get(plan.suite).settings(plan.split, plan.data)
        met: dict[str, list[tuple[Row, Episode]]] = {label: [] for label in settings}
        for shard in shards(plan):
            scenario = cell(settings[shard.label].scenario, shard.trace)
            trace = bench.cells(scenario)[0][0]
            for seed in shard.seeds:
                key = {"scenario": shard.label, "trace": trace, "seed": seed}
                met[shard.label].append((key, bench.draw(scenario, seed)))
        self.cells = cells(plan.suite, plan.split, plan.capacities, plan.data)
        self._sizes = [len(met[c.label]) for c in self.cells]
        self._keys = [key | {"capacity": c.capacity} for c in self.cells for key, _ in met[c.label]]
        self._episodes = [episode for c in self.cells for _, episode in met[c.label]]
        self._fixed = {(*_name(row), row["policy"]): row for row in self.rows}

    def known(self, policy: str, column: str = "qoi") -> Numbers:
        """[rows]: what the fixed policy has in this column."""
        return np.array([self._fixed[*_name(key), policy][column] for key in self._keys], np.float64)

    def play(self, agent: Agent, seats: int) -> World:
        """All episodes to their ends, under the agent's best guess at every decision."""
        world = World(self.cells, self._sizes, seats)
        world.load(self._episodes)
        actions = np.zeros(world.num_envs, np.int64)
        while (live := ~world.ended()).any():
            seen = {name: column[live] for name, column in world.observation().items()}
            actions[live], _ = agent.predict(seen, deterministic=True, action_masks=world.action_masks()[live])
            world.act(actions)
        return world

    def verdict(self, agent: Agent, seats: int) -> Verdict:
        """The agent against Drop Oldest, AFR and the clairvoyant; the plan must have both policies."""
        world = self.play(agent, seats)
        return self._verdict(np.concatenate([rows.summary(slice(None))["qoi"] for rows in world.groups]))

    def verdict_on(self, policy: Policy) -> Verdict:
        """The same for a policy."""
        return self._verdict(np.array([result.qoi for result in self._outcomes(policy)]))

    def _outcomes(self, policy: Policy) -> list[Outcome]:
        """What came of every row under a policy."""
        ends = np.cumsum(self._sizes).tolist()
        found = []
        for at, size, end in zip(self.cells, self._sizes, ends, strict=True):
            senders = run(policy, self._episodes[end - size : end], at.capacity, at.scenario.value)
            found += [outcome(senders, i) for i in range(size)]
        return found

    def _verdict(self, h: Numbers) -> Verdict:
        first = np.cumsum([0, *self._sizes[:-1]])
        ours, base, afr, best = (
            np.add.reduceat(given, first)
            for given in (h, self.known(BASELINE), self.known("afr"), self.known("afr", "clairvoyant"))
        )
        discriminative = regret(base, best) >= DISCRIMINATIVE
        if not discriminative.any():
            raise BufgymError(
                f"suite {self.plan.suite}, L = {list(self.plan.capacities)}: Drop Oldest cannot be bettered"
            )
        ours, base, afr, best = ours[discriminative], base[discriminative], afr[discriminative], best[discriminative]
        mine, theirs = float(regret(ours, best).mean()), float(regret(afr, best).mean())
        return Verdict(float(normalised_score(ours, base, best).mean()), mine, mine / theirs if theirs else np.inf)

    def rows_of(self, agent: Agent, seats: int, name: str, training_seed: int) -> list[Row]:
        """The agent's rows, as the benchmark has them."""
        world = self.play(agent, seats)
        outcomes = [outcome(rows.senders, i) for rows in world.groups for i in range(len(rows))]
        return self._rows(outcomes, name, training_seed)

    def rows_under(self, policy: Policy, name: str, training_seed: int) -> list[Row]:
        """The rows of a trained policy."""
        return self._rows(self._outcomes(policy), name, training_seed)

    def _rows(self, outcomes: Sequence[Outcome], name: str, training_seed: int) -> list[Row]:
        found = []
        for key, result in zip(self._keys, outcomes, strict=True):
            fixed = self._fixed[*_name(key), BASELINE]
            bound = {"clairvoyant": fixed["clairvoyant"], "certified": fixed["certified"]}
            bound["regret"] = bench.regret(result.qoi, bound["clairvoyant"])
            found.append({**key, "policy": name, **asdict(result), **bound, "training_seed": training_seed})
        return found


def _name(row: Row) -> tuple[str, str, int, int]:
    return row["scenario"], row["trace"], row["seed"], row["capacity"]


def seeds_for(suite: str, split: str, capacities: Sequence[int], episodes: int, data: str | None) -> int:
    """Seeds a trace, so that all scenarios, traces and capacities together have about so many episodes."""
    one_seed = sum(len(shard.seeds) for shard in shards(Plan(suite, (), split, tuple(capacities), 1, data).checked()))
    return max(1, round(episodes / (one_seed * len(capacities))))


def plan(
    arguments: Arguments, suite: str, split: str, specs: tuple[str, ...] = ("afr",), seeds: int | None = None
) -> Plan:
    """What the fixed policies meet on a split of one of the run's suites."""
    capacities, data = capacities_of(suite, arguments.capacities), arguments.data or None
    if split == "validation":
        share = math.ceil(arguments.validation_episodes / len(arguments.suites))
        seeds = seeds_for(suite, split, capacities, share, data)
    return Plan(suite, specs, split, capacities, seeds, data)


class ValidationSet:
    """The fixed validation episodes of all suites; made once, read from the run's folder afterwards."""

    def __init__(self, arguments: Arguments, folder: Path, progress: bool = False) -> None:
        self.trials = [
            Trials(plan(arguments, suite, "validation"), folder / "validation" / suite, progress=progress)
            for suite in arguments.suites
        ]

    def verdict(self, agent: Agent, seats: int) -> Verdict:
        """The agent's, averaged over the suites."""
        return _mean([trials.verdict(agent, seats) for trials in self.trials])

    def verdict_on(self, policy: Policy) -> Verdict:
        """The same for a policy."""
        return _mean([trials.verdict_on(policy) for trials in self.trials])


def _mean(verdicts: Sequence[Verdict]) -> Verdict:
    return Verdict(*np.mean(verdicts, axis=0).tolist())
