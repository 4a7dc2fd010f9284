"""Bandwidth traces from files: numbers worked by hand, broken files, and real data sets if present."""

from __future__ import annotations

import csv
import gzip
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bufgym.errors import BufgymError, TraceError
from bufgym.traces import (
    FORMATS,
    Trace,
    describe,
    detect_format,
    files,
    mahimahi,
    read_trace,
    readers,
    write_csv,
)

DATA = Path(os.environ.get("BUFGYM_SHARED_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
HEADER = "t_ms,bytes,interval_ms\n"


def written(folder: Path, text: str | bytes, name: str = "lte.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def knots(trace: Trace) -> list[tuple[int, int]]:
    return list(zip(trace.time_us.tolist(), trace.cumulative_bytes.tolist(), strict=True))


# ---------------------------------------------------------------- numbers worked by hand


def test_mahimahi_packets_cross_during_the_ms_that_ends_at_their_time(tmp_path: Path) -> None:
    trace = read_trace(written(tmp_path, "0\n2\n2\n3\n10\n", "link.up"))
    assert knots(trace) == [
        (0, 0),
        (1_000, 1_500),  # the packet of ms 0, which has no ms before it
        (2_000, 4_500),
        (3_000, 6_000),
        (9_000, 6_000),  # nothing for 6 ms
        (10_000, 7_500),
    ]
    assert trace.total_bytes == 1500 * 5
    assert trace.name == "link.up" and "mahimahi, detected" in trace.source


def test_mahimahi_single_line_is_a_steady_link(tmp_path: Path) -> None:
    # mahimahi's own README: a file of just "1" is 12 Mbit/s for ever.
    trace = read_trace(written(tmp_path, "1"))
    assert knots(trace) == [(0, 0), (1_000, 1_500)]
    assert trace.mean_bytes_per_s * 8 == 12e6


def test_mahimahi_in_small_pieces_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stamps = np.cumsum(np.random.default_rng(7).poisson(0.4, 5000))
    path = written(tmp_path, "\n".join(map(str, stamps.tolist())))
    whole = read_trace(path)
    assert whole.total_bytes == 1500 * 5000
    # The slow, obvious way: count the packets up to each ms.
    ends_us = np.arange(1, stamps[-1] + 1) * 1000
    expected = 1500 * np.searchsorted(stamps, np.arange(1, stamps[-1] + 1), side="right")
    assert np.interp(ends_us, whole.time_us, whole.cumulative_bytes).tolist() == expected.tolist()
    monkeypatch.setattr(mahimahi, "_CHUNK_BYTES", 11)
    assert read_trace(path) == whole
    monkeypatch.setattr(mahimahi, "_fast_values", lambda block, last_ms: None)
    assert read_trace(path) == whole


def test_csv_time_is_the_end_of_the_interval(tmp_path: Path) -> None:
    trace = read_trace(written(tmp_path, HEADER + "840,1000,840\n1840.5,5000,1000.5\n"))
    assert knots(trace) == [(0, 0), (840_000, 1_000), (1_840_500, 6_000)]
    assert trace.name == "lte"


def test_csv_may_begin_late(tmp_path: Path) -> None:
    assert knots(read_trace(written(tmp_path, HEADER + "9000,10,1000\n"))) == [(0, 0), (1_000_000, 10)]


def test_mbit_rate_holds_until_the_next_time_and_last_for_the_median(tmp_path: Path) -> None:
    # 8 Mbit/s is 1 MB/s: to 11 s 1 MB/s, to 13 s 2 MB/s, to 14 s none; the last for the median of 1, 2, 1 s.
    trace = read_trace(written(tmp_path, "10 8\n11\t16\n13 0\n14 4\n", "cooked"))
    assert knots(trace) == [
        (0, 0),
        (1_000_000, 1_000_000),
        (3_000_000, 5_000_000),
        (4_000_000, 5_000_000),
        (5_000_000, 5_500_000),
    ]


def test_mbit_of_lines_with_one_time_the_last_counts(tmp_path: Path) -> None:
    assert read_trace(written(tmp_path, "0 8\n0 16\n1 8\n")).cumulative_bytes.tolist() == [
        0,
        2_000_000,
        3_000_000,
    ]


def test_belgium_raw_log(tmp_path: Path) -> None:
    text = "1453112088291 710 51.04 3.72 994124 710\n1453112089290 1709 51.04 3.72 3324168 999\n"
    trace = read_trace(written(tmp_path, text, "report.log"))
    assert knots(trace) == [(0, 0), (710_000, 994_124), (1_709_000, 994_124 + 3_324_168)]


@pytest.mark.parametrize(
    ("text", "format"),
    [
        ("5\n6\n", "mahimahi"),
        (HEADER + "1,1,1\n", "csv"),
        ("0 1.5\n1 2\n", "mbit"),
        ("1 1 51 3 1 1\n", "belgium"),
    ],
)
def test_same_trace_by_any_packing(tmp_path: Path, text: str, format: str) -> None:
    plain = written(tmp_path, text)
    expected = read_trace(plain, format=format)
    assert detect_format(plain) == format
    assert f"{format}, as told" in expected.source
    dressed = {
        "gzip": gzip.compress(text.encode()),
        "Windows": text.replace("\n", "\r\n").encode(),
        "byte order mark": b"\xef\xbb\xbf" + text.encode(),
        "blank lines": ("\n" + text.replace("\n", " \n\n")).encode(),
        "no last line end": text.rstrip("\n").encode(),
    }
    for packed in dressed.values():
        assert read_trace(written(tmp_path, packed)) == expected


def test_round_trip_is_exact(tmp_path: Path) -> None:
    trace = Trace.from_intervals([1, 999_999, 1_234_567, 2_000_000], [0, 10**12, 7, 0], name="odd")
    write_csv(trace, tmp_path / "odd.csv")
    assert read_trace(tmp_path / "odd.csv") == trace


def test_unwritable_traces(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match="cannot be written"):
        write_csv(Trace.constant(1, 1), tmp_path)
    with pytest.raises(TraceError, match="at most 1000000000000 bytes"):
        write_csv(Trace.constant(2e12, 1), tmp_path / "fast.csv")


# ---------------------------------------------------------------- broken files

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
    (HEADER + "1e3,1,1\n", "line 2: t_ms = 1e3: must be a number of ms"),
    (HEADER + "10000000001,1,1\n", "line 2: t_ms = 10000000001: must be at most 10000000 s"),
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
    monkeypatch.setattr(files, "MAX_TEXT_BYTES", 30)
    with pytest.raises(TraceError, match="more than 30 bytes of text"):
        read_trace(written(tmp_path, gzip.compress(text.encode())))


def test_format_must_be_said_where_two_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, "1\n2\n")
    seconds = readers.Format("one number, s", lambda text: text.isdigit(), FORMATS["mahimahi"].read)
    monkeypatch.setitem(FORMATS, "seconds", seconds)
    with pytest.raises(TraceError, match=r"fits more than one format \(mahimahi, seconds\): say which with format="):
        read_trace(path)
    assert read_trace(path, format="mahimahi").total_bytes == 3000


def test_unknown_format_and_ending(tmp_path: Path) -> None:
    path = written(tmp_path, "1\n2\n")
    with pytest.raises(BufgymError, match="format = 'pcap': must be one of mahimahi, csv, mbit, belgium"):
        read_trace(path, format="pcap")
    with pytest.raises(BufgymError, match="after = 'again'"):
        read_trace(path, after="again")  # type: ignore[arg-type]


CELLS = st.one_of(
    st.integers(-5, 10**14).map(str),
    st.floats(allow_nan=True).map(str),
    st.sampled_from(["", "-0", "1e999", "٣", "+"]),
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    lines=st.lists(st.lists(CELLS, min_size=1, max_size=7), max_size=6),
    separator=st.sampled_from([" ", ",", "\t"]),
    format=st.sampled_from([None, *FORMATS]),
    header=st.booleans(),
)
def test_any_text_is_a_sound_trace_or_a_clear_error(
    tmp_path: Path, lines: list[list[str]], separator: str, format: str | None, header: bool
) -> None:
    text = (HEADER if header else "") + "\n".join(separator.join(cells) for cells in lines)
    try:
        trace = read_trace(written(tmp_path, text), format=format)
    except TraceError as error:
        assert "lte.csv" in str(error)
    else:
        assert trace.total_bytes > 0


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=60), format=st.sampled_from([None, *FORMATS]), magic=st.booleans())
def test_any_bytes_end_well(tmp_path: Path, data: bytes, format: str | None, magic: bool) -> None:
    try:
        read_trace(written(tmp_path, (b"\x1f\x8b" if magic else b"") + data), format=format)
    except TraceError as error:
        assert "lte.csv" in str(error)


# ---------------------------------------------------------------- real data sets

SETS = {
    "belgium_4g": ("belgium_4g/csv/*.csv", "csv"),
    "belgium_4g raw": ("belgium_4g/raw/*.log", "belgium"),
    "mahimahi": ("mahimahi/*.gz", "mahimahi"),
    "norway_hsdpa": ("norway_hsdpa/cooked/*", "mbit"),
    "lumos5g_4G": ("lumos5g/4G/*", "mbit"),
    "solis_wifi": ("solis_wifi/*.txt", "mbit"),
}
# The table gives one decimal, so half a tenth and a little for its rounding of exact ties.
ROUNDING = 0.051
# Where the table goes by a rule of its own, how far it may be off: min and max, mean (both relative), s.
#   mahimahi: its seconds run from ms 0 to 999, ours end with the packets of ms 1000.
#   solis_wifi: it takes each line as 1 s, we go by the times in the file, which jitter.
LOOSER = {"mahimahi": (0.01, 1e-3, 1.0), "solis_wifi": (0.01, 4e-3, 0.6)}
# Two Solis files whose only zeros are lines with the same time as the next one.
LEAST_WITHOUT_LINES_OF_NO_LENGTH = {"wifi_cafe_231115-154511": 45.0, "wifi_restr_231115-134450": 42.5}


def table() -> dict[tuple[str, str], dict[str, float]]:
    with open(DATA / "STATS.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        (row["set"], row["trace"]): {k: float(v) for k, v in row.items() if k not in ("set", "trace")} for row in rows
    }


@pytest.mark.skipif(not (DATA / "STATS.csv").is_file(), reason=f"no real data sets under {DATA}")
@pytest.mark.parametrize("name", SETS)
def test_real_traces_agree_with_the_table(name: str) -> None:
    pattern, format = SETS[name]
    data_set = name.removesuffix(" raw")
    rate, mean, seconds = LOOSER.get(data_set, (0.0, 0.0, 0.0))
    expected, paths = table(), sorted(DATA.glob(pattern))
    assert paths
    for path in paths:
        trace = read_trace(path)
        assert f"format {format}, detected" in trace.source
        found, row = describe(trace), expected[data_set, trace.name]
        for key, value in row.items():
            relative = mean if key == "mean_KBps" else rate if key.endswith("KBps") and key[0] == "m" else 0.0
            absolute = ROUNDING + (0.0 if relative else seconds)
            if key == "min_KBps":
                value = LEAST_WITHOUT_LINES_OF_NO_LENGTH.get(trace.name, value)
            assert found[key] == pytest.approx(value, rel=relative, abs=absolute), (trace.name, key)


@pytest.mark.skipif(not (DATA / "mahimahi").is_dir(), reason=f"no mahimahi traces under {DATA}")
def test_mahimahi_by_the_tables_own_seconds() -> None:
    """In windows that end before the packets of ms 1000, 2000, .. the table's numbers come out exactly."""
    expected = table()
    for path in sorted((DATA / "mahimahi").glob("*.gz")):
        trace = read_trace(path)
        assert trace.total_bytes == 1500 * len(gzip.decompress(path.read_bytes()).split())
        edges_us = np.arange(0, trace.duration_us + 1, 1_000_000) - 1000
        edges_us[0] = 0
        rates = np.diff(np.interp(edges_us, trace.time_us, trace.cumulative_bytes)) / 1e3
        row = expected["mahimahi", trace.name]
        assert rates.min() == pytest.approx(row["min_KBps"], abs=ROUNDING)
        assert rates.max() == pytest.approx(row["max_KBps"], abs=ROUNDING)
        assert (rates < 500).sum() == row["seconds_below_500KBps"]


@pytest.mark.skipif(not (DATA / "belgium_4g").is_dir(), reason=f"no Belgium traces under {DATA}")
def test_belgium_csv_and_raw_log_are_one_trace() -> None:
    for raw in sorted((DATA / "belgium_4g" / "raw").glob("*.log")):
        assert read_trace(raw) == read_trace(DATA / "belgium_4g" / "csv" / f"{raw.stem}.csv")


@pytest.mark.skipif(not (DATA / "belgium_4g").is_dir(), reason=f"no Belgium traces under {DATA}")
def test_car_0002_fades_in_its_seconds_21_and_23() -> None:
    """The trace of the AFR paper's evaluation (490.2 and 222.3 KB/s, by the README of the data)."""
    _, rates = read_trace(DATA / "belgium_4g" / "csv" / "report_car_0002.csv").segments()
    low = np.flatnonzero(rates < 500_000)
    assert low.tolist() == [21, 23, 73, 82, 128, 157, 294, 296, 395]
    assert (rates[[21, 23]] / 1e3).round(1).tolist() == [490.2, 222.3]
