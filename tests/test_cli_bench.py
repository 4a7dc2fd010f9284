"""``bufgym bench`` as a user types it, and each mistake that ends in one line and exit code 2."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from cli_cases import fails

from bufgym import policies
from bufgym.benchmark.rows import read_rows
from bufgym.cli import main, split_policies
from bufgym.kernel import JIT

QUICK = ["--seconds", "1", "--fps", "10", "--seeds", "2", "--capacity", "2"]
"""A benchmark of a few messages."""


@pytest.fixture
def trace(tmp_path: Path) -> str:
    path = tmp_path / "link.csv"
    path.write_text("t_ms,bytes,interval_ms\n1000,500000,1000\n2000,0,1000\n3000,900000,1000\n")
    return str(path)


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
        told = f"\n{name} " in text or re.search(rf"^note: .*\b{name}\b.*the same rows here", text, re.M)
        assert bool(told) != policies.get(name).for_topics


@pytest.mark.skipif(not JIT, reason="it plays whole benchmarks, which takes compiled code")
def test_bench_meets_the_episodes_of_the_environment_by_default(tmp_path: Path) -> None:
    """Row (trace, seed) is what ``reset`` of bufgym/Uplink-v0 plays by these numbers; neither side has an argument."""
    assert main(["bench", "--seeds", "1", "--policies", "drop-oldest", "--format", "csv", "--out", str(tmp_path)]) == 0
    (row,) = (row for row in read_rows(tmp_path / "rows.csv") if row["trace"] == "lte-synthetic-3")
    env = gym.make("bufgym/Uplink-v0", bound=True).unwrapped
    _, info = env.reset(options={"trace": "lte-synthetic-3", "seed": 0})
    ended = False
    while not ended:
        action = 9 if info["action_mask"][9] else 0  # accept, else evict the oldest
        _, _, ended, _, info = env.step(action)
    assert info["qoi"] == row["qoi"] and info["regret"] == pytest.approx(row["regret"]) and info["score"] == 0


@pytest.mark.skipif(not JIT, reason="it plays whole benchmarks, which takes compiled code")
def test_the_default_task_is_worth_learning(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Drop Oldest loses at least 8 %, AFR at least 3 %, and on fewer than 3 % of the episodes nothing can be gained."""
    chosen = ["drop-oldest", "drop-newest", "afr", "min-motion-gap"]
    out = ["--format", "csv", "--out", str(tmp_path)]
    assert main(["bench", "--seeds", "5", "--policies", ",".join(chosen), *out]) == 0
    rows = read_rows(tmp_path / "rows.csv")
    by_policy = {name: [row for row in rows if row["policy"] == name] for name in chosen}
    lost = {
        name: 1 - sum(r["qoi"] for r in own) / sum(r["clairvoyant"] for r in own) for name, own in by_policy.items()
    }
    assert lost["drop-oldest"] > 0.08 and lost["afr"] > 0.03 and lost["min-motion-gap"] < lost["afr"] - 0.01
    flat = [all(row["regret"] < 1e-9 for row in met) for met in zip(*by_policy.values(), strict=True)]
    assert sum(flat) < 0.03 * len(flat)


def test_the_score_needs_no_row_of_the_baseline(trace: str, capsys: pytest.CaptureFixture[str]) -> None:
    stream = ["--seconds", "6", "--fps", "10", "--bytes", "200000", "--seeds", "3", "--capacity", "2"]
    assert main(["bench", "--trace", trace, *stream, "--policies", "clairvoyant"]) == 0
    head, line = (text.split() for text in capsys.readouterr().out.splitlines()[6:8])
    assert head[2] == "score" and line[:3] == ["clairvoyant", "2", "1.000"]


def test_bench_of_one_interruption_has_regret(capsys: pytest.CaptureFixture[str]) -> None:
    law = ["--law", "fixed", "--t-max", "5", "--value", "saturating:2"]
    assert main(["bench", "--interruption", *law, "--capacity", "1,2", "--seeds", "1", "--policies", "afr"]) == 0
    text = capsys.readouterr().out
    assert "regret" in text and "T = 5" in text


def test_bench_runs_a_users_policy_file(trace: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = tmp_path / "mine.py"
    mine.write_text(
        "from bufgym.policies import ACCEPT, register\n"
        "@register('my-own', memory={'seen': 0}, parameters={'step': 1})\n"
        "def my_own(buffer, arrival, memory):\n"
        "    'Mine.'\n"
        "    memory[0] += buffer.parameters[0]\n"
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
        (["--seconds", "1e9"], "duration_s = 1000000000.0: must be at most"),
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


def test_an_output_folder_that_cannot_be_made(trace: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "taken").touch()
    fails(["bench", "--trace", trace, *QUICK, "--out", str(tmp_path / "taken")], "taken: File exists", capsys)
    fails(["bench", "--trace", trace, *QUICK, "--out", "rows.csv"], "rows.csv: without --suite it must be", capsys)


@pytest.mark.slow
def test_regret_that_rests_on_an_upper_bound_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--trace", "lte-synthetic-0", "--size-cv", "1", "--bytes", "900000", "--seconds", "5", "--capacity", "3"]
    assert main(["bench", *words, "--seeds", "1", "--policies", "clairvoyant,afr,rosbridge"]) == 0
    lines = capsys.readouterr().out.splitlines()
    table = [line.split()[0] for line in lines if line.startswith(("clairvoyant", "afr", "rosbridge"))]
    assert table[0] == "afr" and set(table[1:]) == {"clairvoyant", "rosbridge"}  # those that do not compete come last
    assert any("regret, at most" in line for line in lines)
    assert "note: clairvoyant does not compete: it knows the future" in lines
    assert any(line.startswith("note: regret rests on an upper bound") for line in lines)


def test_the_oracle_is_a_name_where_there_is_one_interruption(trace: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--capacity", "3", "--seeds", "2", "--policies", "oracle,afr,clairvoyant"]
    assert main(["bench", "--interruption", "--t-max", "30", *words]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "note: oracle does not compete: it knows the future" in lines
    told = {line.split()[0]: line.split()[1:] for line in lines if line.startswith(("oracle", "clairvoyant", "afr"))}
    assert told["oracle"][1:3] == told["clairvoyant"][1:3] != told["afr"][1:3]  # QoI and regret
    fails(["bench", "--trace", trace, *QUICK, "--policies", "oracle"], "policy oracle: it plans for one", capsys)


def test_the_clairvoyant_plans_for_a_sender_that_is_always_asked(
    trace: str, capsys: pytest.CaptureFixture[str]
) -> None:
    overflow = ["bench", "--trace", trace, *QUICK, "--decide-at", "overflow"]
    assert main([*overflow, "--policies", "clairvoyant,afr"]) == 2
    assert "policy clairvoyant: it plans for a sender that asks at every arrival" in capsys.readouterr().err
    assert main(overflow) == 0
    assert "\nclairvoyant " not in capsys.readouterr().out


def test_a_suites_run_is_never_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "manifest.json").write_text("{}", encoding="utf-8")
    assert main(["bench", "--policies", "afr", "--seeds", "1", "--seconds", "1", "--out", str(tmp_path)]) == 2
    assert "holds the run of a suite" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["manifest.json"]


def test_a_python_file_is_no_policy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fails(["bench", "--policies", "mine.py"], "--policy-file mine.py registers its policies", capsys)


def test_cells_without_a_score_say_why(capsys: pytest.CaptureFixture[str]) -> None:
    chosen = ["--policies", "afr,drop-oldest", "--capacity", "8", "--seeds", "1", "--jobs", "1"]
    assert main(["bench", "--suite", "interruption-v1", *chosen]) == 0
    assert "Nothing is scored here: on these episodes Drop Oldest's regret is under 1 %" in capsys.readouterr().out
