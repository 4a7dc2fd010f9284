"""An agent and the fixed policies on held-out episodes of one environment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import gymnasium as gym
import numpy as np

from agents.settings import Settings
from bufgym import scenario as scenarios
from bufgym.benchmark.run import draw
from bufgym.benchmark.score import paired_difference
from bufgym.policies import registry
from bufgym.scenario import Episode, Scenario, Uplink
from bufgym.sim import run
from bufgym.sim.metrics import Outcome, outcome

HELD_OUT_TRACES = 2
HELD_OUT_SEED = 1_000_000_000
"""Held-out episodes are drawn from this seed on."""


def split_scenario(settings: Settings) -> tuple[Scenario, Scenario]:
    """(training scenario, held-out scenario): the same but for the traces, the last two of which are held out."""
    base = scenarios.get(gym.spec(settings.env).kwargs["scenario"])
    if not isinstance(base, Uplink):
        return base, base
    base = replace(base, size_bytes=settings.size_bytes, duration_s=settings.duration_s)
    traces, held_out = base.traces[:-HELD_OUT_TRACES], base.traces[-HELD_OUT_TRACES:]
    return replace(base, traces=traces), replace(base, traces=held_out)


def held_out_episodes(scenario: Scenario, count: int) -> list[Episode]:
    """Episodes that no training run sees, with uniform draws for policies that randomise."""
    return [draw(scenario, HELD_OUT_SEED + i) for i in range(count)]


def run_fixed(episodes: Sequence[Episode], scenario: Scenario, capacity: int) -> dict[str, list[Outcome]]:
    """The outcomes of every registered policy of one queue, by name."""
    outcomes = {}
    for name in registry.names(for_topics=False):
        senders = run(registry.get(name), episodes, capacity, scenario.value)
        outcomes[name] = [outcome(senders, i) for i in range(len(episodes))]
    return outcomes


def known_mean(numbers: Sequence[float]) -> float:
    """The mean of those that are known; NaN where none is: a policy that delivered nothing has no delay."""
    known = [number for number in numbers if not math.isnan(number)]
    return float(np.mean(known)) if known else math.nan


def summarise(outcomes: Mapping[str, Sequence[Outcome]], agent: str, resamples: int = 2000) -> list[dict[str, Any]]:
    """One row a policy, best QoI first: means over the episodes, and QoI minus the agent's with its 95 % interval.

    The interval is ``score.paired_difference``'s: policies meet the same episodes, so an episode's own QoI cancels.
    """
    reference = [result.qoi for result in outcomes[agent]]
    rows = []
    for name, results in outcomes.items():
        means = {field.name: known_mean([getattr(o, field.name) for o in results]) for field in fields(Outcome)}
        minus, low, high = paired_difference([result.qoi for result in results], reference, resamples=resamples)
        rows.append({"policy": name, **means, "minus_agent": minus, "minus_agent_95": [low, high]})
    return sorted(rows, key=lambda row: -row["qoi"])
