"""Workloads: in and out of CSV files, summed up by topic, and played over a link."""

import gzip
import math
from pathlib import Path

import link_files
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusal_cases import refuse

from bufgym import policies, scenario
from bufgym.benchmark import drops
from bufgym.ground.errors import BufgymError, TraceError
from bufgym.traces import Motion, Trace, Workload, read_workload_csv, write_workload_csv
from bufgym.traces.formats.recordings import read_workload

CSV = """time_s,bytes,topic,x
100.5,1000,/camera,2
101.5,500,/odom,2
101.5,1000,/camera,2.25
104.5,1500,/camera,4
"""


def written(folder: Path, text: str) -> Path:
    return link_files.written(folder, text, "w.csv")


def test_a_file_in_full(tmp_path: Path) -> None:
    workload = read_workload(written(tmp_path, CSV))
    assert (workload.name, workload.topics) == ("w", ("/camera", "/odom"))
    assert workload.arrival_us.tolist() == [0, 1_000_000, 1_000_000, 4_000_000]
    assert workload.size_bytes.tolist() == [1000, 500, 1000, 1500]
    assert [workload.topic_of(k) for k in range(4)] == ["/camera", "/odom", "/camera", "/camera"]
    assert workload.x is not None and workload.x.tolist() == [0, 0, 0.25, 2]
    camera, odom = workload.summary()
    # Two intervals in 4 s; 3500 of 4000 bytes.
    assert camera == ("/camera", 3, 0.5, 3500, 0.875)
    assert odom[:2] == ("/odom", 1) and math.isnan(odom.rate_hz) and odom[3:] == (500, 0.125)
    (tmp_path / "w.csv.gz").write_bytes(gzip.compress(CSV.encode()))
    assert read_workload_csv(tmp_path / "w.csv.gz").arrival_us.tolist() == workload.arrival_us.tolist()
    least = read_workload_csv(written(tmp_path, "time_s,bytes\n0,1\n0.000001,2\n"))
    assert least.arrival_us.tolist() == [0, 1] and least.topics == ("",) and least.x is None
    # The clock and x begin with the first message chosen.
    path = written(tmp_path, CSV + "105.5,7,/imu,5\n")
    late = read_workload(path, topics=["/odom", "/i*"])
    assert late.arrival_us.tolist() == [0, 4_000_000] and late.size_bytes.tolist() == [500, 7]
    assert late.x is not None and late.x.tolist() == [0, 3] and late.topic_of(1) == "/imu"
    refuse(r"no topic '/lidar'; it has: /camera, /odom", read_workload, path, topics=["/lidar"])
    refuse(r"odom = '/odom': needs a recording, which this is not", read_workload, path, odom="/odom")


MESSAGES = st.tuples(st.integers(0, 10**9), st.integers(1, 10**10), st.integers(0, 2), st.floats(0, 1e6))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(messages=st.lists(MESSAGES, min_size=1), names=st.booleans(), moves=st.booleans())
def test_a_round_trip(tmp_path: Path, messages: list[tuple[int, int, int, float]], names: bool, moves: bool) -> None:
    steps_us, sizes, topics, steps = (np.array(column) for column in zip(*messages, strict=True))
    moved, time_us = np.cumsum(steps), np.cumsum(steps_us)
    topic, called = (topics, ("/a", "/b c", "/ü")) if names else (None, ("",))
    workload = Workload("w", time_us - time_us[0], sizes, topic, called, moved - moved[0] if moves else None)
    write_workload_csv(workload, tmp_path / "w.csv")
    again = read_workload_csv(tmp_path / "w.csv")
    assert again.arrival_us.tolist() == workload.arrival_us.tolist() and again.size_bytes.tolist() == sizes.tolist()
    assert [again.topic_of(k) for k in range(len(again))] == [workload.topic_of(k) for k in range(len(again))]
    assert np.array_equal(again.x, workload.x) if moves else again.x is None


def test_broken_files(tmp_path: Path) -> None:
    for text, says in (
        ("", "w.csv: is empty: must begin with the header time_s,bytes"),
        ("time_s,bytes\n", "w.csv: holds no message: must hold at least one"),
        ("time_s,bytes\n1,0\n", "line 2: bytes = 0: must be at least 1"),
        ("time_s,bytes\n1,99999999999\n", "line 2: bytes = 99999999999: must be at most 10000000000"),
        ("time_s,bytes\n1,1\n2e7,1\n", "line 3: time_s = 2e7: must be at most 10000000 s after the first"),
        ("time_s,bytes,topic\n1,1,\n", "line 2: topic = '': must not be empty"),
        ("time_s,bytes,x\n1,1,1\n2,1,0.5\n", "line 3: x = 0.5: must not be below the line above"),
    ):
        refuse(says, read_workload, written(tmp_path, text), kind=TraceError)


def test_broken_arrays_and_names_that_a_csv_file_cannot_hold(tmp_path: Path) -> None:
    time_us, size = np.array([0, 5]), np.array([1, 1])
    for arguments, says in (
        ((np.array([1, 5]), size), "arrival_us must begin with 0"),
        ((time_us, np.array([1])), "size_bytes must be int64"),
        ((time_us, np.array([1, 0])), "size_bytes must lie between 1"),
        ((time_us[:0], size[:0]), "at least one message"),
        ((time_us, size, None, ("",), np.array([0, -1.0])), "x must be .* not decrease"),
    ):
        refuse(f"workload 'w': .*{says}", Workload, "w", *arguments)
    for name in ("a,b", " a", "", "a\nb"):
        workload = Workload("w", np.array([0]), np.array([1]), np.array([0]), (name, "other"))
        refuse("a name in a CSV file must be printable", write_workload_csv, workload, tmp_path / "w.csv")
    with pytest.raises(TraceError, match="cannot be written"):
        write_workload_csv(Workload("w", np.array([0]), np.array([1])), tmp_path / "nowhere" / "w.csv")


NOTHING = Trace("outage", np.array([0, 4_000_000, 5_000_000]), np.array([0, 0, 10_000]), "hold")
"""For four seconds."""


def recorded(sizes: tuple[int, ...] = (1000, 1000, 1000, 1000)) -> Workload:
    """A message a second, on two topics in turn; the scene moves on in the second and third second only."""
    time_us, x = np.arange(4) * 1_000_000, np.array([0.0, 0.0, 1.0, 2.0])
    return Workload("drive", time_us, np.array(sizes), np.array([0, 1, 0, 1]), ("/camera", "/odom"), x)


def uplink(workload: Workload, **other: object) -> scenario.Uplink:
    fixed = {"traces": (NOTHING,), "random_offset": False, "propagation_us": 0}
    return scenario.Uplink(workload=workload, **fixed, **other)  # type: ignore[arg-type]


@pytest.mark.kernels
def test_the_drops_of_a_recording() -> None:
    """L = 1 and nothing crosses for 4 s: message 0 is in transmission, 1 waits, 2 and 3 find the buffer full."""
    chosen = [policies.get(name) for name in ("drop-oldest", "drop-newest")]
    dropped = list(drops.drops(chosen, uplink(recorded()), [1, 2], 1))
    assert [(d.policy, d.capacity, d.message, d.time_s, d.topic, d.x, d.dropped_s) for d in dropped] == [
        ("drop-oldest", 1, 1, 1.0, "/odom", 0.0, 2.0),
        ("drop-oldest", 1, 2, 2.0, "/camera", 1.0, 3.0),
        ("drop-newest", 1, 2, 2.0, "/camera", 1.0, 2.0),
        ("drop-newest", 1, 3, 3.0, "/odom", 2.0, 3.0),
        ("drop-oldest", 2, 1, 1.0, "/odom", 0.0, 3.0),
        ("drop-newest", 2, 3, 3.0, "/odom", 2.0, 3.0),
    ]
    with pytest.raises(BufgymError, match="must play a recording"):
        list(drops.drops(chosen, scenario.Uplink(traces=(NOTHING,)), [1], 1))


def test_an_episode_is_the_recording_with_x_of_its_own_or_from_elsewhere_or_from_the_number() -> None:
    stream, streams = uplink(recorded((1, 2, 3, 4))), scenario.Streams.seeded(3)
    episode = stream.draw(streams)
    assert (stream.max_messages, episode.link.offset_us) == (4, 0)
    columns = (episode.arrivals[name].tolist() for name in ("arrival_us", "size_bytes", "topic", "x"))
    rows = [(0, 1, 0, 0), (1_000_000, 2, 1, 0), (2_000_000, 3, 0, 1), (3_000_000, 4, 1, 2)]
    assert list(zip(*columns, strict=True)) == rows
    silent = Workload("w", np.array([0, 500_000, 1_000_000]), np.array([1, 1, 1]))
    motion = Motion("m", np.array([0, 1_000_000]), np.array([0.0, 3.0]))
    assert uplink(silent).draw(streams).arrivals["x"].tolist() == [0, 1, 2]
    assert uplink(silent, motion=(motion,)).draw(streams).arrivals["x"].tolist() == [0, 1.5, 3]
    refuse("workload 'drive' has an x of its own", uplink, recorded(), motion=(motion,))
