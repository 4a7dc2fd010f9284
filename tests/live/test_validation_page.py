"""What ``bufgym live validate --out`` leaves: every run in a file, and a page with pictures."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from bufgym.errors import BufgymError
from bufgym.live.runs import Run, save

pytest.importorskip("jinja2", reason="the page needs Jinja")
pytest.importorskip("plotly", reason="the page needs plotly")

RUNS = [
    Run("afr", "lte <b>", 0, 99, 100, 4.99, 5.0, 5.0, "tcp", (0.1, 0.2), (0.1, 0.3)),
    Run("afr", "lte <b>", 0, 100, 100, 5.0, 5.0, 5.0, "websocket", (0.1,), (0.1,)),
    Run("drop-oldest", "lte <b>", 0, 90, 90, 4.0, 4.0, 5.0, "tcp", (), ()),
]


def test_the_page_tells_all_runs(tmp_path: Path) -> None:
    from bufgym.benchmark.report import live

    page = live.write(save(RUNS, "10 s of <video>", "bufgym live validate --trace x", tmp_path / "out")).read_text()
    assert json.loads((tmp_path / "out" / "runs.json").read_text())["runs"][0]["live_s"] == [0.1, 0.2]
    assert "10 s of &lt;video&gt;." in page and "lte <b>" not in page
    assert "3 runs: QoI live and simulated 0.00% apart (median), 0.20% at most; delivered 0 and 1." in page
    assert "Of 1 pairs of policies that differ by more than 1%, 1 stand in the same order." in page
    found = re.search(r'<script type="application/json" id="figures">(.*?)</script>', page)
    assert found is not None
    figures = json.loads(found[1])
    qoi, delivered = figures["apart"][""]
    lanes = {trace["y"][0]: trace["x"] for trace in qoi["data"]}
    assert lanes == {"afr": [-0.2, 0], "drop-oldest": [0]}
    assert [trace["x"] for trace in delivered["data"]] == [[0], [-1, 0]]
    assert set(figures["regret"]) == {"lte <b>\ntcp", "lte <b>\nwebsocket"} == set(figures["delivery"])
    curves = {trace["name"]: trace["x"] for trace in figures["delivery"]["lte <b>\ntcp"][0]["data"]}
    assert set(curves) == {"afr, live", "afr, simulated"}  # nothing came of the other
    assert (curves["afr, simulated"][0], curves["afr, simulated"][-1]) == (0.1, 0.3)


def test_the_page_says_by_how_much_one_policy_beats_another(tmp_path: Path) -> None:
    from bufgym.benchmark.report import live

    runs = [
        Run(policy, "a", seed, 1, 1, qoi, qoi, 5.0)
        for seed in (0, 1)
        for policy, qoi in (("afr", 4.0), ("random", 4.1))
    ]
    page = live.write(save(runs, "", "", tmp_path)).read_text()
    assert "<p>random against afr, 2 episodes: regret lower by 2.00 % [2.00, 2.00] live" in page


@pytest.mark.parametrize("text", ["", "[]", '{"runs": [{"policy": 3}]}', '{"runs": 1, "about": "", "command": ""}'])
def test_a_file_without_runs_is_named(text: str, tmp_path: Path) -> None:
    from bufgym.benchmark.report import live

    (tmp_path / "runs.json").write_text(text)
    with pytest.raises(BufgymError, match=r"runs\.json: must hold the runs of bufgym live validate"):
        live.write(tmp_path / "runs.json")
