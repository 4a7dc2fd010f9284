"""Fig. 6 of the AFR paper and the size of a frame: facts of the recorded link, and recordings that are missing."""

import csv
from pathlib import Path

import numpy as np
import pytest
from cli_cases import Capsys, Patch
from refusal_cases import refuse

from bufgym.cli import main
from bufgym.papers import NEEDS_DATA, figure, run
from bufgym.papers.afr_frame_size import full
from bufgym.sim import NEVER
from bufgym.traces import Trace, write_csv


def test_fig6_names_the_seconds_under_500_KB_per_s(tmp_path: Path) -> None:
    path = tmp_path / "dips.csv"
    write_csv(Trace.steps([(1, 9e6), (1, 0.4e6), (1, 9e6), (1, 0.5e6), (1, 0.1e6)], name="dips"), path)
    # 90 frames: seconds 0, 1, 2. 500 KB/s itself is not under 500 KB/s.
    fig6 = figure("afr-fig6", trace=str(path), frames=90, size_bytes=200_000)
    rows = fig6.simulate()
    assert rows.where(under_500KBps=True).distinct("second") == [1, 4]
    assert rows.where(streamed=True).distinct("second") == [0, 1, 2]
    facts = fig6.claims(rows)
    assert not facts["low-seconds"] and facts["low_seconds"] == "1"
    assert fig6.tables(rows) == ["Second 1: 400.0 KB/s, from 1.00 to 2.00 s of the trace."]
    assert (facts["under"], facts["seconds"], facts["overload"]) == (1, 3, False)  # under the demand of 6 MB/s
    assert facts["carried"] == pytest.approx(18.4 / 18)
    # Frames kept are counted by the second of their arrival.
    write_csv(Trace.constant(1e8, 30.0, name="wide"), path)
    rows = figure("afr-frame-size", trace=str(path), frames=750, capacities=(5,), runs=1, sweep_kb=(300,)).simulate()
    assert set(rows.column("dropped")) == {0}
    assert all(abs(row[f"kept_in_second_{s}"] - 30) <= 1 for row in rows for s in (21, 23))


def test_recordings_that_are_missing_are_named(tmp_path: Path) -> None:
    for name in NEEDS_DATA:
        refuse(r"\(--data DIR\) with belgium_4g/csv/report_car_0002.csv", run, name)
        refuse(r"report_car_0002.csv: no such file", run, name, data=tmp_path)


def test_all_leaves_them_out_without_data(tmp_path: Path, monkeypatch: Patch, capsys: Capsys) -> None:
    data, out = tmp_path / "data", str(tmp_path / "out")
    (data / "belgium_4g" / "csv").mkdir(parents=True)
    trace = Trace.steps([(1, 9e6), (40, 0.4e6)], name="report_car_0002")
    write_csv(trace, data / "belgium_4g" / "csv" / "report_car_0002.csv")
    monkeypatch.setattr("bufgym.papers.FIGURES", {"afr-fig6": "needs data"})
    for words, code, says in (
        (["all"], 0, "afr-fig6: left out; it needs a folder of recordings (--data DIR) with belgium_4g/csv/"),
        (["afr-fig6"], 2, "(--data DIR)"),
        (["all", "--data", str(tmp_path / "absent")], 2, "no such folder (--data)"),
        (["afr-fig6", "--data", str(data)], 0, "The link is report_car_0002"),
    ):
        assert main(["reproduce", *words, "--out", out]) == code
        assert says in "".join(capsys.readouterr())
    with (tmp_path / "out" / "afr-fig6.csv").open(newline="") as file:
        assert [row["under_500KBps"] for row in csv.DictReader(file)][:2] == ["False", "True"]


def test_the_share_of_the_time_in_which_a_queue_is_full() -> None:
    """L = 2: messages come at 0, 1 and 3 s, the second leaves at 1.5 s, the first is dropped at 2 s: two for .5 s."""
    kinds = [("dropped_us", np.int64), ("dequeued_us", np.int64)]
    log = np.array([(2_000_000, NEVER), (NEVER, 1_500_000), (NEVER, NEVER)], kinds)
    assert full(log, np.array([0.0, 1.0, 3.0]), 2) == pytest.approx(0.5 / 3)
