"""Sizes of ROS messages, encoded: counted by hand, decoded again, and beside the Robofleet paper's Table I."""

import base64
import json
import math
import re
import sys
from typing import Any

import numpy as np
import pytest
from needs import needs
from refusal_cases import refuse

pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))
pytest.importorskip("flatbuffers", reason=needs("extras", "flatbuffers"))

from flatbuffers.number_types import Float32Flags
from flatbuffers.table import Table
from rosbags.typesys import get_types_from_msg

from bufgym.utils.errors import install
from studies import encodings
from studies.encodings import KINDS, Kind, content, encode, stores
from studies.robofleet_table1 import PAPER, Reproduction, fitted

HEADER = 4 + 8 + 4  # seq, stamp, length of frame_id
STATUS = {"status": "on", "is_ok": True, "battery_level": 1.0, "location": "lab"}


@pytest.fixture(autouse=True)
def status(monkeypatch: pytest.MonkeyPatch) -> None:
    """A short message of Robofleet's own, to be counted by hand."""
    of, fields = "amrl_msgs/msg/RobofleetStatus", "string status\nbool is_ok\nfloat32 battery_level\nstring location\n"
    monkeypatch.setitem(KINDS, "RobofleetStatus", Kind(of, "", dict))
    for store in stores().values():
        if of not in store.fielddefs:
            store.register(get_types_from_msg(fields, of))


def size(kind: str, encoding: str, **parameters: Any) -> int:
    return len(encode(kind, content(kind, **parameters), encoding))


def test_ros1_sizes_are_the_sums_of_their_fields() -> None:
    frame_id = "a/longer/frame"
    header = HEADER + len(frame_id)
    # Each field of a cloud: its name, offset, datatype, count.
    cloud = header + 4 + 4 + (4 + 4 * (4 + 4 + 1 + 4) + len("xyzintensity")) + 1 + 4 + 4 + (4 + 6 * 16) + 1
    for kind, parameters, expected in (
        ("PoseStamped", {}, header + 7 * 8),
        ("LaserScan", {"beams": 5}, header + 7 * 4 + (4 + 5 * 4) + 4),
        ("NavSatFix", {}, header + (1 + 2) + 3 * 8 + 9 * 8 + 1),
        ("CompressedImage", {"data_bytes": 100, "format": "png"}, header + (4 + len("png")) + (4 + 100)),
        ("PointCloud2", {"points": 6}, cloud),
    ):
        assert size(kind, "ros1", frame_id=frame_id, **parameters) == expected, kind
    assert len(encode("RobofleetStatus", STATUS, "ros1")) == (4 + 2) + 1 + 4 + (4 + 3)


def test_cdr_and_flatbuffer_by_hand() -> None:
    """CDR of a pose; a RobofleetStatus as flatbuffer, each text: length 4, letters, its 0, then a multiple of 4."""
    # Encapsulation 4; stamp 8; frame_id 4 + "map" + its 0; doubles begin at a multiple of 8: 16 already is one.
    assert size("PoseStamped", "cdr", frame_id="map") == 4 + 8 + 4 + 4 + 7 * 8
    assert size("PoseStamped", "cdr", frame_id="maps") == 4 + 8 + 4 + (5 + 7) + 7 * 8
    vtable = 2 + 2 + 5 * 2  # own size, table's size, a slot each for metadata and four fields
    table = 4 + (3 + 1) + 3 * 4  # where the vtable is, is_ok after 3 of padding, status, battery_level, location
    bare = 4 + vtable + table + (4 + 2 + 1 + 1) + (4 + 3 + 1)
    assert bare == 54
    assert len(encode("RobofleetStatus", STATUS, "robofleet-bare")) == 56  # a multiple of 4
    # With metadata: its offset, its table (12) and vtable (8), and two texts.
    with_metadata = bare + 4 + 12 + 8 + (4 + len("amrl_msgs/RobofleetStatus") + 1 + 2) + (4 + len("/s") + 1 + 1)
    assert with_metadata == 118
    assert len(encode("RobofleetStatus", STATUS, "robofleet", "/s")) == 120


def test_json_by_hand_and_read_back_with_infinity_as_null_and_bytes_two_ways() -> None:
    spaced = '{"op": "publish", "topic": "/s", "msg": {"status": "on", "is_ok": true, "battery_level": 1.0, '
    assert encode("RobofleetStatus", STATUS, "json", "/s").decode() == spaced + '"location": "lab"}}'
    compact = '{"op":"publish","topic":"/s","msg":{"status":"on","is_ok":true,"battery_level":1,"location":"lab"}}'
    assert encode("RobofleetStatus", STATUS, "json-numbers", "/s").decode() == compact
    scan = content("LaserScan", beams=40)
    scan["ranges"][7] = np.inf
    for encoding in ("json", "json-numbers"):
        message = json.loads(encode("LaserScan", scan, encoding))["msg"]
        ranges = [math.inf if x is None else x for x in message["ranges"]]
        np.testing.assert_array_equal(np.array(ranges, np.float32), scan["ranges"])
        assert message["header"]["stamp"] == {"secs": 1_600_000_000, "nsecs": 123_456_789}
    image = content("CompressedImage", data_bytes=1000)
    data = [json.loads(encode("CompressedImage", image, e))["msg"]["data"] for e in ("json", "json-numbers")]
    assert base64.b64decode(data[0]) == image["data"].tobytes() and data[1] == image["data"].tolist()


def test_flatbuffers_read_by_the_released_slots() -> None:
    """Of a scan, by the library's own table: metadata 0, header 1, numbers from 2 on, ranges 9."""
    scan = content("LaserScan", beams=37, seed=1)
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
    offset = table.Offset(4 + 2 * 9)
    numbers = np.frombuffer(data, "<f4", table.VectorLen(offset), table.Vector(offset))
    np.testing.assert_array_equal(numbers, scan["ranges"])


def test_the_fitted_messages_have_the_papers_bytes_as_ros_binary() -> None:
    for beams in (1786, 1800, 1802):
        assert all(len(encode(kind, message, "ros1")) == PAPER[kind][0] for kind, message in fitted(beams).items())
    data = content("CompressedImage", data_bytes=50_000)["data"].tolist()  # with a JPEG's markers and no other
    assert (data[:2], data[-2:]) == ([0xFF, 0xD8], [0xFF, 0xD9])
    assert {data[i + 1] for i in range(2, len(data) - 3) if data[i] == 0xFF} == {0}


def test_what_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse("unknown encoding 'xml'; known: ros1, cdr, robofleet", encode, "PoseStamped", content("PoseStamped"), "xml")
    for beams in (1785, 1803):
        refuse(f"beams = {beams}: 7260 bytes would need a frame_id of", Reproduction(beams=beams).simulate)
    stores.cache_clear()
    for library, encoding, extra in (
        ("rosbags.typesys", "cdr", "ros"),
        ("flatbuffers", "robofleet", "bufgym-robot[robofleet]"),
    ):
        monkeypatch.setitem(sys.modules, library, None)  # None there makes the import fail
        refuse(re.escape(f"needs {library}: {install(extra)}"), encode, "PoseStamped", content("PoseStamped"), encoding)
        assert len(encode("PoseStamped", content("PoseStamped"), "json")) > 0  # which needs neither
    assert "flatbuffers" not in vars(encodings) and "rosbags" not in vars(encodings)
