"""The experiment: common random numbers, the oracle's column, rows in and out of files."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from bufgym import oracle, policies
from bufgym.benchmark import run
from bufgym.benchmark.rows import RUNS
from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.policies import Policy
from bufgym.scenario import Interruption, Uplink
from bufgym.traces import Trace

SLOW = Trace.steps([(1.0, 300_000), (1.0, 0)], name="slow")
FAST = Trace.steps([(1.0, 9_000_000)], name="fast")
UPLINK = Uplink(traces=(SLOW, FAST), rate_hz=10, duration_s=2, size_bytes=100_000)


def spy(name: str, log: list[Any]) -> Policy:
    """A policy that writes down what it meets and rejects all."""

    def on_arrival(buffer: Any, arrival: Any, memory: Any) -> int:
        log.append((int(arrival.seq), int(arrival.arrival_us), int(arrival.size_bytes), float(arrival.uniform)))
        return policies.REJECT

    return Policy(name, on_arrival)


def test_every_policy_and_capacity_meets_the_same_episodes() -> None:
    first: list[Any] = []
    second: list[Any] = []
    scenario = replace(UPLINK, size_cv=0.5)
    run.run([spy("one", first), spy("two", second)], scenario, [2, 5], 3)
    assert first == second
    half = len(first) // 2
    assert half == 2 * 3 * 20  # traces x seeds x messages
    # Traces come one after the other, capacities within them.
    per = 3 * 20
    assert first[:per] == first[per : 2 * per]
    assert len({uniform for *_, uniform in first[:per]}) == per


def test_a_seed_means_the_same_episode_in_any_company(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = [policies.get("random"), policies.get("afr")]
    rows = run.run(chosen, UPLINK, [1, 3], 4)
    alone = run.run([policies.get("random")], replace(UPLINK, traces=(FAST,)), [3], [2])
    wanted = ("random", 3, "fast", 2)
    assert alone == [row for row in rows if (row["policy"], row["capacity"], row["trace"], row["seed"]) == wanted]
    monkeypatch.setattr(run, "_BATCH_MESSAGES", 41)  # two episodes of 20
    assert sorted(map(repr, run.run(chosen, UPLINK, [1, 3], 4))) == sorted(map(repr, rows))


def test_every_trace_is_met_on_its_own_even_under_one_name() -> None:
    parts = run.by_trace(replace(UPLINK, traces=(SLOW, FAST, SLOW, SLOW)))
    assert [label for label, _ in parts] == ["slow", "fast", "slow#2", "slow#3"]
    assert all(len(part.traces) == 1 for _, part in parts if isinstance(part, Uplink))


def test_an_interruption_has_a_bound_and_a_regret() -> None:
    """T = 3, L = 1: message 0 is sent, of 1, 2, 3 one is kept, and message 4 comes after.

    V = min(1, d / 4): drop-oldest keeps 3, H = 1 + 3/4 + 1/4 = 2, the clairvoyant 1 + 2/4 + 2/4 as well: regret 0.
    V = min(1, d / 2): drop-oldest 1 + 1 + 1/2, the clairvoyant 1 + 1 + 1: regret (3 - 2.5) / 3.
    """
    for distance, best, regret in ((4, 2.0, 0.0), (2, 3.0, 1 / 6)):
        v = qoi.saturating(distance)
        scenario = Interruption(law="fixed", t_max=3, value=v)
        (row,) = run.run([policies.get("drop-oldest")], scenario, [1], 1, label="short")
        assert list(row) == list(RUNS)
        assert (row["scenario"], row["trace"]) == ("short", "interruption")
        assert row["clairvoyant"] == best == 1 + oracle.integer(1, 3, v)
        assert row["certified"] is True
        assert row["regret"] == pytest.approx(regret)
        assert (row["arrived"], row["delivered"], row["dropped"]) == (5, 3, 2)


def test_bounds_that_are_not_asked_for_or_do_not_hold() -> None:
    (row,) = run.run([policies.get("afr")], replace(UPLINK, traces=(FAST,)), [2], 1, bound=False)
    assert row["clairvoyant"] is None and row["certified"] is None and row["regret"] is None
    (free,) = run.run([policies.get("rosbridge")], replace(UPLINK, traces=(SLOW,)), [2], 1)
    assert free["clairvoyant"] > 0 and free["regret"] is None  # L does not bind it
    assert free["dropped"] == 0 and free["peak_backlog_bytes"] > 2 * 100_000
    dead = replace(UPLINK, traces=(Trace.steps([(1.0, 1), (1.0, 0)], name="dead", after="stop"),))
    (nothing,) = run.run([policies.get("afr")], dead, [2], 1)
    assert (nothing["qoi"], nothing["clairvoyant"], nothing["regret"]) == (0, 0, 0)


def test_where_only_a_full_buffer_asks_the_bound_is_an_upper_one() -> None:
    asked = run.run([policies.get("clairvoyant")], replace(UPLINK, traces=(SLOW,)), [2], 3)
    assert all(row["certified"] and row["regret"] == pytest.approx(0, abs=1e-12) for row in asked)
    rows = run.run([policies.get("drop-oldest")], replace(UPLINK, traces=(SLOW,)), [2], 3, decide_at="overflow")
    assert not any(row["certified"] for row in rows)
    assert [row["clairvoyant"] for row in rows] == [row["clairvoyant"] for row in asked]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"policies": []}, "policies"),
        ({"capacities": []}, "capacities"),
        ({"capacities": [0]}, "capacity = 0"),
        ({"seeds": 0}, "seeds = 0"),
        ({"seeds": [-1]}, "seed = -1"),
        ({"policies": ["afr", "afr"]}, "'afr' is given more than once"),
        ({"decide_at": "never"}, "'never'"),
    ],
)
def test_bad_arguments_are_named(change: dict[str, Any], message: str) -> None:
    given = {"policies": ["afr"], "capacities": [2], "seeds": 1, **change}
    chosen = [policies.get(name) for name in given.pop("policies")]
    with pytest.raises(BufgymError, match=message):
        run.run(chosen, UPLINK, **given)


def test_functions_and_names_are_policies_too() -> None:
    def newest(buffer: Any, arrival: Any, memory: Any) -> int:
        return policies.ACCEPT if len(buffer.slots) < buffer.capacity else 0

    rows = run.run([newest, "drop-oldest", policies.get("afr")], UPLINK, [2], 1)
    qoi_of = {row["policy"]: row["qoi"] for row in rows if row["trace"] == "slow"}
    assert list(qoi_of) == ["newest", "drop-oldest", "afr"] and qoi_of["newest"] == qoi_of["drop-oldest"]
    with pytest.raises(BufgymError, match="policy 3: must be a name, a Policy, or a function"):
        run.run([3], UPLINK, [2], 1)  # type: ignore[list-item]
    with pytest.raises(BufgymError, match="'afr' is given more than once; 'afr' is a built-in policy's name"):
        run.run([Policy("afr", newest), "afr"], UPLINK, [2], 1)
