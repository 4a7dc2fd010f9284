"""The report: folders that are refused, and the page in a real browser."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import pytest
from browser_cases import opened
from report_cases import MANIFEST, TIMELINE, make

from bufgym.benchmark import folder as inputs
from bufgym.benchmark import report
from bufgym.errors import BufgymError

pytest.importorskip("jinja2", reason="the report needs Jinja")
pytest.importorskip("plotly", reason="the report needs plotly")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make(tmp_path / "run")


def refusal(folder: Path) -> str:
    with pytest.raises(BufgymError) as caught:
        report.write(folder)
    assert not (folder / "report.html").exists()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_page_needs_an_extra_and_the_tables_do_not(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly.graph_objects", None)
    assert "pip install jinja2 plotly" in refusal(folder)
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
    ("text", "complaint"),
    [
        ('{"format": 2,\n', ", line 2: must be JSON"),
        ("[]", ": must be a JSON object"),
        ('{"format": 1}', ": format = 1: must be 2"),
        ({"suite": 3}, ": suite = 3: must be text"),
        ({"scenarios": {"a": 1}}, ": scenarios.a must be an object"),
        ({"scenarios": {"a": {"outage_s": "x"}}}, ": scenarios.a.outage_s = x: must be a number"),
        ({"task": "chess"}, ": task = chess: must be one of queue, stress, topics, fleet"),
        (json.dumps({k: v for k, v in MANIFEST.items() if k != "command"}), ": no command"),
    ],
)
def test_a_broken_manifest_is_refused(folder: Path, text: str | dict[str, Any], complaint: str) -> None:
    text = text if isinstance(text, str) else json.dumps({**MANIFEST, **text})
    (folder / "manifest.json").write_text(text, encoding="utf-8")
    assert f"manifest.json{complaint}" in refusal(folder)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"x": [0.0]}, "arrival_s and x must have one entry a message"),
        ({"x": [0.0, 1.0, 2.0, 3.0, 4.0, "5"]}, "x must hold numbers alone"),
        ({"x": [0.0, 1.0, 2.0, 3.0, 4.0, math.nan]}, "NaN: numbers must be finite"),
        ({"rate": {"t_s": [0.0], "bytes_per_s": []}}, "must be of one length"),
        ({"policies": {"afr": {"qoi": 1.0, "received": [[6, 0.0, 0.0]], "dropped": []}}}, "a message 0..5"),
        ({"policies": {"afr": {"qoi": 1.0, "received": [], "dropped": [[0]]}}}, "policies.afr.dropped = [0]"),
        ({"policies": {"afr": {"received": [], "dropped": []}}}, "timeline.json: no policies.afr.qoi"),
    ],
)
def test_a_broken_timeline_is_refused(folder: Path, changes: dict[str, Any], complaint: str) -> None:
    (folder / "timeline.json").write_text(json.dumps({**TIMELINE, **changes}), encoding="utf-8")
    found = refusal(folder)
    assert complaint in found and "timeline.json" in found


def test_broken_rows_are_refused(tmp_path: Path) -> None:
    rows = inputs.read(make(tmp_path / "a")).rows
    without = [{name: cell for name, cell in row.items() if name != "qoi"} for row in rows]
    assert "rows.csv: no column 'qoi'" in refusal(make(tmp_path / "b", rows=without))
    unmet = [row for row in rows if (row["policy"], row["seed"]) != ("afr", 1)]
    assert "rows.csv: afr at " in refusal(make(tmp_path / "c", rows=unmet))
    no_baseline = [row for row in rows if row["policy"] != "drop-oldest"]
    assert "rows.csv: " in (found := refusal(make(tmp_path / "d", rows=no_baseline))) and "baseline" in found


SIZES = """() => [...document.querySelectorAll("[data-panel]:not([hidden])")].map((place) => {
    const box = place.querySelector("svg.main-svg").getBoundingClientRect();
    return [place.closest("figure").dataset.chart, box.width, box.height, place.querySelectorAll("path, image").length];
})"""


@pytest.mark.nightly
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_browser_draws_every_chart_without_network_or_complaint(folder: Path, scheme: str) -> None:
    """Another scheme while the page is open: the charts follow. A name is shown as it is written, not as bold type."""
    colour = "getComputedStyle(document.querySelector('#ranking .xtick text')).fill"
    with opened(report.write(folder), scheme, 1000) as page:
        page.wait_for_function("document.querySelectorAll('svg.main-svg').length >= 7")
        sizes, ink = page.evaluate(SIZES), page.evaluate(colour)
        page.emulate_media(color_scheme="light" if scheme == "dark" else "dark")
        page.wait_for_function(f"(was) => {colour} !== was", arg=ink)
        page.select_option("#capacities select", "long")
        assert "<b>" in page.locator("#delays .ytick text").all_text_contents()
    assert {chart for chart, *_ in sizes} == {"ranking", "capacities", "outages", "delays", "timeline", "memory"}
    assert all(wide > 200 and high > 100 and shapes > 0 for _, wide, high, shapes in sizes), sizes
    assert ink == ("rgb(27, 31, 36)" if scheme == "light" else "rgb(230, 233, 237)")
