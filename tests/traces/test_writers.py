"""Traces written and read back: exactly where the format can hold them, else with a loss that is stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from link_files import written

from bufgym.errors import TraceError
from bufgym.traces import Trace, difference, read_trace, write_csv, write_mahimahi
from bufgym.traces.formats import writers


def test_csv_is_exact(tmp_path: Path) -> None:
    trace = Trace.from_intervals([1, 999_999, 1_234_567, 2_000_000], [0, 10**12, 7, 0], name="odd")
    write_csv(trace, tmp_path / "odd.csv")
    assert read_trace(tmp_path / "odd.csv") == trace


@pytest.mark.parametrize(
    ("trace", "text", "lost"),
    [
        # 1000 B/ms for 4 ms, then nothing for 3: the 1500 bytes of a packet are through after 1.5 and 3 ms, so at ms 2
        # and 3. 1000 bytes are left over, and ms 7 needs a packet to tell how long the trace lasts. The trace has 3500
        # bytes after 3.5 ms and 4000 after 4, the copy 3000 up to 6 ms and 4500 at 7.
        (
            Trace.from_intervals([4_000, 3_000], [4_000, 0]),
            "2\n3\n7\n",
            "total +500 bytes, at most 1000 bytes off at any",
        ),
        (Trace.from_intervals([1_250], [1_500]), "2\n", "duration +0.75 ms"),
        # Nothing is one packet at the end.
        (Trace("silence", np.array([0, 9_000]), np.array([0, 0]), "hold"), "9\n", "total +1500 bytes"),
        (Trace("silence", np.array([0, 9_000]), np.array([0, 0]), "stop"), "9\n", "total +1500 bytes"),
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


ROWS = st.lists(st.tuples(st.integers(1, 10**5), st.integers(0, 10**5)), min_size=1, max_size=20)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rows=ROWS.filter(lambda rows: sum(count for _, count in rows) > 0))
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


def test_many_packets_are_written_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trace = read_trace(written(tmp_path, "\n".join(str(k // 3) for k in range(3, 400)), "link.up"))
    write_mahimahi(trace, tmp_path / "whole")
    monkeypatch.setattr(writers, "_CHUNK_PACKETS", 7)
    write_mahimahi(trace, tmp_path / "pieces")
    assert (tmp_path / "pieces").read_bytes() == (tmp_path / "whole").read_bytes()


def test_unwritable_traces(tmp_path: Path) -> None:
    for write in (write_csv, write_mahimahi):
        for path, why in ((tmp_path, "Is a directory"), (tmp_path / "nowhere" / "link", "No such file")):
            with pytest.raises(TraceError, match=f"cannot be written: {why}"):
                write(Trace.constant(1, 1), path)
    with pytest.raises(TraceError, match="at most 1000000000000 bytes"):
        write_csv(Trace.constant(2e12, 1), tmp_path / "fast.csv")
    with pytest.raises(TraceError, match="at most 300000000 packets"):
        write_mahimahi(Trace.constant(4.6e11, 1), tmp_path / "fast.up")
    assert list(tmp_path.iterdir()) == []
