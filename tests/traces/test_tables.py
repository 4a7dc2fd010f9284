"""Tables whose header names their columns, or whose columns are chosen, and what other tools write."""

import warnings
from pathlib import Path

import pytest
from cli_cases import shown
from link_files import SAMPLES, knots, written
from recording_cases import ODD_FILES
from refusal_cases import refuse

from bufgym.traces import Columns, read_motion, read_trace, read_workload
from bufgym.traces.formats.trajectories import read_poses
from bufgym.utils.errors import BufgymError, TraceError, TraceWarning

S = 1_000_000


def test_columns_of_any_table(tmp_path: Path) -> None:
    """1 kB/s for 2 s and 3 kB/s for 2 s more, with blanks, commas, semicolons or tabs, by name and by number."""
    right = [(0, 0), (2 * S, 2_000), (4 * S, 8_000)]
    for text, columns in (
        ("i,when [ms],cell,up\n0,500,a,1\n1,2500,b,3\n", Columns("when [ms]", "up", "kB/s")),
        ('"i";"when";"up"\n0;0,5;8,0\n1;2,5;24\n', Columns("when", "up", "kbit/s")),
        ("up\tat_us\n1000\t0\n3000\t2000000\n", Columns("at_us", "1", "B/s")),
        ("7 500 1\n7 2500 3\n", Columns("2", "3", "kB/s", "ms")),
        ("# time up\n0 1\n2 3\n", Columns("time", "up", "kB/s")),
        ("up,time\n1,2024-01-31 12:00:00\n3,2024-01-31 12:00:02\n", Columns("2", "1", "kB/s")),
    ):
        assert knots(read_trace(written(tmp_path, text), columns=columns)) == right, text
    path = written(tmp_path, "a,b\n0,1\n1,1,1\n")
    refuse(
        "line 1: .*has no column 'c': must be one of a, b, or a number from 1",
        read_trace,
        path,
        columns=Columns("c", "b"),
    )
    refuse("line 3: 0*1,1,1: must have 2 columns, has 3", read_trace, path, columns=Columns("a", "b"))
    refuse(
        "unit of the rate = furlongs: b is a bit and B a byte: must be as Mbps or MBps",
        read_trace,
        path,
        columns=Columns("a", "b", "furlongs"),
    )
    refuse("time_unit = 'h': must be one of s, ms, us, ns", read_trace, path, columns=Columns("a", "b", time_unit="h"))
    refuse("go without format and column", read_trace, path, "mbit", columns=Columns("a", "b"))
    refuse(r"line 1: a,b: must fit a known format .*, or name its columns: --time COL --rate COL", read_trace, path)


def test_numbers_name_columns_where_a_cell_is_the_same_number(tmp_path: Path) -> None:
    """Time in the second column, whose first cell is 1: no header."""
    path = written(tmp_path, "5 1\n7 2\n")
    assert knots(read_trace(path, columns=Columns("2", "1", "B/s"))) == [(0, 0), (S, 5), (2 * S, 12)]


def test_what_other_tools_write(tmp_path: Path) -> None:
    """One interface, one stream or their sums, a counter that grows; and ping is no measurement of capacity."""
    files = ODD_FILES / "turn7"
    assert knots(read_trace(files / "pandas_index.csv")) == [(k * S, k * 1_250_000) for k in range(6)]
    assert knots(read_trace(files / "iperf2.txt")) == [(0, 0), (S, 1_310_720)]
    assert knots(read_trace(files / "mm_log.log")) == [(0, 0), (1000, 1500)]
    received = read_trace(written(tmp_path, SAMPLES["proc-net-dev"]), column="download")
    assert knots(received) == [(0, 0), (S, 200), (3 * S, 400)]
    lines = "[{0}]  0.00-1.00   sec  {1} KBytes  8 Kbits/sec    0   9 KBytes\n"
    streams = "Connecting to host a, port 5201\n" + lines.format("  5", 1) + lines.format("  7", 3)
    assert read_trace(written(tmp_path, streams + lines.format("SUM", 4))).total_bytes == 4096
    for text, says in (
        (streams, "holds streams 5, 7 and no sum of them"),
        (SAMPLES["proc-net-dev"].replace("wlan0: 700", "eth0: 700"), "must be of one interface, not of eth0 and wlan0"),
        (
            SAMPLES["proc-net-dev"].replace("3000", "30"),
            r"line 7: upload = 30: must not be below the line above \(1000\)",
        ),
        (SAMPLES["mm-link"] + "?", "line 7: .*must be a line of mm-link"),
        ("PING 1.1.1.1 (1.1.1.1) 56(84) bytes of data.\n", "is the output of ping, which says how long"),
    ):
        refuse(says, read_trace, written(tmp_path, text), kind=TraceError)


@pytest.mark.parametrize(
    ("name", "right"),
    [("openvins20.txt", (0.96667, 0.29)), ("rtabmap9.txt", (0.96667, 0.29)), ("head_names.csv", (9.967, 2.99))],
)
def test_tables_of_other_tools(name: str, right: tuple[float, float]) -> None:
    """30 or 300 poses at 30 Hz, 0.02 m apart, in fields of 2 m; with more columns, or under names."""
    motion = read_motion(ODD_FILES / "turn7" / name)
    assert (motion.duration_us / 1e6, motion.total) == pytest.approx(right, abs=1e-6)


# 3 poses 1 s apart, at 0, 3 and 9 m.
TABLES = {
    "%time,field.header.seq,field.pose.pose.position.x,field.pose.pose.position.y\n"
    "1700000000000000000,1,0,0\n1700000001000000000,2,3,0\n1700000002000000000,3,9,0\n": None,
    "stamp [ms];id;px;py;pz\n0;a;0,0;0;0\n1000;b;3,0;0;0\n2000;c;9,0;0;0\n": None,
    "Date,X,Y,Z,QX,QY,QZ,QW\n"
    + "".join(f"2024-01-31T12:00:0{k},{x},0,0,0,0,0,1\n" for k, x in ((0, 0), (1, 3), (2, 9))): None,
    "a b c\n0 0 5\n0 1000 8\n0 2000 14\n": Columns("b", pose=("c", "a"), time_unit="ms"),
    "0 0 5\n0 1 8\n0 2 14\n": Columns("2", pose=("3", "1", "1")),
    "# id time x y z qx qy qz qw\n7 0 0 0 0 0 0 0 1\n7 1 3 0 0 0 0 0 1\n7 2 9 0 0 0 0 0 1\n": None,
}


@pytest.mark.parametrize("text", TABLES)
def test_poses_of_any_table(tmp_path: Path, text: str) -> None:
    poses = read_poses(written(tmp_path, text, "poses.txt"), columns=TABLES[text])
    assert poses.time_us.tolist() == [0, 1_000_000, 2_000_000]
    assert (poses.position_m - poses.position_m[0])[:, 0].tolist() == [0, 3, 9]


def test_what_a_table_of_poses_lacks_is_said(tmp_path: Path) -> None:
    path = written(tmp_path, "t,x,y\n0,1,2\n1,1,2,3\n", "poses.csv")
    refuse("line 3: .*must have 3 columns, has 4", read_motion, path)
    refuse("has no column 'w': must be one of t, x, y", read_motion, path, columns=Columns("t", pose=("x", "w")))
    refuse("must be x y, x y z, or", read_motion, path, columns=Columns("t", pose=("x",)))
    refuse("time_unit = 'h'", read_motion, path, columns=Columns("t", pose=("x", "y"), time_unit="h"))
    refuse("go without format and times", read_motion, path, columns=Columns("t", pose=("x", "y")), format="tum")
    nine = written(tmp_path, "0 0 0 0 0 0 0 1 5\n1 0 0 0 0 0 0 1 5\n", "nine.txt")
    refuse("must have 8 columns.*has 9: name them with --time COL --pose", read_motion, nine)
    norm = written(tmp_path, "t,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,2\n1,0,0,0,0,0,0,1\n", "norm.csv")
    refuse("line 2: norm of the quaternion = 2: must be 1 within 1 %", read_motion, norm)
    refuse("is XML, as of GPX", read_motion, written(tmp_path, "<?xml version='1.0'?>\n<gpx/>\n", "a.gpx"))


def test_messages_of_other_tools(tmp_path: Path) -> None:
    """Times in s, in ms by the header, and as dates; a topic, and columns of no use."""
    for text in (
        "frame.number,frame.time_epoch,frame.len\n1,1700000000.25,10\n2,1700000001.75,20\n",
        "stamp_ms,size,note\n250,10,a\n1750,20,b\n",
        "channel,date,bytes\na,2024-01-31T12:00:00.25,10\na,2024-01-31T12:00:01.75,20\n",
    ):
        workload = read_workload(written(tmp_path, text))
        assert (workload.arrival_us.tolist(), workload.size_bytes.tolist()) == ([0, 1_500_000], [10, 20])


def test_x_stands_beside_times_in_any_unit(tmp_path: Path) -> None:
    workload = read_workload(written(tmp_path, "time_ms,bytes,topic,x\n0,5,a,1\n500,5,b,2.5\n"))
    assert workload.x is not None
    assert (workload.arrival_us.tolist(), workload.x.tolist()) == ([0, 500_000], [0, 1.5])


def test_receivers_of_satellites(tmp_path: Path) -> None:
    """A thousandth of a degree of latitude at 45 degrees is 111.13 m, over midnight in 2 s; also as JSON and as CSV."""
    fix = "$GPGGA,{0}.00,45{1},N,00700.0000,W,1,08,0.9,100.0,M,46.9,M,,*47\n"
    nmea = "$GPRMC,1*00\n" + fix.format("235959", "00.0000") + fix.format("000001", "00.0600")
    gpsd = '{"class":"VERSION"}\n' + "".join(
        f'{{"class":"TPV","mode":3,"time":"2024-01-31T12:00:0{2 * k}.000Z","lat":{45 + k / 1000},"lon":-7,"alt":100}}\n'
        for k in range(2)
    )
    csv = "time,lat,lon,elevation,accuracy\n2024-01-31T12:00:00Z,45,-7,100,3\n2024-01-31T12:00:02Z,45.001,-7,100,3\n"
    for text in (nmea, gpsd, csv):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TraceWarning)  # 200 km/h
            poses = read_poses(written(tmp_path, text, "gps.txt"))
        assert poses.time_us.tolist() == [0, 2_000_000] and "no orientation" in poses.format
        assert poses.position_m[1] == pytest.approx([0, 111.13, 0], abs=0.02)


def test_messages_of_any_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """100 bytes on /x, 50 ms later 200 on /y, another 50 ms later 100 on /x."""
    path = written(tmp_path, "a;when [ms];n;ch\n1;0;100;/x\n2;50;200;/y\n3;100;100;/x\n", "any.txt")
    columns = Columns("when [ms]", bytes="n", topic="ch")
    workload = read_workload(path, columns=columns)
    assert workload.arrival_us.tolist() == [0, 50_000, 100_000]
    assert workload.size_bytes.tolist() == [100, 200, 100]
    assert [workload.topic_of(k) for k in range(3)] == ["/x", "/y", "/x"]
    refuse("columns must name bytes", read_workload, path, columns=Columns("a"), kind=BufgymError)
    refuse("line 1: has no column 'size'", read_workload, path, columns=Columns("a", bytes="size"))
    recording = ODD_FILES / "good.mcap"
    refuse("of a table, which a recording is not", read_workload, recording, columns=columns, kind=BufgymError)
    played = ["bench", "--workload", str(path), "--trace", "4Mbit/s", "--policies", "afr", "--capacity", "3"]
    assert "3 messages, 400 bytes in 0.100 s" in shown(
        [*played, "--columns", "2", "n", "ch", "--time-unit", "ms"], capsys
    )
