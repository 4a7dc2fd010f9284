"""The task of stress: ratios of rows made by hand, byte limits, what is printed."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from test_score import rows_of

from bufgym.benchmark import report
from bufgym.benchmark.leaderboard import entries
from bufgym.benchmark.score import scores
from bufgym.benchmark.sweep import Sweep, run_sweep
from bufgym.benchmark.tasks import TASKS
from bufgym.benchmark.tasks.stress import ratios
from bufgym.scenario import Uplink, suites
from bufgym.traces import Trace

CELLS = [
    # Regrets 10, 19 and 15 %: the better of AFR and Drop Oldest has 10 %, so mine has 1.5 of it.
    *rows_of({"afr": [90.0], "drop-oldest": [81.0], "mine": [85.0]}, [100.0], scenario="one"),
    # 20, 5 and 10 %: here Drop Oldest is better, mine has twice its regret.
    *rows_of({"afr": [80.0], "drop-oldest": [95.0], "mine": [90.0]}, [100.0], scenario="two"),
    # 0.05 % is not over 0.1 %: mine could be as bad as it likes.
    *rows_of({"afr": [99.95], "drop-oldest": [50.0], "mine": [10.0]}, [100.0], scenario="three"),
]


def test_ratios_worked_by_hand() -> None:
    found = ratios(scores(CELLS))
    assert found["mine"] == (pytest.approx(2.0), ("two", 4), pytest.approx(1.75), 2)
    assert found["afr"] == (pytest.approx(4.0), ("two", 4), pytest.approx(2.5), 2)
    assert found["drop-oldest"] == (pytest.approx(1.9), ("one", 4), pytest.approx(1.45), 2)


def test_without_the_reference_there_is_no_ratio() -> None:
    found = ratios(scores([row for row in CELLS if row["policy"] != "afr"]))
    assert math.isnan(found["mine"].worst) and found["mine"].cell is None


def test_the_worst_cell_orders_policies_and_is_named() -> None:
    made = TASKS["stress"].summary([{**row, "mean_sojourn_s": 1.0, "mean_age_s": 1.0} for row in CELLS])
    assert [s.policy for s in made.overall] == ["drop-oldest", "mine", "afr"]
    assert made.overall[1]["worst"].value == pytest.approx(2.0) and math.isnan(made.overall[1]["worst"].low)
    assert made.notes[1] == "mine is worst in two at L = 4: 2.000, of 2 cells"
    listed = entries(CELLS, "stress-v1", {})
    assert [entry.policy for entry in listed] == ["drop-oldest", "mine", "afr"] and [e.rank for e in listed] == [
        1,
        2,
        3,
    ]
    assert set(listed[0].values) == {"worst", "ratio", "regret"}


def test_a_byte_limit_of_a_setting_holds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """B = 2 messages: L = 2 and L = 9 are the same episode, and without the limit they are not."""

    def build(split: str, data: Path | None) -> dict[str, suites.Setting]:
        uplink = Uplink((Trace.constant(100_000.0, 60.0),), rate_hz=5, duration_s=10, size_bytes=100_000)
        return {"free": suites.Setting(uplink, "free"), "tight": suites.Setting(uplink, "tight", max_bytes=250_000)}

    tight = suites.Suite("tight-v1", "tight", build, (2, 9), 1, kind="stress")
    monkeypatch.setitem(suites.SUITES, "tight-v1", tight)
    rows = run_sweep(Sweep("tight-v1", ("afr", "drop-oldest", "min-gap")), tmp_path / "run", jobs=1, progress=False)
    h = {(row["scenario"], row["capacity"]): row["qoi"] for row in rows if row["policy"] == "min-gap"}
    best = {(row["scenario"], row["capacity"]): row["clairvoyant"] for row in rows}
    for truth in (h, best):
        assert truth["tight", 2] == truth["tight", 9] == truth["free", 2] < truth["free", 9]
    assert all(row["certified"] for row in rows)
    printed = report.plain(tmp_path / "run")
    assert "worst cell" in printed.splitlines()[0] and "is worst in " in printed
    assert "is worst in " in report.markdown(tmp_path / "run")
