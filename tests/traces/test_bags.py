"""Recordings of robots, in every container: the same drive reads the same, and what is broken says so."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("mcap", reason="recordings need the extra 'ros'")
pytest.importorskip("rosbags", reason="recordings need the extra 'ros'")

import bag_cases as cases
from mcap.writer import CompressionType
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from bufgym.errors import BufgymError, TraceError
from bufgym.traces import MotionSettings, read_workload, workload_from_bag
from bufgym.traces.formats.bags import is_bag, matching, read_bag

WRITERS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "mcap, zstd": ("mcap", lambda path: cases.write_mcap(path, cases.drive())),
    "mcap, lz4": ("mcap", lambda path: cases.write_mcap(path, cases.drive(), CompressionType.LZ4)),
    "mcap, plain": ("mcap", lambda path: cases.write_mcap(path, cases.drive(), CompressionType.NONE)),
    "mcap of ROS 1": ("mcap", lambda path: cases.write_mcap(path, cases.drive(cases.ROS1), encoding="ros1")),
    "rosbag2, sqlite3": ("rosbag2", lambda path: cases.write_rosbag2(path, cases.drive(), StoragePlugin.SQLITE3)),
    "rosbag2, mcap": ("mcap", lambda path: cases.write_rosbag2(path, cases.drive(), StoragePlugin.MCAP)),
    **{
        f"rosbag2, zstd by {mode.name}": (
            "rosbag2",
            lambda path, mode=mode: cases.write_rosbag2(path, cases.drive(), StoragePlugin.SQLITE3, mode),
        )
        for mode in (CompressionMode.FILE, CompressionMode.MESSAGE)
    },
    "ros1": ("ros1", lambda path: cases.write_ros1(path, cases.drive(cases.ROS1))),
    "ros1, bz2": (
        "ros1",
        lambda path: cases.write_ros1(path, cases.drive(cases.ROS1), Writer1.CompressionFormat.BZ2),
    ),
    "ros1, lz4": (
        "ros1",
        lambda path: cases.write_ros1(path, cases.drive(cases.ROS1), Writer1.CompressionFormat.LZ4),
    ),
}


@pytest.mark.parametrize("container", WRITERS)
def test_the_same_drive_in_every_container(tmp_path: Path, container: str) -> None:
    kind, write = WRITERS[container]
    # No ending: the kind is told from the content.
    path = write(tmp_path / "drive")
    bag = read_bag(path, "/odom")
    assert bag.kind == kind
    assert bag.topics == {
        "/camera/left": "std_msgs/msg/String",
        "/odom": "nav_msgs/msg/Odometry",
        "/status": "std_msgs/msg/String",
    }
    assert np.bincount(bag.topic).tolist() == [5, 3, 1]
    assert (bag.time_ns - cases.START_NS).tolist() == [
        t * cases.MS for t in (0, 0, 500, 700, 1000, 1000, 1500, 2000, 2000)
    ]
    camera = bag.size_bytes[bag.topic == 0]
    # Serialised: ROS 1 is 4 bytes of length and the text; CDR has 4 bytes of header more, and an ending 0.
    per_message = 4 if "ros1" in container or "ROS 1" in container else 9
    assert camera.tolist() == [
        100 + per_message,
        200 + per_message,
        300 + per_message,
        400 + per_message,
        500 + per_message,
    ]
    assert bag.poses is not None and bag.poses_from_ns == cases.START_NS
    assert bag.poses.time_us.tolist() == [0, 1_000_000, 2_000_000]
    assert bag.poses.position_m[:, 0].tolist() == [0, 1, 1]
    workload = workload_from_bag(bag, topics=["/camera/*"])
    # 1 m / 2 m by 1 s, then 90 degrees / 60 degrees by 2 s.
    assert workload.x == pytest.approx([0, 0.25, 0.5, 1.25, 2.0])
    assert workload.arrival_us.tolist() == [0, 500_000, 1_000_000, 1_500_000, 2_000_000]
    assert workload.topics == ("/camera/left",)


def test_the_db3_file_alone_under_any_name(tmp_path: Path) -> None:
    folder = cases.write_rosbag2(tmp_path / "drive", cases.drive(), StoragePlugin.SQLITE3)
    alone = (folder / "drive.db3").rename(tmp_path / "renamed")
    assert len(read_bag(alone).time_ns) == 9


def test_field_of_view_scene_scale_and_what_begins_when(tmp_path: Path) -> None:
    """x begins at the first message chosen: /status at 700 ms, when 0.7 m are behind."""
    path = cases.write_mcap(tmp_path / "drive.mcap", cases.drive())
    workload = read_workload(path, topics=["/status", "/odom"], odom="/odom", settings=MotionSettings(90, 4))
    assert workload.x == pytest.approx([0, 0.175, 0.25, 1.25])
    later = read_workload(path, topics=["/status"], odom="/odom")
    assert later.arrival_us.tolist() == [0] and later.x is not None and later.x.tolist() == [0]
    assert read_workload(path).x is None


def test_messages_logged_out_of_order_are_put_in_order(tmp_path: Path) -> None:
    entries = [(ms, "/t", "std_msgs/msg/String", cases.text("x" * ms)) for ms in (30, 10, 20)]
    workload = read_workload(cases.write_mcap(tmp_path / "w.mcap", entries))
    assert workload.arrival_us.tolist() == [0, 10_000, 20_000]
    assert workload.size_bytes.tolist() == [19, 29, 39]


def test_a_message_without_content_counts_as_a_byte(tmp_path: Path) -> None:
    path = cases.write_mcap(tmp_path / "e.mcap", [(0, "/e", "std_msgs/Empty", b"")], encoding="ros1")
    assert read_bag(path).size_bytes.tolist() == [1]
    assert read_bag(path).topics == {"/e": "std_msgs/msg/Empty"}


def turning(times_ms: list[int]) -> list[cases.Entry]:
    """90 degrees in 9 s, odometry at these times; a message every second from 0 to 9 s."""
    entries = [(t, "/odom", "nav_msgs/msg/Odometry", cases.odometry(0, t / 100)) for t in times_ms]
    return entries + [(1000 * k, "/cam", "std_msgs/msg/String", cases.text("x")) for k in range(10)]


def test_gaps_are_refused_unless_told_to_bridge_them(tmp_path: Path) -> None:
    path = cases.write_mcap(tmp_path / "gap.mcap", turning([0, 1000, 2000, 6000, 7000, 8000]))
    with pytest.raises(
        BufgymError, match=r"/odom has a gap of more than 1 s without a pose, the longest 4.0 s, at 2.0"
    ):
        read_workload(path, topics=["/cam"], odom="/odom")
    bridged = read_workload(path, topics=["/cam"], odom="/odom", bridge_gaps=True)
    assert bridged.gaps == ((2_000_000, 6_000_000),) and bridged.longest_gap_s == 4.0
    # 10 degrees a second throughout; after the last pose (8 s) nothing is known to move.
    assert bridged.x == pytest.approx([k / 6 for k in (0, 1, 2, 3, 4, 5, 6, 7, 8, 8)])
    patient = read_workload(path, topics=["/cam"], odom="/odom", settings=MotionSettings(max_gap_s=4))
    assert patient.gaps == ()


def test_odometry_that_begins_late_or_ends_early_is_a_gap(tmp_path: Path) -> None:
    path = cases.write_mcap(tmp_path / "late.mcap", turning([3000, 4000, 5000]))
    with pytest.raises(BufgymError, match=r"2 gaps of more than 1 s without a pose, the longest 4[.]0 s, at 5[.]0 s"):
        read_workload(path, topics=["/cam"], odom="/odom")
    bridged = read_workload(path, topics=["/cam"], odom="/odom", bridge_gaps=True)
    assert bridged.gaps == ((0, 3_000_000), (5_000_000, 9_000_000))
    assert bridged.x == pytest.approx([k / 6 for k in (0, 0, 0, 0, 1, 2, 2, 2, 2, 2)])
    # Gaps before the first message or after the last are no concern of it.
    path = cases.write_mcap(tmp_path / "long.mcap", turning([-5000, *range(0, 10_000, 1000), 20_000]))
    whole = read_workload(path, topics=["/cam"], odom="/odom")
    assert whole.gaps == () and whole.x == pytest.approx([k / 6 for k in range(10)])


@pytest.mark.parametrize(
    ("odom", "says"),
    [
        ("/nope", "no topic '/nope'; it has: /camera/left, /odom, /status"),
        ("/status", "/status carries std_msgs/msg/String: must be one of nav_msgs/msg/Odometry"),
        ("/odom:a", "must be a topic, or TOPIC:PARENT:CHILD"),
        ("/odom:a:b", "odom = '/odom:a:b': has no pose"),
    ],
)
def test_odometry_that_is_none(tmp_path: Path, odom: str, says: str) -> None:
    path = cases.write_mcap(tmp_path / "drive.mcap", cases.drive())
    with pytest.raises(BufgymError, match=says):
        read_bag(path, odom)


def test_poses_that_are_none(tmp_path: Path) -> None:
    def bag(*data: bytes, encoding: str = "cdr") -> Path:
        entries = [(k, "/odom", "nav_msgs/msg/Odometry", message) for k, message in enumerate(data)]
        return cases.write_mcap(tmp_path / "p.mcap", entries, encoding=encoding)

    good = cases.odometry(0, 0)
    for data, says in (
        ((good, cases.odometry(0, 0, scale=0.5)), "/odom, pose 1, norm = 0.5: must be 1 within 1 %"),
        ((good, cases.odometry(float("nan"), 0)), "pose 1, position = .*nan.*: must be finite and within 1e"),
        ((good,), "'/odom' has 1 pose: needs at least 2"),
        ((good, good[:40]), "cut off or damaged: "),
    ):
        with pytest.raises(BufgymError, match=says):
            read_bag(bag(*data), "/odom")
    with pytest.raises(BufgymError, match="/odom is encoded in 'json': must be cdr or ros1"):
        read_bag(bag(good, good, encoding="json"), "/odom")
    # For arrivals and sizes alone, the encoding does not matter.
    assert len(read_bag(bag(good, good, encoding="json")).time_ns) == 2


def test_topics_by_name_and_pattern() -> None:
    names = ["/camera/left", "/camera/right", "/odom"]
    assert matching("b", names, None) == names
    assert matching("b", names, ["/odom", "/camera/l*"]) == ["/camera/left", "/odom"]
    with pytest.raises(BufgymError, match=r"b: no topic '/lidar\*'; it has: /camera/left, /camera/right, /odom"):
        matching("b", names, ["/odom", "/lidar*"])


def test_what_is_no_recording(tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("not one")
    (tmp_path / "empty").mkdir()
    for name in ("text.mcap", "empty"):
        assert not is_bag(tmp_path / name)
        with pytest.raises(TraceError, match=f"{name}: must be an MCAP file, a ROS 1 bag, or a rosbag2 folder"):
            read_bag(tmp_path / name)
    with pytest.raises(TraceError, match="nothing: no such file"):
        read_bag(tmp_path / "nothing")
    nothing = cases.write_mcap(tmp_path / "nothing.mcap", [])
    with pytest.raises(BufgymError, match="no message on any topic"):
        read_workload(nothing)


def test_lengths_out_of_all_proportion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A time of another unit, a record said to be longer than memory, a chunk that unpacks to more than it may."""
    path = cases.write_mcap(tmp_path / "t.mcap", [(ms, "/t", "x", b"1") for ms in (0, 10**11)])
    with pytest.raises(TraceError, match="spans more than 10000000 s"):
        read_bag(path)
    # The first record after the 8 bytes of magic: one byte of kind, eight of length.
    raw = bytearray(path.read_bytes())
    for length in (2**62, 2**30):
        raw[9:17] = length.to_bytes(8, "little")
        path.write_bytes(raw)
        with pytest.raises(TraceError, match="cut off or damaged"):
            read_bag(path)
    from bufgym.traces.formats import bag_files, bags

    monkeypatch.setattr(bag_files, "MAX_CHUNK_BYTES", 300)
    monkeypatch.setattr(bags, "MAX_BAG_MESSAGES", 8)
    for compression in (CompressionType.ZSTD, CompressionType.LZ4):
        bomb = cases.write_mcap(tmp_path / "b.mcap", [(0, "/t", "x", bytes(10_000))], compression)
        with pytest.raises(TraceError, match=r"a chunk of \d+ bytes: must be at most 300"):
            read_bag(bomb)
    for form in (Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4):
        entries = [(0, "/t", "std_msgs/msg/String", cases.text("x" * 10_000, cases.ROS1))]
        bomb = cases.write_ros1(tmp_path / f"{form.name}.bag", entries, form)
        with pytest.raises(TraceError, match="a chunk of more than 300 bytes"):
            read_bag(bomb)
    monkeypatch.setattr(bag_files, "MAX_CHUNK_BYTES", 2**20)
    many = cases.write_rosbag2(tmp_path / "many", cases.drive(), StoragePlugin.SQLITE3)
    with pytest.raises(TraceError, match="more than 8 messages: must be fewer"):
        read_bag(many)


def test_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    path = cases.write_mcap(tmp_path / "drive.mcap", cases.drive())
    for name in [name for name in sys.modules if name == "mcap" or name.startswith("mcap.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mcap", None)
    with pytest.raises(BufgymError, match=r"reading recordings needs mcap.*: pip install .*mcap"):
        read_bag(path)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The drive as one file of each kind."""
    folder = tmp_path_factory.mktemp("small")
    sqlite = cases.write_rosbag2(folder / "drive", cases.drive(), StoragePlugin.SQLITE3) / "drive.db3"
    return {
        "mcap": cases.write_mcap(folder / "m", cases.drive()).read_bytes(),
        "mcap, plain": cases.write_mcap(folder / "p", cases.drive(), CompressionType.NONE).read_bytes(),
        "ros1": cases.write_ros1(folder / "r", cases.drive(cases.ROS1)).read_bytes(),
        "sqlite3": sqlite.read_bytes(),
    }


@pytest.mark.parametrize("kind", ["mcap", "mcap, plain", "ros1", "sqlite3"])
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(data=st.data())
def test_cut_and_changed_anywhere(tmp_path: Path, small: dict[str, bytes], kind: str, data: Any) -> None:
    """Only a result or the package's own error, which names the file."""
    raw = bytearray(small[kind])
    if data.draw(st.booleans(), "cut"):
        raw = raw[: data.draw(st.integers(0, len(raw) - 1), "at")]
    else:
        for place in data.draw(st.lists(st.integers(0, len(raw) - 1), min_size=1, max_size=8), "places"):
            raw[place] = data.draw(st.integers(0, 255), "byte")
    path = tmp_path / "broken"
    path.write_bytes(raw)
    try:
        workload = read_workload(path, odom="/odom", bridge_gaps=True)
    except BufgymError as error:
        assert "broken" in str(error) and "\n" not in str(error)
    else:
        assert 1 <= len(workload) <= 9


@pytest.mark.parametrize("kind", ["mcap", "mcap, plain", "ros1"])
def test_cut_off_recordings_are_refused(tmp_path: Path, small: dict[str, bytes], kind: str) -> None:
    """A robot that lost power: the recording lacks its end."""
    path = tmp_path / "cut"
    for share in (0.3, 0.6, 0.9):
        path.write_bytes(small[kind][: int(share * len(small[kind]))])
        with pytest.raises(TraceError, match="cut: cut off or damaged: "):
            read_bag(path)


# Messages by topic, and the whole motion (counted by hand from the README there, and with the libraries' own tools).
REAL = {
    "nav2_turtlebot.mcap": ({"/odom": 2639, "/tf": 5422, "/tf_static": 1, "/amcl_pose": 135}, "/odom", 97.36),
    "tf_example.bag": ({"/tf": 517, "/tf_static": 1}, "/tf", 51.6),
    "tf_example": ({"/tf": 517, "/tf_static": 1}, "/tf", 51.6),
}


@pytest.mark.parametrize("name", REAL)
def test_real_recordings(shared_data: Path, name: str) -> None:
    counts, odom, seconds = REAL[name]
    path = shared_data / "rosbags" / name
    if not path.exists():
        pytest.skip(f"recording absent: rosbags/{name}")
    bag = read_bag(path, odom)
    topics = list(bag.topics)
    assert {topics[k]: int(n) for k, n in enumerate(np.bincount(bag.topic))} == counts
    workload = workload_from_bag(dataclasses.replace(bag), topics=[odom], bridge_gaps=True)
    assert workload.duration_us / 1e6 == pytest.approx(seconds, abs=0.05)
    assert workload.x is not None and workload.x[-1] > 1
