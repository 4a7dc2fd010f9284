"""A policy's runs on one queue, beside the clairvoyant's bound on the same episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bufgym.benchmark.rows import Row
from bufgym.oracle import Plan, clairvoyant
from bufgym.oracle.clairvoyant import privileged
from bufgym.oracle.measure import regret
from bufgym.policies import Policy
from bufgym.scenario import Episode, Scenario
from bufgym.sim import Senders, run
from bufgym.sim.senders import padded


def best(
    episode: Episode, capacity: int, scenario: Scenario, max_bytes: int | None = None, decide_at: str = "arrival"
) -> Plan:
    """Compute the clairvoyant's plan, which is only an upper bound if decisions wait for a full buffer."""
    plan = clairvoyant(episode, capacity, scenario.value, max_bytes=max_bytes)
    return plan if decide_at == "arrival" or plan.kept.all() else replace(plan, certified=False)


def meet(
    policy: Policy,
    episodes: Sequence[Episode],
    capacity: int,
    scenario: Scenario,
    plans: Sequence[Plan | None],
    max_bytes: int | None = None,
    decide_at: str = "arrival",
) -> Senders:
    """Run ``policy`` on the episodes and return the senders; the clairvoyant reuses known plans."""
    memory = None
    if policy.privileged is privileged and all(plan is not None for plan in plans):
        memory = padded([plan.kept for plan in plans if plan is not None])
    return run(policy, episodes, capacity, scenario.value, max_bytes=max_bytes, decide_at=decide_at, memory=memory)


def columns(policy: Policy, h: float, plan: Plan | None) -> Row:
    """Columns of a row besides the policy's ``Outcome``: clairvoyant, certified and regret, see ``rows.RUNS``."""
    if plan is None:
        return {"clairvoyant": None, "certified": None, "regret": None}
    lost = None if policy.unbounded else regret(h, plan.qoi)
    return {"clairvoyant": plan.qoi, "certified": plan.certified, "regret": lost}
