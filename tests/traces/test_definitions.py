"""Messages that are not what their type's name says in ROS, or in another form: named, or read."""

import sqlite3
from pathlib import Path

import pytest
from needs import needs
from recording_cases import ODD_FILES
from refusal_cases import refuse

pytest.importorskip("mcap", reason=needs("extras", "mcap"))
pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))

import bag_cases as cases
from rosbags.rosbag2 import StoragePlugin

from bufgym.traces.formats.bags import read_bag
from bufgym.traces.formats.definitions import ros_type, typestore
from bufgym.utils.errors import TraceError

ODOMETRY = "nav_msgs/msg/Odometry"
DDS = "nav_msgs::msg::dds_::Odometry_"
MINE = "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\nstring child_frame_id\n"
MINE_IDL = """module nav_msgs { module msg { struct Odometry {
  std_msgs::msg::Header header; string child_frame_id; double x; }; }; };"""


def drive(type: str = ODOMETRY, form: int = 1) -> list[cases.Entry]:
    """1 m in 1 s, in this form of CDR."""
    poses = [cases.odometry(0.1 * k, 0) for k in range(11)]
    return [(100 * k, "/odom", type, bytes([0, form]) + pose[2:]) for k, pose in enumerate(poses)]


def test_the_name_of_a_type() -> None:
    for name, right in (
        (DDS, ODOMETRY),
        ("nav_msgs::msg::Odometry", ODOMETRY),
        ("nav_msgs/Odometry", ODOMETRY),
        (ODOMETRY, ODOMETRY),
        ("foxglove.PoseInFrame", "foxglove.PoseInFrame"),
        ("", ""),
    ):
        assert ros_type(name) == right


def test_odometry_under_its_name_in_dds_is_odometry(tmp_path: Path) -> None:
    bag = read_bag(cases.write_mcap(tmp_path / "dds.mcap", drive(DDS)), "/odom")
    assert bag.topics == {"/odom": ODOMETRY} and bag.poses is not None
    assert bag.poses.position_m[-1, 0] == pytest.approx(1)
    folder = cases.write_rosbag2(tmp_path / "dds", drive(), StoragePlugin.SQLITE3)
    with sqlite3.connect(folder / "dds.db3") as base:
        base.execute("UPDATE topics SET type = ?", (DDS,))
    again = read_bag(folder, "/odom").poses
    assert again is not None and again.position_m.tolist() == bag.poses.position_m.tolist()


@pytest.mark.parametrize(
    ("form", "name"),
    [(7, "XCDR2 "), (6, "XCDR2 "), (9, "XCDR2, delimited "), (11, "a parameter list of XCDR2 "), (3, "a parameter")],
)
def test_other_forms_of_cdr_are_named(tmp_path: Path, form: int, name: str) -> None:
    path = cases.write_mcap(tmp_path / "x.mcap", drive(form=form))
    says = rf"message 1 on /odom is encoded in {name}.*encapsulation 0x000{form:x}\): must be CDR"
    refuse(says, read_bag, path, "/odom", kind=TraceError)
    assert len(read_bag(path).time_ns) == 11  # arrivals and sizes are what they are


def test_the_odd_file_in_xcdr2() -> None:
    refuse(
        r"is encoded in XCDR2 \(encapsulation 0x0007\)", read_bag, ODD_FILES / "xcdr2.mcap", "/odom", kind=TraceError
    )


@pytest.mark.parametrize(
    ("definition", "language", "field"),
    [
        (MINE, "ros2msg", "field 2 of nav_msgs/msg/Odometry is geometry_msgs/msg/PoseWithCovariance pose in the .*"),
        (MINE_IDL, "ros2idl", "field 3 of nav_msgs/msg/Odometry is float64 x in the recording: must be geometry_msgs/"),
        ("std_msgs/Header header\nstring child_frame_id\n", "ros2msg", "field 3 of .* is nothing in the recording"),
    ],
)
def test_another_definition_under_a_known_name_is_named(
    tmp_path: Path, definition: str, language: str, field: str
) -> None:
    path = cases.write_mcap(tmp_path / "x.mcap", drive(), definition=definition, language=language)
    refuse(f"/odom carries another definition of {ODOMETRY}: {field}", read_bag, path, "/odom", kind=TraceError)
    folder = cases.write_rosbag2(tmp_path / "x", drive(), StoragePlugin.SQLITE3)
    with sqlite3.connect(folder / "x.db3") as base:
        base.execute("DROP TABLE IF EXISTS message_definitions")
        base.execute("CREATE TABLE message_definitions(topic_type, encoding, encoded_message_definition)")
        base.execute("INSERT INTO message_definitions VALUES (?, ?, ?)", (ODOMETRY, language, definition))
    refuse(f"/odom carries another definition of {ODOMETRY}: {field}", read_bag, folder, "/odom", kind=TraceError)


def test_definitions_as_ros_has_them_and_texts_that_are_none(tmp_path: Path) -> None:
    text, _ = typestore("cdr").generate_msgdef(ODOMETRY, ros_version=2)
    for definition in (text, "", "{no: definition}", "uint8 NOT_A_FIELD=3\n" + text):
        path = cases.write_mcap(tmp_path / "x.mcap", drive(), definition=definition)
        poses = read_bag(path, "/odom").poses
        assert poses is not None and len(poses.time_us) == 11


def test_without_a_definition_the_message_that_does_not_fit_is_named(tmp_path: Path) -> None:
    entries = drive()
    entries[4] = (*entries[4][:3], entries[4][3] + bytes(24))
    says = f"message 5 on /odom is cut off or damaged, or of another definition than {ODOMETRY} has in ROS"
    refuse(says, read_bag, cases.write_mcap(tmp_path / "x.mcap", entries), "/odom", kind=TraceError)
