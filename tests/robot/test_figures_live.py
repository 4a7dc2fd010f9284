"""Robofleet's figures on real sockets: the same messages, and what became of them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from loop_cases import compiled

from bufgym.cli import main
from bufgym.papers import figure, run_live

SMALL: dict[str, dict[str, Any]] = {
    "robofleet-fig3": {"rates_hz": (10,), "duration_s": 0.5},
    "robofleet-fig4": {"dropouts_s": (1,), "links_mbit_per_s": (12,), "kinds": ("LaserScan",), "live": 20.0},
    "robofleet-fig5": {"fall_s": 2.0, "stay_s": 0.0, "points": 500},
    "robofleet-fig6": {"points": (100,), "max_consumers": 2, "duration_s": 1.0},
    "robofleet-fig7": {"bad_from": 5, "bad_s": 1.0, "after_s": 1.0},
}
"""Options that keep each short; one that is played live must add its own."""


@compiled
@pytest.mark.nightly
@pytest.mark.parametrize("name", SMALL)
def test_each_is_played_live(name: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    expected, steps = list[tuple[int, float]](), list[int]()

    @contextmanager
    def watch(runs: int, takes_s: float) -> Iterator[Callable[[], None]]:
        expected.append((runs, takes_s))
        yield lambda: steps.append(1)

    text = run_live(name, tmp_path, watch, **SMALL[name])
    ((runs, takes_s),) = expected
    assert len(steps) == runs  # a picture of runs that were played plays none again
    if name == "robofleet-fig6":  # one and two consumers, three programs, 1 s each: what comes later is not awaited
        assert (runs, takes_s) == (6, 6.0)
    assert "Live, beside simulated:\n  " in text
    for medium in ("simulated", "live"):
        assert str(tmp_path / f"{name}-{medium}.csv") in text
        assert (tmp_path / f"{name}-{medium}.png").is_file()


@compiled
@pytest.mark.nightly
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


@compiled
def test_the_command_says_how_far_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from bufgym.papers.robofleet_fig5 import Reproduction

    monkeypatch.setattr(Reproduction, "LIVE", {**Reproduction.LIVE, **SMALL["robofleet-fig5"], "live": 8.0})
    assert main(["reproduce", "robofleet-fig5", "--live", "--out", str(tmp_path)]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("robofleet-fig5: ")]
    assert told == [
        "robofleet-fig5: 4 runs on real sockets take about 1 s",  # 2 s, four programs, eight times as fast
        *(f"robofleet-fig5: run {k} of 4" for k in (1, 2, 3, 4)),
    ]
