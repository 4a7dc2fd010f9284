"""The leaderboard: what a row says, that it can be made again, and that a row which no longer holds is found out."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cli_cases import fails, shown

from bufgym import policies
from bufgym.benchmark import leaderboard
from bufgym.benchmark.bootstrap import Interval
from bufgym.benchmark.leaderboard import Entry
from bufgym.errors import BufgymError
from bufgym.scenario import Interruption, suites
from bufgym.scenario.suites import Setting, Suite

REPO = Path(__file__).resolve().parents[2]

TINY = Suite(
    "tiny-v1",
    "a few interruptions",
    lambda split, data: {"all": Setting(Interruption(t_max=60), "T up to 60")},
    capacities=(4, 8),
    seeds=6,
)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(suites.SUITES, "tiny-v1", TINY)


def made(path: Path) -> list[Entry]:
    return leaderboard.make(path, ["tiny-v1"], {"tiny-v1": ["afr", "min-gap", "clairvoyant", "rosbridge"]}, jobs=1)


def test_a_file_says_who_is_first_and_how_to_see_it_again(tiny: None, tmp_path: Path) -> None:
    by_name = {entry.policy: entry for entry in made(tmp_path / "board.csv")}
    ranks = {"min-gap": 1, "afr": 2, "drop-oldest": 3, "clairvoyant": 0, "rosbridge": 0}
    assert {name: entry.rank for name, entry in by_name.items()} == ranks
    score = {name: entry.values["score"].value for name, entry in by_name.items()}
    assert score["drop-oldest"] == 0 and score["clairvoyant"] == 1 and math.isnan(score["rosbridge"])
    assert by_name["afr"].command == "bufgym bench --suite tiny-v1 --policies afr"
    again = leaderboard.read(tmp_path / "board.csv")
    assert list(again) == [entry.name for entry in by_name.values()] and again["tiny-v1/afr"] == by_name["afr"]
    text = (tmp_path / "board.md").read_text()
    assert "## tiny-v1" in text and "| 1 | min-gap |" in text and f"`{by_name['afr'].command}`" in text


def test_a_row_is_run_again_and_one_that_has_changed_is_refused(tiny: None, tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "board.csv"
    made(path)
    assert "tiny-v1/afr: holds" in shown(["validate", "tiny-v1/afr", "--file", path, "--jobs", 1], capsys)
    entry = leaderboard.find(path, "tiny-v1/afr")
    again = leaderboard.validate(entry, jobs=1)
    assert replace(again, rank=entry.rank) == entry  # the very same numbers, in smaller company
    better = replace(entry, values={"score": Interval(*(number + 0.2 for number in entry.values["score"]))})
    with pytest.raises(BufgymError, match=r"tiny-v1/afr: score is .* but the file states 1\.1"):
        leaderboard.validate(better, jobs=1)


def test_bad_files_and_rows_are_named(tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    path, board = tmp_path / "board.csv", REPO / "docs" / "leaderboard.csv"
    leaderboard.write([], path)
    with path.open("a") as file:
        file.write("lte-v1,p,1,1,score,many,1,1,0.1.0,c\n")
    with pytest.raises(BufgymError, match=r"board\.csv.*many.*must be a number"):
        leaderboard.read(path)
    fails(["validate", "lte-v1/nobody", "--file", board], "no row 'lte-v1/nobody'", capsys)
    monkeypatch.chdir(tmp_path)
    fails(["validate", "lte-v1/afr"], "docs/leaderboard.csv is that of bufgym's repository", capsys)
    fails(["leaderboard", "no-suite", "--file", path], "no-suite", capsys)
    with pytest.raises(BufgymError, match=r"written to a \.csv file"):
        leaderboard.write([], tmp_path / "board.txt")


def test_the_published_rows_are_of_known_suites_and_policies() -> None:
    entries = leaderboard.read(REPO / "docs" / "leaderboard.csv")
    for entry in entries.values():
        assert entry.suite in suites.SUITES
        assert policies.get(entry.policy).name == entry.policy
        assert set(entry.values) == set(leaderboard.task_of(entry.suite).listed)
    assert {suites.get(entry.suite).kind for entry in entries.values()} == {"queue", "topics", "fleet"}


@pytest.mark.nightly
def test_a_published_row_holds() -> None:
    entry = leaderboard.find(REPO / "docs" / "leaderboard.csv", "sustained-v1/min-motion-gap")
    assert leaderboard.validate(entry, jobs=1).values["score"] == pytest.approx(entry.values["score"], abs=1e-12)
