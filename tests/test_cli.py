"""Each command as a user types it, and each mistake that ends in one line and exit code 2."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from cli_cases import fails

from bufgym import __version__, cli, policies, traces
from bufgym.cli import main
from bufgym.traces.generate.shipped import shipped_calls


@pytest.fixture
def trace(tmp_path: Path) -> str:
    path = tmp_path / "link.csv"
    path.write_text("t_ms,bytes,interval_ms\n1000,500000,1000\n2000,0,1000\n3000,900000,1000\n")
    return str(path)


# -------------------- list


def test_list_names_everything_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    text = capsys.readouterr().out
    for name in (
        *policies.names(),
        *traces.shipped(),
        *cli.KINDS,
        "bufgym/Uplink-v0",
        "lte",
        "retained",
        "service_ratio",
    ):
        assert name in text
    assert "every=3" in text
    assert all(call in text for call in shipped_calls().values())


@pytest.mark.parametrize("kind", cli.KINDS)
def test_list_one_kind(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", kind]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == kind
    assert len(lines) > 1 and all(line.startswith("  ") for line in lines[1:])


def test_list_has_a_group_of_policies_made_for_topics(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "policies"]) == 0
    one_queue, topics = capsys.readouterr().out.split("  -- made for several topics side by side --\n")
    for name in policies.names():
        part, other = (topics, one_queue) if policies.get(name).for_topics else (one_queue, topics)
        assert f"\n  {name} " in f"\n{part}" and f"\n  {name} " not in f"\n{other}"


def test_list_opens_no_heavy_module() -> None:
    heavy = ("bufgym.sim", "bufgym.envs", "matplotlib", "pyarrow", "tqdm", "mcap", "rosbags")
    program = (
        f"import sys; from bufgym.cli import main; main(['list']);print([m for m in {heavy!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


# -------------------- mistakes


@pytest.mark.parametrize(
    ("command", "naming"),
    [
        ([], "COMMAND"),
        (["fly"], "'fly'"),
        (["list", "planets"], "'planets'"),
        (["trace"], "VERB"),
        (["trace", "info", "missing.csv"], "missing.csv"),
        (["trace", "plot", "lte-synthetic-0", "--out", "x.doc"], "x.doc"),
        (["play", "--env", "Moon-v0"], "'Moon-v0'"),
        (["play", "--policies", "guess"], "'guess'"),
        (["play", "--seed", "-1"], "-1"),
        (["perf", "--repeats", "0"], "0: must be"),
        (["reproduce", "fig99"], "'fig99'"),
    ],
)
def test_bad_commands(command: list[str], naming: str, capsys: pytest.CaptureFixture[str]) -> None:
    fails(command, naming, capsys)


def test_ctrl_c_and_a_reader_that_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def interrupt(kind: Any) -> str:
        raise KeyboardInterrupt

    monkeypatch.setitem(cli._LISTS, "policies", lambda: interrupt(0))
    assert main(["list", "policies"]) == 130
    assert capsys.readouterr().err == "bufgym: stopped\n"
    monkeypatch.setattr("bufgym.benchmark.sweep.run_sweep", lambda *_, **__: interrupt(0))
    assert main(["bench", "--suite", "interruption-v1", "--out", str(tmp_path)]) == 130
    assert capsys.readouterr().err == "bufgym: stopped; the same command resumes it\n"
    program = "import sys; from bufgym.cli import main; sys.exit(main(['list']))"
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


# -------------------- the other commands


def test_trace_info(trace: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trace", "info", trace, "lte-synthetic-0"]) == 0
    first, second = capsys.readouterr().out.split("\n\n")
    assert first.startswith("link\n") and "format csv, detected" in first
    assert ["duration_s", "3"] in [line.split() for line in first.splitlines()]
    assert ["seconds_below_500KBps", "1"] in [line.split() for line in first.splitlines()]
    assert second.startswith("lte-synthetic-0\n")


def test_trace_plot(trace: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "picture.png"
    assert main(["trace", "plot", trace, "lte-synthetic-1", "--out", str(out)]) == 0
    assert out.read_bytes().startswith(b"\x89PNG")


def test_trace_plot_without_matplotlib(
    trace: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    fails(["trace", "plot", trace, "--out", "x.png"], "pip install matplotlib", capsys)


def test_reproduce_lists_and_dispatches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from bufgym import reproduce

    monkeypatch.setattr(reproduce, "FIGURES", {"one": "the first", "two": "the second"})
    monkeypatch.setattr(reproduce, "run", lambda name, out: f"{name} in {out.name}")
    assert main(["reproduce"]) == 0
    assert "the second" in capsys.readouterr().out
    assert main(["reproduce", "two", "two", "--out", str(tmp_path / "o")]) == 0
    assert capsys.readouterr().out == "two in o\n"
    assert main(["reproduce", "all", "--out", str(tmp_path / "o")]) == 0
    assert capsys.readouterr().out == "one in o\n\ntwo in o\n"


def test_perf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from bufgym.benchmark import perf

    # tests/benchmark measures; here it is the command alone.
    monkeypatch.setattr(perf, "measure", lambda sizes: [perf.Figure("rollout, afr", 2.5e7, "arrivals/s", 2e7, "what")])
    target = tmp_path / "perf.json"
    assert main(["perf", "--quick", "--repeats", "1", "--json", str(target)]) == 0
    assert "rollout, afr  25 M arrivals/s  (target 20 M arrivals/s)" in capsys.readouterr().out
    assert json.loads(target.read_text())["sizes"]["repeats"] == 1


def test_play_ends_where_bench_does(capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "play",
        "--env",
        "Interruption-v0",
        "--policies",
        "afr",
        "--speed",
        "0",
        "--seed",
        "3",
        "--capacity",
        "4",
    ]
    assert main([*command, "--steps", "400"]) == 0
    over = capsys.readouterr().out.splitlines()[-1]
    from bufgym import scenario
    from bufgym.benchmark.run import run

    (row,) = run([policies.get("afr")], scenario.get("interruption"), [4], [3])
    assert over == (
        f"over: QoI {row['qoi']:.3f}, {row['delivered']} of {row['arrived']} delivered, {row['dropped']} dropped"
    )


def test_play_stops_after_so_many_decisions(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["play", "--speed", "0", "--steps", "2"]) == 0
    text = capsys.readouterr().out
    assert "decision 2" in text and "decision 3" not in text
    assert "stopped after 2 decisions" in text
    # This is no terminal.
    assert "\x1b" not in text


@pytest.mark.parametrize("wish", ["", "1"])
def test_a_terminal_gets_colours_unless_it_wants_none(
    wish: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("NO_COLOR", wish)
    assert main(["play", "--speed", "0", "--steps", "2"]) == 0
    assert ("\x1b" in capsys.readouterr().out) == (not wish)


def test_the_module_runs_as_a_command() -> None:
    done = subprocess.run([sys.executable, "-m", "bufgym", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"bufgym {__version__}\n"
    wrong = subprocess.run([sys.executable, "-m", "bufgym", "fly"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2 and "Traceback" not in wrong.stderr
