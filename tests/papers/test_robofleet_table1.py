"""Sizes of ROS messages, encoded: counted by hand, decoded again, and beside the Robofleet paper's Table I."""

import base64
import json
import math
import re
import sys
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="extra ros")
pytest.importorskip("flatbuffers", reason="extra robofleet")

from flatbuffers.number_types import Float32Flags
from flatbuffers.table import Table

from bufgym.ground.errors import BufgymError, install
from bufgym.papers import encodings
from bufgym.papers.encodings import ENCODINGS, KINDS, content, encode, sizes, stores
from bufgym.papers.robofleet_table1 import PAPER, Reproduction, fitted, of_paper

HEADER = 4 + 8 + 4  # seq, stamp, length of frame_id


def test_ros1_sizes_are_the_sums_of_their_fields() -> None:
    frame_id = "a/longer/frame"
    header = HEADER + len(frame_id)
    pose, twist, covariance = 7 * 8, 6 * 8, 36 * 8
    expected = {
        "PoseStamped": header + pose,
        "LaserScan": header + 7 * 4 + (4 + 5 * 4) + (4 + 3 * 4),
        "NavSatFix": header + (1 + 2) + 3 * 8 + 9 * 8 + 1,
        "CompressedImage": header + (4 + len("png")) + (4 + 100),
        # Each field: its name, offset, datatype, count.
        "PointCloud2": header + 4 + 4 + (4 + 4 * (4 + 4 + 1 + 4) + len("xyzintensity")) + 1 + 4 + 4 + (4 + 6 * 20) + 1,
        "Odometry": header + (4 + len("base")) + pose + covariance + twist + covariance,
    }
    parameters: dict[str, dict[str, Any]] = {
        "LaserScan": {"beams": 5, "intensities": 3},
        "CompressedImage": {"data_bytes": 100, "format": "png"},
        "PointCloud2": {"points": 6, "point_step": 20},
        "Odometry": {"child_frame_id": "base"},
    }
    for kind, size in expected.items():
        assert sizes(kind, frame_id=frame_id, **parameters.get(kind, {}))["ros1"] == size, kind
    assert sizes("RobofleetStatus", status="on", location="lab")["ros1"] == (4 + 2) + 1 + 4 + (4 + 3)


def test_cdr_and_flatbuffer_by_hand() -> None:
    """CDR of a pose; a RobofleetStatus as flatbuffer, each text: length 4, letters, its 0, then a multiple of 4."""
    # Encapsulation 4; stamp 8; frame_id 4 + "map" + its 0; doubles begin at a multiple of 8: 16 already is one.
    assert sizes("PoseStamped", frame_id="map")["cdr"] == 4 + 8 + 4 + 4 + 7 * 8
    assert sizes("PoseStamped", frame_id="maps")["cdr"] == 4 + 8 + 4 + (5 + 7) + 7 * 8
    root = 4
    vtable = 2 + 2 + 5 * 2  # own size, table's size, a slot each for metadata and four fields
    table = 4 + (3 + 1) + 3 * 4  # where the vtable is, is_ok after 3 of padding, status, battery_level, location
    texts = (4 + 2 + 1 + 1) + (4 + 3 + 1)
    size = root + vtable + table + texts
    assert size == 54
    assert sizes("RobofleetStatus", status="on", location="lab")["robofleet-bare"] == 56  # a multiple of 4
    # With metadata: its offset, its table (12) and vtable (8), and two texts.
    with_metadata = size + 4 + 12 + 8 + (4 + len("amrl_msgs/RobofleetStatus") + 1 + 2) + (4 + len("/s") + 1 + 1)
    assert with_metadata == 118
    assert sizes("RobofleetStatus", topic="/s", status="on", location="lab")["robofleet"] == 120


def test_json_by_hand_and_read_back_with_infinity_as_null_and_bytes_two_ways() -> None:
    message = content("RobofleetStatus", status="on", location="lab") | {"battery_level": 1.0}
    spaced = '{"op": "publish", "topic": "/s", "msg": {"status": "on", "is_ok": true, "battery_level": 1.0, '
    assert encode("RobofleetStatus", message, "json", "/s").decode() == spaced + '"location": "lab"}}'
    compact = '{"op":"publish","topic":"/s","msg":{"status":"on","is_ok":true,"battery_level":1,"location":"lab"}}'
    assert encode("RobofleetStatus", message, "json-numbers", "/s").decode() == compact
    scan = content("LaserScan", beams=40, no_return=0.25)
    assert np.isinf(scan["ranges"]).sum() == 10
    for encoding in ("json", "json-numbers"):
        operation = json.loads(encode("LaserScan", scan, encoding, "/scan"))
        assert (operation["op"], operation["topic"]) == ("publish", "/scan")
        ranges = [math.inf if x is None else x for x in operation["msg"]["ranges"]]
        np.testing.assert_array_equal(np.array(ranges, np.float32), scan["ranges"])
        assert operation["msg"]["header"]["stamp"] == {"secs": 1_600_000_000, "nsecs": 123_456_789}
    image = content("CompressedImage", data_bytes=1000)
    data = [json.loads(encode("CompressedImage", image, e))["msg"]["data"] for e in ("json", "json-numbers")]
    assert base64.b64decode(data[0]) == image["data"].tobytes() and data[1] == image["data"].tolist()


def same(ours: Any, theirs: Any) -> None:
    """Every field that rosbags read is the one we wrote."""
    if isinstance(ours, dict):
        for name in theirs.__dataclass_fields__:
            if not name.startswith("_") and not name.isupper():  # constants of the definition are in capitals
                same(ours[name], getattr(theirs, name))
    elif isinstance(ours, list):
        assert len(ours) == len(theirs)
        for mine, its in zip(ours, theirs, strict=True):
            same(mine, its)
    elif isinstance(ours, np.ndarray):
        np.testing.assert_array_equal(ours, theirs)
    else:
        assert ours == theirs


def test_ros_reads_what_was_written() -> None:
    for kind, (type_name, *_) in KINDS.items():
        message = content(kind, seed=3)
        same(message, stores()["ros1"].deserialize_ros1(encode(kind, message, "ros1"), type_name))
        same(message, stores()["cdr"].deserialize_cdr(encode(kind, message, "cdr"), type_name))


def test_flatbuffers_read_by_the_released_slots() -> None:
    """Of a scan, by the library's own table: metadata 0, header 1, numbers from 2 on, ranges 9."""
    scan = content("LaserScan", beams=37, intensities=5, no_return=0.5, seed=1)
    data = encode("LaserScan", scan, "robofleet", "/a/topic")
    table = Table(bytearray(data), int(np.frombuffer(data, "<u4", 1)[0]))

    def text(outer: int, slot: int) -> str:
        inner = Table(table.Bytes, table.Indirect(table.Pos + table.Offset(4 + 2 * outer)))
        return inner.String(inner.Pos + inner.Offset(4 + 2 * slot)).decode()

    assert (text(0, 0), text(0, 1)) == ("sensor_msgs/LaserScan", "/a/topic")
    assert text(1, 3) == scan["header"]["frame_id"]
    names = ("angle_min", "angle_max", "angle_increment", "time_increment", "scan_time", "range_min", "range_max")
    for slot, name in enumerate(names, start=2):
        assert table.Get(Float32Flags, table.Pos + table.Offset(4 + 2 * slot)) == scan[name]
    for slot, name in ((9, "ranges"), (10, "intensities")):
        offset = table.Offset(4 + 2 * slot)
        numbers = np.frombuffer(data, "<f4", table.VectorLen(offset), table.Vector(offset))
        np.testing.assert_array_equal(numbers, scan[name])


def test_the_fitted_messages_have_the_papers_bytes_as_ros_binary() -> None:
    for beams in (1786, 1800, 1802):
        assert all(len(encode(kind, message, "ros1")) == PAPER[kind][0] for kind, message in fitted(beams).items())
    data = content("CompressedImage", data_bytes=50_000)["data"].tolist()  # with a JPEG's markers and no other
    assert (data[:2], data[-2:]) == ([0xFF, 0xD8], [0xFF, 0xD9])
    assert {data[i + 1] for i in range(2, len(data) - 3) if data[i] == 0xFF} == {0}


def test_table1_stands_beside_the_papers() -> None:
    rows = Reproduction().simulate()
    ours = {(row["message"], row["encoding"]): row["bytes"] for row in rows}
    ratio = {(row["message"], row["encoding"]): row["ours_to_paper"] for row in rows}
    assert len(rows) == len(KINDS) * len(ENCODINGS)
    bare = [ours[kind, "robofleet-bare"] - PAPER[kind][1] for kind in ("NavSatFix", "LaserScan", "CompressedImage")]
    assert bare == [0, 4, 24]
    # Bytes as a list of numbers is what the paper measured; base64 is not.
    assert float(ratio["CompressedImage", "json-numbers"]) == pytest.approx(1, abs=0.005)
    assert float(ratio["CompressedImage", "json"]) < 0.4
    assert ratio["PoseStamped", "json"] == ratio["LaserScan", "cdr"] is of_paper("PoseStamped", "ros1") is None


def test_what_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind, parameters, rule in (
        ("Laser", {}, "unknown kind of message 'Laser'; known: LaserScan, NavSatFix"),
        ("LaserScan", {"rays": 3}, "LaserScan: no parameter 'rays'; it has: beams, intensities"),
        ("LaserScan", {"no_return": 1.5}, "no_return = 1.5: must be from 0 to 1"),
        ("LaserScan", {"beams": 2.5}, "beams = 2.5: must be a whole number"),
        ("PointCloud2", {"point_step": 12}, "point_step = 12: must be a whole number from 16"),
        ("PoseStamped", {"frame_id": "grün"}, "frame_id = 'grün': must be a text of at most 255 ASCII letters"),
        ("Odometry", {"seed": -1}, "seed = -1: must be a whole number >= 0"),
    ):
        with pytest.raises(BufgymError, match=re.escape(rule)):
            sizes(kind, **parameters)
    with pytest.raises(BufgymError, match="unknown encoding 'xml'; known: ros1, cdr, robofleet"):
        encode("PoseStamped", content("PoseStamped"), "xml")
    for beams in (1785, 1803):
        with pytest.raises(BufgymError, match=f"beams = {beams}: 7260 bytes would need a frame_id of"):
            Reproduction(beams=beams).simulate()
    stores.cache_clear()
    for library, encoding, extra in (("rosbags.typesys", "cdr", "ros"), ("flatbuffers", "robofleet", "robofleet")):
        monkeypatch.setitem(sys.modules, library, None)  # None there makes the import fail
        with pytest.raises(BufgymError, match=re.escape(f"needs {library}: {install(extra)}")):
            encode("PoseStamped", content("PoseStamped"), encoding)
        assert len(encode("PoseStamped", content("PoseStamped"), "json")) > 0  # which needs neither
    assert "flatbuffers" not in vars(encodings) and "rosbags" not in vars(encodings)
