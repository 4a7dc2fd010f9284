"""`bufgym trace generate` as a user calls it."""

from __future__ import annotations

from pathlib import Path

import pytest

from bufgym.cli import trace_generate
from bufgym.cli.options import Parser
from bufgym.errors import BufgymError
from bufgym.traces import load_motion, read_motion, read_trace


def generate(*arguments: str) -> None:
    parser = Parser(prog="bufgym trace")
    trace_generate.add(parser.add_subparsers(required=True))
    options = parser.parse_args(["generate", *arguments])
    options.command(options)


@pytest.mark.parametrize(
    "arguments",
    [
        ["link", "--mode", "train", "--seed", "4", "--duration", "50", "--mean", "8e6"],
        ["gilbert-elliott", "--seed", "4", "--duration", "50", "--mean-bad", "1"],
        ["roaming", "--seed", "4", "--duration", "50", "--gap", "0.5"],
        ["steady", "--duration", "50", "--rate", "1e6"],
        ["ramp", "--duration", "50"],
        ["tunnel", "--before", "15", "--after", "20"],
    ],
)
def test_the_command_writes_traces(arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    generate(*arguments, "-o", str(tmp_path / "a.csv"))
    generate(*arguments, "-o", str(tmp_path / "b.csv"))
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    assert read_trace(tmp_path / "a.csv").duration_us == 50_000_000
    assert "mean" in capsys.readouterr().out


def test_the_command_writes_motion_and_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    generate("drive", "--seed", "1", "--duration", "20", "--cruise", "1,1", "-o", str(tmp_path / "m.csv"))
    assert read_motion(tmp_path / "m.csv").duration_us == 20_000_000
    generate("frames", "--motion", str(tmp_path / "m.csv"), "--duration", "2", "-o", str(tmp_path / "f.csv"))
    lines = (tmp_path / "f.csv").read_text().splitlines()
    assert lines[0] == "time_s,bytes,x"
    assert len(lines) == 1 + 60
    x = [float(line.split(",")[2]) for line in lines[1:]]
    assert x[-1] == pytest.approx(load_motion(tmp_path / "m.csv").at(1_966_667))
    assert "60 frames" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["link", "--mode", "boat", "-o", "x.csv"], "mode = 'boat'"),
        (["drive", "--cruise", "2,1", "-o", "x.csv"], "must not be above the second"),
        (["drive", "--cruise", "2", "-o", "x.csv"], "must be two numbers"),
        (["frames", "--rate-hz", "1e9", "-o", "x.csv"], "must be from 1 to 1e7"),
        (["link", "--mode", "bus", "--links", "nowhere.json", "-o", "x.csv"], "nowhere.json: cannot be read"),
    ],
)
def test_what_the_command_refuses(arguments: list[str], says: str) -> None:
    with pytest.raises(BufgymError, match=says):
        generate(*arguments)
