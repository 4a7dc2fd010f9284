"""`bufgym bench --workload` and `bufgym trace from-bag`, as a user would call them; every number worked by hand."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from cli_cases import Capsys, fails, shown

from bufgym.cli import main

# A message a second; nothing crosses for 4 s, then 10 kB/s.
WORKLOAD = """time_s,bytes,topic,x
0,1000,/camera,0
1,1000,/odom,0
2,1000,/camera,1
3,1000,/odom,2
"""
TRACE = "t_ms,bytes,interval_ms\n4000,0,4000\n5000,10000,1000\n"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("w.csv").write_text(WORKLOAD)
    Path("outage.csv").write_text(TRACE)
    return tmp_path


W = "--workload w.csv --trace outage.csv"
BENCH = ["bench", *W.split(), "--capacity", "1"]


def test_bench_of_a_recording(here: Path, capsys: Capsys) -> None:
    text = shown([*BENCH, "--policies", "drop-oldest,drop-newest,clairvoyant", "--drops", "drops.csv"], capsys)
    lines = text.splitlines()
    # By topic: two messages each, 1 s between the two, 2 s apart.
    assert lines[0] == "w.csv (time_s,bytes,topic,x)"
    assert ["/camera", "2", "0.500", "2,000", "1,000", "50.0%"] in [line.split() for line in lines]
    assert "4 messages, 4,000 bytes in 3.000 s, 1,333 bytes/s" in lines
    assert "Played over outage, from the trace's start; all topics share one queue." in lines
    # H: messages 0 and 3 give 1 + V(2) = 1.865; 0 and 1 give 1 + V(0) = 1.
    first, _, second = text.partition("dropped of")
    table = {line.split()[0]: line.split() for line in first.splitlines() if line}
    assert table["drop-oldest"][1:6] == ["1", "1.865", "0.00%", "2.0", "2.0"]
    assert table["drop-newest"][1:6] == ["1", "1.000", "46.37%", "2.0", "2.0"]
    assert "note: L = 1: the clairvoyant's QoI is 1.865; regret is measured against it" in lines
    # Best QoI first, as above; Drop Oldest drops one of each topic, Drop Newest as well.
    shares = {line.split()[0]: line.split()[1:] for line in second.splitlines()[1:4]}
    assert list(shares) == ["drop-oldest", "drop-newest", "clairvoyant"]
    assert shares["drop-oldest"] == ["1", "50.0%", "50.0%"]
    assert Path("drops.csv").read_text().splitlines()[:3] == [
        "policy,capacity,trace,seed,message,time_s,topic,bytes,x,dropped_s",
        "drop-oldest,1,outage,0,1,1.0,/odom,1000,0.0,2.0",
        "drop-oldest,1,outage,0,2,2.0,/camera,1000,1.0,3.0",
    ]
    assert "6 dropped messages in drops.csv" in lines


def test_one_topic_and_some_seeds(here: Path, capsys: Capsys) -> None:
    text = shown([*BENCH, "--topics", "/camera", "--policies", "drop-oldest", "--seeds", "3"], capsys)
    assert "Played over outage, 3 random places each.\n" in text
    assert "/odom" not in text and "dropped of" not in text


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (f"{W} --fps 30", "--fps cannot go with --workload: a recording has its own"),
        (f"{W} --topics /lidar", "no topic '/lidar'; it has: /camera, /odom"),
        (f"{W} --odom /odom", "odom = '/odom': needs a recording, which this is not"),
        (f"{W} --fov-deg 70", "--fov-deg needs --odom or --motion"),
        (f"{W} --bridge-gaps", "--bridge-gaps needs --odom"),
        (f"{W} --interruption", "cannot go with --interruption"),
        (f"{W} --suite lte-v1", "cannot go with --suite"),
        (f"{W} --motion drive-0", "workload 'w' has an x of its own"),
        ("--workload nothing.mcap", "nothing.mcap: no such file"),
        ("--drops d.csv", "--drops needs --workload"),
        ("--topics /a", "--topics needs --workload"),
        ("--bridge-gaps", "--bridge-gaps needs --workload"),
        ("--fov-deg 70", "--fov-deg needs --motion, or --workload with --odom"),
        ("--motion drive-0 --fov-deg 70", "--fov-deg cannot go with drive-0, which holds finished coordinates"),
    ],
)
def test_what_does_not_go_together(here: Path, capsys: Capsys, words: str, says: str) -> None:
    fails(["bench", "--policies", "drop-oldest", *words.split()], says, capsys)


@pytest.fixture
def drive(here: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """1 m forward in a second, a turn of 90 degrees in the next; a picture every 500 ms (see bag_cases)."""
    pytest.importorskip("mcap", reason="recordings need the extra 'ros'")
    pytest.importorskip("rosbags", reason="recordings need the extra 'ros'")
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "traces"))
    import bag_cases

    monkeypatch.setitem(sys.modules, "bag_cases", bag_cases)
    return bag_cases.write_mcap(Path("drive.mcap"), bag_cases.drive())


def test_topics_of_a_bag(drive: Path, capsys: Capsys) -> None:
    text = shown(["trace", "from-bag", drive], capsys)
    lines = [line.split() for line in text.splitlines() if line.startswith("/")]
    # Pictures of 109, 209, .. 509 bytes, "ok" in 11, and three of odometry.
    odometry = len(sys.modules["bag_cases"].odometry(0, 0))
    total = 3 * odometry + 11 + 5 * 309
    assert lines[0][:3] == ["/odom", "3", "1.000"] and lines[0][5:] == ["yes", "nav_msgs/msg/Odometry"]
    assert lines[1] == ["/camera/left", "5", "2.000", "1,545", f"{1545 / total:.1%}", "std_msgs/msg/String"]
    assert lines[2][:4] == ["/status", "1", "-", "11"]


def test_a_bag_becomes_a_csv_that_plays_the_same(drive: Path, capsys: Capsys) -> None:
    chosen = ["--odom", "/odom", "--topics", "/camera/*"]
    text = shown(
        ["trace", "from-bag", drive, "--odom", "/odom", "--topics", "/camera/*,/status", "-o", "drive.csv"], capsys
    )
    assert "drive.mcap (mcap, motion from /odom: 60 degrees, 2 m)" in text
    assert "x: camera motion of 2.000 fields of view" in text
    assert Path("drive.csv").read_text().splitlines()[:4] == [
        "time_s,bytes,topic,x",
        "0.000000,109,/camera/left,0.0",
        "0.500000,209,/camera/left,0.25",
        "0.700000,11,/status,0.35",
    ]
    bench = ["bench", "--trace", "outage.csv", "--capacity", "2", "--policies", "afr", "--workload"]
    one, other = (shown([*bench, *words], capsys) for words in ([drive, *chosen, "/status"], ["drive.csv"]))
    assert one.partition("\n\n")[2] == other.partition("\n\n")[2]


def test_gaps_are_told(drive: Path, capsys: Capsys) -> None:
    words = ["trace", "from-bag", drive, "--odom", "/odom", "--max-gap-s", "0.9"]
    fails(words, "/odom has 2 gaps of more than 0.9 s without a pose, the longest 1.0 s", capsys)
    text = shown([*words, "--bridge-gaps"], capsys)
    assert "note: 2 gaps without a pose, the longest 1.0 s: motion taken as even" in text


# 1 m, then 90 degrees, then nothing for 5 s.
TUM = "0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 1 0 0 0 0 0.70710678 0.70710678\n7 1 0 0 0 0 0.70710678 0.70710678\n"


def test_a_trajectory_becomes_motion(here: Path, capsys: Capsys) -> None:
    """1 m / 4 m + 90 / 45."""
    Path("path.txt").write_text(TUM)
    words = ["trace", "from-poses", "path.txt", "--fov-deg", "45", "--scene-scale-m", "4"]
    text = shown(words, capsys)
    assert "motion  2.250 fields of view in 7.000 s" in text and "gaps    1, the longest 5.0 s" in text
    assert main([*words, "-o", "motion.csv"]) == 2
    assert "path.txt: has gaps: say --bridge-gaps" in capsys.readouterr().err
    assert not Path("motion.csv").exists()
    shown([*words, "-o", "motion.csv", "--bridge-gaps"], capsys)
    assert Path("motion.csv").read_text().splitlines()[:3] == ["t_s,motion", "0,0.0", "1,0.25"]


def test_bench_over_a_trajectory_tells_of_its_gaps(here: Path, capsys: Capsys) -> None:
    """Messages 0 and 3: 1 + V(2.25) with V = 1 - exp(-d)."""
    Path("path.txt").write_text(TUM)
    Path("w.csv").write_text("time_s,bytes\n0,1000\n1,1000\n2,1000\n3,1000\n")
    words = ["--policies", "drop-oldest", "--motion", "path.txt", "--fov-deg", "45", "--scene-scale-m", "4"]
    text = shown([*BENCH, *words], capsys)
    assert "x is the motion, from path (gaps bridged: 1, the longest 5.0 s), in fields of view." in text
    assert "1.895" in text
