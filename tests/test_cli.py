"""Each command as a user types it, and each mistake that ends in one line and exit code 2."""

import csv
import errno
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from cli_cases import Capsys, Patch, fails, shown
from needs import needs
from PIL import Image
from refusal_cases import refuse

from bufgym import __version__, compare, policies, scenario, traces
from bufgym.benchmark.rows import read_rows
from bufgym.benchmark.run import run
from bufgym.cli import main
from bufgym.cli.listing import LISTS
from bufgym.jit import JIT
from bufgym.model import observe
from bufgym.traces.shipped import shipped_calls


@pytest.fixture
def trace(tmp_path: Path) -> str:
    path = tmp_path / "link.csv"
    path.write_text("t_ms,bytes,interval_ms\n1000,500000,1000\n2000,0,1000\n3000,900000,1000\n")
    return str(path)


def test_list_names_everything_there_is(capsys: Capsys) -> None:
    text = shown(["list"], capsys)
    names = [*policies.names(), *traces.shipped(), *LISTS, *shipped_calls().values()]
    names += ["bufgym/Uplink-v1", "lte", "retained", "service_ratio", "every=3"]
    tables = (observe.CANDIDATE_FIELDS, observe.QUEUE_FIELDS, observe.FIELDS, observe.TOPIC_FIELDS)
    names += [field.name for fields in (*tables, observe.ON_BOARD_FIELDS) for field in fields]
    assert not [name for name in names if name not in text]
    for kind in LISTS:
        head, *lines = shown(["list", kind], capsys).splitlines()
        assert head == kind and lines and all(line.startswith("  ") for line in lines)


def test_the_module_runs_as_a_command_and_opens_no_heavy_module() -> None:
    heavy = ("bufgym.envs", "matplotlib", "pyarrow", "tqdm", "mcap", "rosbags")
    held = f"[m for m in {heavy!r} if m in sys.modules]"
    program = f"import sys; from bufgym.cli import main; main(['list'])\nprint({held})"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    done = subprocess.run([sys.executable, "-m", "bufgym", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"bufgym {__version__}\n"


def test_ctrl_c_and_a_reader_that_left(monkeypatch: Patch, capsys: Capsys, tmp_path: Path) -> None:
    def interrupt(*_: Any, **__: Any) -> str:
        raise KeyboardInterrupt

    monkeypatch.setitem(LISTS, "policies", interrupt)
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


def test_play_writes_a_film(tmp_path: Path) -> None:
    """A picture for each decision, and one of the end; 5 a second."""
    film = tmp_path / "film.gif"
    assert main(["play", "--env", "Interruption-v1", "--steps", "3", "--out", str(film)]) == 0
    with Image.open(film) as picture:
        assert (picture.n_frames, picture.size, picture.info["duration"]) == (3, (800, 400), 200)


def test_play_ends_where_bench_does(capsys: Capsys) -> None:
    words = "play --env Interruption-v1 --policies afr --speed 1000 --seed 3 --capacity 4 --steps 400"
    over = shown(words.split(), capsys).splitlines()[-1]
    (row,) = run([policies.get("afr")], scenario.get("interruption"), [4], [3])
    assert over == (
        f"over: QoI {row['qoi']:.3f}, {row['delivered']} of {row['arrived']} delivered, {row['dropped']} dropped"
    )


QUICK = ["--seconds", "1", "--fps", "10", "--seeds", "2", "--capacity", "2"]
"""A benchmark of a few messages."""


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


def test_traces_and_motions_with_commas_are_those_of_compare(tmp_path: Path) -> None:
    named = ["--trace", "lte-synthetic-1,20Mbit/s", "--motion", "drive-1,drive-0", "--policies", "afr"]
    assert main(["bench", *named, *QUICK, "--format", "csv", "--out", str(tmp_path / "out")]) == 0
    settings: dict[str, Any] = {"capacity": 2, "seeds": 2, "duration_s": 1.0, "rate_hz": 10.0}
    done = compare("afr", "lte", traces="lte-synthetic-1,20Mbit/s", motion="drive-1,drive-0", **settings)
    rows = read_rows(tmp_path / "out" / "rows.csv")
    assert [row["trace"] for row in rows] == ["lte-synthetic-1"] * 2 + ["20Mbit/s"] * 2
    assert [row["qoi"] for row in rows] == [row["qoi"] for row in done.rows]


def test_bench_against_a_policy(capsys: Capsys) -> None:
    """On a suite and elsewhere; the policy and AFR run too."""
    for where in (["--suite", "interruption-v1", "--jobs", "1"], ["--scenario", "interruption"]):
        chosen = ["--policies", "min-gap", "--against", "target-gap", "--capacity", "4", "--seeds", "3"]
        text = shown(["bench", *where, *chosen], capsys)
        assert "regret / afr's, minus target-gap's" in text and "afr " in text and "drop-oldest" in text


def test_bench_writes_parquet_where_it_can(trace: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyarrow", reason=needs("extras", "pyarrow"))
    command = ["bench", "--trace", trace, *QUICK, "--policies", "afr", "--out"]
    assert main([*command, str(tmp_path)]) == 0
    assert len(read_rows(tmp_path / "rows.parquet")) == 2
    monkeypatch.setitem(sys.modules, "pyarrow", None)  # importing it now fails
    assert main([*command, str(tmp_path / "other")]) == 0
    assert (tmp_path / "other" / "rows.csv").exists()
    assert main([*command, str(tmp_path / "third"), "--format", "parquet"]) == 2


def test_bench_takes_shipped_traces_and_all_policies_by_default(capsys: Capsys) -> None:
    text = shown(["bench", *QUICK, "--seeds", "1"], capsys)
    assert "8 traces x 1 seed" in text
    for name in policies.names():
        message = f"\n{name} " in text or re.search(rf"^note: .*\b{name}\b.*the same rows here", text, re.M)
        assert bool(message) != policies.get(name).for_topics


@pytest.mark.skipif(not JIT, reason=needs("compiled", "it plays whole benchmarks, which takes compiled code"))
def test_bench_meets_the_episodes_of_the_environment_by_default(tmp_path: Path) -> None:
    """Row (trace, seed) is what ``reset`` of bufgym/Uplink-v1 plays by these numbers; neither side has an argument."""
    assert main(["bench", "--seeds", "1", "--policies", "drop-oldest", "--format", "csv", "--out", str(tmp_path)]) == 0
    (row,) = (row for row in read_rows(tmp_path / "rows.csv") if row["trace"] == "lte-synthetic-3")
    env = gym.make("bufgym/Uplink-v1", bound=True, actions="slots").unwrapped
    _, info = env.reset(options={"trace": "lte-synthetic-3", "seed": 0})
    ended = False
    while not ended:
        action = 9 if info["action_mask"][9] else 0  # accept, else evict the oldest
        _, _, ended, _, info = env.step(action)
    assert info["qoi"] == row["qoi"] and info["regret"] == pytest.approx(row["regret"]) and info["score"] == 0


def test_an_output_folder_that_cannot_be_written(trace: str, tmp_path: Path, capsys: Capsys) -> None:
    (tmp_path / "taken").touch()
    fails(["bench", "--trace", trace, *QUICK, "--out", tmp_path / "taken"], "taken: File exists", capsys)
    (tmp_path / "manifest.json").write_text("{}", encoding="utf-8")
    fails(["bench", "--policies", "afr", *QUICK, "--out", tmp_path], "holds the run of a suite", capsys)
    assert {path.name for path in tmp_path.iterdir()} == {"manifest.json", "taken", "link.csv"}


def _disk_is_full(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # like a write, it names no file


def test_a_full_disk_is_named_by_the_file_and_leaves_no_folder(
    trace: str, tmp_path: Path, monkeypatch: Patch, capsys: Capsys
) -> None:
    """Of the folders ``new/results`` nothing stays; one that was there before does, and so do finished rows."""
    bench = ["bench", "--trace", trace, *QUICK, "--policies", "afr", "--format", "csv", "--out"]
    (tmp_path / "held").mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(csv.DictWriter, "writerows", _disk_is_full)
        for folder in ("new/results", "held"):
            file = tmp_path / folder / "rows.csv"
            fails([*bench, tmp_path / folder], f"{file}: No space left on device", capsys)
        assert main([*map(str, bench), str(tmp_path / "rows.csv")]) == 2  # the table was printed
        assert f"{tmp_path / 'rows.csv'}: No space left on device" in capsys.readouterr().err
    monkeypatch.setattr(Path, "write_text", _disk_is_full)
    suite = ["bench", "--suite", "interruption-v1", "--jobs", "1", "--policies", "afr", "--seeds", "1"]
    manifest = tmp_path / "suite" / "manifest.json"
    fails([*suite, "--out", tmp_path / "suite"], f"{manifest}: No space left on device", capsys)
    assert {path.name for path in tmp_path.iterdir()} == {"held", "link.csv"} and not any((tmp_path / "held").iterdir())
    fails([*bench, tmp_path / "half"], f"{tmp_path / 'half' / 'table.md'}: No space left on device", capsys)
    assert len(read_rows(tmp_path / "half" / "rows.csv")) == 2


def test_the_clairvoyant_plans_for_a_sender_that_is_always_asked(trace: str) -> None:
    overflow: dict[str, Any] = {"traces": trace, "duration_s": 1.0, "capacity": 2, "seeds": 2, "decide_at": "overflow"}
    message = "policy clairvoyant: it plans for a sender that asks at every arrival"
    refuse(message, compare, ["clairvoyant", "afr"], **overflow)
