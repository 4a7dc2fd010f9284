"""An agent and the fixed policies on fixed episodes of one environment, scored as ``bufgym bench`` scores a row."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from typing import Any

import gymnasium as gym
import numpy as np

from agents.constants import UNTAUGHT
from agents.evaluation import play
from agents.mixed_env import Cell
from agents.settings import Settings
from agents.tasks import Environment
from bufgym import scenario as scenarios
from bufgym.benchmark.bootstrap import RESAMPLES, SEED, interval, times_drawn
from bufgym.benchmark.rows import Row
from bufgym.benchmark.score import REFERENCE, CellScore, scores
from bufgym.benchmark.tasks import QueueTask
from bufgym.oracle import normalised_score
from bufgym.oracle.measure import BASELINE, regret
from bufgym.policies import Policy, registry
from bufgym.scenario import Scenario, Uplink
from bufgym.scenario.numbered import draw
from bufgym.sim.metrics import Outcome
from bufgym.traces import Trace, synthetic_lte
from bufgym.traces.shipped import SHIPPED_DURATION_S, SHIPPED_LTE

HELD_OUT_TRACES, GENERATED, FIRST_LINK = 2, 14, 30_000
"""Shipped links that no training sees, links generated like them beside those, and the first seed of these."""
FIRST_SEED = {"validation": 2_000_000_000, "test": 1_000_000_000}
"""First seed of a split's episodes."""


@functools.cache
def generated() -> tuple[Trace, ...]:
    """Links of the shipped ones' modes and means, by turns."""
    kinds = [SHIPPED_LTE[k % len(SHIPPED_LTE)] for k in range(GENERATED)]
    return tuple(synthetic_lte(FIRST_LINK + k, SHIPPED_DURATION_S, mean, mode) for k, (mode, mean) in enumerate(kinds))


def split_scenario(on: Environment) -> tuple[Scenario, Scenario]:
    """Training and held-out scenario, the same but for the traces: sixteen are held out, two of them shipped."""
    base = scenarios.get(gym.spec(on.env).kwargs["scenario"])
    if not isinstance(base, Uplink):
        return base, base
    base = replace(base, size_bytes=on.size_bytes, duration_s=on.duration_s)
    traces, held_out = base.traces[:-HELD_OUT_TRACES], base.traces[-HELD_OUT_TRACES:]
    return replace(base, traces=traces), replace(base, traces=(*held_out, *generated()))


class FixedEpisodes:
    """Episodes that no training run sees, with the results of the clairvoyant and Drop Oldest.

    ``validation`` has new episodes on the training traces, ``test`` has episodes on the sixteen held-out traces.
    """

    def __init__(self, on: Environment, split: str, count: int) -> None:
        self.scenario, self.capacity = split_scenario(on)[split == "test"], on.capacity
        # With uniform draws for policies that randomise.
        self.episodes = [draw(self.scenario, FIRST_SEED[split] + i) for i in range(count)]
        self._plans = [QueueTask().best(episode, self.capacity, self.scenario) for episode in self.episodes]
        self._base = math.fsum(result.qoi for result in self.play(registry.get(BASELINE)))
        self._best = math.fsum(plan.qoi for plan in self._plans)

    def play(self, agent: Policy) -> list[Outcome]:
        """Outcomes of an agent."""
        return play(agent, [Cell("", self.scenario, self.capacity)], [len(self.episodes)], self.episodes)

    def play_fixed(self) -> dict[str, list[Outcome]]:
        """Outcomes of constant actions, of chance and of every registered policy of one queue, by name."""
        fixed = [*UNTAUGHT, *(registry.get(name) for name in registry.names(for_topics=False))]
        return {policy.name: self.play(policy) for policy in fixed}

    def score(self, outcomes: Sequence[Outcome]) -> float:
        """0 for Drop Oldest, 1 for the clairvoyant; NaN where the two are equal."""
        return float(normalised_score(math.fsum(result.qoi for result in outcomes), self._base, self._best))

    def rows(self, outcomes: Mapping[str, Sequence[Outcome]]) -> list[Row]:
        """The outcomes of all policies as rows of the benchmark."""
        unbounded = {name for name in registry.names() if registry.get(name).unbounded}
        rows = []
        for name, results in outcomes.items():
            for seed, (result, plan) in enumerate(zip(results, self._plans, strict=True)):
                link = self.episodes[seed].link.trace.name
                key = {"scenario": "", "trace": link, "seed": seed, "policy": name, "capacity": self.capacity}
                known = {"clairvoyant": plan.qoi, "certified": plan.certified}
                lost = None if name in unbounded else regret(result.qoi, plan.qoi)
                rows.append({**key, **asdict(result), **known, "regret": lost})
        return rows


def fixed_episodes(settings: Settings, split: str) -> FixedEpisodes:
    """The episodes of these settings, whose bounds take seconds: a process makes them once for all algorithms."""
    on = settings.environment
    return _made(on, split, settings.validations() if split == "validation" else on.episodes)


_made = functools.lru_cache(maxsize=4)(FixedEpisodes)


def known_mean(numbers: Sequence[float]) -> float:
    """The mean of the known numbers, NaN if none is: a policy that delivered nothing has no delay."""
    known = [number for number in numbers if not math.isnan(number)]
    return float(np.mean(known)) if known else math.nan


def together(rows: Sequence[Row], several: Mapping[str, Sequence[tuple[int, str]]]) -> dict[str, CellScore]:
    """What the agents of several training seeds score together, by algorithm: for fresh seeds and fresh links.

    ``several`` has each algorithm's (seed, name in the rows).
    """
    plain, found = [row for row in rows if row["policy"] in (BASELINE, REFERENCE)], {}
    for algo, agents in several.items():
        seed_of = {name: seed for seed, name in agents}
        own = [{**row, "training_seed": seed_of[row["policy"]]} for row in rows if row["policy"] in seed_of]
        cells = scores([*plain, *({**row, "policy": algo} for row in own)]).cells
        found[algo] = next(cell for cell in cells if cell.policy == algo)
    return found


def summarise(outcomes: Mapping[str, Sequence[Outcome]], rows: Sequence[Row], agent: str) -> list[dict[str, Any]]:
    """One entry per policy, best QoI first: its score and regret, means over the episodes, QoI minus the agent's.

    ``rows`` belong to the outcomes. ``score_95`` and ``minus_agent_95`` are 95 % intervals for fresh links, or of one
    link for fresh episodes, paired as in ``score``: policies meet the same episodes, so an episode's own QoI cancels.
    """
    measured = {cell.policy: cell for cell in scores(rows).cells}
    reference = np.array([result.qoi for result in outcomes[agent]])
    link = np.unique([row["trace"] for row in rows if row["policy"] == agent], return_inverse=True)[1]
    drawn = link if link.max() > 0 else np.arange(len(link))
    clusters = int(drawn.max()) + 1
    weights = times_drawn(clusters, RESAMPLES, np.random.default_rng(SEED))[:, drawn]
    entries = []
    for name, results in outcomes.items():
        score, low, high = measured[name].score
        entry = {"policy": name, "score": score, "score_95": [low, high], "regret": measured[name].regret.value}
        entry |= {field.name: known_mean([getattr(o, field.name) for o in results]) for field in fields(Outcome)}
        less = np.array([result.qoi for result in results]) - reference
        minus, low, high = interval(weights @ less / weights.sum(axis=1), clusters)
        entries.append({**entry, "minus_agent": minus, "minus_agent_95": [low, high]})
    return sorted(entries, key=lambda entry: -entry["qoi"])
