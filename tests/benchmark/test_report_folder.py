"""The report: folders that are refused, and the page in a real browser."""

from __future__ import annotations

import json
import math
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
from report_cases import MANIFEST, TIMELINE, make

from bufgym.benchmark import folder as inputs
from bufgym.benchmark import report
from bufgym.errors import BufgymError

pytest.importorskip("jinja2", reason="the report needs Jinja")
pytest.importorskip("plotly", reason="the report needs plotly")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make(tmp_path / "run")


# --- bad folders ------------------------------------------------------------------------------------------------------


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
        ('{"format": 2,\n', "manifest.json, line 2: must be JSON"),
        ("[]", "manifest.json: must be a JSON object"),
        ('{"format": 1}', "manifest.json: format = 1: must be 2"),
        (json.dumps({**MANIFEST, "suite": 3}), "manifest.json: suite = 3: must be text"),
        (json.dumps({**MANIFEST, "scenarios": {"a": 1}}), "manifest.json: scenarios.a must be an object"),
        (json.dumps({**MANIFEST, "scenarios": {"a": {"outage_s": "x"}}}), "scenarios.a.outage_s = x: must be a number"),
        (
            json.dumps({**MANIFEST, "task": "chess"}),
            "manifest.json: task = chess: must be one of queue, stress, topics, fleet",
        ),
        (json.dumps({k: v for k, v in MANIFEST.items() if k != "command"}), "manifest.json: no command"),
    ],
)
def test_a_broken_manifest_is_refused(folder: Path, text: str, complaint: str) -> None:
    (folder / "manifest.json").write_text(text, encoding="utf-8")
    assert complaint in refusal(folder)


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


# --- in a browser -----------------------------------------------------------------------------------------------------

QUIET = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]

SIZES = """() => [...document.querySelectorAll("[data-panel]:not([hidden])")].map((place) => {
    const box = place.querySelector("svg.main-svg").getBoundingClientRect();
    return [place.closest("figure").dataset.chart, box.width, box.height, place.querySelectorAll("path, image").length];
})"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_browser_draws_every_chart_without_network_or_complaint(folder: Path, scheme: str) -> None:
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium on this machine")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = report.write(folder)
    said: list[str] = []
    asked: list[str] = []
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=QUIET)
        page = browser.new_page(color_scheme=scheme, viewport={"width": 1000, "height": 800})
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_function("document.querySelectorAll('svg.main-svg').length >= 7")
        sizes = page.evaluate(SIZES)
        ink = page.evaluate("getComputedStyle(document.querySelector('#ranking .xtick text')).fill")
        # Another scheme while the page is open: the charts follow.
        page.emulate_media(color_scheme="light" if scheme == "dark" else "dark")
        page.wait_for_function(
            "(was) => getComputedStyle(document.querySelector('#ranking .xtick text')).fill !== was", arg=ink
        )
        page.select_option("#capacities select", "long")
        names = page.locator("#delays .ytick text").all_text_contents()
        width = page.evaluate("document.documentElement.scrollWidth")
        browser.close()
    assert said == []
    assert [url for url in asked if not url.startswith("data:")] == [path.as_uri()]
    assert {chart for chart, *_ in sizes} == {"ranking", "capacities", "outages", "delays", "timeline", "memory"}
    for chart, wide, high, shapes in sizes:
        assert wide > 200 and high > 100 and shapes > 0, chart
    assert ink == ("rgb(27, 31, 36)" if scheme == "light" else "rgb(230, 233, 237)")
    assert "<b>" in names  # as it is written, not as bold type
    assert width == 1000  # nothing sticks out
