"""The report: what stands on the page and in the tables."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
from report_cases import MANIFEST, QOI, TIMELINE, make

from bufgym.benchmark import folder as inputs
from bufgym.benchmark import report, table
from bufgym.benchmark.report import style, tables, timeline
from bufgym.benchmark.sweep import Sweep, run_sweep
from bufgym.scenario import FleetScenario, suites

pytest.importorskip("jinja2", reason="the report needs Jinja")
pytest.importorskip("plotly", reason="the report needs plotly")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make(tmp_path / "run")


def figures(page: str) -> dict[str, Any]:
    """The charts' numbers in a page."""
    found = re.search(r'<script type="application/json" id="figures">(.*?)</script>', page)
    assert found is not None
    made: dict[str, Any] = json.loads(found[1])
    return made


def test_the_ranking_in_markdown(folder: Path) -> None:
    """All episodes are alike, so every interval is a point. (95 - 80) / (100 - 80) = 0.75, and so on."""
    lines = report.markdown(folder).splitlines()
    assert lines[:3] == ["```", MANIFEST["command"], "```"]
    at = lines.index("| # | policy | score | IQM | regret, at most | better than afr |")
    zero, one = "0.000 [0.000, 0.000]", "1.000 [1.000, 1.000]"
    assert [line.strip("| ").split(" | ") for line in lines[at + 2 : at + 7]] == [
        ["1", "&lt;b&gt;", *["0.750 [0.750, 0.750]"] * 2, "5.00 % [5.00, 5.00]", one],
        ["2", "afr", *["0.500 [0.500, 0.500]"] * 2, "10.0 % [10.0, 10.0]", "–"],
        ["3", "drop-oldest", *[zero] * 2, "20.0 % [20.0, 20.0]", zero],
        ["4", "random", *["−1.000 [−1.000, −1.000]"] * 2, "40.0 % [40.0, 40.0]", zero],
        ["–", "clairvoyant (it knows the future)", *[one] * 2, "0.000 % [0.000, 0.000]", one],
    ]


def test_cells_are_marked_where_they_are_not_discriminative_or_the_bound_is_not_exact(folder: Path) -> None:
    text = report.markdown(folder)
    cells = {"short": "L = 2 | L = 4", "long": "L = 2† | L = 4†", "good": "L = 2\\* | L = 4\\*"}  # as in the manifest
    found = [text.index(f"Score, {name}:\n\n| policy | {marked} |") for name, marked in cells.items()]
    assert found == sorted(found)
    assert "Drop Oldest loses under 1 % there" in text and "upper bound" in text
    rows = [dict(row, certified=True) for row in inputs.read(folder).rows if row["scenario"] == "short"]
    text = report.markdown(make(folder.with_name("short"), rows=rows))
    assert "†" not in text and "\\*" not in text and "good" not in text


@pytest.mark.parametrize("certified", [False, True])
def test_regret_that_rests_on_an_upper_bound_says_so(folder: Path, certified: bool) -> None:
    rows = [dict(row, certified=row["certified"] or certified) for row in inputs.read(folder).rows]
    run = inputs.read(make(folder, rows=rows))
    plain = tables.plain(run, run.task.summary(run.rows, run.manifest["unranked"]))
    page = report.write(folder).read_text(encoding="utf-8")
    assert ("regret at most" in page) is not certified
    for text in (report.markdown(folder), plain, page):
        assert ("regret, at most" in text) is not certified


@pytest.mark.parametrize(
    ("share", "written"),
    [
        *((0.1234, "12.3 %"), (0.01234, "1.23 %"), (0.001234, "0.123 %"), (0.09999, "10.0 %"), (-0.05, "−5.00 %")),
        *((-1e-9, "0.000 %"), (math.nan, "–")),
    ],
)
def test_per_cent_has_three_digits(share: float, written: str) -> None:
    assert table.percent(share) == written


def test_the_page_says_what_was_run_and_how_to_run_it_again(folder: Path) -> None:
    path = report.write(folder)
    assert path == folder / "report.html"
    page = path.read_text(encoding="utf-8")
    told = ["Two outages and a good link.", "2026-05-01", "bench --suite tiny-v1 --out &lt;here&gt;", "Out for 20 s."]
    told += ['<html lang="en">', "<title>bufgym: tiny-v1, test</title>", "not ranked: it knows the future"]
    assert all(words in page for words in [*told, "Drop Oldest loses under 1 % there"])
    assert page.count(' flat"') == 2 * len(QOI)  # both capacities of the good link
    assert set(figures(page)) == {"ranking", "capacities", "outages", "delays", "timeline", "memory"}
    assert report.write(folder).read_text(encoding="utf-8") == page and len(page) < 8e6


def test_names_are_shown_as_they_are_written(folder: Path) -> None:
    """No name becomes an element of the page, of a chart's text, or the end of a script."""
    page = report.write(folder).read_text(encoding="utf-8")
    body = page[page.index("<body>") : page.index('<script type="application/json"')]
    assert "<b></b>" not in body and "</span><b>" not in body and "&lt;b&gt;" in body
    data = re.search(r'id="figures">(.*?)</script>', page)
    assert data is not None and "<" not in data[1]
    (lane,) = (trace for trace in figures(page)["timeline"][""][0]["data"] if trace["type"] == "heatmap")
    assert lane["y"] == ["&lt;b&gt;", "afr"]


def test_what_a_run_does_not_have_has_no_chart(tmp_path: Path) -> None:
    """One capacity, no outage of known length, no record of memory, no timeline."""
    kept = [row for row in inputs.read(make(tmp_path / "a")).rows if row["capacity"] == 2 and row["scenario"] == "good"]
    rows = [{name: cell for name, cell in row.items() if name != "peak_backlog_bytes"} for row in kept]
    folder = make(tmp_path / "b", rows=rows)
    (folder / "timeline.json").unlink()
    page = report.write(folder).read_text(encoding="utf-8")
    assert set(figures(page)) == {"delays"}  # and as the good link is not discriminative, no ranking
    assert "there is no score" in page


def test_without_a_clairvoyant_there_are_dashes(tmp_path: Path) -> None:
    rows = [dict(row, clairvoyant=None, regret=None) for row in inputs.read(make(tmp_path / "a")).rows]
    folder = make(tmp_path / "b", rows=rows)
    assert "| – | afr | – | – | – | – |" in report.markdown(folder)
    assert set(figures(report.write(folder).read_text(encoding="utf-8"))) == {"timeline", "memory"}


@pytest.mark.parametrize(
    ("suite", "changes", "heading"),
    [
        ("topics-v1", {"consumers": 2}, '<th scope="col">QoI / robofleet</th>'),
        ("fleet-v1", {"robots": 2}, '<th scope="col">gain over afr</th>'),
    ],
)
def test_topics_and_fleets_have_a_page_too(
    suite: str, changes: dict[str, int], heading: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the quantities that their task shows, over all cells and in each."""
    short = {
        label: dataclasses.replace(setting, scenario=shortened(setting.scenario))
        for label, setting in suites.get(suite).settings("validation").items()
    }
    monkeypatch.setitem(suites.SUITES, suite, dataclasses.replace(suites.get(suite), build=lambda *_: short))
    sweep = Sweep(suite, ("drop-oldest", "rosbridge"), "validation", (3, 6), seeds=2, changes=changes)
    run_sweep(sweep, tmp_path, jobs=1, command="the command", form="csv")
    page = report.write(tmp_path).read_text(encoding="utf-8")
    assert page.count(heading) == 1 + 2 * len(short)
    assert f"{next(iter(changes))} = 2" in page and "not ranked: its queue is unbounded" in page
    assert "ranking" in figures(page) and "discriminative" not in page
    assert report.markdown(tmp_path).count("\n| # | policy |") == 1 + 2 * len(short)
    assert f"Suite {suite}, validation: " in report.plain(tmp_path)


def shortened(scenario: Any) -> Any:
    """Two seconds on two of its traces."""
    if isinstance(scenario, FleetScenario):
        return dataclasses.replace(scenario, uplink=shortened(scenario.uplink))
    return dataclasses.replace(scenario, traces=scenario.traces[:2], duration_s=2.0)


def test_outcomes_and_the_longest_gap_by_hand() -> None:
    """0, 2 and 4 arrive: steps in x of 1.0 and 3.5. What was dropped between 2 and 4 lies in the longest gap."""
    lane = {"received": [[0, 0, 0], [2, 0, 0], [4, 0, 0]], "dropped": [[1, 2.0], [3, 3.0]]}
    gap = timeline.longest_gap(TIMELINE["x"], [0, 2, 4])
    assert gap == (2, 4)
    kept, dropped, in_gap, left = timeline.KEPT, timeline.DROPPED, timeline.IN_GAP, timeline.LEFT
    assert timeline.log(6, lane, gap) == [kept, dropped, kept, in_gap, kept, left]
    assert timeline.longest_gap(TIMELINE["x"], [3]) is None
    assert timeline.longest_gap([0, 1, 2], [0, 1, 2]) == (0, 1)  # the first of equals


def test_labels_are_moved_apart_no_further_than_needed() -> None:
    assert style.apart({"a": 0.0, "b": 100.0}, 10) == {"a": 0.0, "b": 100.0}
    assert style.apart({"a": 50.0, "b": 50.0}, 10) == {"a": 45.0, "b": 55.0}
    # b and c touch; moved apart they touch a: all three settle around their mean, 54.
    assert style.apart({"a": 50.0, "c": 56.0, "b": 56.0}, 10) == {"a": 44.0, "c": 54.0, "b": 64.0}
