"""Files as people's recorders, loggers and spreadsheets leave them: read right, or refused or warned of by name."""

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from link_files import SAMPLES, written
from needs import needs
from recording_cases import ODD_FILES
from refusal_cases import refuse

from bufgym.cli import main
from bufgym.traces import Trace, read_motion, read_trace, read_workload
from bufgym.traces.formats.trajectories import read_poses
from bufgym.utils.errors import TraceError, TraceWarning

RIGHT: list[tuple[str, Any, str | None]] = [
    ("good.mcap", (2.95, 1.475), None),
    # By the header stamps, which went on: by the log times alone it is 0.683 s or more.
    ("clock_back_0.733s.mcap", r"goes back by 0.733 s before message 46 \(/odom, .*, after message 45 \(/odom", None),
    ("rollover.mcap", r"message 51 \(/odom\), log time in ns = 18446744068709551616: must be from 0 to 2", None),
    ("clock_1970.mcap", r"message 46 \(/odom, .*\) is 1699999960 s from message 45 \(/odom, logged at 41.450", None),
    ("odom_jump.mcap", (2.95, 501.475), r"pose 31 of 60 \(/odom\), 1.500 s after .*, is 1000.05 m from the one 0.05"),
    ("tum_comma_sec_long.csv", (2997, 749.25), None),
    ("turn_csv_us.csv", (1.966647, 1.5), None),
    ("vins.csv", (1.966666, 1.5), None),
    # 100 to 102 Mbit/s for 15 minutes each, the last for as long as the others.
    ("cron15_100.csv", (7200, (3 * (100 + 101 + 102) - 102) * 125_000 * 900), None),
    ("dst_slow.csv", (3605, 125_000 * 3603 + 250_000 * 2), "line 5: 2024-03-31 03:00:00 is 3601 s after the line"),
    ("ip_stream.json", (3, 375_000), None),
    ("cooked_epoch.txt", (10, 125_000 * 19), None),
    # Bytes, not bits: 10 MB/s for 10 s.
    ("MBps.csv", (10, 100_000_000), None),
    ("KBps.csv", (10, 100_000_000), None),
]
"""File; seconds, and x or bytes at the end, or the error; the warning."""


def read(path: Path) -> tuple[float, float]:
    """Seconds, and what has gathered by the end."""
    if path.suffix == ".mcap":
        workload = read_workload(path, odom="/odom")
        assert workload.x is not None
        return workload.duration_us / 1e6, float(workload.x[-1])
    if path.name.startswith(("tum", "turn", "vins")):
        motion = read_motion(path)
        return motion.duration_us / 1e6, motion.total
    trace = read_trace(path)
    return trace.duration_us / 1e6, trace.total_bytes


@pytest.mark.parametrize(("name", "right", "warning"), RIGHT)
def test_each_odd_file_is_read_right_or_says_why_not(name: str, right: Any, warning: str | None) -> None:
    path = ODD_FILES / name
    if path.suffix == ".mcap":
        pytest.importorskip("mcap", reason=needs("extras", "mcap"))
    if isinstance(right, str):
        refuse(f"{name}: .*{right}", read, path, kind=TraceError)
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert read(path) == pytest.approx(right, rel=1e-9)
    assert len(caught) == (warning is not None)
    if warning is not None:
        assert caught[0].category is TraceWarning
        with pytest.warns(TraceWarning, match=f"{name}.*{warning}"):
            read(path)


# 60 poses at 30 Hz that turn by 1 degree each: 59 / 60 fields of view in 59 / 30 s. TUM's quaternion ends with w, and
# EuRoC's begins with it.
UNITS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}


def turning(unit: str, separator: str, start_s: int, w_first: bool, end: str = "") -> str:
    lines = []
    for k in range(60):
        half = math.radians(k) / 2
        turn = [math.cos(half), 0, 0, math.sin(half)] if w_first else [0, 0, math.sin(half), math.cos(half)]
        time_us = start_s * 10**6 + k * 100_000 // 3
        time = f"{time_us / 10**6:.6f}" if unit == "s" else str(time_us * UNITS[unit] // 10**6)
        lines.append(separator.join([time, "0", "0", "0", *(f"{value:.9f}" for value in turn)]) + end)
    return "\n".join(lines)


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize(("separator", "end"), [(",", ""), (",", ","), (" ", "")])
def test_the_unit_of_a_trajectory_is_found(tmp_path: Path, unit: str, separator: str, end: str) -> None:
    for start_s in (0, 7, 1_700_000_000):  # from the first pose, from the robot's start, from 1970
        for w_first in (False, True):
            path = written(tmp_path, turning(unit, separator, start_s, w_first, end), "path.csv")
            motion = read_motion(path)
            assert motion.duration_us / 1e6 == pytest.approx(59 / 30, abs=1e-3), motion.source
            assert motion.total == pytest.approx(59 / 60, abs=1e-6)


def test_the_unit_of_kittis_times_is_found(tmp_path: Path) -> None:
    """Four poses at 10 Hz; of steps of 10 the user says that they are seconds."""
    path = written(tmp_path, "1 0 0 0 0 1 0 0 0 0 1 0\n" * 4, "00.txt")
    for unit, start in (("s", 0), ("ms", 0), ("us", 0), ("ns", 1_700_000_000)):
        step = UNITS[unit] / 10
        times = "".join(f"{start * UNITS[unit] + k * step:.1f}\n" for k in range(4))
        motion = read_motion(path, times=written(tmp_path, times, "times.txt"))
        assert motion.duration_us == pytest.approx(300_000, abs=1), unit
    tens = written(tmp_path, "0\n10\n20\n30\n", "times.txt")
    refuse(r"times\.txt: median step of the times = 10: may be s or ms", read_motion, path, times=tens)
    assert read_motion(path, format="kitti", times=tens).duration_us == 30_000_000


def test_times_in_a_unit_that_cannot_be_are_refused(tmp_path: Path) -> None:
    """Steps of 5 may be s or ms, and microseconds under a header that says ns give 30,000 poses a second."""
    pose = ",0,0,0,0,0,0,1\n"
    fives = written(tmp_path, "".join(f"{5 * k}{pose}" for k in range(4)), "path.csv")
    refuse(r"path.csv: median step of the times = 5: may be s or ms: say format='tum'", read_motion, fives)
    assert read_motion(fives, format="tum").duration_us == 15_000_000
    refuse(
        "median step of the times = 10: may be s or ms",
        read_motion,
        written(tmp_path, "0 0 0 0 0 0 0 1\n10 0 0 0 0 0 0 1\n", "t.txt"),
    )
    header = "#timestamp [ns],p_x,...\n" + turning("us", ",", 0, True)
    for text, format in ((header, None), (turning("us", ",", 1_700_000_000, True), "euroc")):
        path = written(tmp_path, text, "path.csv")
        rule = (
            "'3.3e-05 s': must be at least 0.0001 s"
            if format
            else r"times are in ns, which .* us make .* must say \[us\]"
        )
        refuse(rule, read_motion, path, format=format)
    assert read_motion(written(tmp_path, header.replace("[ns]", "[us]"), "path.csv")).duration_us == 1_966_666
    refuse("median step of the times", read_motion, written(tmp_path, "t_s,motion\n0,0\n0.000001,1\n", "m.csv"))


def test_a_jump_in_a_trajectory_is_warned_of(tmp_path: Path) -> None:
    """At 20 Hz: 2 m in 50 ms are 40 m/s, 3 m are 60 m/s, which no robot drives; 0.9 m in 1 ms is a late log time."""
    for step_m, step_s, jumps in ((2, 0.05, False), (3, 0.05, True), (0.9, 0.001, False), (60, 1, True)):
        times = [0, 0.05, 0.1, 0.1 + step_s, 0.15 + step_s]
        text = "".join(f"{time:.3f} {step_m * (time > 0.1)} 0 0 0 0 0 1\n" for time in times)
        path = written(tmp_path, text, "path.txt")
        if jumps:
            says = rf"pose 4 of 5 \(tum\), {0.1 + step_s:.3f} s after the first, is {step_m} m from the one {step_s}"
            with pytest.warns(TraceWarning, match=f"path.txt: {says}"):
                assert read_motion(path).total == step_m / 2
        else:
            assert read_motion(path).total == step_m / 2


def test_a_car_whose_poses_come_in_bursts_does_not_jump(tmp_path: Path) -> None:
    """25 m/s at 20 Hz: 1.25 m each, of which ten are logged within 10 ms. Steps of 3 m instead are jumps."""
    times = [k // 10 / 2 + k % 10 / 1000 for k in range(60)]
    for step_m, total in ((1.25, 59 * 1.25 / 2), (3, 59 * 3 / 2)):
        text = "".join(f"{time:.3f} {step_m * k} 0 0 0 0 0 1\n" for k, time in enumerate(times))
        path = written(tmp_path, text, "car.txt")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert read_poses(path).position_m[-1, 0] / 2 == total
        assert len(caught) == (step_m == 3)


def test_poses_in_bursts_are_as_valid_as_others(tmp_path: Path) -> None:
    """Two poses 3 us apart, 40 ms to the next two, and each goes 0.02 m: 299 steps, in fields of 2 m."""
    motion = read_motion(ODD_FILES / "turn7" / "burst.txt")
    assert (motion.total, motion.duration_us) == (pytest.approx(2.99), 5_960_003)
    fast = "".join(f"{k * 3e-6:.6f} {k} 0 0 0 0 0 1\n" for k in range(300))
    refuse("median step of the times = .3e-06 s", read_motion, written(tmp_path, fast, "fast.txt"))


def test_the_command_says_a_warning_in_a_line(tmp_path: Path) -> None:
    path = written(tmp_path, "0 1\n1 1\n3601 1\n3602 1\n")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert main(["trace", "info", str(path)]) == 0
    line = (
        f"bufgym: warning: {path}, line 3: 3601 is 3600 s after the line above, where 1 s is usual: the rate is held, "
        "mean 125 KB/s (--holes zero: 0.138773 KB/s)\n"
    )
    assert warnings.formatwarning(caught[0].message, caught[0].category, caught[0].filename, caught[0].lineno) == line


def test_rates_are_held_for_a_day_at_any_rate_and_holes_are_named(tmp_path: Path) -> None:
    for bytes_per_s in (1, 12_500_000, 125_000_000_000):  # up to 10**6 Mbit/s
        trace = read_trace(written(tmp_path, f"time_s,bytes_per_s\n0,{bytes_per_s}\n86400,{bytes_per_s}\n"))
        assert trace.total_bytes == 2 * 86_400 * bytes_per_s and trace.duration_us == 2 * 86_400 * 10**6
        assert trace.rate_bytes_per_s(np.arange(0, 172_800, 977) * 10**6) == pytest.approx(bytes_per_s, rel=1e-3)
        lengths_us, counts = (np.diff(knots) for knots in (trace.time_us, trace.cumulative_bytes))
        assert all(int(a) * int(b) < 2**62 for a, b in zip(lengths_us, counts, strict=True))
    # 2**63 bytes x us, in three pieces whose ends are rounded down.
    assert Trace("t", np.array([0, 2**31]), np.array([0, 2**32])).time_us.tolist() == [0, 715827882, 1431655765, 2**31]
    scaled = Trace.constant(1e9, 1000).scaled(1e6)
    assert scaled.total_bytes == 10**18
    for step_s, hole_s, named in (
        (300, 3600, True),
        (900, 3600, True),
        (1, 61, True),
        (1, 10, False),
        (0.1, 2, False),
        (0.1, 2.1, True),
        (1800, 3600, False),
        (1800, 5400, True),
        (3600, 7200, True),
        (7200, 10_799, False),
    ):
        times = [0, step_s, 2 * step_s, 2 * step_s + hole_s, 3 * step_s + hole_s]
        path = written(tmp_path, "".join(f"{time} 0.1\n" for time in times))
        if named:
            with pytest.warns(
                TraceWarning, match=f"lte.csv, line 4: {times[3]} is {hole_s} s after the line above, where"
            ):
                read_trace(path)
        else:
            read_trace(path)


def test_an_hour_that_comes_twice_is_said(tmp_path: Path) -> None:
    """Hourly lines in autumn: daylight saving ends at 3, which is 2 again. Two lines in one second are usual."""
    lines = "".join(f"2024-10-27 0{hour}:00:00,8\n" for hour in (0, 1, 2, 2, 3))
    with pytest.warns(
        TraceWarning, match=r"line 5: 2024-10-27 02:00:00 is the time of the line above, where 3600 s is"
    ):
        assert read_trace(written(tmp_path, "time,mbps\n" + lines)).duration_us == 4 * 3600 * 10**6
    assert read_trace(written(tmp_path, "0 8\n1 8\n1 8\n2 8\n")).duration_us == 3 * 10**6


@pytest.mark.parametrize(("unit", "rate"), [("Mbps", 125_000), ("mbps", 125_000), ("kB/s", 1000), ("KBps", 1000)])
def test_b_is_a_bit_and_capital_b_a_byte(tmp_path: Path, unit: str, rate: int) -> None:
    assert read_trace(written(tmp_path, f"time,{unit}\n0,2\n1,2\n")).total_bytes == 4 * rate
    refuse(
        "unit of the rate = MBPS: b is a bit and B a byte: must be as Mbps or MBps",
        read_trace,
        written(tmp_path, "time,MBPS\n0,2\n1,2\n"),
    )


def test_a_comma_at_the_end_of_each_line_begins_no_column(tmp_path: Path) -> None:
    for text in (SAMPLES["csv"], SAMPLES["rates"], SAMPLES["nyu"], "Run 1\n0,0.5\n8,16\n"):
        plain = read_trace(written(tmp_path, text))
        ended = "\n".join(f"{line}," if "," in line else line for line in text.strip().split("\n"))
        assert read_trace(written(tmp_path, ended)) == plain
    workload = read_workload(written(tmp_path, "time_s,bytes,topic,\n0,5,a,\n1,6,b,\n"))
    assert workload.topics == ("a", "b") and workload.size_bytes.tolist() == [5, 6]


def test_the_events_of_iperf3(tmp_path: Path) -> None:
    """1 s omitted, then 125,000 and 250,000 bytes; an error of its own; a line cut off when it was killed."""

    def event(start_s: float, count: int, omitted: str = "false") -> str:
        about = f'"start": {start_s}, "end": {start_s + 1}, "bytes": {count}, "omitted": {omitted}, "sender": true'
        return '{"event": "interval", "data": {"sum": {' + about + "}}}\n"

    start, end = '{"event":"start","data":{"version":"iperf 3.17"}}\n', '{"event":"end","data":{}}\n'
    intervals = event(0, 7, "true") + event(0, 125_000) + event(1, 250_000)
    for text in (start + intervals + end, intervals, start + "\n" + intervals):
        trace = read_trace(written(tmp_path, text))
        assert trace.cumulative_bytes.tolist() == [0, 125_000, 375_000] and "measured by the sender" in trace.source
    for text, says in (
        (
            start + '{"event": "error", "data": "unable to connect"}\n',
            "error = 'unable to connect': must be a run that",
        ),
        (start + intervals + '{"event": "inter', "line 5: .*: must be JSON .*; the 4 values above are sound$"),
        (start + end, "holds no measurement"),
        ("{}\n{}\n", "must be an object with a list of intervals"),
    ):
        refuse(says, read_trace, written(tmp_path, text), kind=TraceError)


@pytest.mark.parametrize("header", ["time_s;bytes_per_s", "Zeit (s);Rate (B/s)", ""])
def test_semicolons_and_decimal_commas_are_named(tmp_path: Path, header: str) -> None:
    """What a spreadsheet saves as CSV where 1/2 is written 0,5; with a header or without."""
    path = written(tmp_path, f"{header}\n0,0;1200,5\n0,5;1300,5\n")
    line = 1 if header else 2
    fault = rf'lte.csv, line {line}: .*: has ";" between cells, as files with decimal commas have: must have "," there'
    for read_file in (read_trace, read_motion, read_workload):
        refuse(fault, read_file, path, kind=TraceError)
    refuse(fault, read_trace, path, "rates", kind=TraceError)
    # Below a header that fits, too.
    mixed = written(tmp_path, "time_s,bytes_per_s\n0.0;1200\n")
    refuse(r'line 2: 0.0;1200: has ";"', read_trace, mixed, kind=TraceError)
