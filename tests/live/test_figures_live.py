"""Robofleet's figures on real sockets: the same messages, and what became of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from cli_cases import fails

from bufgym.kernel import JIT
from bufgym.reproduce import figure, run_live

SMALL: dict[str, dict[str, Any]] = {
    "robofleet-fig3": {"rates_hz": (10,), "duration_s": 0.5},
    "robofleet-fig4": {"dropouts_s": (1,), "links_mbit_per_s": (12,), "kinds": ("LaserScan",), "live": 20.0},
    "robofleet-fig5": {"fall_s": 2.0, "stay_s": 0.0, "points": 500},
    "robofleet-fig6": {"points": (100,), "max_consumers": 2, "duration_s": 1.0},
    "robofleet-fig7": {"bad_from": 5, "bad_s": 1.0, "after_s": 1.0},
}
"""Options that keep each short; one that is played live must add its own."""
compiled = pytest.mark.skipif(not JIT, reason="uncompiled, decisions take as long as messages do")


@compiled
@pytest.mark.parametrize("name", SMALL)
def test_each_is_played_live(name: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    text = run_live(name, tmp_path, **SMALL[name])
    assert "Live, beside simulated:\n  " in text
    for medium in ("simulated", "live"):
        assert str(tmp_path / f"{name}-{medium}.csv") in text
        assert (tmp_path / f"{name}-{medium}.png").is_file()


@compiled
def test_on_an_easy_link_nothing_is_dropped_live_either() -> None:
    """Five clouds of 160 kB (JSON: 562 kB), 250 ms apart, over 2.5 MB/s: each program sends each of them.

    A link so slow that the 5 ms which it may be ahead after a pause (``live/shaped.py``) are less than a tenth.
    """
    settings = {"rates_hz": (4,), "mbit_per_s": 20.0, "duration_s": 1.25, "runs": 1}
    rows = figure("robofleet-fig3", **settings, live=1.0).simulate()
    assert [row["dropped"] for row in rows] == [0] * 5
    # No sooner than the link carries them, and half a round trip later: 64 ms and 225 ms, and 5 ms.
    least_ms = {row["sender"]: 230.0 if row["sender"] == "rosbridge" else 69.0 for row in rows}
    assert all(row["latency_ms"] > 0.9 * least_ms[row["sender"]] for row in rows)


def test_others_are_not(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["reproduce", "afr-fig4", "--live", "--out", str(tmp_path)]
    fails(words, "afr-fig4: is not played on sockets; robofleet-fig3 to robofleet-fig7 are", capsys)
