"""The summary that tasks share, the task of stress, by hand; the leaderboard and its rows."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_cases import fails, shown
from refusal_cases import refuse
from sweep_cases import exactly
from test_score import TWO_CELLS, noisy, rows_of, standing_of, width

from bufgym.benchmark import bootstrap, leaderboard, report
from bufgym.benchmark.episodes import Numbers
from bufgym.benchmark.leaderboard import Entry, entries
from bufgym.benchmark.report import tables
from bufgym.benchmark.score import scores
from bufgym.benchmark.summary import Quantity, Run, Summary, summarise, table_of
from bufgym.benchmark.sweep import Sweep, run_sweep
from bufgym.benchmark.table import score
from bufgym.benchmark.tasks import TASKS
from bufgym.benchmark.tasks.stress import ratios
from bufgym.jit import fingerprint as fingerprints
from bufgym.policies import target_gap
from bufgym.scenario import Uplink, suites
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError

QUANTITIES = (
    Quantity("mean", "mean", score, "of H", interval=False),
    Quantity("over", "H / base's", score, "sum over sum", versus="base"),
    Quantity("seen", "episodes", "{:g}".format, "how many", interval=False, total=True),
)


def statistics(ours: Numbers, theirs: Numbers, weights: Numbers) -> dict[str, Numbers]:
    h, base = weights @ ours[:, 0], weights @ theirs[:, 0]
    return {"mean": h / len(ours), "over": h / base, "seen": weights.sum(axis=1)}


def runs(policies: Mapping[str, list[float]], scenario: str = "s", capacity: int = 4) -> dict[Run, list[float]]:
    return {(scenario, capacity, name, "t", k): [h] for name, hs in policies.items() for k, h in enumerate(hs)}


def summary(numbers: Mapping[Run, list[float]], **options: Any) -> Summary:
    return summarise(numbers, statistics, QUANTITIES, rank_by="over", baseline="base", **options)


NOISY = runs({"base": [10, 100, 50, 20], "mine": [11, 108, 57, 23]})
"""Episodes differ tenfold, the two policies in any of them by 8 to 15 %."""


def test_intervals_are_paired_and_repeatable() -> None:
    found = summary(NOISY)
    over = found.standings["mine"]["over"]
    assert over.value == pytest.approx(199 / 180)
    assert 1 < over.low < over.value < over.high < 1.2
    assert summary(dict(reversed(NOISY.items()))).overall == found.overall


def test_over_all_cells_it_is_the_mean_of_theirs_or_their_sum() -> None:
    other = runs({"base": [1, 1], "mine": [3, 3]}, "other", 9)
    found = summary({**runs({"base": [2, 2, 2], "mine": [1, 1, 1]}), **other})
    assert list(found.cells) == [("s", 4), ("other", 9)]  # as in the runs
    assert [standing.policy for standing in found.cells["s", 4]] == ["base", "mine"]
    mine = found.standings["mine"]
    assert mine["over"] == exactly((0.5 + 3) / 2) and mine["seen"] == exactly(5)


def test_one_episode_has_no_interval() -> None:
    found = summary(runs({"base": [2], "mine": [3]}))
    value, low, high = found.standings["mine"]["over"]
    assert value == 1.5 and math.isnan(low) and math.isnan(high)
    assert table_of(found).plain().splitlines()[3].split() == ["mine", "3.000", "1.500", "[–]", "1"]


def test_unranked_policies_come_last() -> None:
    numbers = runs({"base": [1, 1], "endless": [9, 9]})
    assert [standing.policy for standing in summary(numbers).overall] == ["endless", "base"]
    found = summary(numbers, unranked={"endless": "its queue is unbounded"}).overall
    assert [(standing.policy, standing.ranked) for standing in found] == [("base", True), ("endless", False)]


def test_runs_that_cannot_be_summed_up() -> None:
    with pytest.raises(BufgymError, match="mine at s, L = 4, trace t, seed 1: no row; every policy must meet"):
        summary(runs({"base": [1, 2], "mine": [1]}))


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
    assert [(entry.rank, entry.policy) for entry in listed] == [(1, "drop-oldest"), (2, "mine"), (3, "afr")]
    assert set(listed[0].values) == {"worst", "ratio", "regret"}


def test_a_byte_limit_of_a_setting_holds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """B = 2 messages: L = 2 and L = 9 are the same episode, and without the limit they are not."""

    def build(split: str, data: Path | None) -> dict[str, suites.Setting]:
        uplink = Uplink((Trace.constant(100_000.0, 60.0),), rate_hz=5, duration_s=10, size_bytes=100_000)
        return {"free": suites.Setting(uplink, "free"), "tight": suites.Setting(uplink, "tight", max_bytes=250_000)}

    monkeypatch.setitem(suites.SUITES, "tight-v1", suites.Suite("tight-v1", "tight", build, (2, 9), 1, kind="stress"))
    rows = run_sweep(Sweep("tight-v1", ("afr", "drop-oldest", "min-gap")), tmp_path / "run", jobs=1, progress=False)
    h = {(row["scenario"], row["capacity"]): row["qoi"] for row in rows if row["policy"] == "min-gap"}
    best = {(row["scenario"], row["capacity"]): row["clairvoyant"] for row in rows}
    for truth in (h, best):
        assert truth["tight", 2] == truth["tight", 9] == truth["free", 2] < truth["free", 9]
    assert all(row["certified"] for row in rows)
    printed = tables.plain(*report.run_of(tmp_path / "run", ""))
    assert "worst cell" in printed.splitlines()[0] and "is worst in " in printed
    assert "is worst in " in report.markdown(tmp_path / "run")


REPO = Path(__file__).resolve().parents[2]


def made(path: Path) -> list[Entry]:
    return leaderboard.make(path, {"small-v1": ["afr", "min-gap", "clairvoyant", "rosbridge"]}, jobs=1)


def test_a_file_says_who_is_first_and_how_to_see_it_again(small: Sweep, tmp_path: Path) -> None:
    by_name = {entry.policy: entry for entry in made(tmp_path / "board.csv")}
    ranks = {"min-gap": 1, "afr": 2, "drop-oldest": 3, "clairvoyant": 0, "rosbridge": 0}
    assert {name: entry.rank for name, entry in by_name.items()} == ranks
    score = {name: entry.values["score"].value for name, entry in by_name.items()}
    assert score["drop-oldest"] == 0 and score["clairvoyant"] == 1 and math.isnan(score["rosbridge"])
    assert by_name["afr"].command == "bufgym bench --suite small-v1 --policies afr"
    again = leaderboard.read(tmp_path / "board.csv")
    assert list(again) == [entry.name for entry in by_name.values()] and again["small-v1/afr"] == by_name["afr"]
    text = (tmp_path / "board.md").read_text()
    assert "## small-v1" in text and "| 1 | min-gap |" in text and "small-v1 --policies POLICY`" in text


def test_a_row_is_run_again(small: Sweep, tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "board.csv"
    made(path)
    assert "small-v1/afr: holds" in shown(["validate", "small-v1/afr", "--file", path, "--jobs", 1], capsys)
    entry = leaderboard.find(path, "small-v1/afr")
    again = leaderboard.validate(entry, jobs=1)
    assert replace(again, rank=entry.rank) == entry  # the very same numbers, in smaller company


def test_a_row_whose_policy_changed_is_stale(monkeypatch: pytest.MonkeyPatch) -> None:
    """A constant that target-gap reads is planted: its row is named, in each suite; AFR's, which reads none, is not."""
    known = {
        f"{suite}/{policy}": Entry(suite, policy, 1, 1, {}, "0", leaderboard.made_of(policy))
        for suite, policy in (("lte-v1", "target-gap"), ("outage-v1", "target-gap"), ("lte-v1", "afr"))
    }
    known["lte-v1/old"] = Entry("lte-v1", "min-gap", 1, 1, {}, "0")  # it does not say
    assert leaderboard.stale(known) == []
    fingerprints._of_one.cache_clear()
    monkeypatch.setattr(target_gap, "SHORT_QUEUE", target_gap.SHORT_QUEUE + 1)
    assert leaderboard.stale(known) == ["lte-v1/target-gap", "outage-v1/target-gap"]
    fingerprints._of_one.cache_clear()


def test_a_page_whose_statistics_changed_is_stale(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another constant of theirs is planted: the page that was stamped before is named, and stamped anew it is not."""
    table = "| afr | 0.346 [0.301, 0.391] |\n"
    pages = {Path("made.md"): leaderboard.stamped(table), Path("old.md"): table, Path("words.md"): "See [0] and [1].\n"}
    now = leaderboard.statistics()
    assert [leaderboard.statistics_of(text) for text in pages.values()] == [now, leaderboard.UNKNOWN, None]
    assert pages[Path("made.md")] == f"{table}\n<!-- statistics {now} -->\n"
    assert leaderboard.stale_pages(pages) == []
    fingerprints._of_one.cache_clear()
    monkeypatch.setattr(bootstrap, "ROUNDING", 1e-9)
    assert leaderboard.statistics() != now and leaderboard.stale_pages(pages) == [Path("made.md")]
    again = leaderboard.stamped(pages[Path("made.md")])
    assert again.count("<!--") == 1 and leaderboard.stale_pages({Path("made.md"): again}) == []
    fingerprints._of_one.cache_clear()


def test_bad_files_and_rows_are_named(tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    path, board = tmp_path / "board.csv", REPO / "results" / "leaderboard.csv"
    leaderboard.write([], path)
    fails(["validate", "lte-v1/nobody", "--file", board], "no row 'lte-v1/nobody'", capsys)
    monkeypatch.chdir(tmp_path)
    fails(["validate", "lte-v1/afr"], "results/leaderboard.csv is that of bufgym's repository", capsys)
    fails(["leaderboard", "no-suite", "--file", path], "no-suite", capsys)
    refuse(r"written to a \.csv file", leaderboard.write, [], tmp_path / "board.txt")


@pytest.mark.nightly
def test_a_published_row_holds() -> None:
    entry = leaderboard.find(REPO / "results" / "leaderboard.csv", "sustained-v1/min-motion-gap")
    assert leaderboard.validate(entry, jobs=1).values["score"] == pytest.approx(entry.values["score"], abs=1e-12)


def test_share_of_afrs_regret_and_its_paired_difference_by_hand() -> None:
    """Regrets at L = 4 and L = 2: afr 4/38 and 8/20, mine 3/38 and 6/20, drop-oldest 8/38 and 10/20."""
    made = scores(TWO_CELLS, against="mine")
    afr, mine, oldest = (a / 38 + b / 20 for a, b in ((4, 8), (3, 6), (8, 10)))
    assert standing_of(made, "mine")["share"].value == pytest.approx(mine / afr) == pytest.approx(0.75)
    assert standing_of(made, "drop-oldest")["share"].value == pytest.approx(oldest / afr)
    assert standing_of(made, "afr")["share"] == (1, 1, 1) and standing_of(made, "mine")["against"] == (0, 0, 0)
    less = standing_of(made, "drop-oldest")["against"]
    assert less.value == pytest.approx((oldest - mine) / afr) and less.low <= less.value <= less.high
    plain = scores(TWO_CELLS)
    assert "against" not in standing_of(plain, "mine").values and plain.cells == made.cells
    refuse("no row of min-gap, with which the others are to be compared", scores, TWO_CELLS, against="min-gap")


def test_a_difference_is_paired() -> None:
    """What is common to two policies moves both shares and not their difference."""
    cell = noisy(60)
    h = cell["h"]
    h |= {"mine": h["afr"] + 0.2, "other": h["afr"] + 0.25}
    mine = standing_of(scores(rows_of(**cell), against="other"), "mine")
    assert mine["against"].low > 0 and width(mine["against"]) < 0.5 * width(mine["share"])
    alone = scores(rows_of(h={"drop-oldest": h["drop-oldest"], "mine": h["mine"]}, best=cell["best"]))
    assert np.isnan(standing_of(alone, "mine")["share"]).all()
