"""Broken bandwidth traces: each error names the file, the line, the value and the rule; limits hold."""

import csv
import gzip
import os
from pathlib import Path

import numpy as np
import pytest
from link_files import HEADER, UCC_HEADER, written
from refusal_cases import refuse

from bufgym.ground.errors import TraceError
from bufgym.traces import FORMATS, Trace, describe, read_trace
from bufgym.traces.datasets.unpack import unpack
from bufgym.traces.formats import links, mahimahi
from bufgym.traces.formats import text as text_files

DAY = "2019.12.16_13.40"
NUTTCP = "nuttcp-t: v8.1.4: socket\n"


def summed(rest: str) -> str:
    """An iperf3 log whose interval goes on with this after its start."""
    return '{"intervals": [{"sum": {"start": ' + rest + "}}]}"


BROKEN = [
    # Mahimahi: a lone bad line among good ones, which the fast way has to give up on.
    (b"PK\x03\x04", "is a zip archive: must be unpacked first"),
    ("1\n2\nx\n4\n", "line 3: time in ms = x: must be a whole number >= 0"),
    ("1\n\n5\n4\n", r"line 4: time in ms = 4: must not be before the line above \(5\)"),
    ("1\n99999999999\n", "line 2: time in ms = 99999999999: must be at most 10000000000"),
    ("1\n2 3\n", "line 2: '2 3': must have 1 columns, has 2"),
    ("0\n0\n", ": time in ms = 0: the last time must be after ms 0"),
    ("1\n" + "2" * 5000, "line 2: 2222.*: must be at most 4096 characters"),
    (b"1\n\xff\xfe\n", "line 2: .*must be UTF-8 text"),
    (HEADER, "holds no measurement"),
    (HEADER + "1000,1_000,1000\n", "line 2: bytes = 1_000: must be a whole number"),
    (HEADER + "1000,1000000000001,1000\n", "line 2: bytes = 1000000000001: must be at most 1000000000000"),
    (HEADER + "1000,1,1000\n3000,1,1000\n", "line 3: start in ms = 2000: must begin where the line above ended"),
    (HEADER + "1000,1,0\n", "line 2: interval in ms = 0: must be above 0"),
    (HEADER + "1000,0,1000\n", "no capacity at all"),
    ("t,bytes\n1,2\n", "line 1: t,bytes: must fit a known format"),
    ("0 1\n1 nan\n", "line 2: Mbit/s = nan: must be a finite number"),
    ("0 1\n1 -2\n", r"line 2: Mbit/s = -2: must be from 0 to 1e\+06"),
    ("time_s,bytes_per_s\n", "is empty: must hold a line for each sample"),
    (UCC_HEADER + "2019.13.16_13.40.04,0,1,20,D\n", "line 2: Timestamp = 2019.13.16_13.40.04: must be a time"),
    (UCC_HEADER + f"{DAY}.04,0,1,1,D\n{DAY}.10,0,1,1,D\n", f"line 3: Timestamp = {DAY}.10: must be at most 5 s after"),
    ("1,Mbits/sec\n1,MBytes/sec\n", "line 2: unit = MBytes/sec: must be one of bits/sec, Kbits/sec"),
    ("[", "line 1: must be JSON"),
    ('[{"duration_ms": 1, "bandwidth_kbps": 1}', r"line 1: must be JSON \(Expecting ',' delimiter"),
    ('[\n{"duration_ms": true}]', "lte.csv, item 1: True: must hold duration_ms, a number"),
    ('[{"duration_ms": 0, "bandwidth_kbps": 1}]', "item 1: duration_ms = 0: must be above 0"),
    ('[{"duration_ms": NaN}]', ": must be JSON .NaN: numbers must be finite"),
    ("[" * 100_000, ": must be JSON .nested too deep"),
    ("nuttcp-t: v8.1.4: error from server\n", "line 1: .*error from server.*: must be a run that succeeded"),
    (NUTTCP + "1e300 MB / 1.00 sec = 8.3886 Mbps\n", "line 2: .*: must be an interval, MB / sec = Mbps, or a remark"),
    ('{"intervals": [], "error": "unable to connect"}', "error = 'unable to connect': must be a run that succeeded"),
    ('{"intervals": [3]}', "item 1: 3: must hold sum, an object"),
    ('{"intervals": [\n{"sum": {"start": 0, "end": 1}}]}', "item 1: .*: must hold bytes, a number"),
    (summed('0, "end": 1, "bytes": -5'), "item 1: bytes = -5: must be from 0"),
    (summed('0, "end": 0, "bytes": 5'), "item 1: end = 0.*: must be after its start"),
    (summed('0, "end": 1, "bytes": 5}},\n{"sum": {"start": 2, "end": 3, "bytes": 5'), "item 2: start = 2.0: must"),
    ("####\n", "has no run 1: must be one of none"),
    ("Run 1\n1,2\nRun 1\n1,2\n", "line 3: Run = 1: must be from 1 to 16, and no run's above"),
    ("####\n1,2\n", "line 2: 1,2: must come under a heading, Run 1"),
    ("Run 1\n0,1\n5,5,5\n", "line 3: samples = 3: must be as many as times in the line above .2."),
    ("Run 1\n0,1\n5,5\n3,4\n", "line 4: run 1 must have one line, or pairs of them"),
    ("", "is empty"),
]


@pytest.mark.parametrize(("text", "says"), BROKEN)
def test_broken_files(tmp_path: Path, text: str | bytes, says: str) -> None:
    with pytest.raises(TraceError, match=says) as caught:
        read_trace(written(tmp_path, text))
    assert "lte.csv" in str(caught.value) and len(str(caught.value)) < 500


def test_damaged_gzip(tmp_path: Path) -> None:
    for text in ("\n".join(map(str, range(3000))), HEADER + "1000,1,1000\n" * 999):
        packed = gzip.compress(text.encode())
        for broken, format in ((packed[:-9], "mahimahi"), (packed[:5], None)):
            with pytest.raises(TraceError, match=r"lte.csv, line \d+: gzip data damaged or cut off"):
                read_trace(written(tmp_path, broken), format=format)


LIMITS = [
    (text_files, "MAX_TEXT_BYTES", 30, "1\n" * 500, "more than 30 bytes of text"),
    (text_files, "MAX_LINES", 3, HEADER + "1,1,1\n2,1,1\n3,1,1\n", "line 4: more than 3 .*must be fewer"),
    (text_files, "MAX_LINES", 30, "\n" * 40, "line 31: more than 30 .*must be fewer"),
    (mahimahi, "MAX_BYTES", 9, "1\n2\n2\n3\n4\n", ": more than 9 bytes: must be at most"),
    (text_files, "MAX_LINES", 10**8, "[" + " " * 2**24, "more than 16777216 bytes: must"),
]


def test_reading_stops_at_each_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module, limit, value, text, says in LIMITS:
        with monkeypatch.context() as patch, pytest.raises(TraceError, match=says):
            patch.setattr(module, limit, value)
            read_trace(written(tmp_path, gzip.compress(text.encode())))


def test_a_format_must_be_known_and_said_where_two_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, "1\n2\n")
    seconds = links.Format("one number, s", lambda text: text.isdigit(), FORMATS["mahimahi"].read)
    monkeypatch.setitem(FORMATS, "seconds", seconds)
    os.mkfifo(tmp_path / "pipe")
    for source, format, says in (
        (path, "pcap", "format = 'pcap': must be one of mahimahi, csv, mbit, belgium, rates, ucc"),
        (path, None, r"fits more than one format \(mahimahi, seconds\): say which with format="),
        (tmp_path / "nothing.csv", "csv", r"nothing\.csv: no such file"),
        (tmp_path, "csv", "is a directory"),
        (tmp_path / "pipe", "csv", "must be a regular file"),
    ):
        refuse(says, read_trace, source, format=format)


# Every recorded link agrees with STATS.csv of the recorded data: duration, mean, seconds under 500 KB/s, and the rest.

SETS = {
    "belgium_4g": ("belgium_4g/csv/*.csv", "csv", 30),
    "belgium_4g raw": ("belgium_4g/raw/*.log", "belgium", 5),
    "belgium_4g sabre": ("belgium_4g/sabre_json/*.json", "sabre", 30),
    "norway_hsdpa": ("norway_hsdpa/cooked/*", "mbit", 80),
    "lumos5g_4G": ("lumos5g/4G/*", "mbit", 175),
    "solis_wifi": ("solis_wifi/*.txt", "mbit", 80),
}
ROUNDING = 0.051
"""The table gives one decimal, so half a tenth and a little for its rounding of exact ties."""
# How far a data set's rule may put them apart: rates in KB/s, min and max and mean relative to theirs, and s.
#   solis_wifi: the table takes each line as 1 s, we go by the times in the file, which jitter.
#   sabre: whole kbit/s, cut off, so up to 0.125 KB/s less.
LOOSER = {"solis_wifi": (0.0, 0.01, 4e-3, 0.6), "belgium_4g sabre": (0.125, 0.0, 0.0, 0.0)}
# Two Solis files whose only zeros are lines with the same time as the next one.
LEAST_WITHOUT_LINES_OF_NO_LENGTH = {"wifi_cafe_231115-154511": 45.0, "wifi_restr_231115-134450": 42.5}


def compare(shared_data: Path, data_set: str, traces: dict[str, Trace], looser: tuple[float, ...] = (0,) * 4) -> None:
    rates, extremes, mean, s = looser
    with open(shared_data / "STATS.csv", newline="") as file:
        rows = {row.pop("trace"): row for row in csv.DictReader(file) if row.pop("set") == data_set}
    for name, trace in traces.items():
        summary, expected = describe(trace), {key: float(value) for key, value in rows[name].items()}
        expected["min_KBps"] = LEAST_WITHOUT_LINES_OF_NO_LENGTH.get(name, expected["min_KBps"])
        assert set(summary) == set(expected)
        for key, value in expected.items():
            relative = {"mean_KBps": mean, "min_KBps": extremes, "max_KBps": extremes}.get(key, 0.0)
            absolute = ROUNDING + (rates if key.endswith("KBps") and key[0] == "m" else s)
            assert summary[key] == pytest.approx(value, rel=relative, abs=absolute), (trace.source, key)


NIGHTLY = [pytest.param(name, marks=pytest.mark.nightly) for name in SETS if "raw" not in name]


@pytest.mark.parametrize("name", ["belgium_4g raw", *NIGHTLY])
def test_recorded_links_agree_with_the_table(shared_data: Path, name: str) -> None:
    pattern, format, count = SETS[name]
    paths = sorted(shared_data.glob(pattern))
    traces = {trace.name: trace for trace in map(read_trace, paths)}
    assert len(traces) == count and all(f"format {format}, detected" in trace.source for trace in traces.values())
    compare(shared_data, name.split()[0], traces, LOOSER.get(name, (0,) * 4))
    if format == "belgium":  # a raw log and its CSV are one trace
        for path in paths:
            assert read_trace(path) == read_trace(shared_data / "belgium_4g" / "csv" / f"{path.stem}.csv")


@pytest.mark.nightly
def test_every_file_of_the_ucc_archive(shared_data: Path, tmp_path: Path) -> None:
    unpack(shared_data / "ucc_5g" / "5G-production-dataset.zip", tmp_path / "ucc")
    traces = {str(path): read_trace(path) for path in (tmp_path / "ucc").rglob("*.csv")}
    downloads = {"/".join(m.split("/")[-2:]): trace for m, trace in traces.items() if "/Download/" in m}
    assert len(traces) == 83 and len(downloads) == 21
    compare(shared_data, "ucc_5g_download", downloads)
    for path in (shared_data / "mahimahi").glob("*.gz"):
        assert read_trace(path).total_bytes == 1500 * len(gzip.decompress(path.read_bytes()).split())


def test_car_0002_fades_in_its_seconds_21_and_23(shared_data: Path) -> None:
    """The trace of the AFR paper's evaluation (490.2 and 222.3 KB/s, by the README of the data)."""
    _, rates = read_trace(shared_data / "belgium_4g" / "csv" / "report_car_0002.csv").segments()
    assert np.flatnonzero(rates < 500_000).tolist() == [21, 23, 73, 82, 128, 157, 294, 296, 395]
    assert (rates[[21, 23]] / 1e3).round(1).tolist() == [490.2, 222.3]
