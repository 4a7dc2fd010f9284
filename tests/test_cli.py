"""Each command as a user types it, and each mistake that ends in one line and exit code 2."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from cli_cases import Capsys, Patch, fails, shown

from bufgym import __version__, cli, policies, reproduce, scenario, traces
from bufgym.benchmark import perf
from bufgym.benchmark.run import run
from bufgym.cli import main
from bufgym.traces.generate.shipped import shipped_calls


@pytest.fixture
def trace(tmp_path: Path) -> str:
    path = tmp_path / "link.csv"
    path.write_text("t_ms,bytes,interval_ms\n1000,500000,1000\n2000,0,1000\n3000,900000,1000\n")
    return str(path)


def test_list_names_everything_there_is(capsys: Capsys) -> None:
    text = shown(["list"], capsys)
    names = [*policies.names(), *traces.shipped(), *cli.KINDS, *shipped_calls().values()]
    assert all(name in text for name in (*names, "bufgym/Uplink-v0", "lte", "retained", "service_ratio", "every=3"))
    for kind in cli.KINDS:
        head, *lines = shown(["list", kind], capsys).splitlines()
        assert head == kind and lines and all(line.startswith("  ") for line in lines)


def test_list_has_a_group_of_policies_made_for_topics(capsys: Capsys) -> None:
    one_queue, topics = shown(["list", "policies"], capsys).split("  -- made for several topics side by side --\n")
    for name in policies.names():
        part, other = (topics, one_queue) if policies.get(name).for_topics else (one_queue, topics)
        assert f"\n  {name} " in f"\n{part}" and f"\n  {name} " not in f"\n{other}"


def test_the_module_runs_as_a_command_and_opens_no_heavy_module() -> None:
    heavy = ("bufgym.sim", "bufgym.envs", "matplotlib", "pyarrow", "tqdm", "mcap", "rosbags")
    held = f"[m for m in {heavy!r} if m in sys.modules]"
    program = f"import sys; from bufgym.cli import main; main(['list'])\nprint({held})"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    done = subprocess.run([sys.executable, "-m", "bufgym", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"bufgym {__version__}\n"


@pytest.mark.parametrize(
    ("command", "naming"),
    [
        ("", "COMMAND"),
        ("fly", "'fly'"),
        ("list planets", "'planets'"),
        ("trace", "VERB"),
        ("trace info missing.csv", "missing.csv"),
        ("trace plot lte-synthetic-0 --out x.doc", "x.doc"),
        ("play --env Moon-v0", "'Moon-v0'"),
        ("play --policies guess", "'guess'"),
        ("play --seed -1", "-1"),
        ("perf --repeats 0", "0: must be"),
        ("reproduce fig99", "'fig99'"),
    ],
)
def test_bad_commands(command: str, naming: str, capsys: Capsys) -> None:
    fails(command.split(), naming, capsys)


def test_ctrl_c_and_a_reader_that_left(monkeypatch: Patch, capsys: Capsys, tmp_path: Path) -> None:
    def interrupt(*_: Any, **__: Any) -> str:
        raise KeyboardInterrupt

    monkeypatch.setitem(cli._LISTS, "policies", interrupt)
    assert main(["list", "policies"]) == 130
    assert capsys.readouterr().err == "bufgym: stopped\n"
    monkeypatch.setattr("bufgym.benchmark.sweep.run_sweep", interrupt)
    assert main(["bench", "--suite", "interruption-v1", "--out", str(tmp_path)]) == 130
    assert capsys.readouterr().err == "bufgym: stopped; the same command resumes it\n"
    command, pipe = [sys.executable, "-m", "bufgym", "list"], subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


def test_trace_info(trace: str, capsys: Capsys) -> None:
    first, second = shown(["trace", "info", trace, "lte-synthetic-0"], capsys).split("\n\n")
    assert first.startswith("link\n") and "format csv, detected" in first and second.startswith("lte-synthetic-0\n")
    lines = [line.split() for line in first.splitlines()]
    assert ["duration_s", "3"] in lines and ["seconds_below_500KBps", "1"] in lines


def test_trace_plot(trace: str, tmp_path: Path, monkeypatch: Patch, capsys: Capsys) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "picture.png"
    shown(["trace", "plot", trace, "lte-synthetic-1", "--out", out], capsys)
    assert out.read_bytes().startswith(b"\x89PNG")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    fails(["trace", "plot", trace, "--out", "x.png"], "pip install matplotlib", capsys)


def test_reproduce_lists_and_dispatches(tmp_path: Path, monkeypatch: Patch, capsys: Capsys) -> None:
    monkeypatch.setattr(reproduce, "FIGURES", {"one": "the first", "two": "the second"})
    monkeypatch.setattr(reproduce, "run", lambda name, out: f"{name} in {out.name}")
    assert "the second" in shown(["reproduce"], capsys)
    assert shown(["reproduce", "two", "two", "--out", tmp_path / "o"], capsys) == "two in o\n"
    assert shown(["reproduce", "all", "--out", tmp_path / "o"], capsys) == "one in o\n\ntwo in o\n"


def test_perf(tmp_path: Path, monkeypatch: Patch, capsys: Capsys) -> None:
    # tests/benchmark measures; here it is the command alone.
    monkeypatch.setattr(perf, "measure", lambda sizes: [perf.Figure("rollout, afr", 2.5e7, "arrivals/s", 2e7, "what")])
    target = tmp_path / "perf.json"
    text = shown(["perf", "--quick", "--repeats", 1, "--json", target], capsys)
    assert "rollout, afr  25 M arrivals/s  (target 20 M arrivals/s)" in text
    assert json.loads(target.read_text())["sizes"]["repeats"] == 1


def test_play_ends_where_bench_does(capsys: Capsys) -> None:
    words = "play --env Interruption-v0 --policies afr --speed 0 --seed 3 --capacity 4 --steps 400"
    over = shown(words.split(), capsys).splitlines()[-1]
    (row,) = run([policies.get("afr")], scenario.get("interruption"), [4], [3])
    assert over == (
        f"over: QoI {row['qoi']:.3f}, {row['delivered']} of {row['arrived']} delivered, {row['dropped']} dropped"
    )


def test_play_stops_after_so_many_decisions_and_colours_a_terminal_alone(monkeypatch: Patch, capsys: Capsys) -> None:
    words = ["play", "--speed", "0", "--steps", "2"]
    text = shown(words, capsys)
    assert "decision 2" in text and "decision 3" not in text and "stopped after 2 decisions" in text
    assert "\x1b" not in text
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    for wish in ("", "1"):
        monkeypatch.setenv("NO_COLOR", wish)
        assert ("\x1b" in shown(words, capsys)) == (not wish)
