"""One episode in full: nothing of it is lost, and it is the very run that the rows tell of."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from typing import Any

import pytest

from bufgym import policies
from bufgym.benchmark import run
from bufgym.benchmark.tasks.timeline import choose, timeline
from bufgym.model import qoi
from bufgym.scenario import Interruption, Uplink
from bufgym.traces import Trace

CHOSEN = [policies.get(spec) for spec in ("drop-oldest", "afr", "random", "codel", "clairvoyant", "rosbridge")]
GAPPY = Uplink(
    traces=(Trace.steps([(1.0, 600_000), (2.0, 0), (1.0, 250_000)], name="gappy"),),
    rate_hz=10,
    duration_s=6,
    size_bytes=50_000,
)
STOPS = replace(GAPPY, traces=(Trace.steps([(2.0, 300_000), (2.0, 20_000)], name="stops", after="stop"),))
"""Here the link ends for good: a message hangs in transmission and others stay queued."""


@pytest.mark.parametrize("scenario", [GAPPY, STOPS, Interruption(t_max=30, value=qoi.saturating(4))])
def test_every_message_is_accounted_for_as_in_the_rows(scenario: Any) -> None:
    rows = run.run(CHOSEN, scenario, [3], [1003], label="here")
    made = timeline(CHOSEN, scenario, rows[0])
    assert json.loads(json.dumps(made, allow_nan=False)) == made
    assert (made["scenario"], made["capacity"], made["seed"]) == ("here", 3, 1003)
    assert list(made["policies"]) == [policy.name for policy in CHOSEN]
    messages = len(made["arrival_s"])
    for row in rows:
        lane = made["policies"][row["policy"]]
        received, dropped = [k for k, _, _ in lane["received"]], [k for k, _ in lane["dropped"]]
        assert not set(received) & set(dropped)
        assert len(set(received)) == len(received) == row["delivered"] and len(dropped) == row["dropped"]
        left = messages - len(received) - len(dropped)
        assert row["arrived"] == messages and left == row["in_transmission"] + row["buffered"]
        assert lane["qoi"] == pytest.approx(row["qoi"], rel=1e-12)
        assert lane["regret"] == (None if row["regret"] is None else pytest.approx(row["regret"], abs=1e-12))
        # H once more, from the picture alone.
        x = [made["x"][k] for k in sorted(received)]
        gains = sum(scenario.value(b - a) for a, b in itertools.pairwise(x))
        assert lane["qoi"] == pytest.approx(1 + gains if x else 0.0)
        assert all(made["arrival_s"][k] <= dequeued <= transmitted for k, dequeued, transmitted in lane["received"])
        assert all(made["arrival_s"][k] <= when for k, when in lane["dropped"])
    assert scenario is not STOPS or any(row["in_transmission"] and row["buffered"] for row in rows)


def test_the_drawn_capacity_carries_the_messages() -> None:
    """The curve's area until a time is at least what was transmitted by then, and it reaches past the last receipt."""
    rows = run.run(CHOSEN, GAPPY, [3], [0])
    made = timeline(CHOSEN, GAPPY, rows[0])
    step_s = made["rate"]["t_s"][1]
    carried = [0.25 * sum(made["rate"]["bytes_per_s"][: k + 1]) for k in range(len(made["rate"]["t_s"]))]
    assert step_s == 0.25
    for name in ("drop-oldest", "afr", "clairvoyant"):
        transmitted = [transmitted for _, _, transmitted in made["policies"][name]["received"]]
        assert made["rate"]["t_s"][-1] + step_s >= max(transmitted)
        for number, at in enumerate(sorted(transmitted), start=1):
            assert carried[int(at / step_s)] >= 50_000 * number
    assert made["demand_bytes_per_s"] == pytest.approx(10 * 50_000, rel=0.02)


def test_the_episode_shown_is_the_one_that_costs_drop_oldest_most_at_the_middle_capacity() -> None:
    given = [("drop-oldest", 2, 0, 0.9), ("drop-oldest", 4, 0, 0.2), ("drop-oldest", 4, 1, 0.3)]
    given += [("drop-oldest", 4, 2, None), ("afr", 4, 3, 0.8), ("drop-oldest", 8, 0, 0.7)]
    names = ("policy", "capacity", "seed", "regret")
    rows = [dict(zip(names, cells, strict=True), scenario="s", trace="t") for cells in given]
    assert choose(rows) == choose(rows[::-1]) == rows[2]
    assert choose(rows[3:4]) is None
