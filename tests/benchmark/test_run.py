"""The experiment: common random numbers, the oracle's column, rows in and out of files."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bufgym import oracle, policies, qoi
from bufgym.benchmark import run
from bufgym.errors import BufgymError
from bufgym.metrics import METRICS
from bufgym.policies import Policy
from bufgym.scenario import Interruption, Uplink
from bufgym.traces import Trace

SLOW = Trace.steps([(1.0, 300_000), (1.0, 0)], name="slow")
FAST = Trace.steps([(1.0, 9_000_000)], name="fast")
UPLINK = Uplink(traces=(SLOW, FAST), rate_hz=10, duration_s=2, size_bytes=100_000)


def spy(name: str, log: list[Any]) -> Policy:
    """A policy that writes down what it meets and rejects all."""

    def on_arrival(buffer: Any, arrival: Any, memory: Any) -> int:
        log.append((int(arrival.seq), int(arrival.arrival_us), int(arrival.size_bytes), float(arrival.luck)))
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
    # Cells come one after the other, capacities within them.
    per = 3 * 20
    assert first[:per] == first[per : 2 * per]
    assert len({luck for *_, luck in first[:per]}) == per


def test_a_seed_means_the_same_episode_in_any_company() -> None:
    chosen = [policies.get("random"), policies.get("afr")]
    all_rows = run.run(chosen, UPLINK, [1, 3], 4)
    alone = run.run([policies.get("random")], replace(UPLINK, traces=(FAST,)), [3], [2])
    assert alone == [
        row
        for row in all_rows
        if (row["policy"], row["capacity"], row["trace"], row["seed"]) == ("random", 3, "fast", 2)
    ]


def test_many_seeds_run_in_several_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = [policies.get("drop-oldest")]
    whole = run.run(chosen, UPLINK, [2], 5)
    monkeypatch.setattr(run, "_BATCH_MESSAGES", 41)  # two episodes of 20
    assert run.run(chosen, UPLINK, [2], 5) == whole


def test_every_trace_is_a_cell_even_under_one_name() -> None:
    parts = run.cells(replace(UPLINK, traces=(SLOW, FAST, SLOW, SLOW)))
    assert [label for label, _ in parts] == ["slow", "fast", "slow#2", "slow#3"]
    assert all(len(cell.traces) == 1 for _, cell in parts if isinstance(cell, Uplink))


def test_an_interruption_has_an_oracle_and_a_regret() -> None:
    """T = 3, L = 1, V = min(1, d / 4): of 1, 2, 3 one is kept, and message 4 comes after.

    drop-oldest keeps 3: H = 1 + 3/4 + 1/4 = 2. The oracle gains 2/4 + 2/4 = 1 as well: V is linear here, regret 0.
    With V = min(1, d / 2) drop-oldest gains 1 + 1/2, the oracle 1 + 1: regret 1/4.
    """
    for distance, regret in ((4, 0.0), (2, 0.25)):
        v = qoi.saturating(distance)
        scenario = Interruption(law="fixed", t_max=3, value=v)
        (row,) = run.run([policies.get("drop-oldest")], scenario, [1], 1)
        assert tuple(row) == run.COLUMNS
        assert row["trace"] == "interruption"
        assert row["oracle"] == oracle.integer(1, 3, v)
        assert row["regret"] == pytest.approx(regret)
        assert (row["arrived"], row["delivered"], row["dropped"]) == (5, 3, 2)


def test_no_oracle_where_there_is_none() -> None:
    (row,) = run.run([policies.get("afr")], replace(UPLINK, traces=(FAST,)), [2], 1)
    assert row["oracle"] is None and row["regret"] is None
    limited = run.run([policies.get("afr")], Interruption(t_max=5), [2], 1, max_bytes=300_000)
    assert limited[0]["regret"] is None


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


# -------------------- files


def rows_of_both_kinds() -> list[run.Row]:
    nothing_delivered = replace(UPLINK, traces=(Trace.steps([(1.0, 1), (1.0, 0)], name="dead", after="stop"),))
    return [
        *run.run([policies.get("afr"), policies.get("decimate:every=2")], Interruption(t_max=9), [1, 2], 2),
        *run.run([policies.get("random")], nothing_delivered, [2], 1),
    ]


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_rows_survive_a_file(tmp_path: Path, ending: str) -> None:
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    rows = rows_of_both_kinds()
    assert math.isnan(rows[-1]["mean_sojourn_s"]) and rows[-1]["regret"] is None
    path = run.write_rows(rows, tmp_path / f"rows.{ending}")
    again = run.read_rows(path)
    assert [list(row) for row in again] == [list(row) for row in rows]
    for row, same in zip(rows, again, strict=True):
        for name, number in row.items():
            assert type(same[name]) is type(number), name
            np.testing.assert_equal(same[name], number)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]  # nothing temporary stays


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "rows.csv"
    run.write_rows(rows_of_both_kinds()[:1], target)
    before = target.read_bytes()
    with pytest.raises(ValueError, match="fields not in fieldnames"):
        run.write_rows([{"policy": "a"}, {"policy": "a", "surprise": 1}], target)
    assert target.read_bytes() == before
    assert list(tmp_path.iterdir()) == [target]


def test_unknown_endings_and_broken_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(BufgymError, match=r"rows\.txt"):
        run.write_rows([], tmp_path / "rows.txt")
    broken = tmp_path / "broken.csv"
    broken.write_text("policy,qoi\nafr,many\n")
    with pytest.raises(BufgymError, match=r"line 2: qoi = 'many'"):
        run.read_rows(broken)


def test_metrics_are_all_in_the_columns() -> None:
    assert set(METRICS) < set(run.COLUMNS)
