"""Links and recordings in which samples share a time, sources share a topic, or a message is far from the others."""

import warnings
from pathlib import Path

import pytest
from link_files import written
from needs import needs
from recording_cases import ODD_FILES
from refusal_cases import refuse

from bufgym.traces import read_trace, read_workload
from bufgym.utils.errors import BufgymError, TraceError, TraceWarning

pytest.importorskip("mcap", reason=needs("extras", "mcap"))
pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))

import bag_cases as cases
from mcap.writer import Writer as McapWriter

from bufgym.traces.formats.bags import read_bag

ODOMETRY, STRING = "nav_msgs/msg/Odometry", "std_msgs/msg/String"


def test_lines_of_one_time_are_counted(tmp_path: Path) -> None:
    """10 and 90 Mbit/s in each second are 6,250 KB/s; the last of each second are 11,250."""
    says = "left out 5 of 10 lines that share a time .* in line 2, at most 2 of one time: the mean .* 6,250 KB/s"
    with pytest.warns(TraceWarning, match=says):
        assert read_trace(ODD_FILES / "dup_rows.csv").total_bytes == 5 * 11_250_000
    one = written(tmp_path, "".join(f"{k} 8\n" for k in [*range(30), 29, *range(30, 40)]))
    assert "left out 1 of 41 lines that share a time with a later one" in read_trace(one).source
    refuse("must differ from the times above, 3 samples of one", read_trace, written(tmp_path, "5 1\n5 2\n5 3\n"))


def test_times_of_links_that_are_no_seconds(tmp_path: Path) -> None:
    refuse("time in s = 45292: looks like days, as a spreadsheet", read_trace, ODD_FILES / "excel_time.csv")
    with pytest.warns(TraceWarning, match=r"its times are 1000 s apart \(median\): are they in ms"):
        read_trace(ODD_FILES / "rel_ms.csv")
    for first, step, says in (
        (45292, 1 / 96, "looks like days"),  # each quarter of an hour
        (45292.25, 1 / 1440, "looks like days"),
        (0, 2e-6, "median step of the times = .2e-06 s.: must be at least 0.001 s"),
    ):
        text = "time,mbps\n" + "".join(f"{first + step * k:.8f},8\n" for k in range(20))
        refuse(says, read_trace, written(tmp_path, text), kind=TraceError)
    for first, step, warned in (
        (0, 900, False),
        (0, 3600, False),
        (0, 1, False),
        (45292, 1, False),
        (45292, 0.5, False),
        (1_700_000_000, 1000, False),
        (17, 100, True),
        (0, 5003, True),
    ):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            read_trace(written(tmp_path, "".join(f"{first + step * k} 8\n" for k in range(20))))
        assert ["are they in ms" in str(one.message) for one in caught] == [True] * warned


def driving(period_ms: int, count: int, step_m: float, offset_m: float = 0, at_ms: int = 0) -> list[cases.Entry]:
    return [(at_ms + period_ms * k, "/odom", ODOMETRY, cases.odometry(step_m * k + offset_m, 0)) for k in range(count)]


def test_a_clock_of_coarse_steps_under_fast_odometry(tmp_path: Path) -> None:
    """100 Hz, of which ten are logged at once: 9 of 10 poses are left out."""
    entries = [(ms // 100 * 100, *rest) for ms, *rest in driving(10, 200, 0.01)]
    path = cases.write_mcap(tmp_path / "sim.mcap", entries)  # type: ignore[arg-type]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_bag(path, "/odom")
    said = [str(one.message).partition(": ")[2] for one in caught]
    assert said == [
        "180 of 200 messages on /odom share a time with a later one, the first in message 1, at most 10 of one time: "
        "they arrive at once",
        "left out 180 of 200 poses on /odom that share a time with a later one, the first in pose 1, at most 10 of one "
        "time",
    ]
    same = cases.write_mcap(tmp_path / "same.mcap", driving(0, 2, 1))
    refuse(r"odom = '/odom' has 1 pose, 2 poses of one time: needs at least 2", read_bag, same, "/odom")


@pytest.mark.parametrize("pattern", ["AB", "ABB", "AABB", "ABBBBB"])
def test_two_publishers_of_one_stream_swing(tmp_path: Path, pattern: str) -> None:
    """Two tracks 0.3 m apart in turn, at 2 cm a pose."""
    entries = [
        (20 * k, "/odom", ODOMETRY, cases.odometry(0.02 * k + 0.3 * (pattern[k % len(pattern)] == "B"), 0))
        for k in range(120)
    ]
    path = cases.write_mcap(tmp_path / "two.mcap", entries)
    with pytest.warns(TraceWarning, match=r"x of every \w+ pose is 0\.\d+ of x .* or hops between two sources"):
        read_workload(path, odom="/odom")


def test_the_odd_file_of_two_publishers() -> None:
    with pytest.warns(TraceWarning):
        (noise,) = read_workload(ODD_FILES / "two_pub.mcap", odom="/odom").sheet.doubts
    assert "x of every second pose is 0.46 of x" in noise


def test_motion_that_turns_round_is_no_noise(tmp_path: Path) -> None:
    """A robot that shuttles 1 m to and fro at 0.5 m/s, 20 poses a second."""
    entries = [(50 * n, "/odom", ODOMETRY, cases.odometry(abs((n * 0.025) % 2 - 1), 0)) for n in range(400)]
    assert read_workload(cases.write_mcap(tmp_path / "shuttle.mcap", entries), odom="/odom").sheet.doubts == ()


def two_channels(path: Path, *streams: list[cases.Entry], callers: tuple[str, ...] = ("", "")) -> Path:
    """An MCAP file with a channel of /odom for each stream."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros2")
        schema = writer.register_schema(ODOMETRY, "ros2msg", b"")
        about = [{"callerid": caller} if caller else {} for caller in callers]
        channels = [writer.register_channel("/odom", "cdr", schema, metadata) for metadata in about]
        entries = sorted((ms, k, data) for k, stream in enumerate(streams) for ms, _, _, data in stream)
        for ms, k, data in entries:
            time_ns = cases.START_NS + ms * cases.MS
            writer.add_message(channels[k], log_time=time_ns, publish_time=time_ns, data=data)
        writer.finish()
    return path


def test_two_channels_of_one_topic_are_chosen_by_number(tmp_path: Path) -> None:
    """Each goes 59 x 2.5 cm."""
    first, second = driving(50, 60, 0.025), driving(50, 60, 0.025, 0.3, 20)
    path = two_channels(tmp_path / "two.mcap", first, second, callers=("/wheels", "/ekf"))
    says = r"'/odom': 2 publishers send at once: say which: /odom@1 \(60 poses by /wheels\), /odom@2 \(60 .* by /ekf"
    refuse(says, read_workload, path, odom="/odom", kind=BufgymError)
    for number in (1, 2):
        poses = read_bag(path, f"/odom@{number}:odom").poses
        assert poses is not None and poses.position_m[:, 0].tolist() == pytest.approx(
            [0.025 * k + 0.3 * (number == 2) for k in range(60)]
        )
    refuse("odom = '/odom@3': has no pose", read_bag, path, "/odom@3", kind=BufgymError)
    # A node that was started again is one source.
    again = two_channels(tmp_path / "again.mcap", first, driving(50, 60, 0.025, 1.5, 3000))
    poses = read_bag(again, "/odom").poses
    assert poses is not None and len(poses.time_us) == 120


def test_a_message_far_from_the_others_is_named(tmp_path: Path) -> None:
    """A map, an hour before 60 poses of 2.95 s: a hole of an hour less the usual step of 50 ms."""
    path = ODD_FILES / "tfstatic_first.mcap"
    says = (
        r"no message for 3,599.95 s, from 0.05 s on, before which are 1 of 61 messages \(/map\) alone: nothing is sent"
    )
    with pytest.warns(TraceWarning, match=says):
        read_workload(path)
    with pytest.warns(TraceWarning, match=says):
        refuse(
            "the longest 3600.0 s.*say --bridge-gaps.*or topics", read_workload, path, odom="/odom", kind=BufgymError
        )
    assert read_workload(path, topics=["/odom"], odom="/odom").duration_us == 2_950_000
    late = [*driving(50, 60, 0.025), *((100_000 + k, "/status", STRING, cases.text("x")) for k in range(2))]
    with pytest.warns(TraceWarning, match=r"after which are 2 of 62 messages \(/status\) alone"):
        read_workload(cases.write_mcap(tmp_path / "late.mcap", late))
