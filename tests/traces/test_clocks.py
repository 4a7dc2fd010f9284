"""The recorder's clock: a step back is found in every container, and what threads log out of order is no step."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from needs import needs
from refusal_cases import refuse

pytest.importorskip("mcap", reason=needs("extras", "mcap"))
pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))

import bag_cases as cases
from rosbags.rosbag2 import StoragePlugin

from bufgym.traces import read_workload
from bufgym.traces.formats.bags import read_bag
from bufgym.utils.errors import TraceError, TraceWarning

ODOMETRY, STRING = "nav_msgs/msg/Odometry", "std_msgs/msg/String"


def odometry(at_ms: list[int], store: Any = cases.ROS2, stamped: bool = False) -> list[cases.Entry]:
    """A robot that drives at 1 m/s, whose odometry of every 50 ms was logged at these times."""
    poses = [cases.odometry(0.05 * k, 0, store, stamp_ms=50 * k if stamped else -1) for k in range(len(at_ms))]
    return [(ms, "/odom", ODOMETRY, pose) for ms, pose in zip(at_ms, poses, strict=True)]


def stepped(size_ms: int, before: int = 30) -> list[int]:
    """Log times of every 50 ms by a clock that goes back by ``size_ms`` before message ``before`` (from 0)."""
    return [50 * k - size_ms * (k >= before) for k in range(60)]


CONTAINERS: dict[str, tuple[Any, Callable[[Path, list[cases.Entry]], Path]]] = {
    "mcap": (cases.ROS2, cases.write_mcap),
    "sqlite3": (cases.ROS2, lambda path, entries: cases.write_rosbag2(path, entries, StoragePlugin.SQLITE3)),
    "ros1": (cases.ROS1, cases.write_ros1),
}


@pytest.mark.parametrize("container", CONTAINERS)
def test_a_clock_that_went_back_is_refused_with_place_and_size(tmp_path: Path, container: str) -> None:
    store, write = CONTAINERS[container]
    good = write(tmp_path / "good", odometry(stepped(0), store, stamped=True))
    assert read_workload(good, odom="/odom").x == pytest.approx([0.025 * k for k in range(60)])
    for size_ms in (120, 700, 3_600_000):
        # Message 31 would have come at 1500 ms; 30 came at 1450.
        for stamped, says in (
            (True, f"by {size_ms / 1000:.6g} s"),
            (False, f"by at least {size_ms / 1000 - 0.05:.6g} s"),
        ):
            path = write(tmp_path / f"{size_ms}-{stamped}", odometry(stepped(size_ms), store, stamped))
            place = r"before message 31 \(/odom, logged at .*\), after message 30 \(/odom, logged at 1700000001.450 s\)"
            refuse(f"the recorder's clock goes back {says} {place}", read_bag, path, kind=TraceError)


def with_pictures(odometry: list[cases.Entry]) -> list[cases.Entry]:
    """20 ms after each message one of /camera, next to it in the file."""
    return [one for entry in odometry for one in (entry, (entry[0] + 20, "/camera", STRING, cases.text("x")))]


def test_a_step_shorter_than_the_period_shows_by_the_header_stamps(tmp_path: Path) -> None:
    """Odometry never goes back by itself: 1450, then 1455. But a picture of 1470 comes before it in the file."""
    for stamped in (True, False):
        entries = with_pictures(odometry(stepped(45), stamped=stamped))
        path = cases.write_mcap(tmp_path / f"{stamped}.mcap", entries)
        if stamped:
            place = r"before message 61 \(/odom, logged at 1700000001.455 s\), after message 60 \(/camera"
            refuse(f"goes back by 0.045 s {place}", read_bag, path)
        else:
            with pytest.warns(
                TraceWarning, match=r"1 of 120 messages logged before .* at most 0.015 s \(message 61 \(/odom"
            ):
                read_bag(path)


@pytest.mark.parametrize("sound", ["fast", "settled"])
def test_stamps_that_come_nearer_to_sound_log_times_are_no_step(tmp_path: Path, sound: str) -> None:
    """Threads log a picture 15 ms early at 1450 and 1470, where stamps come nearer as they do in sound recordings.

    A simulation at double speed: 50 ms each 25 ms. A pose whose filter needs 45 ms less from then on, while that of the
    wheels needs what it did.
    """
    entries = odometry([50 * k for k in range(60)], stamped=True)
    if sound == "fast":
        entries = odometry([25 * k for k in range(60)], stamped=True)
    else:
        filtered = [(ms - 45 * (k >= 30) + 46, "/ekf", type, pose) for k, (ms, _, type, pose) in enumerate(entries)]
        entries = [one for pair in zip(entries, filtered, strict=True) for one in pair]
    place = len(entries) // 2
    entries.insert(place, (entries[place][0] + 15, "/camera", STRING, cases.text("x")))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        bag = read_bag(cases.write_mcap(tmp_path / "sound.mcap", entries))
    assert len(bag.time_ns) == len(entries)
    assert "messages logged before a message above them" in bag.sheet.doubts[0]
    assert [str(one.message) for one in caught] == list(bag.sheet.doubts) and len(caught) == 1 + (sound == "fast")
    if sound == "fast":
        assert "header stamps on /odom go on by 2 s in a second of log time (2.95 s in 1.475 s)" in bag.sheet.doubts[1]


def test_what_threads_log_out_of_order_is_sorted_and_said(tmp_path: Path) -> None:
    """One message late by 120 ms, one early; two topics written one after the other; but not one late by 2 s."""
    late, early = stepped(0), stepped(0)
    late[30] -= 120
    early[30] += 120
    pictures = [(50 * k, "/camera", STRING, cases.text("x")) for k in range(60)]
    for name, entries, count, most_s in (
        ("late", odometry(late, stamped=True), 1, 0.07),
        ("early", odometry(early, stamped=True), 2, 0.07),
        ("topics", odometry(stepped(0)) + pictures, 59, 2.95),
    ):
        path = cases.write_mcap(tmp_path / f"{name}.mcap", entries)
        with pytest.warns(
            TraceWarning, match=f"{name}.mcap: {count} of .* at most {most_s} s .*: taken in order of log"
        ):
            bag = read_bag(path)
        assert bag.time_ns.tolist() == sorted(bag.time_ns.tolist())
    late[30] -= 2000
    refuse("goes back by .* before message 31", read_bag, cases.write_mcap(tmp_path / "far.mcap", odometry(late)))


def test_log_times_that_are_none(tmp_path: Path) -> None:
    zero_ms = -cases.START_NS // cases.MS
    for place, ms, says in (
        (0, zero_ms, r"message 1 \(/odom, logged at 0.000 s\) has no log time: all messages must have one"),
        (7, zero_ms, r"message 8 \(/odom, logged at 0.000 s\) has no log time"),
        (
            59,
            zero_ms + 1,
            r"message 60 .*logged at 0.001 s\) is 1700000002 s from message 59 .*: a recording spans at most",
        ),
        (30, 2_600_000_000_000, r"message 31 \(/odom, logged at 4300000000.000 s\) is 2599999998 s from message 30"),
        (
            30,
            (2**63 - cases.START_NS) // cases.MS + 1,
            r"message 31 \(/odom\), log time in ns = \d+: must be from 0 to 2\*\*63 - 1 ns",
        ),
    ):
        times = stepped(0)
        times[place] = ms
        path = cases.write_mcap(tmp_path / f"{place}{ms}.mcap", odometry(times))
        refuse(says, read_bag, path, kind=TraceError)
    unset = cases.write_mcap(tmp_path / "unset.mcap", odometry([zero_ms] * 60))
    refuse("message 1 .* has no log time", read_bag, unset)
    # A simulated clock begins at 0.
    simulated = cases.write_mcap(tmp_path / "sim.mcap", odometry([zero_ms + 50 * k for k in range(60)]))
    assert read_workload(simulated).duration_us == 2_950_000
