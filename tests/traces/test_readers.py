"""Bandwidth traces from files: numbers by hand in every format, broken files, limits; `trace info|plot|convert`."""

import gzip
import os
from pathlib import Path

import numpy as np
import pytest
from cli_cases import Capsys, fails, shown
from link_files import HEADER, SAMPLES, UCC_HEADER, knots, written
from refusal_cases import refuse

from bufgym.cli import main
from bufgym.traces import FORMATS, detect_format, read_trace
from bufgym.traces.formats import links, mahimahi
from bufgym.traces.formats import text as text_files
from bufgym.utils.errors import BufgymError, TraceError

NUTTCP = """Start time: 1730498381814
[2024-11-01T14:59:42.722595-0700] nuttcp-t: v8.1.4: socket
[2024-11-01T14:59:42.724539-0700]     3.1250 MB /   0.50 sec =   52.4220 Mbps     0 retrans   2599 KB-cwnd
[2024-11-01T14:59:42.724540-0700]     0.0000 MB /   0.49 sec =    0.0000 Mbps     2 retrans      1 KB-cwnd
[2024-11-01T14:59:43.702696-0700]     0.0625 MB /   0.50 sec =    1.0486 Mbps     0 retrans      1 KB-cwnd
[2024-11-01T15:01:42.809697-0700]
[2024-11-01T15:01:42.809794-0700] nuttcp-r: 3.1875 MB in 1.50 real seconds = 2176.00 KB/sec = 17.8258 Mbps
End time: 1730498502868
"""
IPERF3 = """{"start": {"title": "\\"intervals\\": [7]", "test_start": {"omit": 1}},
 "intervals": [
  {"streams": [], "sum": {"start": 0, "end": 1, "bytes": 999, "omitted": true, "sender": false}},
  {"streams": [], "sum": {"start": 0, "end": 1.000167, "bytes": 5473440, "omitted": false, "sender": false}},
  {"streams": [], "sum": {"start": 1.000167, "end": 1.144206, "bytes": 0, "omitted": false, "sender": false}}],
 "end": {"sum_received": {"bytes": 5473440}}}"""
S = 1_000_000

BY_HAND = [
    # A packet crosses during the ms that ends at its time; that of ms 0, which has no ms before it, in the first.
    ("mahimahi", SAMPLES["mahimahi"], [(0, 0), (1000, 1500), (2000, 4500), (3000, 6000), (9000, 6000), (10000, 7500)]),
    # mahimahi's own README: a file of just "1" is 12 Mbit/s for ever.
    ("mahimahi", "1", [(0, 0), (1000, 1500)]),
    # CSV's time is the end of the interval, and it may begin late.
    ("csv", SAMPLES["csv"], [(0, 0), (840_000, 1000), (1_840_500, 6000)]),
    ("csv", HEADER + "9000,10,1000\n", [(0, 0), (S, 10)]),
    # 8 Mbit/s is 1 MB/s: to 11 s 1 MB/s, to 13 s 2 MB/s, to 14 s none; the last for the median of 1, 2, 1 s.
    ("mbit", SAMPLES["mbit"], [(0, 0), (S, S), (3 * S, 5 * S), (4 * S, 5 * S), (5 * S, 5_500_000)]),
    # Of lines with one time the last counts.
    ("mbit", "0 8\n0 16\n1 8\n", [(0, 0), (S, 2 * S), (2 * S, 3 * S)]),
    ("belgium", SAMPLES["belgium"], [(0, 0), (710_000, 994_124), (1_709_000, 994_124 + 3_324_168)]),
    # 2 s at 1000 B/s, half a second at nothing, then the median of 2 and 0.5 s at 4 B/s: 5 bytes in 1.25 s.
    ("rates", SAMPLES["rates"], [(0, 0), (2 * S, 2000), (2_500_000, 2000), (3_750_000, 2005)]),
    # 0.5 Mbit/s is 62,500 B/s, 43.3 Kbit/s is 5412.5 and rounds to even, 1e-5 Gbit/s is 1250.
    (
        "nyu",
        SAMPLES["nyu"] + "0.00001,Gbits/sec\n",
        [(0, 0), (S, 62_500), (2 * S, 62_500), (3 * S, 67_912), (4 * S, 69_162)],
    ),
    # 36,014 kbit/s for 725 ms are 26,110,150 bits: 3,263,768.75 bytes; 16 kbit/s for 1 s are 2000.
    ("sabre", SAMPLES["sabre"], [(0, 0), (725_000, 3_263_769), (1_725_000, 3_265_769)]),
    ("sabre", "".join(SAMPLES["sabre"].split()), [(0, 0), (725_000, 3_263_769), (1_725_000, 3_265_769)]),
    # 3.125 MB are 3.125 * 2**20 = 3,276,800 bytes; 0.0625 MB are 65,536. Intervals follow each other, whatever their
    # stamps; the closing line is left out.
    ("nuttcp", NUTTCP, [(0, 0), (500_000, 3_276_800), (990_000, 3_276_800), (1_490_000, 3_342_336)]),
    # MBytes are 2**20 bytes; the total over all is no interval.
    ("iperf-text", SAMPLES["iperf-text"], [(0, 0), (S, 1_310_720), (2 * S, 1_441_792)]),
    # Opportunities at ms 0 and 4 of the trace.
    ("mm-link", SAMPLES["mm-link"], [(0, 0), (1000, 1500), (3000, 1500), (4000, 3000)]),
    # 2,000 bytes sent in 1 s, then 500 in 2 s; 600 in 2 s, none in 1 s. A counter says nothing of what follows.
    ("proc-net-dev", SAMPLES["proc-net-dev"], [(0, 0), (S, 2000), (3 * S, 2500)]),
    ("mmcli", SAMPLES["mmcli"], [(0, 0), (2 * S, 600), (3 * S, 600)]),
    # Intervals but those that iperf3 omits.
    ("iperf3", IPERF3, [(0, 0), (1_000_167, 5_473_440), (1_144_206, 5_473_440)]),
]


@pytest.mark.parametrize(("format", "text", "expected"), BY_HAND)
def test_numbers_worked_by_hand(tmp_path: Path, format: str, text: str, expected: list[tuple[int, int]]) -> None:
    trace = read_trace(written(tmp_path, text, "link.txt"))
    assert knots(trace) == expected
    assert trace.name == "link" and f"format {format}, detected" in trace.source


def test_each_format_has_a_sample() -> None:
    lacking = sorted({*FORMATS} - {*SAMPLES})
    assert not lacking, f"no sample of the formats {lacking}: add them to SAMPLES of tests/traces/link_files.py"


def test_each_format_has_a_row() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "guide" / "recordings.md").read_text(encoding="utf-8")
    lacking = [name for name in FORMATS if f"\n| `{name}` |" not in page]
    assert not lacking, f"docs/guide/recordings.md has no row of the formats {lacking}"


@pytest.mark.parametrize("format", SAMPLES)
def test_same_trace_by_any_packing(tmp_path: Path, format: str) -> None:
    text = SAMPLES[format]
    plain = written(tmp_path, text)
    expected = read_trace(plain, format=format)
    assert detect_format(plain) == format and f"{format}, requested" in expected.source
    # With Windows' ends of lines, a byte order mark, blank lines, and no end of the last line; and packed.
    dressed = (text.replace("\n", "\r\n"), "\ufeff" + text, "\n" + text.replace("\n", " \n\n"), text.rstrip("\n"))
    for packed in (gzip.compress(text.encode()), *dressed):
        assert read_trace(written(tmp_path, packed)) == expected


def test_mahimahi_line_by_line_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stamps = np.cumsum(np.random.default_rng(7).poisson(0.4, 5000))
    path = written(tmp_path, "\n".join(map(str, stamps.tolist())), "link.up")
    whole = read_trace(path)
    assert whole.name == "link.up"
    # The slow, obvious way: count the packets up to each ms.
    ends_ms = np.arange(1, stamps[-1] + 1)
    expected = 1500 * np.searchsorted(stamps, ends_ms, side="right")
    assert np.interp(ends_ms * 1000, whole.time_us, whole.cumulative_bytes).tolist() == expected.tolist()
    monkeypatch.setattr(mahimahi, "_parsed_at_once", lambda text: None)
    assert read_trace(path) == whole


def test_ucc_columns(tmp_path: Path) -> None:
    # 72 kbit/s is 9000 bytes in a second. Two lines share a stamp: each counts for 1 s all the same.
    lines = "2019.12.16_13.40.04,0,72,20,D\n2019.12.16_13.40.04,0,0,8,I\n2019.12.16_13.40.08,3,16.5,0,D\n"
    path = written(tmp_path, UCC_HEADER + lines)
    trace = read_trace(path)
    assert knots(trace) == [(0, 0), (S, 9_000), (2 * S, 9_000), (3 * S, 11_062)]
    assert trace.source.endswith("(format ucc, detected, column DL_bitrate, 1 s a line, 4 s by its clock)")
    assert read_trace(path, column="DL_bitrate") == trace
    assert read_trace(path, column="UL_bitrate").cumulative_bytes.tolist() == [0, 2_500, 3_500, 3_500]
    refuse("column = 'Speed': must be one of DL_bitrate, UL_bitrate", read_trace, path, column="Speed")
    with pytest.raises(BufgymError, match="column = 'DL_bitrate': format mahimahi has no columns"):
        read_trace(written(tmp_path, "1\n"), column="DL_bitrate")


def test_runs_of_a_list_with_and_without_times(tmp_path: Path) -> None:
    # 8 Mbit/s are 1 MB/s: 100 kB in the 0.1 s of a sample.
    # And speed tests say what was measured and by whom.
    assert read_trace(written(tmp_path, NUTTCP, "uplink.out")).source.endswith("detected, 3 intervals)")
    one_line = IPERF3.replace("\n", "").replace('"sender": false', '"sender": true')
    assert read_trace(written(tmp_path, one_line)).source.endswith("measured by the sender)")
    text = "\n####\nRun 1\n8,16.0,0\n###\nRun 3\n0.5,1.5\n8,4\n0.1,-2\n7,7\nRun 2\n80,80\n"
    path = written(tmp_path, text, "walk.list")
    first = read_trace(path)
    assert knots(first) == [(0, 0), (100_000, 100_000), (200_000, 300_000), (300_000, 300_000)]
    assert first.source.endswith("(format runs, detected, run 1 of 3, a sample each 0.1 s)")
    third = read_trace(path, column="run 3")
    assert knots(third) == [(0, 0), (S, S), (2 * S, 1_500_000)]
    assert third.source.endswith("run 3 of 3, times as stated, the first of 2 pairs)")
    assert read_trace(path, column="run 2").total_bytes == 2_000_000
    refuse("has no run 4: must be one of run 1, run 3, run 2", read_trace, path, column="run 4")


def test_what_convert_refuses(tmp_path: Path, capsys: Capsys) -> None:
    first, second = str(written(tmp_path, "1\n", "a.up")), str(written(tmp_path, "2\n", "b.up"))
    out = tmp_path / "out"
    both = ["trace", "convert", first, second, "--to", "csv", "--out", str(out)]
    fails(both, "must be an existing folder", capsys)
    out.mkdir()
    shown(both, capsys)
    assert sorted(path.name for path in out.iterdir()) == ["a.up.csv", "b.up.csv"]
    for words, says in (
        ([str(out), "--to", "csv"], "a.up.csv is taken"),
        ([str(tmp_path / "x.up")], "must be one of csv, mahimahi"),
        ([first, "--to", "csv"], "must not be the file that is read"),
    ):
        fails(["trace", "convert", first, "--out", *words], says, capsys)


def test_info_of_every_format(tmp_path: Path, capsys: Capsys) -> None:
    files = [written(tmp_path, text, format) for format, text in SAMPLES.items()]
    for format, block in zip(SAMPLES, shown(["trace", "info", *files], capsys).split("\n\n"), strict=True):
        assert block.startswith(f"{format}\n") and f"(format {format}, detected" in block
    out = shown(["trace", "info", tmp_path / "ucc", "--format", "ucc", "--column", "UL_bitrate"], capsys)
    assert "(format ucc, requested, column UL_bitrate," in out
    # 20 and 8 kbit/s are 2.5 and 1 KB/s.
    assert ["mean_KBps", "1.75"] in [line.split() for line in out.splitlines()]


def test_validate_tells_sound_files_and_info_goes_on_after_a_broken_one(tmp_path: Path, capsys: Capsys) -> None:
    sound, broken = written(tmp_path, "1\n2\n", "sound.up"), written(tmp_path, "1\nx\n", "broken.up")
    assert main(["trace", "validate", str(sound), str(broken), str(tmp_path / "missing")]) == 1
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["OK", "error", "error", "1"]
    assert main(["trace", "info", str(broken), str(tmp_path / "missing"), str(sound)]) == 2
    said = capsys.readouterr()
    assert said.out.startswith("sound.up\n") and "missing: no such file" in said.err
    assert "error: " in said.err and "broken.up, line 2: time in ms = x: must be a whole number" in said.err


def test_convert_states_what_was_lost(tmp_path: Path, capsys: Capsys) -> None:
    source = written(tmp_path, SAMPLES["rates"], "link.csv")  # 2005 bytes in 3.75 s
    up, back = tmp_path / "link.up", tmp_path / "back.csv"
    out = shown(["trace", "convert", source, "--to", "mahimahi", "--out", up], capsys)
    assert up.read_text() == "1500\n3750\n"
    assert out.startswith(f"wrote {up} (format mahimahi) from {source} (format rates, detected): total +995 bytes, ")
    assert shown(["trace", "convert", up, "--out", back], capsys).endswith(": nothing lost\n")  # .csv says the format
    assert read_trace(back).time_us.tolist() == read_trace(up).time_us.tolist()


DAY = "2019.12.16_13.40"
BEGUN = "nuttcp-t: v8.1.4: socket\n"


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
    (
        "1,Mbits/sec\n1,MBytes/sec\n",
        "line 2: 1,MBytes/sec: must be a line of nyu .number,unit with a unit such as Mbits/sec",
    ),
    ("[", "line 1: must be JSON"),
    ('[{"duration_ms": 1, "bandwidth_kbps": 1}', r"line 1: must be JSON \(Expecting ',' delimiter"),
    ('[\n{"duration_ms": true}]', "lte.csv, item 1: True: must hold duration_ms, a number"),
    ('[{"duration_ms": 0, "bandwidth_kbps": 1}]', "item 1: duration_ms = 0: must be above 0"),
    ('[{"duration_ms": NaN}]', ": must be JSON .NaN: numbers must be finite"),
    ("[" * 100_000, ": must be JSON .nested too deep"),
    (
        "nuttcp-t: v8.1.4: error from server\n",
        "line 1: .*error from server.*: must be a line of nuttcp .* of a run that succeeded",
    ),
    (
        BEGUN + "1e300 MB / 1.00 sec = 8.3886 Mbps\n",
        "line 2: .*: must be a line of nuttcp .MB / sec = Mbps and remarks",
    ),
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
def test_broken_links(tmp_path: Path, text: str | bytes, says: str) -> None:
    with pytest.raises(TraceError, match=says) as caught:
        read_trace(written(tmp_path, text))
    assert "lte.csv" in str(caught.value) and str(caught.value).isprintable()  # in one line


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
        (path, "pcap", "format = 'pcap': must be one of mahimahi, mbit, rates, ucc"),
        (path, None, r"fits more than one format \(mahimahi, seconds\): say which with format="),
        (tmp_path / "nothing.csv", "csv", r"nothing\.csv: no such file"),
        (tmp_path, "csv", "is a directory"),
        (tmp_path / "pipe", "csv", "must be a regular file"),
    ):
        refuse(says, read_trace, source, format=format)
