"""Broken bandwidth traces: each error names the file, the line, the value and the rule; limits hold."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import numpy as np
import pytest
from link_files import HEADER, UCC_HEADER, knots, written

from bufgym.errors import BufgymError, TraceError
from bufgym.traces import FORMATS, read_trace
from bufgym.traces.formats import links, mahimahi
from bufgym.traces.formats import text as text_files

NUTTCP = "nuttcp-t: v8.1.4: socket\n"

BROKEN = [
    # Mahimahi: a lone bad line among good ones, which the fast way has to give up on.
    ("1\n2\nx\n4\n", "line 3: time in ms = x: must be a whole number >= 0"),
    ("1\n2\n-3\n", "line 3: time in ms = -3: must be a whole number >= 0"),
    ("1\n\n5\n4\n", r"line 4: time in ms = 4: must not be before the line above \(5\)"),
    ("1\n2.5\n", "line 2: time in ms = 2.5: must be a whole number"),
    ("1\n99999999999\n", "line 2: time in ms = 99999999999: must be at most 10000000000"),
    ("1\n2 3\n", "line 2: '2 3': must have 1 columns, has 2"),
    ("0\n0\n", "line 2: time in ms = 0: the last time must be after ms 0"),
    ("1\n" + "2" * 5000, "line 2: 2222.*: must be at most 4096 characters"),
    (b"1\n\xff\xfe\n", "line 2: .*must be UTF-8 text"),
    # CSV
    (HEADER, "holds no measurement"),
    (HEADER + "1000,-3,1000\n", "line 2: bytes = -3: must be a whole number >= 0"),
    (HEADER + "1000,nan,1000\n", "line 2: bytes = nan: must be a whole number"),
    (HEADER + "1000,1_000,1000\n", "line 2: bytes = 1_000: must be a whole number"),
    (HEADER + "1000,1000000000001,1000\n", "line 2: bytes = 1000000000001: must be at most 1000000000000"),
    (
        HEADER + "1000,1,1000\n3000,1,1000\n",
        "line 3: start in ms = 2000: must begin where the line above ended",
    ),
    (HEADER + "1000,1,1000\n500,1,500\n", "line 3: start in ms = 0: must begin where"),
    (HEADER + "1000,1,0\n", "line 2: interval in ms = 0: must be above 0"),
    (HEADER + "1000,1,2000\n", "line 2: interval in ms = 2000: must not begin before time 0"),
    (HEADER + "1000,1\n", "line 2: 1000,1: must have 3 columns, has 2"),
    (HEADER + "1e3,1,1\n", "line 2: time in ms = 1e3: must be a number of ms"),
    (HEADER + "10000000001,1,1\n", "line 2: time in ms = 10000000001: must be at most 10000000 s"),
    (HEADER + "9000000,1000000000000,9000000\n", r"line 2: bytes x microseconds .*: must be below 2\*\*62"),
    (HEADER + "1000,0,1000\n", "no capacity at all"),
    ("t,bytes\n1,2\n", "line 1: t,bytes: must fit a known format"),
    # Mbit/s
    ("0 1\n1 nan\n", "line 2: Mbit/s = nan: must be a finite number"),
    ("0 1\n1 inf\n", "line 2: Mbit/s = inf: must be a finite number"),
    ("0 1\n1 -2\n", r"line 2: Mbit/s = -2: must be from 0 to 1e\+06"),
    ("0 1\n2 1\n1 1\n", r"line 3: time in s = 1: must not be before the line above \(2\)"),
    ("0 1\n1e8 1\n", r"line 2: time in s = 1e8: must be from 0 to 1e\+07"),
    ("0 1e6\n100 1\n", "line 1: bytes = 12500000000000: must be at most 1000000000000"),
    ("0 1\n", "line 1: '0 1': must have a second line"),
    ("0 1\n1 2 3\n", "line 2: '1 2 3': must have 2 columns"),
    # Belgium
    ("1 1 51 3 1 1\n2 2 91 3 1 1\n", "line 2: latitude = 91: must be from -90 to 90"),
    ("1 1 51 3 1 1\n2 2 51 3 1.5 1\n", "line 2: bytes = 1.5: must be a whole number"),
    ("1 1 51 3 1 1\n2 2 51 3 1 1 7\n", "line 2: .*must have 6 columns, has 7"),
    # Rates under a header
    ("time_s,bytes_per_s\n", "is empty: must hold a line for each sample"),
    ("time_s,bytes_per_s\n0,1\n", "line 2: 0,1: must have a second line"),
    ("time_s,bytes_per_s\n0,1\n1,-1\n", "line 3: bytes_per_s = -1: must be from 0 to"),
    ("time_s,bytes_per_s\n0,1\n1,2e11\n", "line 3: bytes_per_s = 2e11: must be from 0 to"),
    ("time_s,bytes_per_s\n0,1\n86401,1\n", "line 3: time in s = 86401: must be at most 86400 s after the line above"),
    # UCC
    (UCC_HEADER, "holds no measurement"),
    (UCC_HEADER + "2019.12.16_13.40.04,0,-,20,D\n", "line 2: DL_bitrate = -: must be a finite number"),
    (UCC_HEADER + "2019.12.16_13.40.04,0,2e9,20,D\n", "line 2: DL_bitrate = 2e9: must be from 0 to"),
    (UCC_HEADER + "2019.13.16_13.40.04,0,1,20,D\n", "line 2: Timestamp = 2019.13.16_13.40.04: must be a time"),
    (UCC_HEADER + "2019.12.16_13.40.04,0,1\n", "line 2: .*: must have 5 columns, has 3"),
    (
        UCC_HEADER + "2019.12.16_13.40.04,0,1,1,D\n2019.12.16_13.40.10,0,1,1,D\n",
        "line 3: Timestamp = 2019.12.16_13.40.10: must be at most 5 s after the line above",
    ),
    # NYU-METS
    ("1,Mbits/sec\n1,MBytes/sec\n", "line 2: unit = MBytes/sec: must be one of bits/sec, Kbits/sec"),
    ("1,Mbits/sec\nx,Mbits/sec\n", "line 2: Mbits/sec = x: must be a finite number"),
    ("1,Mbits/sec\n1e4,Gbits/sec\n", r"line 2: Gbits/sec = 1e4: must be from 0 to 1000"),
    ("1,Mbits/sec\n1\n", "line 2: 1: must have 2 columns, has 1"),
    # Sabre
    ("[", r"line 1: .*: must be JSON"),
    ("[3", "line 1: 3: must be an object"),
    ('[{"duration_ms": 1, "bandwidth_kbps": 1}', "line 1: must be ',', for a list"),
    ("[]", "holds no measurement"),
    ("[\n3]", "line 2: 3: must be an object with duration_ms"),
    ("[\n{}]", "line 2: {}: must hold duration_ms"),
    ('[\n{"duration_ms": true}]', "line 2: .*true.*: duration_ms must be a number"),
    ('[{"duration_ms": ' + "[" * 900 + "]" * 900 + "}]", "line 1: .*(must be JSON|duration_ms must be a number)"),
    ('[{"duration_ms": 1, "bandwidth_kbps": 1}\n{}]', r"line 2: {}]: must be ',', for a list of objects"),
    ('[{"duration_ms": 1, "bandwidth_kbps": 1}]\n5', "line 2: 5: must be nothing after the list"),
    ('[{"duration_ms": 0, "bandwidth_kbps": 1}]', "line 1: duration_ms = 0: must be above 0"),
    ('[\n\n{"duration_ms": 1, "bandwidth_kbps": -1}]', "line 3: bandwidth_kbps = -1: must be from 0"),
    ('[{"duration_ms": 1, "bandwidth_kbps": 1e999}]', "line 1: bandwidth_kbps = inf: must be from 0"),
    ('[{"duration_ms": NaN}]', "line 1: must be JSON .NaN is not a finite number"),
    ('[{"duration_ms": ' + "9" * 5000 + "}]", "line 1: must be JSON .Exceeds the limit"),
    ("[" * 100_000, "line 1: must be JSON .nested too deep"),
    ('[\n{"duration_ms": 1,}]', "line 2: .*: must be JSON"),
    (b'[\n{"\xff": 1}]', "line 2: .*: must be UTF-8 text"),
    # nuttcp
    ("nuttcp-t: v8.1.4: error from server\n", "line 1: .*error from server.*: must be a run that succeeded"),
    ("nuttcp-t: v8.1.4: socket\n", "holds no measurement"),
    (NUTTCP + "1.0000 MB / 1.00 sec = 83.886 Mbps\n", "line 2: Mbps = 83.886: must be MB / sec, 8.389"),
    (NUTTCP + "1.0000 MB / 0.00 sec = 8.3886 Mbps\n", "line 2: sec = 0.00: must be from 0.01 to 3600"),
    (NUTTCP + "1.0.0 MB / 1.00 sec = 8.3886 Mbps\n", "line 2: MB = 1.0.0: must be a finite number"),
    (NUTTCP + "1e300 MB / 1.00 sec = 8.3886 Mbps\n", "line 2: .*: must be an interval, MB / sec = Mbps, or a remark"),
    (NUTTCP + "9999999.0 MB / 1.00 sec = 8.3886 Mbps\n", "line 2: MB = 9999999.0: must be from 0 to 953674"),
    (NUTTCP + "hello\n", "line 2: hello: must be an interval"),
    # iperf3
    ("{}", "must be an object with a list of intervals"),
    ('{"intervals": []}', "holds no measurement"),
    ('{"intervals": [], "error": "unable to connect"}', "error = 'unable to connect': must be a run that succeeded"),
    ('{"intervals": [3]}', "line 1: 3: must hold sum, an object"),
    ('{"intervals": [\n{"sum": {"start": 0, "end": 1}}]}', "line 2: .*: must hold bytes, a whole number"),
    ('{"intervals": [{"sum": {"start": 0, "end": 1, "bytes": 1.5}}]}', "line 1: 1.5: must hold bytes, a whole number"),
    ('{"intervals": [{"sum": {"start": 0, "end": 1, "bytes": -5}}]}', "line 1: bytes = -5: must be at least 0"),
    ('{"intervals": [{"sum": {"start": 0, "end": true, "bytes": 5}}]}', "line 1: True: must hold end, a number"),
    ('{"intervals": [{"sum": {"start": 0, "end": 0, "bytes": 5}}]}', "line 1: end = 0.*: must be after its start"),
    ('{"intervals": [{"sum": {"start": 0, "end": 1e9, "bytes": 5}}]}', "line 1: end = 1000000000.0: must be from 0 to"),
    ('{"intervals": [{"sum": {"start": NaN, "end": 1, "bytes": 5}}]}', "line 1: (start = nan: must be|must be JSON)"),
    (
        '{"intervals": [{"sum": {"start": 0, "end": 1, "bytes": 5}},\n{"sum": {"start": 2, "end": 3, "bytes": 5}}]}',
        "line 2: start = 2.0: must begin where the interval above ended",
    ),
    ('{"intervals": [}', "line 1: .*: must be JSON"),
    # Lists of runs
    ("####\n", "has no run 1: must be one of none"),
    ("Run 2\n1,2\n", "has no run 1: must be one of run 2"),
    ("Run 1\n", "run 1 must have a line of Mbit/s"),
    ("Run 1\n1,2\nRun 1\n1,2\n", "line 3: Run = 1: must be from 1 to 16, and no run's above"),
    ("Run 17\n1,2\n", "line 1: Run = 17: must be from 1 to 16"),
    ("####\n1,2\n", "line 2: 1,2: must come under a heading, Run 1"),
    ("Run 1\n1,x\n", "line 2: Mbit/s = x: must be a finite number"),
    ("Run 1\n1,-1\n", "line 2: Mbit/s = -1: must be from 0"),
    ("Run 1\n1\n", "line 2: 1: must have a second line"),
    ("Run 1\n0,1\n5,5,5\n", "line 3: samples = 3: must be as many as times in the line above .2."),
    ("Run 1\n0,1\n5,5\n3,4\n", "line 4: run 1 must have one line, or pairs of them"),
    ("Run 1\n1,0\n5,5\n", "line 3: time in s = 0: must not be before the line above"),
    # None of them
    ("", "is empty"),
    ("\n \n", "is empty"),
    ("hello\n", "line 1: hello: must fit a known format"),
    ("1 2 3\n", "line 1: '1 2 3': must fit a known format"),
    (b"\x00\x01", "line 1: .*must fit a known format"),
    (b"\x80\x81\n", "line 1: .*must be UTF-8 text"),
    ("7" * 5000, "line 1: 777.*: must be at most 4096 characters"),
]


@pytest.mark.parametrize(("text", "says"), BROKEN)
def test_broken_files(tmp_path: Path, text: str | bytes, says: str) -> None:
    with pytest.raises(TraceError, match=says) as caught:
        read_trace(written(tmp_path, text))
    assert "lte.csv" in str(caught.value) and len(str(caught.value)) < 500


def test_the_line_number_is_right_far_into_a_long_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mahimahi, "_CHUNK_BYTES", 1000)
    lines = [str(k) for k in range(5000)]
    lines[4321] = "4l"
    with pytest.raises(TraceError, match="line 4322: time in ms = 4l"):
        read_trace(written(tmp_path, "\n".join(lines)))


def test_what_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match=r"nothing\.csv: no such file"):
        read_trace(tmp_path / "nothing.csv")
    with pytest.raises(TraceError, match="is a directory"):
        read_trace(tmp_path, format="mahimahi")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(TraceError, match="must be a regular file"):
        read_trace(tmp_path / "pipe")


@pytest.mark.parametrize("text", ["\n".join(map(str, range(3000))), HEADER + "1000,1,1000\n" * 999])
def test_damaged_gzip(tmp_path: Path, text: str) -> None:
    packed = gzip.compress(text.encode())
    with pytest.raises(TraceError, match=r"lte.csv, line \d+: gzip data damaged or cut off"):
        read_trace(written(tmp_path, packed[:-9]), format="mahimahi")
    with pytest.raises(TraceError, match=r"lte.csv, line \d+: gzip data damaged or cut off"):
        read_trace(written(tmp_path, packed[:5]))


@pytest.mark.parametrize("text", ["1\n" * 500, HEADER + "1,1,1\n" + "2,1,1\n" * 90])
def test_reading_stops_where_the_text_gets_too_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr(text_files, "MAX_TEXT_BYTES", 30)
    with pytest.raises(TraceError, match="more than 30 bytes of text"):
        read_trace(written(tmp_path, gzip.compress(text.encode())))


@pytest.mark.parametrize(("text", "count"), [(HEADER + "1,1,1\n2,1,1\n3,1,1\n", 3), ("\n" * 40, 30)])
def test_reading_stops_after_so_many_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, count: int
) -> None:
    monkeypatch.setattr(text_files, "MAX_LINES", count)
    with pytest.raises(TraceError, match=f"line {count + 1}: more than {count} .*must be fewer"):
        read_trace(written(tmp_path, text))


def test_mahimahi_has_no_limit_of_bare_lines_but_one_of_odd_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mahimahi, "MAX_LINES", 50)
    monkeypatch.setattr(mahimahi, "_CHUNK_BYTES", 64)
    assert read_trace(written(tmp_path, "7\n" * 100)).total_bytes == 150_000
    assert read_trace(written(tmp_path, "7\r\n" * 100)).total_bytes == 150_000
    with pytest.raises(
        TraceError, match=r"line \d+: more than 50 lines so far in blocks that are not all bare numbers"
    ):
        read_trace(written(tmp_path, "7\n" + "\n" * 200))


def test_json_longer_than_its_limit(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match="more than 16777216 bytes of JSON"):
        read_trace(written(tmp_path, gzip.compress(b"[" + b" " * 2**24)))


def test_long_mahimahi_traces_are_taken_in_longer_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Knots at 1 ms: 0, 1, 2, 3, 9, 10, 11, 14, 15; in cells of 2 ms (0, 2], (2, 4], .. one knot less than 8.
    path = written(tmp_path, "0\n2\n2\n3\n10\n11\n15\n")
    assert read_trace(path).time_us.tolist() == [ms * 1000 for ms in (0, 1, 2, 3, 9, 10, 11, 14, 15)]
    monkeypatch.setattr(mahimahi, "MAX_KNOTS", 8)
    trace = read_trace(path)
    assert knots(trace) == [
        (0, 0),
        (2_000, 4_500),
        (4_000, 6_000),
        (8_000, 6_000),
        (10_000, 7_500),
        (12_000, 9_000),
        (14_000, 9_000),
        (15_000, 10_500),  # the last cell ends with the last packet
    ]
    assert trace.source.endswith("a knot every 2 ms)")


@pytest.mark.parametrize("rate", [0.05, 0.4, 3.0])
@pytest.mark.parametrize("most", [40, 300, 2500])
def test_longer_cells_keep_the_count_at_each_of_their_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate: float, most: int
) -> None:
    stamps = np.cumsum(np.random.default_rng(most).poisson(1 / rate, 4000))
    path = written(tmp_path, "\n".join(map(str, stamps.tolist())))
    monkeypatch.setattr(mahimahi, "MAX_KNOTS", most)
    monkeypatch.setattr(mahimahi, "_CHUNK_BYTES", 1000)
    trace = read_trace(path)
    assert trace.time_us.size <= most
    assert trace.total_bytes == 1500 * 4000 and trace.duration_us == stamps[-1] * 1000
    expected = 1500 * np.searchsorted(stamps, trace.time_us // 1000, side="right")
    assert trace.cumulative_bytes[1:].tolist() == expected[1:].tolist()
    monkeypatch.setattr(mahimahi, "_CHUNK_BYTES", 10**6)
    assert np.array_equal(read_trace(path).time_us, trace.time_us)


def test_format_must_be_said_where_two_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, "1\n2\n")
    seconds = links.Format("one number, s", lambda text: text.isdigit(), FORMATS["mahimahi"].read)
    monkeypatch.setitem(FORMATS, "seconds", seconds)
    with pytest.raises(TraceError, match=r"fits more than one format \(mahimahi, seconds\): say which with format="):
        read_trace(path)
    assert read_trace(path, format="mahimahi").total_bytes == 3000


def test_unknown_format_and_ending(tmp_path: Path) -> None:
    path = written(tmp_path, "1\n2\n")
    with pytest.raises(
        BufgymError, match="format = 'pcap': must be one of mahimahi, csv, mbit, belgium, rates, ucc, nyu, sabre"
    ):
        read_trace(path, format="pcap")
    with pytest.raises(BufgymError, match="after = 'again'"):
        read_trace(path, after="again")  # type: ignore[arg-type]
