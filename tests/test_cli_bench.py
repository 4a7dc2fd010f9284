"""``bufgym bench`` as a user types it, and each mistake that ends in one line and exit code 2."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from cli_cases import Capsys, fails, shown

from bufgym import policies
from bufgym.benchmark.rows import read_rows
from bufgym.cli import main, split_policies
from bufgym.kernel import JIT
from bufgym.policies import registry

QUICK = ["--seconds", "1", "--fps", "10", "--seeds", "2", "--capacity", "2"]
"""A benchmark of a few messages."""


@pytest.fixture
def trace(tmp_path: Path) -> str:
    path = tmp_path / "link.csv"
    path.write_text("t_ms,bytes,interval_ms\n1000,500000,1000\n2000,0,1000\n3000,900000,1000\n")
    return str(path)


@pytest.fixture(autouse=True)
def own_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a policy file registers ends with its test."""
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))


def test_bench_writes_rows_and_a_table(trace: str, tmp_path: Path, capsys: Capsys) -> None:
    out = tmp_path / "new" / "results"
    chosen = ["--policies", "afr,decimate:every=2,random", "--format", "csv", "--out", out]
    text = shown(["bench", "--trace", trace, "--motion", "none", *QUICK, *chosen], capsys)
    assert "over link" in text and "decimate:every=2" in text and "V = exponential:0.618" in text
    rows = read_rows(out / "rows.csv")
    assert [row["policy"] for row in rows] == ["afr"] * 2 + ["decimate:every=2"] * 2 + ["random"] * 2
    assert {row["trace"] for row in rows} == {"link"} and {row["arrived"] for row in rows} == {10}
    assert "| decimate:every=2 | 2 |" in (out / "table.md").read_text()
    assert sorted(path.name for path in out.iterdir()) == ["rows.csv", "table.md"]


def test_bench_writes_parquet_where_it_can(trace: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyarrow")
    command = ["bench", "--trace", trace, *QUICK, "--policies", "afr", "--out", str(tmp_path)]
    assert main(command) == 0
    assert len(read_rows(tmp_path / "rows.parquet")) == 2
    monkeypatch.setitem(sys.modules, "pyarrow", None)  # importing it now fails
    assert main(command) == 0
    assert (tmp_path / "rows.csv").exists()
    assert main([*command, "--format", "parquet"]) == 2


def test_bench_takes_shipped_traces_and_all_policies_by_default(capsys: Capsys) -> None:
    text = shown(["bench", *QUICK, "--seeds", "1"], capsys)
    assert "8 traces x 1 seed" in text
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


@pytest.mark.nightly
@pytest.mark.skipif(not JIT, reason="it plays whole benchmarks, which takes compiled code")
def test_the_default_task_is_worth_learning(capsys: Capsys, tmp_path: Path) -> None:
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


def test_the_score_needs_no_row_of_the_baseline(trace: str, capsys: Capsys) -> None:
    stream = "--seconds 6 --fps 10 --bytes 200000 --seeds 3 --capacity 2 --policies clairvoyant"
    head, line = (row.split() for row in shown(["bench", "--trace", trace, *stream.split()], capsys).splitlines()[6:8])
    assert head[2] == "score" and line[:3] == ["clairvoyant", "2", "1.000"]


def test_bench_of_one_interruption_has_regret(capsys: Capsys) -> None:
    words = "bench --interruption --law fixed --t-max 5 --value saturating:2 --capacity 1,2 --seeds 1 --policies afr"
    text = shown(words.split(), capsys)
    assert "regret" in text and "T = 5" in text


def test_bench_runs_a_users_policy_file(trace: str, tmp_path: Path, capsys: Capsys) -> None:
    mine = tmp_path / "mine.py"
    mine.write_text(
        "from bufgym.policies import ACCEPT, register\n"
        "@register('my-own', memory={'seen': 0}, parameters={'step': 1})\n"
        "def my_own(buffer, arrival, memory):\n"
        "    'Mine.'\n"
        "    memory[0] += buffer.parameters[0]\n"
        "    return ACCEPT if len(buffer.slots) < buffer.capacity else int(memory[0]) % buffer.capacity\n"
    )
    chosen = ["--policies", "my-own,my-own:step=2,afr", "--policy-file", mine]
    assert "my-own:step=2" in shown(["bench", "--trace", trace, *QUICK, *chosen], capsys)
    assert "a policy file" in shown(["list", "policies", "--policy-file", mine], capsys)


BOOM = """
from bufgym.policies import register
@register('boom'{})
def boom(buffer, arrival, memory):
    return {}
"""


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("def broken(:\n", "line 1"),
        ("import a_module_that_is_not_there\n", "line 1: ModuleNotFoundError"),
        (BOOM.format("", "1 // 0"), "line 5: ZeroDivisionError"),
        (BOOM.format(", compile=True", "buffer.nothing"), "compile" if JIT else "line 5: AttributeError"),
    ],
)
def test_a_users_mistake_is_shown_where_it_is(trace: str, tmp_path: Path, text: str, line: str, capsys: Capsys) -> None:
    mine = tmp_path / "mine.py"
    mine.write_text(text)
    only = ["--policies", "boom"] if "boom" in text else []
    fails(["bench", "--trace", trace, *QUICK, "--policy-file", mine, *only], line, capsys)


def test_a_setting_belongs_to_the_policy_before_it() -> None:
    for specs in (["afr"], ["afr", "random"], ["p:a=1,b=2", "decimate:every=2", "afr"]):
        assert split_policies(",".join(specs)) == specs


@pytest.mark.parametrize(
    ("options", "naming"),
    [
        ("--policies decimate:every=0", "every = 0"),
        ("--policies decimate:pace=2", "'pace'"),
        ("--policies afr,afr", "'afr'"),
        ("--policies mine.py", "--policy-file mine.py registers its policies"),
        ("--capacity 0", "0: must be"),
        ("--capacity 5,5", "5 is given more than once"),
        ("--capacity 99999999", "99999999"),
        ("--fps nan", "nan: must be"),
        ("--bytes 1.5", "1.5"),
        ("--seconds 1e9", "duration_s = 1000000000.0: must be at most"),
        ("--jitter 2", "jitter = 2"),
        ("--value exponential:1.5", "1.5"),
        ("--decide-at never", "'never'"),
        ("--trace no-such.csv", "no-such.csv"),
        ("--motion no-such.txt", "no-such.txt"),
        ("--policy-file no-such.py", "no-such.py"),
        ("--t-max 5", "--t-max needs --interruption"),
        ("--interruption --trace x.csv", "--trace cannot go with --interruption"),
        ("--interruption --law gauss", "'gauss'"),
        ("--interruption --t-min 9 --t-max 5", "t_min = 9"),
        ("--out rows.csv", "rows.csv: without --suite it must be"),
        ("--nonsense", "--nonsense"),
    ],
)
def test_bad_options_of_bench(options: str, naming: str, capsys: Capsys) -> None:
    fails(["bench", *options.split()], naming, capsys)


def test_an_output_folder_that_cannot_be_written(trace: str, tmp_path: Path, capsys: Capsys) -> None:
    (tmp_path / "taken").touch()
    fails(["bench", "--trace", trace, *QUICK, "--out", tmp_path / "taken"], "taken: File exists", capsys)
    (tmp_path / "manifest.json").write_text("{}", encoding="utf-8")
    fails(["bench", "--policies", "afr", *QUICK, "--out", tmp_path], "holds the run of a suite", capsys)
    assert {path.name for path in tmp_path.iterdir()} == {"manifest.json", "taken", "link.csv"}


def test_the_oracle_is_a_name_where_there_is_one_interruption(trace: str, capsys: Capsys) -> None:
    words = "--interruption --t-max 30 --capacity 3 --seeds 2 --policies oracle,afr,clairvoyant"
    lines = shown(["bench", *words.split()], capsys).splitlines()
    assert "note: oracle does not compete: it knows the future" in lines
    told = {line.split()[0]: line.split()[1:] for line in lines if line.startswith(("oracle", "clairvoyant", "afr"))}
    assert told["oracle"][1:3] == told["clairvoyant"][1:3] != told["afr"][1:3]  # QoI and regret
    fails(["bench", "--trace", trace, *QUICK, "--policies", "oracle"], "policy oracle: it plans for one", capsys)


def test_the_clairvoyant_plans_for_a_sender_that_is_always_asked(trace: str, capsys: Capsys) -> None:
    overflow = ["bench", "--trace", trace, *QUICK, "--decide-at", "overflow"]
    told = "policy clairvoyant: it plans for a sender that asks at every arrival"
    fails([*overflow, "--policies", "clairvoyant,afr"], told, capsys)
    assert "\nclairvoyant " not in shown(overflow, capsys)


def test_cells_without_a_score_say_why(capsys: Capsys) -> None:
    words = "bench --suite interruption-v1 --policies afr,drop-oldest --capacity 8 --seeds 1 --backend sequential"
    why = "Nothing is scored here: on these episodes Drop Oldest's regret is under 1 %"
    assert why in shown(words.split(), capsys)
