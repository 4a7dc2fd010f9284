"""``bufgym topics`` as a user types it, and each mistake that ends in one line and exit code 2."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from cli_cases import FAR_OFF, Capsys, Patch, fails, shown

from bufgym import policies
from bufgym.benchmark.rows import read_rows
from bufgym.benchmark.tasks.topics import ROWS
from bufgym.policies import registry

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
    words = (
        "--scale 0.01 --trace lte-synthetic-0 --seeds 2 --policies fifo,edf --capacity 2,4 --window 3 --by-topic edf"
    )
    text = shown(["topics", "--config", config, *words.split(), "--out", out], capsys)
    assert f"The client of {config}." in text
    assert "2 episodes of 2 s; n_T = 3, acks 40 ms after a message is transmitted, 1 consumer." in text
    assert "mine: 2 topics over lte-synthetic-0 x 0.01, L = 2\n" in text and "mean of these 2\n" in text
    assert "age, priority 20 (s)" in text
    assert "edf, topic by topic: means over episodes" in text and "\ncommands " in text
    assert f"24 rows in {out}" in text
    rows = read_rows(out, ROWS)
    # The baseline runs whether named or not.
    assert [row["policy"] for row in rows[:12:4]] == ["fifo", "edf", "robofleet"]
    assert {row["capacity"] for row in rows} == {2, 4} and {row["window"] for row in rows} == {3}


@pytest.mark.nightly
def test_the_suite_runs_by_default(capsys: Capsys) -> None:
    words = "topics --split validation --seeds 1 --policies robofleet --consumers 2"
    text = shown(words.split(), capsys)
    assert text.startswith("Suite topics-v1, validation: ")
    assert "18 episodes of 60 s; n_T = 1 and 5, " in text and "2 consumers" in text
    assert "Not the suite as it is: consumers = 2." in text
    assert all(f"\n{label}: Robofleet's example client" in text for label in ("scarce", "half", "ample"))
    lines = [line.split() for line in text.splitlines() if line.startswith("robofleet ")]
    assert len(lines) == 7 and all(line[2:5] == ["1.000", "[1.000,", "1.000]"] and line[5] == "0" for line in lines)


def test_all_policies_by_default_with_a_word_on_the_unbounded(config: str, capsys: Capsys) -> None:
    words = ["topics", "--config", config, "--trace", "lte-synthetic-0", "--seeds", "1", "--motion", "none"]
    text = shown(words, capsys)
    assert all(f"\n{name} " in text for name in [*policies.names(for_topics=True), "drop-oldest", "rosbridge"])
    assert "rosbridge has no rank: its queue is unbounded." in text


def test_decisions_that_cannot_be_carried_out_are_told(
    config: str, tmp_path: Path, capsys: Capsys, monkeypatch: Patch
) -> None:
    """Each of the 2 s x (10 + 2) messages/s is sent by such a decision, whatever its topic."""
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
    mine = tmp_path / "mine.py"
    mine.write_text(FAR_OFF.format(True))
    chosen = ["--seeds", "1", "--policies", "far-off", "--policy-file", mine]
    told = shown(["topics", "--config", config, "--trace", "lte-synthetic-0", *chosen], capsys)
    assert told.count("invalid") == 1 and "\nnote: far-off gave 24 invalid decisions\n" in told
    # Nor do the intervals of a single episode look as if they were known.
    assert "1 episode of 2 s" in told and "1.000 [–]" in told and "1.000 [1.000" not in told


@pytest.mark.parametrize(
    ("options", "naming"),
    [
        ("topics --window x", "'x'"),
        ("topics --consumers 0", "consumers = 0"),
        ("topics --suite fleet-v1", "suite fleet-v1 is not one of topics: bufgym bench --suite fleet-v1"),
        ("topics --policies clairvoyant", "policy clairvoyant: it plans with a queue of its own"),
        *((f"topics --{name} 2", f"--{name} needs --config") for name in ("trace", "motion", "scale")),
        ("topics --by-topic afr", "--by-topic afr: not among the policies that run"),
        ("topics --out rows.txt", "rows.txt: rows are written to .csv or .parquet files"),
        ("topics --out no-such-folder/rows.csv", "no-such-folder/rows.csv: no folder"),
        ("topics --config no-such.toml", "error: no-such.toml: no such file\n"),
        ("topics --config x.toml --suite topics-v1", "--suite cannot go with --config"),
        ("topics --config x.toml --split test", "--split cannot go with --config"),
        ("topics --config x.toml --jobs 2", "--jobs cannot go with --config"),
        ("topics --config x.toml --out folder", "folder: with --config rows are written to .csv or .parquet files"),
        ("fleet --policies clairvoyant", "it plans with a link of its own, which no robot in a cell has"),
        ("fleet --suite lte-v1", "suite lte-v1 is not one of fleet: bufgym bench --suite lte-v1"),
        ("fleet --robots 0", "must be a whole number >= 1"),
        ("fleet --robots 257", "robots = 257: must be a whole number from 1 to 256"),
    ],
)
def test_bad_options(options: str, naming: str, capsys: Capsys) -> None:
    fails(options.split(), naming, capsys)


def test_what_is_wrong_on_the_command_line_is_not_the_files_fault(
    config: str, capsys: Capsys, monkeypatch: Patch
) -> None:
    fails(["topics", "--config", config, "--trace", "lte-synthetic-0", "--window", 0], "error: window = 0", capsys)
    fails(["topics", "--config", config, "--trace", "none.csv"], "none.csv", capsys)
    Path(config).write_text(f"window = 0\n{CONFIG}")
    fails(["topics", "--config", config], "mine.toml: window = 0: n_T must be a whole number", capsys)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    fails(["topics", "--out", "rows.parquet"], "Parquet files need pyarrow", capsys)
