"""Bandwidth traces from files: numbers worked by hand in every format."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from link_files import HEADER, UCC_HEADER, knots, written

from bufgym.errors import BufgymError
from bufgym.traces import detect_format, read_trace
from bufgym.traces.formats import mahimahi

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
    monkeypatch.setattr(mahimahi, "_parsed_at_once", lambda block, last_ms: None)
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
        ("time_s,bytes_per_s\n0,5\n1,5\n", "rates"),
        ("Timestamp,DL_bitrate,UL_bitrate\n2019.12.16_13.40.04,72,20\n", "ucc"),
        ("0.57,Mbits/sec\n", "nyu"),
        ('[{"duration_ms": 5,\n"bandwidth_kbps": 8}]', "sabre"),
        (" 1.0000 MB / 1.00 sec = 8.3886 Mbps\n", "nuttcp"),
        ('{"intervals": [\n{"sum": {"start": 0, "end": 1, "bytes": 5}}]}', "iperf3"),
        ("Run 1\n8,16\n", "runs"),
    ],
)
def test_same_trace_by_any_packing(tmp_path: Path, text: str, format: str) -> None:
    plain = written(tmp_path, text)
    expected = read_trace(plain, format=format)
    assert detect_format(plain) == format
    assert f"{format}, requested" in expected.source
    dressed = {
        "gzip": gzip.compress(text.encode()),
        "Windows": text.replace("\n", "\r\n").encode(),
        "byte order mark": b"\xef\xbb\xbf" + text.encode(),
        "blank lines": ("\n" + text.replace("\n", " \n\n")).encode(),
        "no last line end": text.rstrip("\n").encode(),
    }
    for packed in dressed.values():
        assert read_trace(written(tmp_path, packed)) == expected


# ---------------------------------------------------------------- logs of measuring tools


def test_rates_hold_until_the_next_line(tmp_path: Path) -> None:
    # 2 s at 1000 B/s, half a second at nothing, then the median of 2 and 0.5 s at 4 B/s: 5 bytes in 1.25 s.
    trace = read_trace(written(tmp_path, "time_s,bytes_per_s\n10,1000\n12,0\n12.5,4\n"))
    assert knots(trace) == [(0, 0), (2_000_000, 2_000), (2_500_000, 2_000), (3_750_000, 2_005)]


def test_nyu_units(tmp_path: Path) -> None:
    # 0.5 Mbit/s is 62,500 B/s, 43.3 Kbit/s is 5412.5 and rounds to even, 1e-5 Gbit/s is 1250.
    lines = "0.5,Mbits/sec\n0,bits/sec\n43.3,Kbits/sec\n0.00001,Gbits/sec\n16,bits/sec\n"
    trace = read_trace(written(tmp_path, lines))
    assert "format nyu, detected" in trace.source
    assert np.diff(trace.cumulative_bytes).tolist() == [62_500, 0, 5_412, 1_250, 2]
    assert trace.duration_us == 5_000_000


def test_ucc_columns(tmp_path: Path) -> None:
    # 72 kbit/s is 9000 bytes in a second. Two lines share a stamp: each counts for 1 s all the same.
    lines = [
        "2019.12.16_13.40.04,0,72,20,D\n",
        "2019.12.16_13.40.04,0,0,8,I\n",
        "2019.12.16_13.40.08,3,16.5,0,D\n",
    ]
    path = written(tmp_path, UCC_HEADER + "".join(lines))
    trace = read_trace(path)
    assert knots(trace) == [(0, 0), (1_000_000, 9_000), (2_000_000, 9_000), (3_000_000, 11_062)]
    assert trace.source.endswith("(format ucc, detected, column DL_bitrate, 1 s a line, 4 s by its clock)")
    assert read_trace(path, column="DL_bitrate") == trace
    assert read_trace(path, column="UL_bitrate").cumulative_bytes.tolist() == [0, 2_500, 3_500, 3_500]


def test_column_only_where_there_is_a_choice(tmp_path: Path) -> None:
    path = written(tmp_path, UCC_HEADER + "2019.12.16_13.40.04,0,72,20,D\n")
    with pytest.raises(BufgymError, match="column = 'Speed': must be one of DL_bitrate, UL_bitrate"):
        read_trace(path, column="Speed")
    with pytest.raises(BufgymError, match="column = 'DL_bitrate': format mahimahi has no columns"):
        read_trace(written(tmp_path, "1\n"), column="DL_bitrate")


SABRE = """[
    {"duration_ms": 725, "bandwidth_kbps": 36014, "latency_ms": 20},
    {"duration_ms": 1000.5, "bandwidth_kbps": 16, "latency_ms": 20}
]"""


def test_sabre_json(tmp_path: Path) -> None:
    # 36,014 kbit/s for 725 ms are 26,110,150 bits: 3,263,768.75 bytes; 16 kbit/s for 1000.5 ms are 2001.
    trace = read_trace(written(tmp_path, SABRE, "report.json"))
    assert knots(trace) == [(0, 0), (725_000, 3_263_769), (1_725_500, 3_265_770)]
    assert trace.name == "report" and "format sabre, detected" in trace.source
    one_line = "".join(SABRE.split())
    assert read_trace(written(tmp_path, one_line, "report.json")) == trace


def test_json_in_a_single_long_line(tmp_path: Path) -> None:
    sample = '{"duration_ms": 1000, "bandwidth_kbps": 8}'
    trace = read_trace(written(tmp_path, f"[{', '.join([sample] * 500)}]"))
    assert trace.duration_us == 500_000_000 and trace.total_bytes == 500_000


# ---------------------------------------------------------------- speed tests

NUTTCP = """Start time: 1730498381814
[2024-11-01T14:59:42.722595-0700] nuttcp-t: v8.1.4: socket
[2024-11-01T14:59:42.724539-0700]     3.1250 MB /   0.50 sec =   52.4220 Mbps     0 retrans   2599 KB-cwnd
[2024-11-01T14:59:42.724540-0700]     0.0000 MB /   0.49 sec =    0.0000 Mbps     2 retrans      1 KB-cwnd
[2024-11-01T14:59:43.702696-0700]     0.0625 MB /   0.50 sec =    1.0486 Mbps     0 retrans      1 KB-cwnd
[2024-11-01T15:01:42.809697-0700]
[2024-11-01T15:01:42.809794-0700] nuttcp-r: 3.1875 MB in 1.50 real seconds = 2176.00 KB/sec = 17.8258 Mbps
End time: 1730498502868
"""


def test_nuttcp_intervals_follow_each_other_whenever_they_were_printed(tmp_path: Path) -> None:
    # 3.125 MB are 3.125 * 2**20 = 3,276,800 bytes; 0.0625 MB are 65,536.
    trace = read_trace(written(tmp_path, NUTTCP, "uplink.out"))
    assert knots(trace) == [(0, 0), (500_000, 3_276_800), (990_000, 3_276_800), (1_490_000, 3_342_336)]
    assert trace.name == "uplink" and "format nuttcp, detected, 3 intervals" in trace.source


def test_nuttcp_without_stamps_and_with_its_closing_line(tmp_path: Path) -> None:
    lines = (
        " 11.2500 MB / 1.00 sec = 94.3690 Mbps\n 11.2500 MB / 1.00 sec = 94.3690 Mbps 1 %TX 2 %RX 0 retrans 0.2 msRTT\n"
    )
    assert knots(read_trace(written(tmp_path, lines))) == [(0, 0), (1_000_000, 11_796_480)]


IPERF3 = """{"start": {"title": "\\"intervals\\": [7]", "test_start": {"omit": 1}},
 "intervals": [
  {"streams": [], "sum": {"start": 0, "end": 1, "bytes": 999, "omitted": true, "sender": false}},
  {"streams": [], "sum": {"start": 0, "end": 1.000167, "bytes": 5473440, "omitted": false, "sender": false}},
  {"streams": [], "sum": {"start": 1.000167, "end": 1.144206, "bytes": 0, "omitted": false, "sender": false}}],
 "end": {"sum_received": {"bytes": 5473440}}}"""


def test_iperf3_intervals_but_those_that_it_omits(tmp_path: Path) -> None:
    trace = read_trace(written(tmp_path, IPERF3, "loc1.json"))
    assert knots(trace) == [(0, 0), (1_000_167, 5_473_440), (1_144_206, 5_473_440)]
    assert trace.source.endswith("(format iperf3, detected, measured by the receiver)")
    one_line = IPERF3.replace("\n", "").replace('"sender": false', '"sender": true')
    assert read_trace(written(tmp_path, one_line)).source.endswith("measured by the sender)")


RUNS = """
###############################
Run 1
8,16.0,0
###############################
Run 3
0.5,1.5
8,4
0.1,-2
7,7
Run 2
80,80
"""


def test_runs_of_a_list_with_and_without_times(tmp_path: Path) -> None:
    # 8 Mbit/s are 1 MB/s: 100 kB in the 0.1 s of a sample.
    path = written(tmp_path, RUNS, "walking.list")
    first = read_trace(path)
    assert knots(first) == [(0, 0), (100_000, 100_000), (200_000, 300_000), (300_000, 300_000)]
    assert first.source.endswith("(format runs, detected, run 1 of 3, a sample each 0.1 s)")
    third = read_trace(path, column="run 3")
    assert knots(third) == [(0, 0), (1_000_000, 1_000_000), (2_000_000, 1_500_000)]
    assert third.source.endswith("run 3 of 3, times as stated, the first of 2 pairs)")
    assert read_trace(path, column="run 2").total_bytes == 2_000_000
    with pytest.raises(BufgymError, match="has no run 4: must be one of run 1, run 3, run 2"):
        read_trace(path, column="run 4")
