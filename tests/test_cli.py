"""Each command as a user types it, and each mistake that ends in one line and exit code 2."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from bufgym import __version__, cli, policies, traces
from bufgym.benchmark.rows import read_rows
from bufgym.cli import main, split_policies
from bufgym.kernel import JIT
from bufgym.traces.generators import shipped_calls

QUICK = ["--seconds", "1", "--fps", "10", "--seeds", "2", "--capacity", "2"]
"""A benchmark of a few messages."""


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


# -------------------- bench


def test_bench_writes_rows_and_a_table(trace: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "results"
    chosen = ["--policies", "afr,decimate:every=2,random", "--format", "csv", "--out", str(out)]
    assert main(["bench", "--trace", trace, "--motion", "none", *QUICK, *chosen]) == 0
    text = capsys.readouterr().out
    assert "over link" in text and "decimate:every=2" in text and "V = exponential:0.618" in text
    rows = read_rows(out / "rows.csv")
    assert [row["policy"] for row in rows] == ["afr"] * 2 + ["decimate:every=2"] * 2 + ["random"] * 2
    assert {row["trace"] for row in rows} == {"link"} and {row["arrived"] for row in rows} == {10}
    assert "| decimate:every=2 | 2 |" in (out / "table.md").read_text()
    assert sorted(path.name for path in out.iterdir()) == ["rows.csv", "table.md"]


def test_bench_by_default_writes_parquet_where_it_can(trace: str, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    assert main(["bench", "--trace", trace, *QUICK, "--policies", "afr", "--out", str(tmp_path)]) == 0
    assert len(read_rows(tmp_path / "rows.parquet")) == 2


def test_bench_without_pyarrow_writes_csv(trace: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)  # importing it now fails
    command = ["bench", "--trace", trace, *QUICK, "--policies", "afr", "--out", str(tmp_path)]
    assert main(command) == 0
    assert (tmp_path / "rows.csv").exists()
    assert main([*command, "--format", "parquet"]) == 2


def test_bench_takes_shipped_traces_and_all_policies_by_default(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *QUICK]) == 0
    text = capsys.readouterr().out
    assert "8 traces x 2 seeds" in text
    for name in policies.names():
        assert (f"\n{name} " in text) != policies.get(name).for_topics


def test_bench_of_one_interruption_has_regret(capsys: pytest.CaptureFixture[str]) -> None:
    law = ["--law", "fixed", "--t-max", "5", "--value", "saturating:2"]
    assert main(["bench", "--interruption", *law, "--capacity", "1,2", "--seeds", "1", "--policies", "afr"]) == 0
    text = capsys.readouterr().out
    assert "regret" in text and "T = 5" in text


def test_bench_runs_a_users_policy_file(trace: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = tmp_path / "mine.py"
    mine.write_text(
        "from bufgym.policies import ACCEPT, register\n"
        "@register('my-own', memory={'seen': 0, 'step': 1}, parameters=('step',))\n"
        "def my_own(buffer, arrival, memory):\n"
        "    'Mine.'\n"
        "    memory[0] += memory[1]\n"
        "    return ACCEPT if len(buffer.slots) < buffer.capacity else int(memory[0]) % buffer.capacity\n"
    )
    try:
        chosen = ["--policies", "my-own,my-own:step=2,afr", "--policy-file", str(mine)]
        assert main(["bench", "--trace", trace, *QUICK, *chosen]) == 0
        assert "my-own:step=2" in capsys.readouterr().out
        assert main(["list", "policies", "--policy-file", str(mine)]) == 0
        assert "a policy file" in capsys.readouterr().out
    finally:
        policies.registry._REGISTRY.pop("my-own", None)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("def broken(:\n", "line 1"),
        ("import a_module_that_is_not_there\n", "line 1: ModuleNotFoundError"),
        (
            "from bufgym.policies import register\n"
            "@register('boom')\n"
            "def boom(buffer, arrival, memory):\n"
            "    return 1 // 0\n",
            "line 4: ZeroDivisionError",
        ),
        (
            "from bufgym.policies import register\n"
            "@register('boom', compile=True)\n"
            "def boom(buffer, arrival, memory):\n"
            "    return buffer.nothing_like_it\n",
            "line 4: AttributeError" if not JIT else "compile",
        ),
    ],
)
def test_a_users_mistake_is_shown_where_it_is(
    trace: str, tmp_path: Path, text: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "mine.py"
    mine.write_text(text)
    try:
        only = ["--policies", "boom"] if "boom" in text else []
        fails(["bench", "--trace", trace, *QUICK, "--policy-file", str(mine), *only], line, capsys)
    finally:
        policies.registry._REGISTRY.pop("boom", None)


@pytest.mark.parametrize(
    ("text", "specs"),
    [
        ("afr", ["afr"]),
        ("afr,random", ["afr", "random"]),
        ("decimate:every=2,afr", ["decimate:every=2", "afr"]),
        ("p:a=1,b=2,decimate:every=2,afr", ["p:a=1,b=2", "decimate:every=2", "afr"]),
    ],
)
def test_a_setting_belongs_to_the_policy_before_it(text: str, specs: list[str]) -> None:
    assert split_policies(text) == specs


# -------------------- mistakes


def fails(command: list[str], naming: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The command ends with code 2 and one line that names the culprit."""
    assert main(command) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert shown.err.startswith("bufgym: error: ")
    assert naming in shown.err
    assert "Traceback" not in shown.err


@pytest.mark.parametrize(
    ("options", "naming"),
    [
        (["--policies", "afr,drop-olds"], "'drop-olds'"),
        (["--policies", "decimate:every=0"], "every = 0"),
        (["--policies", "decimate:pace=2"], "'pace'"),
        (["--policies", "afr,afr"], "'afr'"),
        (["--capacity", "-5"], "-5"),
        (["--capacity", "0"], "0: must be"),
        (["--capacity", "5,x"], "x: must be"),
        (["--capacity", "5,5"], "5 is given more than once"),
        (["--capacity", "99999999"], "99999999"),
        (["--fps", "0"], "0: must be"),
        (["--fps", "nan"], "nan: must be"),
        (["--seeds", "0"], "0: must be"),
        (["--bytes", "1.5"], "1.5"),
        (["--seconds", "1e9"], "30000000000"),
        (["--jitter", "2"], "jitter = 2"),
        (["--scale", "-1"], "-1"),
        (["--value", "exponential:1.5"], "1.5"),
        (["--value", "exponential:half"], "'half'"),
        (["--value", "cubic:3"], "'cubic'"),
        (["--decide-at", "never"], "'never'"),
        (["--trace", "no-such.csv"], "no-such.csv"),
        (["--motion", "no-such.txt"], "no-such.txt"),
        (["--policy-file", "no-such.py"], "no-such.py"),
        (["--t-max", "5"], "--t-max needs --interruption"),
        (["--interruption", "--trace", "x.csv"], "--trace cannot go with --interruption"),
        (["--interruption", "--law", "gauss"], "'gauss'"),
        (["--interruption", "--t-min", "9", "--t-max", "5"], "t_min = 9"),
        (["--nonsense"], "--nonsense"),
    ],
)
def test_bad_options_of_bench(options: list[str], naming: str, capsys: pytest.CaptureFixture[str]) -> None:
    fails(["bench", *options], naming, capsys)


@pytest.mark.parametrize(
    ("content", "naming"),
    [
        ("", "link.csv"),
        ("t_ms,bytes,interval_ms\n1000,nan,1000\n", "line 2: bytes = nan"),
        ("t_ms,bytes,interval_ms\n1000,-4,1000\n", "-4"),
        ("hello\n", "link.csv"),
    ],
)
@pytest.mark.parametrize("command", [["bench", "--trace"], ["trace", "info"]])
def test_bad_traces(
    command: list[str], content: str, naming: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "link.csv"
    path.write_text(content)
    fails([*command, str(path)], naming, capsys)


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


def test_an_output_folder_that_cannot_be_made(trace: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "taken").touch()
    fails(["bench", "--trace", trace, *QUICK, "--out", str(tmp_path / "taken")], "taken: File exists", capsys)
    fails(["bench", "--trace", trace, *QUICK, "--out", "rows.csv"], "rows.csv: without --suite it must be", capsys)


def test_ctrl_c_and_a_reader_that_left(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(kind: Any) -> str:
        raise KeyboardInterrupt

    monkeypatch.setitem(cli._LISTS, "policies", lambda: interrupt(0))
    assert main(["list", "policies"]) == 130
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
    fails(["trace", "plot", trace, "--out", "x.png"], "bufgym[plot]", capsys)


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
