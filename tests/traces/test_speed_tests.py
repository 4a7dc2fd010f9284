"""Tests of links that say two things at once: both directions in one file, and what was sent beside what arrived."""

import json
from pathlib import Path
from typing import Any

import pytest
from link_files import written
from recording_cases import ODD_FILES
from refusal_cases import refuse

from bufgym.traces import read_trace
from bufgym.utils.errors import TraceError


def sums(count: int, sender: bool, **more: Any) -> list[dict[str, Any]]:
    """Two intervals of 1 s with as many bytes each."""
    return [{"start": k, "end": k + 1, "bytes": count, "sender": sender, **more} for k in range(2)]


def test_old_versions_of_iperf3_write_both_directions_under_one_name() -> None:
    """1,250,000 bytes a second to the server, 10,000,000 back."""
    path = ODD_FILES / "ip_bidir_old.json"
    upload = read_trace(path)
    assert (upload.duration_us, upload.total_bytes) == (5_000_000, 6_250_000)
    assert "upload of a test in both directions" in upload.source
    assert read_trace(path, column="download").total_bytes == 50_000_000


@pytest.mark.parametrize(("side", "upload_is_sent"), [("connecting_to", True), ("accepted_connection", False)])
@pytest.mark.parametrize("second", ["sum", "sum_bidir_reverse"])
def test_the_upload_is_what_the_client_sent_whoever_wrote_the_file(
    tmp_path: Path, side: str, upload_is_sent: bool, second: str
) -> None:
    for up_first in (True, False):
        pairs = list(zip(sums(1000, upload_is_sent), sums(70, not upload_is_sent), strict=True))
        pairs = pairs if up_first else [(b, a) for a, b in pairs]
        items = ",".join(f'{{"sum": {json.dumps(a)}, "{second}": {json.dumps(b)}}}' for a, b in pairs)
        path = written(tmp_path, f'{{"start": {{"{side}": {{}}}}, "intervals": [{items}]}}')
        assert read_trace(path).total_bytes == 2000
        assert read_trace(path, column="download").total_bytes == 140


def test_what_of_two_directions_is_refused(tmp_path: Path) -> None:
    one = json.dumps({"intervals": [{"sum": a} for a in sums(1000, True)]})
    refuse("holds one direction only: download", read_trace, written(tmp_path, one), column="download", kind=TraceError)
    same = json.dumps({"intervals": [{"sum": a, "sum_bidir_reverse": a} for a in sums(1000, True)]})
    refuse("holds two directions .*: sender must say", read_trace, written(tmp_path, same), kind=TraceError)
    thrice = '{"intervals": [{"sum": 1, "sum": 2, "sum": 3}]}'
    refuse("holds 'sum' more than twice", read_trace, written(tmp_path, thrice), kind=TraceError)
    twice = '[{"duration_ms": 1000, "duration_ms": 2000, "bandwidth_kbps": 8}]'
    refuse("holds 'duration_ms' twice: must hold it once", read_trace, written(tmp_path, twice), kind=TraceError)


def udp(end: Any, sender: bool = True, **more: Any) -> str:
    """A report of 12,500 bytes a second over UDP."""
    intervals = [{"sum": one} for one in sums(12_500, sender, packets=9)]
    return json.dumps({"start": {"test_start": {"protocol": "UDP"}}, "intervals": intervals, "end": end, **more})


def test_the_sender_of_udp_counts_what_was_lost(tmp_path: Path) -> None:
    lost = {"sum": {"lost_percent": 90.0}}
    for end, says in (
        (lost, "over UDP by the sender, which counts what was lost, 90 %: must be the receiver's JSON"),
        ({"sum": {"lost_percent": 0}, "sum_received": {"lost_percent": 7}}, "what was lost, 7 %"),
        ({}, "what was lost, an unknown part"),
        (None, "what was lost, an unknown part"),
    ):
        refuse(says, read_trace, written(tmp_path, udp(end)), kind=TraceError)
    assert read_trace(written(tmp_path, udp({"sum": {"lost_percent": 0}}))).total_bytes == 25_000
    assert read_trace(written(tmp_path, udp(lost, sender=False))).total_bytes == 25_000
    received = json.loads(udp(lost, sender=False))
    for item in received["intervals"]:
        item["sum"]["bytes"] = 1250
    trace = read_trace(written(tmp_path, udp(lost, server_output_json=received)))
    assert trace.total_bytes == 2500 and "measured by the receiver, UDP, 90 % lost" in trace.source
    refuse("over UDP by the sender.* 90 %", read_trace, ODD_FILES / "ip_udp_sender.json", kind=TraceError)


def test_the_events_of_a_udp_test(tmp_path: Path) -> None:
    """The same by ``--json-stream``; killed before its end, the loss is unknown; without a start the packets tell."""
    report = json.loads(udp({"sum": {"lost_percent": 0}}))
    start, *intervals, end = (
        json.dumps({"event": event, "data": data}) + "\n"
        for event, data in (
            ("start", report["start"]),
            *(("interval", item) for item in report["intervals"]),
            ("end", report["end"]),
        )
    )
    assert read_trace(written(tmp_path, start + "".join(intervals) + end)).total_bytes == 25_000
    for killed in (start + "".join(intervals), "".join(intervals)):
        refuse("measured over UDP by the sender, .* an unknown part", read_trace, written(tmp_path, killed))


def test_nuttcp_over_udp_counts_what_arrived() -> None:
    """1.1921 MB of 2**20 bytes in each of five seconds; 12 of 1,221 packets of each are lost."""
    trace = read_trace(ODD_FILES / "nuttcp_udp.log")
    assert trace.duration_us == 5_000_000 and trace.total_bytes == 5 * round(1.1921 * 2**20)
    assert "5 intervals, UDP, 60 of 6,105 packets lost" in trace.source
