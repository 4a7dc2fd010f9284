"""Made-up links and motions: what a seed promises, and the files that are shipped."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bufgym.errors import BufgymError, TraceError
from bufgym.traces import (
    describe,
    drive_motion,
    load,
    load_motion,
    outage,
    read_motion,
    read_trace,
    shipped,
    synthetic_lte,
    write_csv,
)
from bufgym.traces.generate.lte import LTE_MODES, MAX_FADE_S
from bufgym.traces.generate.shipped import SHIPPED_LTE, write_shipped

ROOT = Path(__file__).resolve().parents[2]
DEMAND_BYTES_PER_S = 6.9e6  # 30 frames of 230 kB a second


def test_a_seed_is_a_trace() -> None:
    first, again, other = synthetic_lte(5), synthetic_lte(5), synthetic_lte(6)
    assert first == again
    assert first.cumulative_bytes.tolist() != other.cumulative_bytes.tolist()


def test_any_whole_number_of_seconds() -> None:
    assert synthetic_lte(1, duration_s=1).duration_us == 1_000_000
    assert synthetic_lte(1, duration_s=1000).duration_us == 1_000_000_000


@pytest.mark.parametrize("mode", list(LTE_MODES))
def test_the_mean_is_the_one_asked_for(mode: str) -> None:
    trace = synthetic_lte(0, 300, 7.5e6, mode)  # type: ignore[arg-type]
    assert abs(trace.total_bytes - 300 * 7.5e6) <= 150  # half a byte for each second


def test_the_faster_the_more_restless() -> None:
    """Spread lies in the range of the Belgium logs (variation 0.26-0.82); it and outages grow to train."""
    spread, broken = [], []
    for mode in LTE_MODES:
        rates = np.concatenate([synthetic_lte(seed, 600, 1e7, mode).segments()[1] for seed in range(20)])
        spread.append(rates.std() / rates.mean())
        broken.append(float((rates < 0.25 * np.median(rates)).mean()))
        centred = rates - rates.mean()
        assert 0.5 < (centred[1:] * centred[:-1]).mean() / rates.var() < 0.9
    assert 0.26 < spread[0] < spread[1] < spread[2] < 0.82
    assert 0.01 < broken[0] < broken[1] < broken[2] < 0.20


def test_breakdowns_last_no_longer_than_stated() -> None:
    rates = np.concatenate([synthetic_lte(seed, 1000, 1e7, "train").segments()[1] for seed in range(10)])
    edges = np.flatnonzero(np.diff(np.concatenate(([0], rates == 0, [0])).astype(int)))
    lengths = edges[1::2] - edges[::2]
    assert lengths.min() == 1
    # Two may follow each other at once, which happens about once in a thousand.
    assert np.sort(lengths)[-2] <= MAX_FADE_S


def test_outage_is_a_rule() -> None:
    trace = outage(3, 1, 8e6, repeats=2)
    assert trace.rate_bytes_per_s(np.arange(7) * 1_000_000).tolist() == [8e6, 8e6, 0, 8e6, 8e6, 0, 8e6]
    assert outage(3, 1, 8e6, outage_bytes_per_s=1e5).total_bytes == 16_100_000


def test_a_robot_cruises_turns_and_stops() -> None:
    motion = drive_motion(3, 300)
    assert motion.duration_us == 300_000_000
    per_s = np.diff(motion.coordinate) * 10
    # At most 60 degrees/s of turning, or 1.5 m/s and 10 degrees/s of cruising; at least 0.5 m/s moving.
    assert per_s.max() <= 1.0 + 1e-5
    assert per_s[per_s > 1e-6].min() >= 0.25 - 1e-5
    assert 0.02 < (per_s < 1e-6).mean() < 0.4
    assert drive_motion(3, 300).coordinate.tolist() == motion.coordinate.tolist()
    assert drive_motion(4, 300).coordinate.tolist() != motion.coordinate.tolist()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: synthetic_lte(-1), "seed = -1: must be >= 0"),
        (lambda: synthetic_lte(0, 0), "duration_s = 0: must be a whole number from 1"),
        (lambda: synthetic_lte(0, 10, float("nan")), "mean_bytes_per_s = nan"),
        (lambda: synthetic_lte(0, mode="boat"), "mode = 'boat': must be one of walk, drive, train"),  # type: ignore[arg-type]
        (lambda: outage(1, 1, 5), "length_s = 1: must be above 0 and below period_s = 1"),
        (lambda: outage(2, 1, 5, repeats=0), "repeats = 0: must be >= 1"),
        (lambda: drive_motion(0, 0), "duration_s = 0: must be from 0.1"),
    ],
)
def test_broken_arguments(make: Callable[[], object], says: str) -> None:
    with pytest.raises(BufgymError, match=says):
        make()


def test_the_command_makes_the_shipped_files_byte_for_byte(tmp_path: Path) -> None:
    command = [sys.executable, "-W", "error", "-m", "bufgym.traces.generate.shipped", str(tmp_path / "new")]
    done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    written = {path.name: path.read_bytes() for path in (tmp_path / "new").iterdir()}
    kept = {path.name: path.read_bytes() for path in (ROOT / "traces").glob("*.csv")}
    assert len(written) == len(SHIPPED_LTE) + 2
    assert written == kept


def test_the_command_says_what_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TraceError, match="cannot be created"):
        write_shipped(tmp_path / "file" / "below")


def test_shipped_traces_trouble_a_robot_but_not_always() -> None:
    for seed, (mode, mean) in enumerate(SHIPPED_LTE):
        trace = load(f"lte-synthetic-{seed}")
        assert trace.cumulative_bytes.tolist() == synthetic_lte(seed, 300, mean, mode).cumulative_bytes.tolist()
        summary = describe(trace)
        assert summary["duration_s"] == 300.0
        assert 3 <= summary["seconds_below_500KBps"] <= 45
        assert 30 <= trace.seconds_below(DEMAND_BYTES_PER_S) <= 150


def test_shipped_names_and_loading(tmp_path: Path) -> None:
    names = shipped()
    assert {f"lte-synthetic-{k}" for k in range(8)} | {"drive-0", "drive-1"} <= set(names)
    assert load_motion("drive-1").coordinate.tolist() == drive_motion(1, 300).coordinate.tolist()
    assert load_motion("drive-0").name == "drive-0"
    own = tmp_path / "own.csv"
    write_csv(outage(2, 1, 1e6), own)
    assert load(own) == load(str(own)) == read_trace(own)
    assert load(own, after="stop").after == "stop"
    with pytest.raises(TraceError, match=r"lte-nowhere: no such file, .*known: .*drive-0.*lte-synthetic-7"):
        load("lte-nowhere")
    with pytest.raises(TraceError, match="must fit a known format"):
        load("drive-0")
    with pytest.raises(TraceError, match="must have 8 columns"):
        read_motion(names["lte-synthetic-0"])


def test_importing_is_light() -> None:
    """Readers must start at once: nothing heavy may come with them."""
    heavy = ("numba", "scipy", "matplotlib", "gymnasium", "torch", "mcap", "rosbags")
    code = (
        "import sys, types; package = types.ModuleType('bufgym'); package.__path__ = ['bufgym'];"
        "sys.modules['bufgym'] = package; import bufgym.traces;"
        f"print([m for m in {heavy!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert os.path.exists(ROOT / "traces" / "README.md")
