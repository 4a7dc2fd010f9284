"""The experiment of ``bufgym bench``: every policy meets the same episodes, and each run becomes one flat row.

Seed s stands for one episode and one sequence of luck, whatever the policy, the capacity and the order in which they
run (common random numbers): two rows with the same trace and seed differ by their policy and capacity alone, so their
difference carries no noise of the draw. Several traces are several cells, each with the full set of seeds.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import Any

from bufgym.benchmark.rows import Row
from bufgym.errors import BufgymError
from bufgym.oracle import Plan, clairvoyant
from bufgym.policies import Policy
from bufgym.scenario import Client, Episode, Interruption, Scenario, Streams, Uplink
from bufgym.sim import Senders, padded
from bufgym.sim import run as run_policy
from bufgym.sim.metrics import outcome

# Messages held at a time (88 bytes each): many seeds run in several batches.
_BATCH_MESSAGES = 1_000_000


def cells(scenario: Scenario) -> list[tuple[str, Scenario]]:
    """The scenario split into one cell a trace: (label, scenario). Traces of one name are told apart by a number."""
    if isinstance(scenario, Interruption):
        return [("interruption", scenario)]
    if not isinstance(scenario, Uplink | Client):
        return [(type(scenario).__name__.lower(), scenario)]
    labels: list[str] = []
    for trace in scenario.traces:
        same = sum(other.name == trace.name for other in scenario.traces[: len(labels)])
        labels.append(f"{trace.name}#{same + 1}" if same else trace.name)
    return [(label, replace(scenario, traces=(t,))) for label, t in zip(labels, scenario.traces, strict=True)]


def draw(scenario: Scenario, seed: int) -> Episode:
    """The episode of this seed, with the luck of randomised policies."""
    streams = Streams.seeded(seed)
    return scenario.draw(streams).with_uniforms(streams.policy)


def run(
    policies: Sequence[Policy],
    scenario: Scenario,
    capacities: Sequence[int],
    seeds: int | Sequence[int],
    *,
    label: str = "",
    max_bytes: int | None = None,
    decide_at: str = "arrival",
    bound: bool = True,
    progress: bool = False,
) -> list[Row]:
    """Every policy at every capacity on every trace and seed; one row each, with the entries of ``rows.COLUMNS``.

    Args:
        policies: see ``bufgym.policies.get``.
        scenario: an ``Uplink`` (each of its traces is a cell of its own) or an ``Interruption``.
        capacities: L, messages.
        seeds: so many (0, 1, ...), or these.
        label: what the rows call the scenario.
        max_bytes: B, bytes; None for no limit.
        decide_at: "arrival" or "overflow" (ask only when full).
        bound: find the clairvoyant's H for every episode and capacity, and every policy's regret.
        progress: show a bar on stderr, where that is a terminal and tqdm is installed.
    """
    chosen = checked(policies, capacities, seeds)
    parts = cells(scenario)
    rows: list[Row] = []
    with bar(len(parts) * len(chosen) * len(capacities) * len(policies), progress) as advance:
        for trace, cell in parts:
            for batch in batches(chosen, scenario.max_messages):
                episodes = [draw(cell, seed) for seed in batch]
                for capacity in capacities:
                    plans = [best(e, capacity, cell, max_bytes, decide_at) if bound else None for e in episodes]
                    for policy in policies:
                        senders = met(policy, episodes, capacity, cell, plans, max_bytes, decide_at)
                        for i, seed in enumerate(batch):
                            key = {"scenario": label, "trace": trace, "seed": seed}
                            rows.append(row(key, policy, capacity, senders, i, plans[i]))
                        advance(len(batch))
    return rows


def checked(policies: Sequence[Policy], capacities: Sequence[int], seeds: int | Sequence[int]) -> list[int]:
    """The seeds, so many or these; an error where there is nothing to run, or policies can't be told apart."""
    chosen = list(range(seeds)) if isinstance(seeds, int) else list(seeds)
    for what, given in (("policies", policies), ("capacities", capacities), ("seeds", chosen)):
        if not given:
            raise BufgymError(f"{what} = {seeds if what == 'seeds' else list(given)}: need at least one")
    distinct(policies)
    return chosen


def batches(seeds: Sequence[int], messages: int) -> list[Sequence[int]]:
    """The seeds, as many at a time as fit in memory if each episode has so many messages."""
    at_once = max(1, _BATCH_MESSAGES // messages)
    return [seeds[k : k + at_once] for k in range(0, len(seeds), at_once)]


def distinct(policies: Sequence[Policy]) -> None:
    """An error if two have one name: their rows could not be told apart."""
    names = [policy.name for policy in policies]
    for name in names:
        if names.count(name) > 1:
            raise BufgymError(f"policies: {name!r} is given more than once")


def best(
    episode: Episode, capacity: int, scenario: Scenario, max_bytes: int | None = None, decide_at: str = "arrival"
) -> Plan:
    """The clairvoyant's plan; where only a full buffer asks, no more than an upper bound."""
    plan = clairvoyant(episode, capacity, scenario.value, max_bytes=max_bytes)
    return plan if decide_at == "arrival" or plan.kept.all() else replace(plan, certified=False)


def met(
    policy: Policy,
    episodes: Sequence[Episode],
    capacity: int,
    scenario: Scenario,
    plans: Sequence[Plan | None],
    max_bytes: int | None = None,
    decide_at: str = "arrival",
) -> Senders:
    """The senders after ``policy`` met the episodes; a policy that foresees reads the plans that are known already."""
    memory = None
    if policy.privileged is not None and all(plan is not None for plan in plans):
        memory = padded([plan.kept for plan in plans if plan is not None])
    return run_policy(
        policy, episodes, capacity, scenario.value, max_bytes=max_bytes, decide_at=decide_at, memory=memory
    )


def row(key: Row, policy: Policy, capacity: int, senders: Senders, i: int, plan: Plan | None) -> Row:
    """What became of sender ``i``, for the episode that ``key`` names."""
    result = outcome(senders, i)
    return {
        **key,
        "policy": policy.name,
        "capacity": capacity,
        **asdict(result),
        "clairvoyant": None if plan is None else plan.qoi,
        "certified": None if plan is None else plan.certified,
        "regret": None if plan is None or policy.unbounded else regret(result.qoi, plan.qoi),
    }


def regret(qoi: float, most: float) -> float:
    """1 - H / H of the clairvoyant; 0 where nothing could be delivered at all."""
    return 1 - qoi / most if most > 0 else 0.0


@contextmanager
def bar(total: int, wanted: bool, unit: str = "run", done: int = 0) -> Iterator[Any]:
    """A function to call with the number of runs (or other units) just done; ``done`` are behind us already."""
    if wanted and sys.stderr.isatty():
        try:
            from tqdm import tqdm
        except ImportError:
            pass
        else:
            # What is done within a second needs no bar.
            with tqdm(total=total, initial=done, unit=unit, delay=1.0, leave=False, file=sys.stderr) as shown:
                yield shown.update
                return
    yield lambda _: None
