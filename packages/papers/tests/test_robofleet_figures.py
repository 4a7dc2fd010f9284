"""Robofleet's Fig. 3 to 7: cases worked by hand, the paper's claims where they hold here, and options."""

import math
from typing import Any

import numpy as np
import pytest
from needs import needs
from refusal_cases import refuse

from bufgym.model.topics import Topic
from bufgym.scenario import Stream
from bufgym.traces import Trace
from bufgym_papers.figures import figure
from bufgym_papers.figures.robofleet_evaluation import BYTES, Sent, cloud_bytes, send, stream
from bufgym_papers.figures.robofleet_fig4 import recovery_s
from studies.robofleet_table1 import PAPER

TEN_HZ = Stream(Topic("scan"), 10, 12_500, jitter=0, encodings={"ros": 12_500, "json": 37_500})
"""12.5 ms over 1 MB/s, 37.5 ms as JSON."""
DROPOUT = Trace.steps([(1.05, 1e6), (1, 0), (20, 1e6)], after="hold")
"""No link from 1.05 to 2.05 s."""


def after_dropout(name: str, **options: Any) -> Sent:
    return send(name, (TEN_HZ,), DROPOUT, 5, round_trip_ms=20, **options)


def receipts_s(sent: Sent, first: int, last: int) -> list[float | None]:
    """Of messages ``first`` to ``last``, s; None where dropped."""
    return [None if math.isnan(at_s) else round(at_s, 6) for at_s in sent.received_s[first : last + 1].tolist()]


def test_each_sender_over_a_dropout_of_a_second() -> None:
    sent = after_dropout("robofleet")
    # 12.5 ms of link and 10 ms to the server.
    assert receipts_s(sent, 0, 10) == [round(0.1 * k + 0.0225, 6) for k in range(11)]
    # Message 11 is on its way when the link goes; it crosses at 2.0625. Its pong comes at 2.0825, and then message 20
    # goes, which has overwritten 12 to 19: crosses 2.095, pong 2.115. Message 21 waits for that from 2.1 on.
    assert receipts_s(sent, 11, 22) == [2.0725, *[None] * 8, 2.105, 2.1375, 2.2225]
    # Nominal 22.5 ms; within 45 ms from message 21 on (37.5 ms), not yet message 20 (105 ms).
    assert recovery_s(sent, 1.05, 2.05, 2) == pytest.approx(2.1375 - 2.05)
    # Within 1.5 times, 33.75 ms, only from message 22 on.
    assert recovery_s(sent, 1.05, 2.05, 1.5) == pytest.approx(2.2225 - 2.05)
    sent = after_dropout("rosbridge")
    # Nothing is dropped: message 11 + j leaves 37.5 ms x (j + 1) after the link's return, until they come slower.
    backlog = [round(2.05 + 0.0375 * (j + 1) + 0.01, 6) for j in range(16)]
    assert receipts_s(sent, 11, 26) == backlog and None not in receipts_s(sent, 0, 50)
    # Nominal 47.5 ms. Latency 0.9975 - 0.0625 j falls to 95 ms at j = 14.44: message 26 is the first within.
    assert recovery_s(sent, 1.05, 2.05, 2) == pytest.approx(backlog[15] - 2.05)
    assert backlog[15] - 2.05 == pytest.approx(0.61)
    sent = after_dropout("ros-native", queue_size=3)
    # Message 11 is on its way; of 12 to 20 the last three wait. Nobody waits for pongs.
    assert receipts_s(sent, 11, 21) == [2.0725, *[None] * 6, 2.085, 2.0975, 2.11, 2.1225]
    # No-drop queues all, and is paced by pongs: one per 12.5 + 20 ms from 2.05 + 0.0125 on.
    sent = after_dropout("no-drop")
    assert receipts_s(sent, 11, 14) == [round(2.0725 + 0.0325 * k, 6) for k in range(4)]
    assert None not in receipts_s(sent, 0, 50)


def test_copies_follow_one_another_and_a_link_that_stays_away_is_never_recovered_from() -> None:
    steady = Trace.constant(1e6, 10)
    sent = send("ros-native", (TEN_HZ,), steady, 1, round_trip_ms=20, consumers=3)
    assert sent.consumer.tolist() == [0, 1, 2] * 10
    assert np.round(sent.latency_s[:3], 6).tolist() == [0.0225, 0.035, 0.0475]
    one = send("robofleet", (TEN_HZ,), steady, 1, round_trip_ms=20, consumers=3)
    assert np.round(one.latency_s, 6).tolist() == [0.0225] * 10
    gone = Trace.steps([(1.05, 1e6), (1, 0), (1, 100_000)], after="hold")  # 1 Mbit/s short of what JSON needs
    sent = send("rosbridge", (TEN_HZ,), gone, 5, round_trip_ms=20)
    assert recovery_s(sent, 1.05, 2.05, 2) == math.inf
    refuse("nothing was received before the dropout", recovery_s, sent, 0.01, 2.05, 2)


def test_sizes_are_table1s() -> None:
    both = set(BYTES) & set(PAPER)
    assert {kind: BYTES[kind] for kind in both} == {kind: PAPER[kind] for kind in both}
    pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))
    pytest.importorskip("flatbuffers", reason=needs("extras", "flatbuffers"))
    from studies.encodings import content, encode

    def sizes(kind: str, **parameters: Any) -> list[int]:
        message = content(kind, **parameters)
        return [len(encode(kind, message, encoding)) for encoding in ("ros1", "robofleet", "json-numbers")]

    for points in (100, 10_000):
        *binary, json = sizes("PointCloud2", points=points)
        assert binary == list(cloud_bytes(points)[:2])
        assert json == pytest.approx(cloud_bytes(points)[2], rel=0.1 if points == 100 else 0.001)
    assert sizes("PoseStamped") == list(BYTES["PoseStamped"])
    scan = stream("LaserScan", 10, priority=3)
    assert (scan.size_bytes, scan.encodings, scan.topic.priority) == (7_328, {"ros": 7_260, "json": 28_000}, 3)


Options = dict[str, Any]
ONE_KIND: Options = {"dropouts_s": (5,), "links_mbit_per_s": (50,), "kinds": ("LaserScan",), "runs": 1}
ZONE: Options = {"bad_mbit_per_s": (1.0,), "image_priorities": (1.0, 0.01), "bad_from": 100, "runs": 1}


def test_fig3_and_fig4_have_the_numbers_worked_by_hand() -> None:
    fig3 = figure("robofleet-fig3", rates_hz=(10, 100), duration_s=5, runs=1)
    rows = fig3.simulate()
    # Fewer messages: 100 Mbit/s take 12.83 ms for 160,344 bytes; with a round trip of 10 ms 43.8 a second.
    assert rows.mean("received_hz", sender="robofleet", publish_hz=100) == pytest.approx(43.8, abs=0.5)
    # 562 kB of JSON take 45 ms: rosbridge is behind at 10 Hz already.
    assert rows.mean("latency_ms", sender="rosbridge", publish_hz=10) == pytest.approx(50, abs=0.5)
    slow = figure("robofleet-fig3", rates_hz=(5, 10), duration_s=1, runs=1)
    assert slow.claims(slow.simulate())["grows"] is None  # no rate exceeds the link
    assert rows == fig3.simulate()
    # Rosbridge's backlog: dropout x load / (1 - load), to within a few messages; a silence delays both senders.
    quick, silent = (figure("robofleet-fig4", **ONE_KIND, silence_s=s).simulate() for s in (0.0, 2.0))
    load = 28_000 * 10 / 6.25e6
    assert quick.mean("recovery_s", sender="rosbridge") == pytest.approx(5 * load / (1 - load), rel=0.15)
    assert quick.mean("recovery_s", sender="robofleet") < 0.5
    assert silent.column("recovery_s") == pytest.approx([float(row["recovery_s"]) + 2 for row in quick], abs=0.3)


def test_fig5_and_fig6_have_the_latencies_worked_by_hand() -> None:
    rows = figure("robofleet-fig5", rate_hz=30.0, runs=1).simulate()
    highest = {s: np.nanmax(rows.column("max_latency_s", sender=s)) for s in ("robofleet", "no-drop")}
    # 160,344 bytes at 4 Mbit/s are 0.32 s; the message that goes is at most a period of 33 ms old.
    assert 0.32 < highest["robofleet"] < 0.37 and highest["no-drop"] > 5
    # Capacity is a line: in its first second 96.8 Mbit/s in the middle, 4 at the end.
    link = rows.column("link_mbit_per_s", sender="robofleet")
    assert (link[0], link[-1]) == (pytest.approx(96.8), 4.0)
    options: Options = {"max_consumers": 4, "runs": 1}
    rows = figure("robofleet-fig6", points=(1_500,), duration_s=10, queue_sizes=(10,), **options).simulate()
    # 24,111 bytes at 12 Mbit/s are 16.07 ms: the mean of n copies is (n + 1) / 2 of these, and 5 ms to the server.
    native = [rows.mean("mean_latency_s", sender="ros-native", consumers=n) for n in (1, 2, 3, 4)]
    assert native == pytest.approx([0.005 + 0.016074 * (n + 1) / 2 for n in (1, 2, 3, 4)], abs=1e-4)
    wide = figure("robofleet-fig6", points=(10_000,), duration_s=20, **options)
    rows = wide.simulate()
    assert "the link carries 1 of 4 copies" in wide.tables(rows)[0]
    # Nobody starves: 9.37 copies a second in all, 20 published.
    columns = ("received_share", "least_received_share")
    share, least = (rows.mean(c, sender="ros-native", consumers=4, queue_size=10) for c in columns)
    assert share == pytest.approx(9.37 / 20, abs=0.01) and share - 0.02 < least <= share


def test_fig7_shares_the_zone_as_worked_by_hand() -> None:
    rows = figure("robofleet-fig7", **ZONE).simulate()

    def zone(sender: str, topic: str, column: str, priority: float = 1.0) -> float:
        return rows.mean(column, sender=sender, topic=topic, image_priority=priority)

    lost = [zone("robofleet", "CompressedImage", "lost_in_zone", priority) for priority in (1.0, 0.01)]
    assert 10 < lost[0] < lost[1]
    # 75,224 bytes take 0.6 s; a pose waits for one image at most, and for what else of it goes first. A scan takes
    # 59 ms itself, and only the newest is sent.
    assert zone("robofleet", "PoseStamped", "p95_in_zone_ms") < 800
    assert zone("robofleet", "LaserScan", "median_in_zone_ms") < 200
    # Native ROS's turns by message: 75,188 + 7,260 + 75 bytes a round are 0.66 s, so 45 poses of 300 in the zone; a
    # full queue of 10 makes them nearly a second old. What waits at its end, 10 of each, goes once the link is good.
    gone, came = (zone("ros-native", "PoseStamped", f"{entry}_in_zone") for entry in ("lost", "arrived"))
    assert gone / came == pytest.approx(1 - (45 + 10) / 300, abs=0.02)
    assert 800 < zone("ros-native", "PoseStamped", "median_in_zone_ms") < 1000
