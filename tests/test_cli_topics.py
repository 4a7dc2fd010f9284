"""``bench`` of a client and of a recording, and ``trace from-bag``, as a user types them; numbers worked by hand."""

import sys
from pathlib import Path

import pytest
from cli_cases import FAR_OFF, Capsys, Patch, fails, shown
from needs import needs

from bufgym.benchmark.rows import read_rows
from bufgym.benchmark.tasks.fleet import ROWS as FLEET_ROWS
from bufgym.benchmark.tasks.topics import ROWS
from bufgym.cli import main

CONFIG = """
duration_s = 2
[[topic]]
name = "pose"
rate_hz = 10
size_bytes = 100
priority = 20
deadline_s = 0.5
[[topic]]
name = "commands"
rate_hz = 2
size_bytes = 100
no_drop = true
"""


@pytest.fixture
def config(tmp_path: Path) -> str:
    path = tmp_path / "mine.toml"
    path.write_text(CONFIG)
    return str(path)


def test_a_client_of_ones_own(config: str, tmp_path: Path, capsys: Capsys) -> None:
    out = tmp_path / "rows.csv"
    words = "--trace lte-synthetic-0 --seeds 2 --policies fifo,edf --capacity 2,4 --by-topic edf"
    text = shown(["bench", "--scenario", f"{config}:scale=.01,window=3", *words.split(), "--out", out], capsys)
    assert "lte-synthetic-0 x 0.01, L = 2\n" in text and "edf, topic by topic" in text and "\ncommands " in text
    rows = read_rows(out, ROWS)
    assert len(rows) == 24
    # The baseline runs whether named or not.
    assert [row["policy"] for row in rows[:12:4]] == ["fifo", "edf", "robofleet"]
    assert {row["capacity"] for row in rows} == {2, 4} and {row["window"] for row in rows} == {3}


def test_a_fleet_of_ones_own(tmp_path: Path, capsys: Capsys, monkeypatch: Patch) -> None:
    """A function that makes a cell; its parameters stand behind its name."""
    monkeypatch.chdir(tmp_path)
    Path("cell_of_two.py").write_text(
        "from bufgym.scenario import FleetScenario\n"
        "make = lambda: FleetScenario.of(2, traces='lte-synthetic-0', duration_s=2.0)\n"
    )
    policies = ["--policies", "random", "--seeds", "1", "--capacity", "2"]
    shown(["bench", "--scenario", "cell_of_two:make:robots=3", *policies, "--out", "rows.csv"], capsys)
    rows = read_rows("rows.csv", FLEET_ROWS)
    assert [(row["policy"], row["robot"]) for row in rows] == [(p, i) for p in ("random", "afr") for i in range(3)]


@pytest.mark.nightly
def test_a_suite_of_topics(capsys: Capsys) -> None:
    words = "--suite topics-v1 --split validation --seeds 1 --policies robofleet"
    text = shown(["bench", *words.split()], capsys)
    assert "18 episodes of 60 s; n_T = 1 and 5, " in text
    lines = [line.split() for line in text.splitlines() if line.startswith("robofleet ")]
    assert len(lines) == 7 and all(line[2:5] == ["1.000", "[1.000,", "1.000]"] and line[5] == "0" for line in lines)


def test_impossible_decisions_are_told(config: str, tmp_path: Path, capsys: Capsys) -> None:
    """Each of the 2 s x (10 + 2) messages/s is sent by such a decision, whatever its topic."""
    mine = tmp_path / "mine.py"
    mine.write_text(FAR_OFF.format(True))
    chosen = ["--seeds", "1", "--policies", "far-off", "--policy-file", mine]
    printed = shown(["bench", "--scenario", config, "--trace", "lte-synthetic-0", *chosen], capsys)
    assert printed.count("invalid") == 1 and "\nnote: far-off gave 24 invalid decisions\n" in printed
    # Nor do the intervals of a single episode look as if they were known.
    assert "1 episode of 2 s" in printed and "1.000 [–]" in printed and "1.000 [1.000" not in printed


def test_a_mistake_typed_is_not_the_files_fault(config: str, capsys: Capsys, monkeypatch: Patch) -> None:
    bench = ["bench", "--scenario"]
    fails([*bench, f"{config}:window=0", "--trace", "lte-synthetic-0"], "error: window = 0", capsys)
    fails([*bench, config, "--trace", "none.csv"], "none.csv", capsys)
    Path(config).write_text(f"window = 0\n{CONFIG}")
    fails([*bench, config], "mine.toml: window = 0: n_T must be a whole number", capsys)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    fails([*bench, "topics", "--out", "rows.parquet"], "a Parquet file, unlike .csv, needs pyarrow", capsys)


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
    # By topic: two messages each, 1 s between the two, 2 s apart.
    assert ["/camera", "2", "0.500", "2,000", "1,000", "50.0%"] in [line.split() for line in text.splitlines()]
    # H: messages 0 and 3 give 1 + V(2) = 1.865; 0 and 1 give 1 + V(0) = 1.
    first, _, second = text.partition("dropped of")
    table = {line.split()[0]: line.split() for line in first.splitlines() if line}
    assert table["drop-oldest"][1:7] == ["1", "1.865", "0.000", "%", "2.0", "2.0"]
    assert table["drop-newest"][1:7] == ["1", "1.000", "46.4", "%", "2.0", "2.0"]
    # Best QoI first, as above; Drop Oldest drops one of each topic, Drop Newest as well.
    shares = {line.split()[0]: line.split()[1:] for line in second.splitlines()[1:4]}
    assert list(shares) == ["drop-oldest", "drop-newest", "clairvoyant"]
    assert shares["drop-oldest"] == ["1", "50.0%", "50.0%"]
    assert Path("drops.csv").read_text().splitlines()[:3] == [
        "policy,capacity,trace,seed,message,time_s,topic,bytes,x,dropped_s",
        "drop-oldest,1,outage,0,1,1.0,/odom,1000,0.0,2.0",
        "drop-oldest,1,outage,0,2,2.0,/camera,1000,1.0,3.0",
    ]
    assert len(Path("drops.csv").read_text().splitlines()) == 1 + 6


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (f"{W} --fps 30", "--fps cannot go with --workload: a recording has its own"),
        (f"{W} --topics /lidar", "no topic '/lidar'; it has: /camera, /odom"),
        (f"{W} --odom /odom", "odom = '/odom': needs a recording, which this is not"),
        (f"{W} --bridge-gaps", "--bridge-gaps needs --odom"),
        (f"{W} --scenario interruption", "--workload cannot go with interruption, which plays no recording"),
        (f"{W} --motion drive-0", "workload 'w' has an x of its own"),
        ("--drops d.csv", "--drops needs --workload"),
        ("--topics /camera", "--topics needs --workload"),
    ],
)
def test_what_does_not_go_together(here: Path, capsys: Capsys, words: str, says: str) -> None:
    fails(["bench", "--policies", "drop-oldest", *words.split()], says, capsys)


@pytest.fixture
def drive(here: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """1 m forward in a second, a turn of 90 degrees in the next; a picture every 500 ms (see bag_cases)."""
    pytest.importorskip("mcap", reason=needs("extras", "mcap"))
    pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "traces"))
    import bag_cases

    monkeypatch.setitem(sys.modules, "bag_cases", bag_cases)
    return bag_cases.write_mcap(Path("drive.mcap"), bag_cases.drive())


def test_a_bag_becomes_a_csv_that_plays_the_same(drive: Path, capsys: Capsys) -> None:
    chosen = ["--odom", "/odom", "--topics", "/camera/*"]
    words = "--odom /odom --topics /camera/*,/status -o drive.csv"
    text = shown(["trace", "from-bag", drive, *words.split()], capsys)
    assert "motion of 2.000 fields of view" in text
    assert Path("drive.csv").read_text().splitlines()[:4] == [
        "time_s,bytes,topic,x",
        "0.000000,109,/camera/left,0.0",
        "0.500000,209,/camera/left,0.25",
        "0.700000,11,/status,0.35",
    ]
    bench = ["bench", "--trace", "outage.csv", "--capacity", "2", "--policies", "afr", "--workload"]
    one, other = (shown([*bench, *words], capsys) for words in ([drive, *chosen, "/status"], ["drive.csv"]))
    # The bag knows more facts, which are indented: its start, and those of its poses.
    tables = ([line for line in text.splitlines()[2:] if not line.startswith("  ")] for text in (one, other))
    assert next(tables) == next(tables) and "  start " in one
    assert "; 3 messages left out, on topics not chosen: /odom\n" in text and "; 3 messages left out" in one


def test_a_recording_is_described_before_the_long_work(drive: Path, capsys: Capsys, monkeypatch: Patch) -> None:
    """Stopped at once: what was read, what was left out, and how much work there is have been said."""
    monkeypatch.setattr("bufgym.benchmark.parts.run", stopped)
    assert main(["bench", "--trace", "outage.csv", "--workload", str(drive), "--topics", "/status", "/camera/*"]) == 130
    out, err = capsys.readouterr()
    assert "; 3 messages left out" in out and "6 messages, 1,556 bytes in 2.000 s" in out
    assert err.startswith("bufgym: finding the clairvoyant's plans for 1 x 6 messages, then playing every policy\n")


def stopped(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


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
