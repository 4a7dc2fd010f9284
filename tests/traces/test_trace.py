"""A trace's rules and numbers, worked by hand; and written to files: exactly, or with a loss that is stated."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from link_files import written
from refusal_cases import refuse, refused

from bufgym.traces import Trace, describe, difference, read_trace, write_csv, write_mahimahi
from bufgym.utils.errors import TraceError, where

# 2 s at 1 MB/s, 1 s of nothing, 1 s at 0.3 MB/s.
STORY = Trace("story", np.array([0, 2_000_000, 3_000_000, 4_000_000]), np.array([0, 2_000_000, 2_000_000, 2_300_000]))


@pytest.mark.parametrize(("after", "rate"), [("loop", 1e6), ("hold", 3e5), ("stop", 0.0)])
def test_after_the_end(after: Any, rate: float) -> None:
    trace = Trace("story", STORY.time_us, STORY.cumulative_bytes, after)
    assert trace.rate_bytes_per_s(4_000_000) == rate
    assert trace.rate_bytes_per_s(9_000_000 if after == "loop" else 99_000_000) == rate
    # The rate at a knot is that of the segment which begins there.
    times = [0, 1_999_999, 2_000_000, 3_000_000, 3_999_999]
    assert trace.rate_bytes_per_s(times).tolist() == [1e6, 1e6, 0.0, 3e5, 3e5]


@pytest.mark.parametrize(
    ("trace", "expected"),
    [
        (STORY, (4.0, 575.0, 0.0, 1000.0, 2.0, 2.0)),
        # Three samples of 1 s and a stray one of 0.1 s without a byte, which the minimum alone leaves out.
        (Trace.steps([(1, 6e5), (0.1, 0), (1, 7e5), (1, 8e5)]), (3.1, 677.4, 600, 800, 0.1, 0.1)),
        # A packet of 1500 bytes in the first ms of every 10 ms, for 2.5 s: whole seconds count, at 150 KB/s.
        (Trace.from_intervals([1000, 9000] * 250, [1500, 0] * 250), (2.0, 150.0, 150.0, 150.0, 2.0, 2.0)),
    ],
)
def test_describe(trace: Trace, expected: tuple[float, ...]) -> None:
    keys = ("duration_s", "mean_KBps", "min_KBps", "max_KBps", "seconds_below_500KBps", "longest_run_below_500KBps_s")
    assert describe(trace) == pytest.approx(dict(zip(keys, expected, strict=True)), abs=0.05)


def test_scaling_equality_steps_and_copies() -> None:
    same = Trace("story", STORY.time_us.copy(), STORY.cumulative_bytes.copy(), source="elsewhere")
    assert same == STORY and hash(same) == hash(STORY)
    assert STORY.scaled(2) != STORY and STORY != "story"
    third = STORY.scaled(1 / 3)
    assert third.cumulative_bytes.tolist() == [0, 666_667, 666_667, 766_667]
    assert third.time_us.tolist() == STORY.time_us.tolist() and "0.333" in third.source
    trace = Trace.steps([(2.5, 1e6), (0.5, 0)])  # a knot a second and at each change
    assert trace.time_us.tolist() == [0, 1_000_000, 2_000_000, 2_500_000, 3_000_000]
    assert trace.cumulative_bytes.tolist() == [0, 1_000_000, 2_000_000, 2_500_000, 2_500_000]
    assert Trace.constant(0.5, 4).cumulative_bytes.tolist() == [0, 0, 1, 2, 2]
    given_us, given_bytes = np.array([0, 10]), np.array([0, 10])
    trace = Trace("link", given_us, given_bytes)
    given_us[1] = given_bytes[1] = 99
    for array in (trace.time_us, trace.cumulative_bytes):
        assert array.tolist() == [0, 10]
        with pytest.raises(ValueError, match="read-only"):
            array[1] = 5
    Trace("edge", [0, 2**31], [0, 2**31 - 1])  # type: ignore[arg-type]  # what integer interpolation can hold
    assert Trace.constant(0, 2, after="hold").total_bytes == Trace.constant(0, 2, after="stop").total_bytes == 0


def bad(time_us: list[Any], cumulative: list[Any]) -> Callable[[], object]:
    return lambda: Trace("bad", time_us, cumulative)  # type: ignore[arg-type]


test_broken_traces_and_arguments = refused(
    (bad([0], [0]), "1 knots: must be at least 2"),
    (bad([0, 1, 2], [0, 1]), "3 times for 2 byte counts"),
    (bad([5, 6], [0, 1]), r"first knot \(5 us, 0 bytes\): must be \(0, 0\)"),
    (bad([0, 2, 2], [0, 1, 2]), r"time_us\[2\] = 2 after 2: must increase"),
    (bad([0, 1, 2], [0, 5, 4]), r"cumulative_bytes\[2\] = 4 after 5: must not decrease"),
    (bad([0.0, float("nan")], [0, 1]), r"time_us\[1\] = nan: must be a whole number"),
    (bad([0, 1], [0, 2**63]), "below 2"),
    (bad([0, 2**62], [0, 1]), "both must be below"),
    (bad([0, 2**61], [0, 2**61]), "segment 0 carries .*: too much for one .add knots."),
    (bad([0, 1], [0, 0]), "no capacity at all"),
    (lambda: Trace("a", STORY.time_us, STORY.time_us, "again"), "after = 'again': must be one of loop"),  # type: ignore[arg-type]
    (lambda: STORY.scaled(float("nan")), "factor = nan"),
    (lambda: STORY.scaled(1e13), "would pass 2"),
    (lambda: STORY.scaled(0), "no capacity"),
    (lambda: STORY.rate_bytes_per_s(-1), "time_us = -1: must be >= 0"),
    (lambda: Trace.steps([(1, 1), (float("inf"), 1)]), "step 1 lasts inf s"),
    (lambda: Trace.constant(1, 1.1e7), "beyond 10000000 s"),
    (lambda: Trace.from_intervals([1, 0], [1, 1]), r"interval_us\[1\] = 0: must be >= 1"),
)


@given(st.lists(st.tuples(st.integers(1, 10**7), st.integers(0, 10**8)), min_size=1, max_size=30), st.floats(1e-6, 1e3))
def test_scaling_keeps_order_and_describe_keeps_its_bounds(rows: list[tuple[int, int]], factor: float) -> None:
    trace = Trace.from_intervals([r[0] for r in rows], [r[1] for r in rows], after="stop")
    scaled = trace.scaled(factor)
    assert (np.diff(scaled.cumulative_bytes) >= 0).all()
    assert abs(scaled.total_bytes - trace.total_bytes * factor) <= 0.5 + 1e-9 * trace.total_bytes * factor
    summary = describe(trace)
    assert summary["longest_run_below_500KBps_s"] <= summary["seconds_below_500KBps"] + 1e-9
    assert summary["seconds_below_500KBps"] <= summary["duration_s"] + 1e-9


def test_where_names_file_line_value_and_rule() -> None:
    message = where("lte.csv", 12, -3, "must be a whole number >= 0", field="bytes")
    assert message == "lte.csv, line 12: bytes = -3: must be a whole number >= 0"
    assert where("a", 1, "\x00", "must be text") == "a, line 1: '\\x00': must be text"
    assert len(where("a", 1, "9" * 5000, "must be short")) < 100


@pytest.mark.parametrize(
    ("trace", "text", "lost"),
    [
        # 1000 B/ms for 4 ms, then nothing for 3: the 1500 bytes of a packet are through after 1.5 and 3 ms, so at ms 2
        # and 3. 1000 bytes are left over, and ms 7 needs a packet to tell how long the trace lasts. The trace has 3500
        # bytes after 3.5 ms and 4000 after 4, the copy 3000 up to 6 ms and 4500 at 7.
        (Trace.from_intervals([4_000, 3_000], [4_000, 0]), "2\n3\n7\n", "total +500 bytes, at most 1000 bytes off"),
        (Trace.from_intervals([1_250], [1_500]), "2\n", "duration +0.75 ms"),
        # Nothing is one packet at the end.
        (Trace("silence", np.array([0, 9_000]), np.array([0, 0]), "hold"), "9\n", "total +1500 bytes"),
    ],
)
def test_mahimahi_by_hand(tmp_path: Path, trace: Trace, text: str, lost: str) -> None:
    write_mahimahi(trace, tmp_path / "link.up")
    assert (tmp_path / "link.up").read_text() == text
    assert lost in str(difference(trace, read_trace(tmp_path / "link.up")))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(stamps=st.lists(st.integers(0, 300), min_size=1, max_size=40).map(sorted).filter(lambda s: s[-1] > 0))
def test_mahimahi_gives_its_own_traces_back_exactly(tmp_path: Path, stamps: list[int]) -> None:
    trace = read_trace(written(tmp_path, "\n".join(map(str, stamps)), "link.up"))
    (tmp_path / "again").mkdir(exist_ok=True)
    for write, name in ((write_mahimahi, "again/link.up"), (write_csv, "again/link.up.csv")):
        write(trace, tmp_path / name)
        assert read_trace(tmp_path / name) == trace
        assert str(difference(trace, read_trace(tmp_path / name))) == "nothing lost"


PACKETS = st.lists(st.tuples(st.integers(1, 10**5), st.integers(0, 10**5)), min_size=1, max_size=20)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rows=PACKETS.filter(lambda rows: sum(count for _, count in rows) > 0))
def test_mahimahi_never_runs_ahead_but_at_the_end(tmp_path: Path, rows: list[tuple[int, int]]) -> None:
    """At every whole ms before the last the copy is behind by less than a packet; both last as long, to a ms."""
    trace = Trace.from_intervals(*zip(*rows, strict=True))
    write_mahimahi(trace, tmp_path / "link.up")
    copy = read_trace(tmp_path / "link.up")
    assert 0 <= copy.duration_us - trace.duration_us < 1000
    for ms in range(1, copy.duration_us // 1000):
        # In whole numbers: bytes x microseconds of the segment that holds this ms.
        k = int(np.searchsorted(trace.time_us, ms * 1000, side="left"))
        (t0, t1), (c0, c1) = trace.time_us[k - 1 : k + 1].tolist(), trace.cumulative_bytes[k - 1 : k + 1].tolist()
        expected = (c0 * (t1 - t0) + (c1 - c0) * (ms * 1000 - t0)) // ((t1 - t0) * 1500) * 1500
        assert int(np.interp(ms * 1000, copy.time_us, copy.cumulative_bytes)) == expected
    assert abs(copy.total_bytes - trace.total_bytes) <= 1500


def test_unwritable_traces(tmp_path: Path) -> None:
    for write in (write_csv, write_mahimahi):
        for path, why in ((tmp_path, "Is a directory"), (tmp_path / "nowhere" / "link", "No such file")):
            refuse(f"cannot be written: {why}", write, Trace.constant(1, 1), path, kind=TraceError)
    refuse("at most 1000000000000 bytes", write_csv, Trace.constant(2e12, 1), tmp_path / "fast.csv", kind=TraceError)
    refuse("at most 10000000 packets", write_mahimahi, Trace.constant(4.6e11, 1), tmp_path / "fast.up", kind=TraceError)
    assert list(tmp_path.iterdir()) == []
    trace = Trace.from_intervals([1, 999_999, 1_234_567, 2_000_000], [0, 10**12, 7, 0], name="odd")
    write_csv(trace, tmp_path / "odd.csv")
    assert read_trace(tmp_path / "odd.csv") == trace
