"""One episode in full, for the report: what each policy delivered and dropped on the very same link."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bufgym.benchmark.rows import Row
from bufgym.benchmark.tasks import bound
from bufgym.oracle.measure import BASELINE
from bufgym.policies import Policy
from bufgym.scenario import Scenario
from bufgym.scenario.numbered import draw
from bufgym.sim.metrics import outcome
from bufgym.sim.state import NEVER

_STEP_S = 0.25
"""The capacity curve is drawn in steps of so many seconds."""


def choose(rows: Sequence[Row]) -> Row | None:
    """The row of the episode to show: at the middle capacity, the one on which Drop Oldest has the largest regret."""
    capacities = sorted({row["capacity"] for row in rows})
    middle = capacities[len(capacities) // 2]
    candidates = [
        row for row in rows if row["policy"] == BASELINE and row["capacity"] == middle and row["regret"] is not None
    ]
    return max(candidates, key=lambda row: (row["regret"], row["scenario"], row["trace"], row["seed"]), default=None)


def timeline(policies: Sequence[Policy], scenario: Scenario, chosen: Row) -> dict[str, Any]:
    """The episode of the row ``chosen`` under every policy; times in s, rates in bytes/s."""
    episode = draw(scenario, chosen["seed"])
    capacity = chosen["capacity"]
    plan = bound.best(episode, capacity, scenario)
    arrivals = np.asarray(episode.arrivals)
    lanes: dict[str, Any] = {}
    last_us = int(arrivals["arrival_us"][-1])
    for policy in policies:
        senders = bound.meet(policy, [episode], capacity, scenario, [plan])
        log = np.asarray(senders.batch.log[0])[: len(arrivals)]
        h = outcome(senders, 0).qoi
        received = np.flatnonzero(log["transmitted_us"] != NEVER)
        dropped = np.flatnonzero(log["dropped_us"] != NEVER)
        lanes[policy.name] = {
            "qoi": h,
            "regret": bound.columns(policy, h, plan)["regret"],
            "received": [
                [int(k), int(log["dequeued_us"][k]) / 1e6, int(log["transmitted_us"][k]) / 1e6] for k in received
            ],
            "dropped": [[int(k), int(log["dropped_us"][k]) / 1e6] for k in dropped],
        }
        if policy.ranked and len(received):
            last_us = max(last_us, int(log["transmitted_us"][received].max()))
    edges_us = np.arange(0, last_us + round(2e6 * _STEP_S), round(1e6 * _STEP_S))
    carried = np.diff(episode.link.carried_by(edges_us))
    offered_s = max(1, int(arrivals["arrival_us"][-1])) / 1e6
    return {
        **{key: chosen[key] for key in ("scenario", "capacity", "trace", "seed")},
        "arrival_s": (arrivals["arrival_us"] / 1e6).tolist(),
        "x": arrivals["x"].tolist(),
        "rate": {"t_s": (edges_us[:-1] / 1e6).tolist(), "bytes_per_s": (carried / _STEP_S).tolist()},
        "demand_bytes_per_s": float(arrivals["size_bytes"][:-1].sum() / offered_s),
        "policies": lanes,
    }
