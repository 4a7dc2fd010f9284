"""Fig. 6 to 8 of the AFR paper: facts of the recorded link, the policies' order, and small runs without recordings."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bufgym.benchmark.run import draw
from bufgym.cli import main
from bufgym.errors import BufgymError
from bufgym.reproduce import NEEDS_DATA, afr_fig6, afr_fig7_qoi, afr_fig8_gap, run
from bufgym.reproduce import afr_evaluation as common
from bufgym.reproduce.report import Report
from bufgym.scenario.suites import motion_value
from bufgym.traces import Motion, Trace, write_csv

SHIPPED: dict[str, Any] = {"trace": "lte-synthetic-0", "motion": ["drive-0"], "frames": 60, "capacities": (3,)}
"""A small run that needs no folder of recordings."""


def columns(report: Report) -> list[dict[str, Any]]:
    return [dict(zip(report.header, row, strict=True)) for row in report.rows]


def mean(rows: list[dict[str, Any]], name: str, **wanted: Any) -> float:
    return float(np.mean([float(r[name]) for r in rows if all(r[k] == v for k, v in wanted.items())]))


# -------------------- the setup


def test_the_second_link_has_the_papers_ceiling_within_the_stream() -> None:
    """60 frames last 2 s: the best of the first two seconds, 3 MB/s, becomes 15; the 6 MB/s later do not count."""
    link = Trace.steps([(1, 3e6), (1, 1e6), (1, 6e6)])
    camera = Motion("turn", np.array([0, 10_000_000]), np.array([0.0, 10.0]))
    made = common.settings(
        link, [camera], timed=True, frames=60, size_bytes=200_000, size_cv=0.0, ceiling_bytes_per_s=15e6
    )
    assert [(s.link, s.camera, s.scale) for s in made] == [
        ("as recorded", "turn", 1.0),
        ("as recorded", "time", 1.0),
        ("x 5.00", "turn", 5.0),
        ("x 5.00", "time", 5.0),
    ]
    assert made[0].uplink.value == motion_value() and made[0].uplink.max_messages == 60
    # 2 MB/s on average of 30 x 200 kB
    assert common.share_carried(link, 60, 200_000) == pytest.approx(1 / 3)
    assert common.share_carried(link, 60, 200_000, 5.0) == pytest.approx(5 / 3)


def test_runs_begin_at_the_start_of_the_link_and_anywhere_on_the_camera() -> None:
    link = common.load_link("lte-synthetic-0", None)
    (setting,) = common.settings(
        link,
        [common.load_camera("drive-0", None)],
        timed=False,
        frames=60,
        size_bytes=200_000,
        size_cv=0.0,
        ceiling_bytes_per_s=None,
    )
    episodes = [draw(setting.uplink, seed) for seed in range(3)]
    assert all(e.link.offset_us == 0 for e in episodes)
    assert len({float(e.arrivals["x"][-1]) for e in episodes}) == 3
    rows = common.runs_of(setting, [3], 3, bound=False)
    assert len(rows) == 3 * len(common.STYLES)
    for row in rows:
        x = episodes[row["seed"]].arrivals["x"]
        every = 1 + sum(1 - np.exp(-gap) for gap in np.diff(x))
        assert row["all_frames"] == pytest.approx(every, rel=1e-12)
        assert row["loss"] == pytest.approx(1 - row["qoi"] / every, abs=1e-12)


# -------------------- Fig. 6


def test_fig6_names_the_seconds_under_500_KB_per_s(tmp_path: Path) -> None:
    path = tmp_path / "dips.csv"
    write_csv(Trace.steps([(1, 9e6), (1, 0.4e6), (1, 9e6), (1, 0.5e6), (1, 0.1e6)], name="dips"), path)
    # 90 frames: seconds 0, 1, 2. 500 KB/s itself is not under 500 KB/s.
    report = afr_fig6.report(trace=str(path), frames=90, size_bytes=200_000)
    assert [r["second"] for r in columns(report) if r["under_500KBps"]] == [1, 4]
    assert [r["second"] for r in columns(report) if r["streamed"]] == [0, 1, 2]
    assert "21 and 23  1: DIFFERS" in report.text
    assert "Second 1: 400.0 KB/s, from 1.00 to 2.00 s of the trace." in report.text
    assert "1 of 3" in report.text  # seconds under the demand of 6 MB/s
    assert "lasting overload" not in report.text


def test_fig6_of_the_recorded_link(shared_data: Path) -> None:
    report = afr_fig6.report(shared_data)
    rows = columns(report)
    streamed = [r for r in rows if r["streamed"]]
    assert len(streamed) == 27  # 794 / 30 = 26.47 s
    assert [r["second"] for r in streamed if r["under_500KBps"]] == [21, 23]
    assert float(rows[21]["bytes_per_s"]) == pytest.approx(490_672 / 1.001)
    assert float(rows[23]["bytes_per_s"]) == pytest.approx(222_104 / 0.999)
    assert max(float(r["bytes_per_s"]) for r in streamed) == pytest.approx(4.03e6, rel=1e-3)
    assert "21, 23: as there" in report.text
    assert "4.03 (7.75 in all 566 s): DIFFERS" in report.text
    assert "27 of 27" in report.text and "lasting overload" in report.text


# -------------------- Fig. 7


def test_fig7_counts_regret_against_the_best_and_loss_against_all_frames() -> None:
    report = afr_fig7_qoi.report(**SHIPPED, size_bytes=500_000, runs=2)
    rows = columns(report)
    assert len(rows) == 2 * 2 * len(common.STYLES) * 2  # links, cameras and time, policies, runs
    for row in rows:
        ours, best, every = (float(row[name]) for name in ("H", "H_clairvoyant", "H_all_frames"))
        assert ours <= best * (1 + 1e-12) and best <= every * (1 + 1e-12)
        assert float(row["regret"]) == pytest.approx(1 - ours / best)
        assert float(row["loss"]) == pytest.approx(1 - ours / every)
    assert max(float(row["loss"]) for row in rows) > 0.01
    assert report.text == afr_fig7_qoi.report(**SHIPPED, size_bytes=500_000, runs=2).text


@pytest.mark.slow
def test_fig7_on_a_slow_but_steady_link_random_is_behind_drop_oldest(tmp_path: Path) -> None:
    """Drop Oldest then sends every third frame by itself; Random sends uneven ones. Said in the report."""
    path = tmp_path / "steady.csv"
    write_csv(Trace.constant(2e6, 30.0, name="steady"), path)
    options = SHIPPED | {"trace": str(path), "frames": 300, "capacities": (5, 20)}
    rows = columns(afr_fig7_qoi.report(**options, size_bytes=200_000, runs=3, ceiling_bytes_per_s=None))
    oldest, random = (mean(rows, "loss", camera="time", policy=p) for p in ("drop-oldest", "random"))
    assert oldest < 0.9 * random


@pytest.mark.slow
def test_fig7_over_the_recorded_link(shared_data: Path) -> None:
    report = afr_fig7_qoi.report(shared_data)
    rows = columns(report)
    for scale in {r["link_scale"] for r in rows}:
        for camera in (*common.CAMERAS, "time"):
            afr, oldest, random = (
                mean(rows, "regret", link_scale=scale, camera=camera, policy=p)
                for p in ("afr", "drop-oldest", "random")
            )
            # The paper's order; by far more than the runs differ.
            assert afr < 0.7 * oldest and afr < 0.6 * random, (scale, camera)
    recorded = {"link_scale": "1.0", "camera": "freiburg1_desk"}
    # Where ours differ from the paper: ORBBuf knows the true motion, Random trails Drop Oldest under overload.
    assert mean(rows, "regret", **recorded, policy="orbbuf") < mean(rows, "regret", **recorded, policy="afr")
    assert mean(rows, "regret", **recorded, policy="random") > 1.3 * mean(
        rows, "regret", **recorded, policy="drop-oldest"
    )
    assert "DIFFERS" in report.text


# -------------------- Fig. 8


def test_fig8_counts_runs_whose_longest_gap_exceeds_the_threshold() -> None:
    report = afr_fig8_gap.report(
        **SHIPPED | {"frames": 150}, size_bytes=900_000, runs=2, more_runs=4, ceiling_bytes_per_s=None
    )
    rows = columns(report)
    assert len(rows) == len(common.STYLES) * 4
    gaps = sorted(float(r["longest_gap_views"]) for r in rows if r["policy"] == "drop-oldest")
    assert len(set(gaps)) == 4
    as_rows = [{"policy": r["policy"], "capacity": r["L"], "longest_gap": float(r["longest_gap_views"])} for r in rows]
    between = (gaps[1] + gaps[2]) / 2
    assert afr_fig8_gap.failures(as_rows, "drop-oldest", between) == 0.5
    assert afr_fig8_gap.failures(as_rows, "drop-oldest", gaps[-1]) == 0  # exceeds, not reaches
    assert afr_fig8_gap.failures(as_rows, "drop-oldest", gaps[0] - 1e-9, 3) == 1


@pytest.mark.slow
def test_fig8_over_the_recorded_link(shared_data: Path) -> None:
    report = afr_fig8_gap.report(shared_data, more_runs=40)
    gaps = [
        {"policy": r["policy"], "capacity": r["L"], "longest_gap": float(r["longest_gap_views"])}
        for r in columns(report)
        if r["link_scale"] == "1.0" and r["camera"] == "freiburg1_desk"
    ]
    rate = {p: afr_fig8_gap.failures(gaps, p, 0.5) for p in common.STYLES}
    assert rate["afr"] < 0.1 and rate["min-motion-gap"] < 0.1
    assert rate["drop-oldest"] > 0.4 and rate["random"] > 0.4
    assert all(afr_fig8_gap.failures(gaps, "afr", 0.5, L) <= 0.05 for L in (15, 20, 25))
    # At L = 5 it does fail, which the paper's "under 10 %" does not say.
    assert afr_fig8_gap.failures(gaps, "afr", 0.5, 5) > 0


# -------------------- without recordings, and mistakes


@pytest.mark.parametrize("name", NEEDS_DATA)
def test_without_the_folder_the_message_says_what_it_needs(name: str, tmp_path: Path) -> None:
    with pytest.raises(BufgymError, match=r"\(--data DIR\) with belgium_4g/csv/report_car_0002.csv"):
        run(name)
    with pytest.raises(BufgymError, match=r"report_car_0002.csv: no such file"):
        run(name, data=tmp_path)


@pytest.mark.parametrize(
    ("report", "options", "match"),
    [
        (afr_fig6.report, {"trace": "lte-synthetic-0", "size_bytes": 0}, "size_bytes = 0"),
        (afr_fig6.report, {"trace": "lte-synthetic-0", "frames": 1}, "frames = 1"),
        (afr_fig7_qoi.report, SHIPPED | {"runs": 0}, "runs = 0"),
        (afr_fig7_qoi.report, SHIPPED | {"motion": "freiburg1_desk"}, "tum_rgbd/freiburg1_desk.groundtruth"),
        (afr_fig8_gap.report, SHIPPED | {"threshold": 0.0}, "threshold = 0"),
        (afr_fig8_gap.report, SHIPPED | {"runs": 5, "more_runs": 4}, "runs = 5, more_runs = 4"),
    ],
)
def test_mistakes_are_named(report: Any, options: dict[str, Any], match: str) -> None:
    with pytest.raises(BufgymError, match=match):
        report(**options)


def test_all_leaves_them_out_without_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from bufgym import reproduce

    monkeypatch.setattr(reproduce, "FIGURES", {"afr-fig6": "needs data"})
    assert main(["reproduce", "all", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("afr-fig6: left out; it needs a folder of recordings (--data DIR) with belgium_4g/csv/")
    assert main(["reproduce", "afr-fig6", "--out", str(tmp_path)]) == 2
    assert "(--data DIR)" in capsys.readouterr().err
    assert main(["reproduce", "all", "--data", str(tmp_path / "absent"), "--out", str(tmp_path)]) == 2
    assert "no such folder (--data)" in capsys.readouterr().err


def test_data_is_passed_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "data" / "belgium_4g" / "csv"
    folder.mkdir(parents=True)
    write_csv(Trace.steps([(1, 9e6), (40, 0.4e6)], name="report_car_0002"), folder / "report_car_0002.csv")
    assert main(["reproduce", "afr-fig6", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]) == 0
    assert "bandwidth of report_car_0002" in capsys.readouterr().out
    with (tmp_path / "out" / "afr-fig6.csv").open(newline="") as file:
        assert [row["under_500KBps"] for row in csv.DictReader(file)][:2] == ["False", "True"]
