"""Recordings that cannot be true: each is read right, or a sentence says what is wrong and which option settles it."""

import gzip
import warnings
from pathlib import Path

import numpy as np
import pytest
from link_files import written
from needs import needs
from recording_cases import ODD_FILES
from refusal_cases import refuse

import bufgym
from bufgym import scenario as scenarios
from bufgym.cli import main
from bufgym.traces import Poses, Trace, motion_from_poses, read_motion, read_trace, read_workload
from bufgym.utils.errors import TraceWarning
from studies import plausible

OUTAGES = ODD_FILES / "four_outages.csv"
HELD = "line 32: 75 is 46 s after the line above, the longest of 4 holes, where 1 s is usual: the rate is held"


def unpacked(tmp_path: Path, name: str) -> Path:
    """An odd file without its gzip."""
    return written(tmp_path, gzip.decompress((ODD_FILES / f"{name}.gz").read_bytes()), name)


def doubt_of(path: Path, **how: str) -> tuple[Trace, str]:
    """The trace, and the single doubt about it, which is also a warning."""
    with pytest.warns(TraceWarning) as caught:
        trace = read_trace(path, **how)  # type: ignore[arg-type]
    assert [str(one.message) for one in caught] == list(trace.sheet.doubts)
    return trace, trace.sheet.doubts[0]


def test_an_outage_is_held_or_empty_or_refused() -> None:
    """1 MB/s but for four times 45 s without a line: 330 s are 330 MB held, and 150 MB with nothing sent."""
    held, doubt = doubt_of(OUTAGES)
    assert held.total_bytes == 330_000_000 and len(held.holes) == 4
    assert f"{HELD}, mean 1,000 KB/s (--holes zero: 454.545 KB/s)" in doubt
    empty, doubt = doubt_of(OUTAGES, holes="zero")
    assert empty.total_bytes == 150_000_000 and "nothing is sent, mean 454.545 KB/s (--holes hold: 1,000" in doubt
    assert empty.rate_bytes_per_s([29_900_000, empty.holes[0][0], empty.holes[0][1]]).tolist() == [1e6, 0, 1e6]
    assert empty.with_holes("hold").total_bytes == 330_000_000 and empty.scaled(2).holes == empty.holes
    refuse("say --holes hold, or --holes zero", read_trace, OUTAGES, holes="refuse")
    refuse("holes = 'none': must be one of hold, zero, refuse", read_trace, OUTAGES, holes="none")
    said = read_trace(ODD_FILES / "four_outages_zero.csv")
    assert not said.sheet.doubts and said.mean_bytes_per_s == pytest.approx(empty.mean_bytes_per_s, rel=0.01)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("hole50.csv", "line 32: 80 is 51 s after the line above, where 1 s is usual: the rate is held"),
        ("cron15_two_missing.csv", "line 6: 5400 is 2700 s after the line above, .* where 900 s is usual"),
        (
            "ms20.csv",
            r"20 s apart \(median\): are they in ms\? .* 9,980 s in all, and not 9.98 s \(a header time_ms,mbps",
        ),
    ],
)
def test_odd_links_are_warned_of(name: str, says: str) -> None:
    with pytest.warns(TraceWarning, match=f"{name}.*{says}"):
        read_trace(ODD_FILES / name)


def test_a_header_says_the_unit(tmp_path: Path) -> None:
    in_ms = (ODD_FILES / "ms20.csv").read_text().replace("time,", "time_ms,")
    assert read_trace(written(tmp_path, in_ms)).duration_us == 10_000_000
    for unit in ("us", "ms"):
        path = ODD_FILES / f"work_{unit}.csv"
        refuse(rf"work_{unit}.csv: .* may be s .* or {unit} \(9.*: name the column time_{unit}", read_workload, path)
        named = written(tmp_path, path.read_text().replace("time_s", f"time_{unit}"), "w.csv")
        assert read_workload(named).duration_us == pytest.approx(9_967_000, abs=101_000)
    slow = written(tmp_path, "time_s,bytes\n0.0,1\n30.0,1\n60.0,1\n", "slow.csv")
    assert read_workload(slow).duration_us == 60_000_000


def test_a_clock_is_no_number_of_seconds() -> None:
    refuse("nmea_hms.csv: time in s = 120000: looks like a clock's HHMMSS", read_trace, ODD_FILES / "nmea_hms.csv")


def test_the_unit_of_slow_poses_is_asked_for(tmp_path: Path) -> None:
    path = ODD_FILES / "ms_1khz.txt.gz"
    refuse(r"may be s, at 0.0006 m/s, or ms, at 0.6 m/s: say format='tum'", read_motion, path)
    assert read_motion(path, format="tum").duration_us == 2_999_000_000
    named = written(tmp_path, b"#timestamp [ms]\n" + gzip.decompress(path.read_bytes()), "p.txt")
    assert read_motion(named).duration_us == 2_999_000
    # A robot that drives 0.5 m in each second, and one that stands.
    for step_m in (0.5, 0):
        lines = "".join(f"{k + 0.5} {step_m * k} 0 0 0 0 0 1\n" for k in range(20))
        assert read_motion(written(tmp_path, lines, "p.txt")).duration_us == 19_000_000


def test_a_false_header_is_named(tmp_path: Path) -> None:
    path = ODD_FILES / "tum_euroc_hdr_s.csv"
    refuse(r"times are in ns, which makes .* where s make 0.03333 s: must say \[s\]", read_motion, path)
    assert read_motion(written(tmp_path, path.read_text().replace("[ns]", "[s]"), "p.csv")).duration_us == 9_966_667


def test_noise_is_no_motion() -> None:
    """0.05 m/s for 60 s, 2 m a field of view: x is 1.5; 5 cm of noise make 33.9 of it."""
    path = ODD_FILES / "uwb.txt"
    with pytest.warns(TraceWarning, match="x of every second pose is 0.50 of x .*: about 100% of x = 33.884 is noise"):
        read_motion(path)
    assert read_motion(path, bufgym.traces.MotionSettings(rate_hz=0.2)).total == pytest.approx(1.5, rel=0.1)
    rng, upright = np.random.default_rng(0), np.tile([0.0, 0, 0, 1], (600, 1))
    standing = Poses(np.arange(600) * 200_000, rng.normal(0, 0.01, (600, 3)), upright)
    assert "of x = " in motion_from_poses(standing).sheet.doubts[0]
    driving = Poses(standing.time_us, standing.position_m / 50 + np.arange(600)[:, None] * [0.1, 0, 0], upright)
    assert not motion_from_poses(driving).sheet.doubts


def test_header_stamps_tell_the_clock(tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason=needs("extras", "mcap"))
    for name, says, seconds in (
        ("log_us.mcap", r"stamps on /odom go on by 1000 s .* \(9.95 s in 0.00995 s\): .*--clock stamps", 9.95),
        ("rtf03.mcap", r"stamps on /cam go on by 0.3 s .* \(9.96667 s in 33.2222 s\)", 9.967),
    ):
        path = unpacked(tmp_path, name)
        with pytest.warns(TraceWarning, match=says):
            read_workload(path, odom="/odom")
        by_stamps = read_workload(path, odom="/odom", clock="stamps")
        assert by_stamps.duration_us / 1e6 == pytest.approx(seconds, abs=0.001)
        assert by_stamps.x is not None and by_stamps.x[-1] == pytest.approx(2.985, abs=0.02)
    refuse("clock = 'wall': must be one of log, stamps", read_workload, path, clock="wall")


def test_a_pause_of_messages_is_said(tmp_path: Path) -> None:
    times = [*range(100), *range(7299, 7399)]
    lines = "".join(f"{time}.0,9\n" for time in times)
    with pytest.warns(TraceWarning, match="w.csv: no message for 7,199 s, from 100 s on: nothing is sent in it"):
        read_workload(written(tmp_path, "time_s,bytes\n" + lines, "w.csv"))


@pytest.mark.filterwarnings("ignore::bufgym.utils.errors.TraceWarning")
def test_a_doubt_stands_in_every_table_and_page(tmp_path: Path) -> None:
    """With both policies' results on either reading of the holes in one line."""
    stream = scenarios.get("lte", traces=str(OUTAGES), rate_hz=5, size_bytes=150_000, duration_s=20)
    done = bufgym.compare(["drop-oldest", "min-gap"], stream, capacity=4, seeds=2, progress=False)
    assert f"warning: {OUTAGES}, {HELD}" in done.about and "QoI with --holes hold (as below) or zero: " in done.about
    assert HELD in str(done) and HELD in done.write_table(tmp_path / "t.md").read_text(encoding="utf-8")
    empty = scenarios.get("lte", traces=read_trace(OUTAGES, holes="zero"))
    again = bufgym.compare("drop-oldest", empty, capacity=4, seeds=1, progress=False)
    assert "QoI with --holes zero (as below) or hold: drop-oldest " in again.about


@pytest.mark.filterwarnings("ignore::bufgym.utils.errors.TraceWarning")
def test_the_commands_print_a_fact_sheet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dated = written(tmp_path, "time,mbps\n2024-03-31 02:00:00,8\n2024-03-31 02:00:01,8\n2024-03-31 02:00:03,8\n")
    assert main(["trace", "info", str(dated), str(OUTAGES), "--holes", "zero"]) == 0
    out = capsys.readouterr().out
    for fact in (
        "start                        2024-03-31 02:00:00 UTC",
        "samples                      3 in 3.000 s",
        "step                         1 s (median), 1 to 46",
        "holes                        4, 180 s in all: zero",
    ):
        assert fact in out
    assert main(["trace", "from-poses", str(ODD_FILES / "uwb.txt"), "--rate-hz", "0.2"]) == 0
    out = capsys.readouterr().out
    assert "path               67.7672 m, 0.05416 m/s (mean), at most 0.06948" in out
    assert "x                  1.622 by translation, 0.000 by rotation" in out


def test_the_study_counts_rules(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written(tmp_path, OUTAGES.read_bytes(), "four.csv")
    with warnings.catch_warnings():
        plausible.main(tmp_path)
    assert "| hole of a link | Trace | 1 of 1 | four.csv |" in capsys.readouterr().out
