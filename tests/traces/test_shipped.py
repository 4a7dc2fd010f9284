"""What comes with bufgym: made by the calls that are stated, by the same generators as the command `generate` has."""

from pathlib import Path
from typing import Any

import pytest
from cli_cases import Capsys, fails, shown

from bufgym import traces
from bufgym.errors import TraceError
from bufgym.traces import describe, drive_motion, load, load_motion, outage, read_motion, read_trace, synthetic_lte
from bufgym.traces.generate.shipped import SHIPPED_LTE, shipped_calls, write_shipped

ROOT = Path(__file__).resolve().parents[2]


def test_the_calls_that_are_stated_make_the_shipped_files_byte_for_byte(tmp_path: Path) -> None:
    write_shipped(tmp_path / "new")
    made = {path.name: path.read_bytes() for path in (tmp_path / "new").iterdir()}
    assert made == {path.name: path.read_bytes() for path in (ROOT / "traces").glob("*.csv")}
    assert len(made) == len(SHIPPED_LTE) + 2 and set(shipped_calls()) == set(traces.shipped())
    for name, call in shipped_calls().items():
        generated: Any = eval(call, {"synthetic_lte": synthetic_lte, "drive_motion": drive_motion})
        assert f"({name.split('-')[-1]}," in call  # the seed
        if name.startswith("drive-"):
            assert load_motion(name).coordinate.tolist() == generated.coordinate.tolist()
        else:
            trace = load(name)
            assert trace.cumulative_bytes.tolist() == generated.cumulative_bytes.tolist()
            # They trouble a robot, but not always: 30 frames of 230 kB a second.
            assert 3 <= describe(trace)["seconds_below_500KBps"] <= 45 and 30 <= trace.seconds_below(6.9e6) <= 150
    (tmp_path / "file").write_text("")
    with pytest.raises(TraceError, match="cannot be created"):
        write_shipped(tmp_path / "file" / "below")


def test_shipped_names_and_loading(tmp_path: Path) -> None:
    names = traces.shipped()
    assert {f"lte-synthetic-{k}" for k in range(8)} | {"drive-0", "drive-1"} <= set(names)
    assert load_motion("drive-0").name == "drive-0"
    own = tmp_path / "own.csv"
    traces.write_csv(outage(2, 1, 1e6), own)
    assert load(own) == load(str(own)) == read_trace(own) and load(own, after="stop").after == "stop"
    with pytest.raises(TraceError, match=r"lte-nowhere: no such file, .*known: .*drive-0.*lte-synthetic-7"):
        load("lte-nowhere")
    with pytest.raises(TraceError, match="must fit a known format"):
        load("drive-0")
    with pytest.raises(TraceError, match="must have 8 columns"):
        read_motion(names["lte-synthetic-0"])


GENERATE = ["trace", "generate"]


def test_the_command_writes_traces_motion_and_frames(tmp_path: Path, capsys: Capsys) -> None:
    for arguments in (
        "link --mode train --seed 4 --duration 50 --mean 8e6",
        "gilbert-elliott --seed 4 --duration 50 --mean-bad 1",
        "roaming --seed 4 --duration 50 --gap 0.5",
        "steady --duration 50 --rate 1e6",
        "ramp --duration 50",
        "tunnel --before 15 --after 20",
    ):
        assert "mean" in shown([*GENERATE, *arguments.split(), "-o", tmp_path / "a.csv"], capsys)
        assert read_trace(tmp_path / "a.csv").duration_us == 50_000_000
    drive = ["drive", "--seed", "1", "--duration", "20", "--cruise", "1,1", "-o", tmp_path / "m.csv"]
    shown([*GENERATE, *drive], capsys)
    assert read_motion(tmp_path / "m.csv").duration_us == 20_000_000
    frames = ["frames", "--motion", tmp_path / "m.csv", "--duration", "2", "-o", tmp_path / "f.csv"]
    assert "60 frames" in shown([*GENERATE, *frames], capsys)
    header, *lines = (tmp_path / "f.csv").read_text().splitlines()
    assert header == "time_s,bytes,x" and len(lines) == 60
    assert float(lines[-1].split(",")[2]) == pytest.approx(load_motion(tmp_path / "m.csv").at(1_966_667))
    for arguments, says in (
        ("drive --cruise 2,1 -o x.csv", "must not be above the second"),
        ("drive --cruise 2 -o x.csv", "must be two numbers"),
        ("link --mode bus --links no.json -o x.csv", "no.json: cannot be read"),
    ):
        fails([*GENERATE, *arguments.split()], says, capsys)
