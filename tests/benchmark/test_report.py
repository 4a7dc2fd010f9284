"""The report: what stands on the page and in the tables, folders that are refused, and the page in a real browser."""

import dataclasses
import json
import math
import os
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from browser_cases import opened
from cli_cases import Patch
from needs import needs
from report_cases import MANIFEST, QOI, TIMELINE, make

from bufgym.benchmark import folder as inputs
from bufgym.benchmark import report
from bufgym.benchmark.report import tables, timeline
from bufgym.benchmark.sweep import Sweep, run_sweep
from bufgym.scenario import FleetScenario, suites
from bufgym.utils.errors import BufgymError

pytest.importorskip("jinja2", reason=needs("extras", "jinja2"))
pytest.importorskip("matplotlib", reason=needs("extras", "matplotlib"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make(tmp_path / "run")


def drawn(page: str) -> list[str]:
    """The charts of a page."""
    return re.findall(r'<figure data-chart="(\w+)">', page)


def test_the_ranking_in_markdown(folder: Path) -> None:
    """All episodes are alike, so every interval is a point. (95 - 80) / (100 - 80) = 0.75, and so on."""
    lines = report.markdown(folder).splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("| # | policy | score | IQM | regret"))
    values = [[cell.partition(" [")[0] for cell in line.strip("| ").split(" | ")] for line in lines[at + 2 : at + 7]]
    # Score, interquartile mean, regret in %, regret / AFR's, how often better than AFR, the regret's difference.
    assert values == [
        ["1", "&lt;b&gt;", "0.750", "0.750", "5.00 %", "0.500", "1.000", "−0.500"],
        ["2", "afr", "0.500", "0.500", "10.0 %", "–", "–", "–"],
        ["3", "drop-oldest", "0.000", "0.000", "20.0 %", "2.000", "0.000", "+1.000"],
        ["4", "random", "−1.000", "−1.000", "40.0 %", "4.000", "0.000", "+3.000"],
        ["–", "clairvoyant (it knows the future)", "1.000", "1.000", "0.000 %", "0.000", "1.000", "−1.000"],
    ]
    # By default the others are compared with the best rule: a policy that is not registered is none.
    assert "minus random's" in tables.plain(*report.run_of(folder, "random"))
    assert "minus" not in tables.plain(*report.run_of(folder, ""))
    assert "minus afr&#39;s" in report.write(folder).read_text(encoding="utf-8")


def test_cells_are_marked_where_they_are_not_discriminative_or_the_bound_is_not_exact(folder: Path) -> None:
    text = report.markdown(folder)
    cells = {"short": "L = 2 | L = 4", "long": "L = 2† | L = 4†", "good": "L = 2\\* | L = 4\\*"}  # as in the manifest
    found = [text.index(f"Score, {name}:\n\n| policy | {marked} |") for name, marked in cells.items()]
    assert found == sorted(found)
    rows = [dict(row, certified=True) for row in inputs.read(folder).rows if row["scenario"] == "short"]
    text = report.markdown(make(folder.with_name("short"), rows=rows))
    assert "†" not in text and "\\*" not in text and "good" not in text


def test_the_page_says_what_was_run_and_how_to_run_it_again(folder: Path) -> None:
    path = report.write(folder)
    assert path == folder / "report.html"
    page = path.read_text(encoding="utf-8")
    texts = ["Two outages and a good link.", "2026-05-01", "bench --suite tiny-v1 --out &lt;here&gt;", "Out for 20 s."]
    assert not [words for words in [*texts, "not ranked: it knows the future"] if words not in page]
    assert page.count(' flat"') == 2 * len(QOI)  # both capacities of the good link
    assert drawn(page) == ["ranking", "capacities", "outages", "delays", "timeline"]
    assert report.write(folder).read_text(encoding="utf-8") == page and len(page) < 8e6


def test_names_are_shown_as_they_are_written(folder: Path) -> None:
    """No name becomes an element of the page or of a chart."""
    page = report.write(folder).read_text(encoding="utf-8")
    assert "<b></b>" not in page and "</span><b>" not in page
    lanes = page[page.index('<figure data-chart="timeline">') :]
    assert "<b>" not in lanes and "&lt;b&gt;</text>" in lanes


@pytest.mark.parametrize(
    ("suite", "changes", "heading"),
    [
        ("topics-v1", {"consumers": 2}, '<th scope="col">QoI / robofleet</th>'),
        ("fleet-v1", {"robots": 2}, '<th scope="col">gain over afr</th>'),
    ],
)
def test_topics_and_fleets_have_a_page_too(
    suite: str, changes: dict[str, int], heading: str, tmp_path: Path, monkeypatch: Patch
) -> None:
    settings = suites.get(suite).settings("validation")
    short = {k: dataclasses.replace(setting, scenario=shortened(setting.scenario)) for k, setting in settings.items()}
    monkeypatch.setitem(suites.SUITES, suite, dataclasses.replace(suites.get(suite), build=lambda *_: short))
    sweep = Sweep(suite, ("drop-oldest", "rosbridge"), "validation", (3, 6), seeds=2, changes=changes)
    run_sweep(sweep, tmp_path, jobs=1, command="the command", form="csv")
    page = report.write(tmp_path).read_text(encoding="utf-8")
    assert page.count(heading) == 1 + 2 * len(short)
    assert f"{next(iter(changes))} = 2" in page and "not ranked: its queue is unbounded" in page
    assert "ranking" in drawn(page) and "discriminative" not in page
    assert report.markdown(tmp_path).count("\n| # | policy |") == 1 + 2 * len(short)
    assert f"Suite {suite}, validation: " in tables.plain(*report.run_of(tmp_path))


def shortened(scenario: Any) -> Any:
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


def refusal(folder: Path) -> str:
    with pytest.raises(BufgymError) as caught:
        report.write(folder)
    assert not (folder / "report.html").exists()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_page_needs_an_extra_and_the_tables_do_not(folder: Path, monkeypatch: Patch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    assert "bufgym[report]" in refusal(folder)
    assert "afr" in report.markdown(folder)


def test_a_folder_must_hold_a_run(tmp_path: Path) -> None:
    assert "must be a folder" in refusal(tmp_path / "absent")
    assert "no manifest.json" in refusal(tmp_path)
    folder = make(tmp_path / "run")
    (folder / "rows.csv").unlink()
    assert "no rows.parquet and no rows.csv" in refusal(folder)
    (folder / "parts").mkdir()
    assert f"not finished; the command that began it resumes it: {MANIFEST['command']}" in refusal(folder)


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("manifest", '{"format": 2,\n', "manifest.json, line 2: must be JSON"),
        ("manifest", "[]", "manifest.json: must be a JSON object"),
        ("manifest", '{"format": 1}', "manifest.json: format = 1: must be 2"),
        ("manifest", {"scenarios": {"a": 1}}, "manifest.json: scenarios.a must be an object"),
        ("manifest", {"task": "chess"}, "manifest.json: task = chess: must be one of queue, stress, topics, fleet"),
        ("manifest", json.dumps(MANIFEST).replace('"command"', '"commands"'), "manifest.json: no command"),
        ("timeline", {"x": [0.0]}, "arrival_s and x must have one entry a message"),
        ("timeline", {"x": [0.0, 1.0, 2.0, 3.0, 4.0, math.nan]}, "NaN: numbers must be finite"),
        ("timeline", {"rate": {"t_s": [0.0], "bytes_per_s": []}}, "must be of one length"),
        ("timeline", {"policies": {"afr": {"qoi": 1.0, "received": [[6, 0, 0]], "dropped": []}}}, "a message 0..5"),
        ("timeline", {"policies": {"afr": {"received": [], "dropped": []}}}, "timeline.json: no policies.afr.qoi"),
    ],
)
def test_broken_json_is_refused(folder: Path, name: str, text: str | dict[str, Any], complaint: str) -> None:
    whole = {"manifest": MANIFEST, "timeline": TIMELINE}[name]
    text = text if isinstance(text, str) else json.dumps(whole | text)
    (folder / f"{name}.json").write_text(text, encoding="utf-8")
    found = refusal(folder)
    assert complaint in found and f"{name}.json" in found


@pytest.mark.parametrize("name", ["manifest.json", "rows.csv", "timeline.json"])
@pytest.mark.parametrize("data", ["fifo", b"\xff", b"[" * 100_000, b"{}", b'{"format": 2}', b"1e999", b"9" * 5000])
def test_files_that_are_none_are_refused(folder: Path, name: str, data: str | bytes) -> None:
    (folder / name).unlink()
    os.mkfifo(folder / name) if isinstance(data, str) else (folder / name).write_bytes(data)
    assert (f"{name}: must be a regular file" if data == "fifo" else str(folder)) in refusal(folder)


def test_broken_rows_are_refused(tmp_path: Path) -> None:
    rows = inputs.read(make(tmp_path / "a")).rows
    without = [{name: cell for name, cell in row.items() if name != "qoi"} for row in rows]
    assert "rows.csv: no column 'qoi'" in refusal(make(tmp_path / "b", rows=without))
    unmet = [row for row in rows if (row["policy"], row["seed"]) != ("afr", 1)]
    assert "rows.csv: afr at " in refusal(make(tmp_path / "c", rows=unmet))
    no_baseline = [row for row in rows if row["policy"] != "drop-oldest"]
    assert "rows.csv: " in (found := refusal(make(tmp_path / "d", rows=no_baseline))) and "baseline" in found


@pytest.mark.nightly
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_browser_draws_every_chart_without_network_or_complaint(folder: Path, scheme: str) -> None:
    """The charts follow the colour scheme of the page."""
    sizes = "[...document.querySelectorAll('figure svg')].map((it) => it.getBoundingClientRect().width)"
    with opened(report.write(folder), scheme, 1000) as page:
        page.evaluate("document.querySelectorAll('details').forEach((it) => { it.open = true; })")
        widths = page.evaluate(sizes)
        ink = page.evaluate("getComputedStyle(document.querySelector('#ranking svg text')).fill")
    assert len(widths) >= 9 and min(widths) > 600
    assert ink == ("rgb(27, 31, 36)" if scheme == "light" else "rgb(230, 233, 237)")
