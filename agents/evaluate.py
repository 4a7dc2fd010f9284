"""An agent and the fixed policies over the same held-out episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import bufgym  # noqa: F401  (registers the environments)
from bufgym import scenario as scenarios
from bufgym.benchmark.run import draw
from bufgym.benchmark.score import paired_difference
from bufgym.envs import SenderVectorEnv
from bufgym.policies import registry
from bufgym.scenario import Episode, Scenario, Uplink
from bufgym.sim import run
from bufgym.sim.metrics import Outcome, outcome

if TYPE_CHECKING:
    from train import Arguments

HELD_OUT_TRACES = 2
HELD_OUT_SEED = 1_000_000_000
"""Held-out episodes are drawn from this seed on."""


class Agent(Protocol):
    """What can act: a trained MaskablePPO is one."""

    def predict(
        self, observation: Any, *, deterministic: bool = False, action_masks: NDArray[np.bool_] | None = None
    ) -> tuple[Any, Any]:
        """(actions, state)."""


def worlds(arguments: Arguments) -> tuple[Scenario, Scenario]:
    """(training scenario, held-out scenario): the same but for the traces, the last two of which are held out."""
    base = scenarios.get(gym.spec(arguments.env).kwargs["scenario"])
    if not isinstance(base, Uplink):
        return base, base
    base = replace(base, size_bytes=arguments.size_bytes, duration_s=arguments.duration_s)
    kept, held_out = base.traces[:-HELD_OUT_TRACES], base.traces[-HELD_OUT_TRACES:]
    return replace(base, traces=kept), replace(base, traces=held_out)


def held_out(world: Scenario, episodes: int) -> list[Episode]:
    """Episodes that no training run sees, with luck for policies that randomise."""
    return [draw(world, HELD_OUT_SEED + i) for i in range(episodes)]


def run_agent(
    agent: Agent, episodes: Sequence[Episode], world: Scenario, capacity: int, decide_at: str
) -> list[Outcome]:
    """What came of each episode under the agent's best guess at every decision."""
    # Stepped below the environment's own autoreset, so that a row that has ended waits for the others as it is.
    envs = SenderVectorEnv(len(episodes), world, capacity, decide_at=decide_at)
    envs.reset(options={"episodes": episodes})
    rows = envs.rows
    while not rows.output.terminated.all():
        seen = rows.observation(rows.output.slots, rows.output.context)
        actions, _ = agent.predict(seen, deterministic=True, action_masks=rows.output.action_mask)
        rows.step(np.asarray(actions, np.int64))
    return [outcome(rows.senders, i) for i in range(len(episodes))]


def run_fixed(episodes: Sequence[Episode], world: Scenario, capacity: int) -> dict[str, list[Outcome]]:
    """The same for every registered policy of one queue, by name."""
    results = {}
    for name in registry.names(for_topics=False):
        senders = run(registry.get(name), episodes, capacity, world.value)
        results[name] = [outcome(senders, i) for i in range(len(episodes))]
    return results


def summarise(results: Mapping[str, Sequence[Outcome]], agent: str, resamples: int = 2000) -> list[dict[str, Any]]:
    """One row a policy, best QoI first: means over the episodes, and QoI minus the agent's with its 95 % interval.

    The interval is ``score.paired_difference``'s: policies meet the same episodes, so what one is worth to everybody
    cancels.
    """
    reference = [o.qoi for o in results[agent]]
    rows = []
    for name, outcomes in results.items():
        means = {f.name: float(np.nanmean([getattr(o, f.name) for o in outcomes])) for f in fields(Outcome)}
        minus, low, high = paired_difference([o.qoi for o in outcomes], reference, resamples=resamples)
        rows.append({"policy": name, **means, "minus_agent": minus, "minus_agent_95": [low, high]})
    return sorted(rows, key=lambda row: -row["qoi"])
