"""Recordings of robots, in every container: the same drive reads the same, and what is broken or too much says so."""

import gzip
import math
import os
import sqlite3
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from needs import needs
from recording_cases import ODD_FILES, fetched
from refusal_cases import refuse
from ros_cases import made

pytest.importorskip("mcap", reason=needs("extras", "mcap"))
pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))

import bag_cases as cases
import zstandard
from mcap.writer import CompressionType
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from bufgym.traces import MotionSettings, read_workload, workload_from_bag
from bufgym.traces.datasets.unpack import unpack
from bufgym.traces.formats import bag_files, bags
from bufgym.traces.formats.bags import read_bag
from bufgym.traces.formats.splits import is_recording
from bufgym.utils.errors import TraceWarning

ODOMETRY, STRING = "nav_msgs/msg/Odometry", "std_msgs/msg/String"


def mcap(compression: CompressionType = CompressionType.ZSTD) -> Callable[[Path], Path]:
    return lambda path: cases.write_mcap(path, cases.drive(), compression)


def rosbag2(plugin: StoragePlugin, mode: CompressionMode = CompressionMode.NONE) -> Callable[[Path], Path]:
    return lambda path: cases.write_rosbag2(path, cases.drive(), plugin, mode)


def ros1(compression: Any = None) -> Callable[[Path], Path]:
    return lambda path: cases.write_ros1(path, cases.drive(cases.ROS1), compression)


# The kind that is told, and bytes of a text besides its letters: ROS 1 has 4 of length; CDR a header of 4, and a 0.
WRITERS: dict[str, tuple[str, int, Callable[[Path], Path]]] = {
    "mcap, zstd": ("mcap", 9, mcap()),
    "mcap, lz4": ("mcap", 9, mcap(CompressionType.LZ4)),
    "mcap, plain": ("mcap", 9, mcap(CompressionType.NONE)),
    "mcap, ros1": ("mcap", 4, lambda path: cases.write_mcap(path, cases.drive(cases.ROS1), encoding="ros1")),
    "rosbag2, sqlite3": ("rosbag2", 9, rosbag2(StoragePlugin.SQLITE3)),
    "rosbag2, mcap": ("mcap", 9, rosbag2(StoragePlugin.MCAP)),
    "rosbag2, zstd by file": ("rosbag2", 9, rosbag2(StoragePlugin.SQLITE3, CompressionMode.FILE)),
    "rosbag2, zstd by message": ("rosbag2", 9, rosbag2(StoragePlugin.SQLITE3, CompressionMode.MESSAGE)),
    "ros1": ("ros1", 4, ros1()),
    "ros1, bz2": ("ros1", 4, ros1(Writer1.CompressionFormat.BZ2)),
    "ros1, lz4": ("ros1", 4, ros1(Writer1.CompressionFormat.LZ4)),
}


@pytest.mark.parametrize("container", WRITERS)
def test_the_same_drive_in_every_container(tmp_path: Path, container: str) -> None:
    kind, besides, write = WRITERS[container]
    path = write(tmp_path / "drive")  # no ending: the kind is told from the content
    bag = read_bag(path, "/odom")
    assert bag.kind == kind and bag.topics == {"/camera/left": STRING, "/odom": ODOMETRY, "/status": STRING}
    assert np.bincount(bag.topic).tolist() == [5, 3, 1]
    assert ((bag.time_ns - cases.START_NS) // cases.MS).tolist() == [0, 0, 500, 700, 1000, 1000, 1500, 2000, 2000]
    assert bag.size_bytes[bag.topic == 0].tolist() == [size + besides for size in (100, 200, 300, 400, 500)]
    assert bag.poses is not None and bag.poses_from_ns == cases.START_NS
    assert bag.poses.time_us.tolist() == [0, 1_000_000, 2_000_000]
    assert bag.poses.position_m[:, 0].tolist() == [0, 1, 1]
    workload = workload_from_bag(bag, topics=["/camera/*"])
    # 1 m / 2 m by 1 s, then 90 degrees / 60 degrees by 2 s.
    assert workload.x == pytest.approx([0, 0.25, 0.5, 1.25, 2.0]) and workload.topics == ("/camera/left",)
    assert workload.arrival_us.tolist() == [0, 500_000, 1_000_000, 1_500_000, 2_000_000]


def test_x_begins_at_the_first_message_chosen(tmp_path: Path) -> None:
    """/status at 700 ms, when 0.7 m are behind; and the field of view and the scene's scale are those asked for."""
    path = mcap()(tmp_path / "drive.mcap")
    workload = read_workload(path, topics=["/status", "/odom"], odom="/odom", settings=MotionSettings(90, 4))
    assert workload.x == pytest.approx([0, 0.175, 0.25, 1.25])
    later = read_workload(path, topics=["/status"], odom="/odom")
    assert later.arrival_us.tolist() == [0] and later.x is not None and later.x.tolist() == [0]
    assert read_workload(path).x is None
    # Messages out of order, and without content.
    entries = [(ms, "/t", STRING, cases.text("x" * ms)) for ms in (30, 10, 20)]
    with pytest.warns(TraceWarning, match="2 of 3 messages logged before .* at most 0.02 s .message 2 ./t, logged at"):
        workload = read_workload(cases.write_mcap(tmp_path / "w.mcap", entries))
    assert workload.arrival_us.tolist() == [0, 10_000, 20_000] and workload.size_bytes.tolist() == [19, 29, 39]
    empty = read_bag(cases.write_mcap(tmp_path / "e.mcap", [(0, "/e", "std_msgs/Empty", b"")], encoding="ros1"))
    assert empty.size_bytes.tolist() == [1] and empty.topics == {"/e": "std_msgs/msg/Empty"}


def test_gaps_are_refused_unless_told_to_bridge_them(tmp_path: Path) -> None:
    """Turning by 10 degrees a second, odometry at these times; after the last pose nothing is known to move."""
    for k, (times_s, says, gaps, tens) in enumerate(
        (
            ([0, 1, 2, 6, 7, 8], "a gap of more than 1 s .*, the longest 4.0 s, at 2.0", [(2, 6)], [*range(9), 8]),
            ([3, 4, 5], "2 gaps .*, the longest 4[.]0 s, at 5[.]0 s", [(0, 3), (5, 9)], [0, 0, 0, 0, 1, 2, 2, 2, 2, 2]),
            # Gaps before the first message or after the last are no concern of it.
            ([-5, *range(10), 20], None, [], range(10)),
        )
    ):
        turning = [(1000 * t, "/odom", ODOMETRY, cases.odometry(0, 10 * t)) for t in times_s]
        messages = [(1000 * t, "/cam", STRING, cases.text("x")) for t in range(10)]
        path = cases.write_mcap(tmp_path / f"{k}.mcap", sorted(turning + messages))
        if says:
            refuse(f"/odom has {says}", read_workload, path, topics=["/cam"], odom="/odom")
        bridged = read_workload(path, topics=["/cam"], odom="/odom", bridge_gaps=says is not None)
        assert bridged.gaps == tuple((a * 1_000_000, b * 1_000_000) for a, b in gaps)
        assert bridged.longest_gap_s == (4.0 if gaps else 0.0)
        assert bridged.x == pytest.approx([ten / 6 for ten in tens])
        assert read_workload(path, topics=["/cam"], odom="/odom", settings=MotionSettings(max_gap_s=4)).gaps == ()


def test_odometry_that_is_none(tmp_path: Path) -> None:
    def odometry(*data: bytes, encoding: str = "cdr") -> Path:
        entries = [(k, "/odom", ODOMETRY, message) for k, message in enumerate(data)]
        return cases.write_mcap(tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap", entries, encoding=encoding)

    drive, good = mcap()(tmp_path / "drive.mcap"), cases.odometry(0, 0)
    for path, odom, says in (
        (drive, "/nope", "no topic '/nope'; it has: /camera/left, /odom, /status"),
        (drive, "/status", "/status carries std_msgs/msg/String: must be one of nav_msgs/msg/Odometry"),
        (drive, "/odom:a:b", "odom = '/odom:a:b': say which frames: /odom:odom:base"),
        (drive, "/goal_pose", "odom = '/goal_pose': /goal_pose is a goal, no place where the robot is"),
        (odometry(good, cases.odometry(0, 0, scale=0.5)), "/odom", "/odom, pose 2, norm = 0.5: must be 1 within 1 %"),
        (odometry(good, cases.odometry(math.nan, 0)), "/odom", "pose 2, position = .*nan.*: must be finite and wit"),
        (
            odometry(good, good[:40]),
            "/odom",
            "message 2 on /odom is cut off or damaged, or of another definition than nav",
        ),
        (odometry(good, good, encoding="json"), "/odom", "/odom is encoded in 'json': must be cdr or ros1"),
    ):
        refuse(says, read_bag, path, odom)
    # One topic in two frames: 1 m in one, and a place in the other that is 90 m off.
    moved, other = cases.odometry(1, 0), cases.odometry(90, 0).replace(b"odom", b"mapa")
    mixed = odometry(good, other, moved, other)
    refuse("odom = '/odom': say which frames: /odom:mapa:base, /odom:odom:base", read_bag, mixed, "/odom")
    one = read_workload(mixed, odom="/odom:odom")
    assert one.x is not None and one.x[-1] == 0.5
    # For arrivals and sizes alone, the encoding does not matter.
    assert len(read_bag(odometry(good, good, encoding="json")).time_ns) == 2


def refused(path: Path, says: str) -> None:
    refuse(says, read_bag, path)


def test_what_is_no_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "text.mcap").write_text("not one")
    (tmp_path / "empty").mkdir()
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "folder" / "a.mcap")
    nothing, drive = cases.write_mcap(tmp_path / "nothing.mcap", []), mcap()(tmp_path / "drive.mcap")
    assert not is_recording(tmp_path / "text.mcap") and not is_recording(tmp_path / "empty")
    for name in ("text.mcap", "empty"):
        refused(tmp_path / name, f"{name}: must be an MCAP file, a ROS 1 bag, or a rosbag2 folder")
    refused(tmp_path / "absent", "absent: no such file")
    refused(tmp_path / "folder", r"a\.mcap: must be a regular file")
    refuse("no message on any topic", read_workload, nothing)
    for name in [name for name in sys.modules if name == "mcap" or name.startswith("mcap.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mcap", None)
    refused(drive, r'reading recordings needs mcap.*: pip install "bufgym\[ros\]"')


def test_times_records_chunks_and_counts_out_of_all_proportion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = cases.write_mcap(tmp_path / "t.mcap", [(ms, "/t", "x", b"1") for ms in (0, 10**11)])
    refused(path, r"message 2 \(/t, .* is 100000000 s from message 1 .*: a recording spans at most 10000000 s")
    raw = bytearray(path.read_bytes())
    for length in (2**62, 2**30):  # of the first record, after the 8 bytes of magic and one of kind
        raw[9:17] = length.to_bytes(8, "little")
        path.write_bytes(raw)
        refused(path, "cut off or damaged")
    many = cases.write_mcap(tmp_path / "m.mcap", [(k, f"/t{k}", "x", b"1") for k in range(20)])
    assert len(read_bag(many).topics) == 20
    monkeypatch.setattr(bags, "MAX_TOPICS", 19)
    refused(many, "more than 19 topics")
    drive = rosbag2(StoragePlugin.SQLITE3, CompressionMode.MESSAGE)(tmp_path / "drive")
    assert len(read_bag(drive).time_ns) == 9
    monkeypatch.setattr(bag_files, "MAX_CHUNK_BYTES", 1000)
    with sqlite3.connect(drive / "drive.db3") as base:
        base.execute("UPDATE messages SET data = ?", (zstandard.compress(bytes(2000)),))
    refused(drive, "a message of more than 1000 bytes")
    for compression in (CompressionType.ZSTD, CompressionType.LZ4):
        bomb = cases.write_mcap(tmp_path / "b.mcap", [(0, "/t", "x", bytes(10_000))], compression)
        refused(bomb, r"a chunk of \d+ bytes: must be at most 1000")
    for form in (Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4):
        entries = [(0, "/t", STRING, cases.text("x" * 10_000, cases.ROS1))]
        refused(cases.write_ros1(tmp_path / f"{form.name}.bag", entries, form), "a chunk of more than 1000 bytes")


def test_a_recording_unpacks_to_no_more_than_it_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """100 kB may be unpacked from next to nothing, instead of 64 MiB."""
    monkeypatch.setattr("bufgym.utils.files.FREELY_UNPACKED_BYTES", 100_000)
    for mode in (CompressionMode.FILE, CompressionMode.MESSAGE):
        entries = [(0, "/t", STRING, cases.text("x" * 20_000_000))]
        path = cases.write_rosbag2(tmp_path / f"bomb{mode.name}", entries, StoragePlugin.SQLITE3, mode)
        assert sum(file.stat().st_size for file in path.iterdir()) < 50_000
        refused(path, r"bomb.*: .*unpacks to more than \d+ bytes: must be less")
    chunks = cases.write_mcap(tmp_path / "b.mcap", [(ms, "/t", "x", bytes(50_000)) for ms in range(60)])
    refused(chunks, "unpacks to more than")
    # Refused from the header's own number, before a byte is written.
    zeros, header = tmp_path / "zeros.tgz", tarfile.TarInfo("zeros.csv")
    header.size = 10_000_000
    with gzip.open(zeros, "wb") as file:
        file.write(header.tobuf() + bytes(header.size))
    refuse(r"unpacks to more than \d+ bytes", unpack, zeros, tmp_path / "zeros")
    assert not (tmp_path / "zeros").exists()


def test_the_metadata_of_a_rosbag2_is_bounded(tmp_path: Path) -> None:
    path = rosbag2(StoragePlugin.SQLITE3)(tmp_path / "drive")
    file = path / "metadata.yaml"
    text = file.read_text()
    file.write_text(text + "  deep: " + "[" * 100_000)  # so deep that libyaml's own composer crashes
    refused(path, r"metadata.yaml: nested more than 50 deep")
    for old, new, says in (
        ("storage_identifier: sqlite3", "storage_identifier: pickle", "must be sqlite3 or mcap"),
        ("storage_identifier: sqlite3", "storage_identifier: [sqlite3]", "must be sqlite3 or mcap"),
        ("- drive.db3", "- ../../../dev/zero", "zero: no such file, which metadata.yaml names"),
    ):
        file.write_text(text.replace(old, new))
        refused(path, says)
    os.truncate(file, 1 << 32)
    refused(path, "larger than 8388608 bytes")
    assert len(read_bag((path / "drive.db3").rename(tmp_path / "alone")).time_ns) == 9  # the file alone, by any name
    # A column of a gigabyte that is computed when it is read.
    with sqlite3.connect(tmp_path / "bomb.db3") as base:
        base.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        base.execute("INSERT INTO topics VALUES (1, '/t', 'x', 'cdr')")
        base.execute("CREATE TABLE messages(topic_id, timestamp, data AS (zeroblob(900000000)))")
        base.execute("INSERT INTO messages VALUES (1, 0)")
    refused(tmp_path / "bomb.db3", "cut off or damaged")


def test_cut_off_recordings_are_refused(tmp_path: Path) -> None:
    for kind in ("mcap, zstd", "mcap, plain", "ros1"):
        path = WRITERS[kind][2](tmp_path / f"{kind} cut")
        whole = path.read_bytes()
        for share in (0.0, 0.3, 0.6, 0.9):
            path.write_bytes(whole[: int(share * len(whole))])
            refused(path, r"cut: (cut off or damaged: |must be an MCAP file)")


def test_real_recordings() -> None:
    nav2, tree = {"/odom": 2639, "/tf": 5422, "/tf_static": 1, "/amcl_pose": 135}, {"/tf": 517, "/tf_static": 1}
    for name, counts, odom, seconds in (
        ("nav2_turtlebot.mcap", nav2, "/odom", 97.36),
        ("tf_example.bag", tree, "/tf", 51.6),
        ("tf_example", tree, "/tf", 51.6),
    ):
        bag = read_bag(fetched("evo-bags") / name, odom)
        assert {list(bag.topics)[k]: int(n) for k, n in enumerate(np.bincount(bag.topic))} == counts
        workload = workload_from_bag(bag, topics=[odom], bridge_gaps=True)
        assert workload.duration_us / 1e6 == pytest.approx(seconds, abs=0.05)
        assert workload.x is not None and workload.x[-1] > 1


def transforms(*of: tuple[str, str, float, float]) -> bytes:
    """A TFMessage of (parent, child, x in m, yaw in degrees)."""
    stamped = []
    for parent, child, x_m, yaw_deg in of:
        half = math.radians(yaw_deg) / 2
        turn = made(cases.ROS2, "geometry_msgs/msg/Quaternion", z=math.sin(half), w=math.cos(half))
        place = made(cases.ROS2, "geometry_msgs/msg/Vector3", x=x_m)
        moved = made(cases.ROS2, "geometry_msgs/msg/Transform", translation=place, rotation=turn)
        header = made(cases.ROS2, "std_msgs/msg/Header", frame_id=parent)
        stamped.append(
            made(cases.ROS2, "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=moved)
        )
    message = cases.ROS2.types["tf2_msgs/msg/TFMessage"](transforms=stamped)
    return bytes(cases.ROS2.serialize_cdr(message, "tf2_msgs/msg/TFMessage"))


def test_a_chain_of_transforms_is_one(tmp_path: Path) -> None:
    """The robot goes 1 m a second in odom, which turns by 90 degrees in the first second; the camera is 1 m ahead.

    So in the map the camera is at (1, 0), after half a second at 45 degrees 1.5 m away, then at (0, 2) and (0, 3).
    """
    tf = "tf2_msgs/msg/TFMessage"
    entries = [(0, "/tf_static", tf, transforms(("base", "camera", 1, 0)))]
    for k in (0, 1, 2, 4):
        corrected = [("map", "odom", 0, 45 * k)] if k in (0, 2) else []
        entries.append((500 * k, "/tf", tf, transforms(*corrected, ("odom", "base", 0.5 * k, 0))))
    path = cases.write_mcap(tmp_path / "tf.mcap", entries)
    poses = read_bag(path, "/tf:map:camera").poses
    assert poses is not None and poses.time_us.tolist() == [0, 500_000, 1_000_000, 2_000_000]
    half = 1.5 * math.sqrt(0.5)
    np.testing.assert_allclose(poses.position_m, [[1, 0, 0], [half, half, 0], [0, 2, 0], [0, 3, 0]], atol=1e-12)
    assert poses.format == "/tf, map -> odom -> base -> camera"
    for odom in ("/tf", "/tf:camera:map", "/tf:map:arm", "/tf:base:camera"):
        refuse("say which frames: /tf:map:odom, /tf:odom:base .or of a chain, from its first", read_bag, path, odom)


def test_odd_transforms() -> None:
    """199 steps of 0.03 m in a motion capture's own type; and over a chain of tf with 9 corrections of 0.02 m."""
    for name, odom, total_m in (("vicon.mcap", "/vicon/r", 5.97), ("tf_chain.mcap", "/tf:map:base_link", 6.15)):
        workload = read_workload(ODD_FILES / "turn7" / name, odom=odom)
        assert workload.x is not None and workload.x[-1] == pytest.approx(total_m / 2)


def test_satellite_fixes_are_metres_in_a_plane(tmp_path: Path) -> None:
    """A minute of arc north at 45 degrees is 1852.2 m on the meridian of WGS 84, one east 1314.2 m; one is no fix."""
    entries = []
    for k, (latitude, longitude, status) in enumerate(
        ((45, 7, 0), (0, 0, -1), (45 + 1 / 60, 7, 0), (45, 7 + 1 / 60, 0))
    ):
        about = made(cases.ROS2, "sensor_msgs/msg/NavSatStatus", status=status)
        fix = made(
            cases.ROS2,
            "sensor_msgs/msg/NavSatFix",
            latitude=latitude,
            longitude=longitude,
            altitude=100.0,
            status=about,
        )
        data = bytes(cases.ROS2.serialize_cdr(fix, "sensor_msgs/msg/NavSatFix"))
        entries.append((1000 * k, "/gps/fix", "sensor_msgs/msg/NavSatFix", data))
    path = cases.write_mcap(tmp_path / "gps.mcap", entries)
    with pytest.warns(TraceWarning, match="pose 2 of 3 .* is 1852"):
        poses = read_bag(path, "/gps/fix").poses
    assert poses is not None and "satellite receiver, no orientation" in poses.format
    np.testing.assert_allclose(np.linalg.norm(poses.position_m, axis=1), [0, 1852.2, 1314.2], rtol=1e-4)
    assert poses.position_m[1, 1] > 1852 and poses.position_m[2, 0] > 1314
