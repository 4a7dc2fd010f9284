"""`bufgym bench --workload` and `bufgym trace from-bag`, as a user would call them; every number worked by hand."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from bufgym.cli import main, trace_bags
from bufgym.cli.options import Parser
from bufgym.errors import BufgymError
from bufgym.traces import MotionSettings

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


def bench(*words: str) -> int:
    return main(["bench", "--workload", "w.csv", "--trace", "outage.csv", "--capacity", "1", *words])


def test_bench_of_a_recording(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench("--policies", "drop-oldest,drop-newest,clairvoyant", "--drops", "drops.csv") == 0
    said = capsys.readouterr().out
    lines = said.splitlines()
    # By topic: two messages each, 1 s between the two, 2 s apart.
    assert lines[0] == "w.csv (time_s,bytes,topic,x)"
    assert [line.split() for line in lines if line.startswith("/camera")] == [
        ["/camera", "2", "0.500", "2,000", "1,000", "50.0%"]
    ]
    assert "4 messages, 4,000 bytes in 3.000 s, 1,333 bytes/s" in lines
    assert "Played over outage, from the trace's start; all topics share one queue." in lines
    # H: messages 0 and 3 give 1 + V(2) = 1.865; 0 and 1 give 1 + V(0) = 1.
    table = {line.split()[0]: line.split() for line in said.partition("dropped of")[0].splitlines() if line}
    assert table["drop-oldest"][1:6] == ["1", "1.865", "0.00%", "2.0", "2.0"]
    assert table["drop-newest"][1:6] == ["1", "1.000", "46.37%", "2.0", "2.0"]
    assert "note: L = 1: the clairvoyant's QoI is 1.865; regret is measured against it" in lines
    # Drop Oldest drops one of each topic, Drop Newest as well.
    # In the order of the table above, best QoI first.
    order = [line.split()[0] for line in said.partition("dropped of")[2].splitlines()[1:4]]
    assert order == ["drop-oldest", "drop-newest", "clairvoyant"]
    shares = {line.split()[0]: line.split()[1:] for line in said.partition("dropped of")[2].splitlines()[1:4]}
    assert shares["drop-oldest"] == ["1", "50.0%", "50.0%"]
    assert Path("drops.csv").read_text().splitlines()[:3] == [
        "policy,capacity,trace,seed,message,time_s,topic,bytes,x,dropped_s",
        "drop-oldest,1,outage,0,1,1.0,/odom,1000,0.0,2.0",
        "drop-oldest,1,outage,0,2,2.0,/camera,1000,1.0,3.0",
    ]
    assert "6 dropped messages in drops.csv" in lines


def test_where_sizes_differ_the_clairvoyant_may_still_be_exact(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("w.csv").write_text(WORKLOAD.replace("1,1000", "1,3000"))
    words = ["--policies", "clairvoyant,drop-oldest", "--capacity", "1,2", "--out", "out", "--format", "csv"]
    assert bench(*words) == 0
    said = capsys.readouterr().out
    # Of four messages the best plan is found, and the bound meets it.
    assert "note: L = 1: the clairvoyant's QoI is 1.865; regret is measured against it" in said
    assert "upper bound" not in said and "regret, at most" not in said


def test_one_topic_and_some_seeds(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench("--topics", "/camera", "--policies", "drop-oldest", "--seeds", "3") == 0
    said = capsys.readouterr().out
    assert "Played over outage, 3 random places each.\n" in said
    assert "/odom" not in said and "dropped of" not in said


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--fps", "30"], "--fps cannot go with --workload: a recording has its own"),
        (["--topics", "/lidar"], "no topic '/lidar'; it has: /camera, /odom"),
        (["--odom", "/odom"], "odom = '/odom': needs a recording, which this is not"),
        (["--fov-deg", "70"], "--fov-deg needs --odom or --motion"),
        (["--bridge-gaps"], "--bridge-gaps needs --odom"),
        (["--interruption"], "cannot go with --interruption"),
        (["--suite", "lte-v1"], "cannot go with --suite"),
        (["--workload", "nothing.mcap"], "nothing.mcap: no such file"),
        (["--motion", "drive-0"], "workload 'w' has an x of its own"),
    ],
)
def test_what_does_not_go_together(here: Path, capsys: pytest.CaptureFixture[str], words: list[str], says: str) -> None:
    assert bench("--policies", "drop-oldest", *words) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1


def test_options_of_a_recording_without_one(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--drops", "d.csv"], ["--topics", "/a"], ["--bridge-gaps"]):
        assert main(["bench", "--policies", "drop-oldest", *words]) == 2
        assert f"{words[0]} needs --workload" in capsys.readouterr().err
    assert main(["bench", "--policies", "drop-oldest", "--fov-deg", "70"]) == 2
    assert "--fov-deg needs --motion, or --workload with --odom" in capsys.readouterr().err
    assert main(["bench", "--policies", "drop-oldest", "--motion", "drive-0", "--fov-deg", "70"]) == 2
    assert "--fov-deg cannot go with drive-0, which holds finished coordinates" in capsys.readouterr().err


# --- bufgym trace from-bag -------------------------------------------------------------------------------------------


def trace_command(*words: str) -> None:
    """One command of `bufgym trace`, whose errors are raised."""
    parser = Parser(prog="bufgym trace")
    trace_bags.add(parser.add_subparsers())
    options = parser.parse_args(words)
    options.command(options)


def from_bag(*words: str) -> None:
    trace_command("from-bag", *words)


@pytest.fixture
def drive(here: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """1 m forward in a second, a turn of 90 degrees in the next; a picture every 500 ms (see bag_cases)."""
    pytest.importorskip("mcap", reason="recordings need the extra 'ros'")
    pytest.importorskip("rosbags", reason="recordings need the extra 'ros'")
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "traces"))
    import bag_cases

    monkeypatch.setitem(sys.modules, "bag_cases", bag_cases)
    return bag_cases.write_mcap(Path("drive.mcap"), bag_cases.drive())


def test_topics_of_a_bag(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from_bag(str(drive))
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("/")]
    # Pictures of 109, 209, .. 509 bytes, "ok" in 11, and three of odometry.
    odometry = len(sys.modules["bag_cases"].odometry(0, 0))
    total = 3 * odometry + 11 + 5 * 309
    assert lines[0][:3] == ["/odom", "3", "1.000"] and lines[0][5:] == ["yes", "nav_msgs/msg/Odometry"]
    assert lines[1] == ["/camera/left", "5", "2.000", "1,545", f"{1545 / total:.1%}", "std_msgs/msg/String"]
    assert lines[2][:4] == ["/status", "1", "-", "11"]


def test_a_bag_becomes_a_csv_that_plays_the_same(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from_bag(str(drive), "--topics", "/camera/*,/status", "--odom", "/odom", "-o", "drive.csv")
    said = capsys.readouterr().out
    assert "drive.mcap (mcap, motion from /odom: 60 degrees, 2 m)" in said
    assert "x: camera motion of 2.000 fields of view" in said
    assert Path("drive.csv").read_text().splitlines()[:4] == [
        "time_s,bytes,topic,x",
        "0.000000,109,/camera/left,0.0",
        "0.500000,209,/camera/left,0.25",
        "0.700000,11,/status,0.35",
    ]
    tables = []
    for words in (["drive.mcap", "--topics", "/camera/*", "/status", "--odom", "/odom"], ["drive.csv"]):
        assert (
            main(["bench", "--trace", "outage.csv", "--capacity", "2", "--policies", "afr", "--workload", *words]) == 0
        )
        tables.append(capsys.readouterr().out.partition("\n\n")[2])
    assert tables[0] == tables[1]


def test_the_help_tells_the_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["bench"], ["trace", "from-bag"], ["trace", "from-poses"]):
        with pytest.raises(SystemExit):
            main([*words, "--help"])
        said = " ".join(capsys.readouterr().out.split())
        for option, default in (
            ("--fov-deg DEG", MotionSettings().fov_deg),
            ("--scene-scale-m M", MotionSettings().scene_scale_m),
            ("--max-gap-s S", MotionSettings().max_gap_s),
        ):
            # The last mention explains it; the usage line comes first.
            assert said.rpartition(option)[2].partition("default: ")[2].startswith(f"{default:g})")


def test_gaps_are_told(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gap = ["--odom", "/odom", "--max-gap-s", "0.9"]
    with pytest.raises(BufgymError, match=r"/odom has 2 gaps of more than 0\.9 s without a pose, the longest 1\.0 s"):
        from_bag(str(drive), *gap)
    from_bag(str(drive), *gap, "--bridge-gaps")
    assert "note: 2 gaps without a pose, the longest 1.0 s: motion taken as even" in capsys.readouterr().out


# --- bufgym trace from-poses, and trajectories as --motion -----------------------------------------------------------

# 1 m, then 90 degrees, then nothing for 5 s.
TUM = "0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 1 0 0 0 0 0.70710678 0.70710678\n7 1 0 0 0 0 0.70710678 0.70710678\n"


def test_a_trajectory_becomes_motion(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("path.txt").write_text(TUM)
    words = ["from-poses", "path.txt", "--fov-deg", "45", "--scene-scale-m", "4"]
    trace_command(*words)
    said = capsys.readouterr().out
    # 1 m / 4 m + 90 / 45.
    assert "motion  2.250 fields of view in 7.000 s" in said and "gaps    1, the longest 5.0 s" in said
    with pytest.raises(BufgymError, match=r"path\.txt: has gaps: say --bridge-gaps"):
        trace_command(*words, "-o", "motion.csv")
    assert not Path("motion.csv").exists()
    trace_command(*words, "-o", "motion.csv", "--bridge-gaps")
    assert Path("motion.csv").read_text().splitlines()[:3] == ["t_s,motion", "0,0.0", "1,0.25"]


def test_bench_over_a_trajectory_tells_of_its_gaps(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("path.txt").write_text(TUM)
    Path("w.csv").write_text("time_s,bytes\n0,1000\n1,1000\n2,1000\n3,1000\n")
    assert bench("--policies", "drop-oldest", "--motion", "path.txt", "--fov-deg", "45", "--scene-scale-m", "4") == 0
    said = capsys.readouterr().out
    assert "x is the motion, from path (gaps bridged: 1, the longest 5.0 s), in fields of view." in said
    # Messages 0 and 3: 1 + V(2.25) with V = 1 - exp(-d).
    assert "1.895" in said
