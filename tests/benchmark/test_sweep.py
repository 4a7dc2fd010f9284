"""A suite's benchmark: the same rows wherever it runs, and nothing lost by a kill."""

from __future__ import annotations

import importlib.util
import subprocess
import threading
from pathlib import Path
from typing import Any

import pytest
from cli_cases import Patch
from sweep_cases import THREE, TINY, bufgym, contents, interrupt

from bufgym import policies
from bufgym.benchmark import run, sweep
from bufgym.benchmark.rows import read_rows
from bufgym.benchmark.sweep import Sweep
from bufgym.cli.options import load_policies
from bufgym.scenario import suites

pytest.importorskip("joblib", reason="a sweep needs joblib")

WORDS = ["bench", "--suite", "interruption-v1", "--policies", ",".join(THREE), "--capacity", "2,4", "--seeds", "3"]
"""The same as ``TINY``, typed."""


def finished(*words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    process = bufgym(*words, **environment)
    out, err = process.communicate()
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def rows_in(out: Path, form: str = "csv") -> str:
    """All rows to the last bit: repr shows every one, and tells NaN from None."""
    return repr(read_rows(out / f"rows.{form}"))


@pytest.fixture(scope="module")
def expected() -> str:
    """The rows of ``TINY``, straight from the experiment."""
    chosen = [policies.get(name) for name in THREE]
    rows = []
    for label, setting in suites.get("interruption-v1").settings("test").items():
        rows += run.run(chosen, setting.scenario, [2, 4], 3, label=label)
    return repr(rows)


@pytest.mark.parametrize("backend", ["sequential", "threading", "loky"])
def test_the_rows_are_those_of_the_experiment(tmp_path: Path, backend: str, expected: str) -> None:
    rows = sweep.run_sweep(TINY, tmp_path, jobs=2, backend=backend, form="csv")
    assert repr(rows) == rows_in(tmp_path) == expected
    assert sorted(path.name for path in tmp_path.iterdir()) == ["manifest.json", "rows.csv", "timeline.json"]


@pytest.mark.nightly
@pytest.mark.parametrize("backend", ["loky", "dask", "ray"])
def test_so_are_they_from_other_processes_which_know_a_users_policy(
    tmp_path: Path, backend: str, mine: Path, expected: str
) -> None:
    """Dask and Ray: a cluster of this machine's own."""
    needed = {"loky": "joblib", "dask": "distributed", "ray": "ray"}[backend]
    if importlib.util.find_spec(needed) is None:
        pytest.skip(f"{needed} is not installed")
    words = [word if word != ",".join(THREE) else ",".join(["mine", *THREE]) for word in WORDS]
    words += ["--policy-file", str(mine), "--backend", backend, "--jobs", "2", "--format", "csv"]
    out = tmp_path / "out"
    done = finished(*words, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "mine" in done.stdout and f"72 rows in {out}" in done.stdout
    rows = read_rows(out / "rows.csv")
    assert repr([row for row in rows if row["policy"] != "mine"]) == expected
    load_policies(str(mine))
    settings = suites.get("interruption-v1").settings("test").items()
    own = [row for label, s in settings for row in run.run([policies.get("mine")], s.scenario, [2, 4], 3, label=label)]
    assert repr([row for row in rows if row["policy"] == "mine"]) == repr(own)


def test_each_trace_has_seeds_of_its_own(tmp_path: Path, small: Sweep) -> None:
    """2 labels x 2 traces x 2 capacities x 3 policies x 2 seeds; the second trace's seeds count from 1000."""
    rows = sweep.run_sweep(small, tmp_path, backend="sequential")
    chosen = [policies.get(name) for name in THREE]
    wanted = []
    for label, setting in suites.get("small-v1").settings("test").items():
        for k, (_, part) in enumerate(run.by_trace(setting.scenario)):
            wanted += run.run(chosen, part, [2, 3], [1000 * k, 1000 * k + 1], label=label)
    assert repr(rows) == repr(wanted) and len(rows) == 2 * 2 * 2 * 3 * 2


def test_many_seeds_are_several_shards_and_the_same_rows(tmp_path: Path, small: Sweep, monkeypatch: Patch) -> None:
    plan = Sweep(small.suite, small.specs, seeds=5)
    whole = sweep.run_sweep(plan, tmp_path / "whole", backend="sequential")
    monkeypatch.setattr(sweep, "_SEEDS_PER_SHARD", 2)
    assert [len(shard.seeds) for shard in plan.checked().shards()] == [2, 2, 1] * 4
    assert len({shard.name for shard in plan.checked().shards()}) == 12
    parted = sweep.run_sweep(plan, tmp_path / "parted", backend="sequential")
    assert sorted(map(repr, parted)) == sorted(map(repr, whole))


def test_the_baseline_is_always_there_and_the_suite_fills_what_is_open(small: Sweep) -> None:
    plan = Sweep("small-v1", ("afr",)).checked()
    assert (plan.specs, plan.capacities, plan.seeds) == (("afr", "drop-oldest"), (2, 3), 2)
    assert Sweep("small-v1", ("drop-oldest", "afr")).checked().specs == ("drop-oldest", "afr")
    assert plan.checked() == plan


def test_a_second_call_runs_nothing(tmp_path: Path, small: Sweep, monkeypatch: Patch) -> None:
    rows = sweep.run_sweep(small, tmp_path, backend="sequential", form="csv")
    before = contents(tmp_path)
    monkeypatch.setattr(sweep, "run_shard", None)
    # Without a word about the format, what is there counts.
    assert repr(sweep.run_sweep(small, tmp_path, backend="sequential")) == repr(rows)
    assert contents(tmp_path) == before


def test_parts_alone_say_the_format_too(tmp_path: Path, small: Sweep, monkeypatch: Patch) -> None:
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(sweep, "_read", interrupt)
        sweep.run_sweep(small, tmp_path, backend="sequential", form="csv")
    (tmp_path / "parts" / ".one-0-0.csv.abcdefgh").touch()  # what a kill in the middle of a write leaves
    monkeypatch.setattr(sweep, "run_shard", None)
    sweep.run_sweep(small, tmp_path, backend="sequential")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["manifest.json", "rows.csv", "timeline.json"]


def test_what_is_missing_of_a_finished_folder_is_made_anew(tmp_path: Path, small: Sweep) -> None:
    sweep.run_sweep(small, tmp_path, backend="sequential", form="csv")
    before = {name: content for name, (content, _) in contents(tmp_path).items()}
    for name in ("timeline.json", "rows.csv"):
        (tmp_path / name).unlink()
        sweep.run_sweep(small, tmp_path, backend="sequential", form="csv")
        assert {name: content for name, (content, _) in contents(tmp_path).items()} == before


@pytest.mark.parametrize("backend", ["sequential", "threading"])
def test_an_error_in_one_shard_loses_no_finished_rows(
    tmp_path: Path, small: Sweep, backend: str, monkeypatch: Patch
) -> None:
    """The second shard fails while the first one runs, which is finished and kept; no shard is begun afterwards."""
    right, begun, failed = sweep.run_shard, [], threading.Event()

    def fails(shard: sweep.Shard, load: Any = None) -> Any:
        begun.append(shard.name)
        if shard.name == "one-1-1000":
            failed.set()
            raise MemoryError("no room")
        if backend == "threading":
            assert failed.wait(60)
        return right(shard)

    monkeypatch.setattr(sweep, "run_shard", fails)
    with pytest.raises(MemoryError, match="no room"):
        sweep.run_sweep(small, tmp_path, jobs=2, backend=backend, form="csv")
    kept = contents(tmp_path / "parts")
    written = {Path(name).stem for name in kept}
    assert "one-0-0" in written and written == set(begun) - {"one-1-1000"}

    begun.clear()
    monkeypatch.setattr(sweep, "run_shard", lambda shard, load=None: begun.append(shard.name) or right(shard))
    rows = sweep.run_sweep(small, tmp_path, jobs=2, backend="sequential", form="csv")
    assert len(begun) == 4 - len(kept) and not set(begun) & written
    assert repr(rows) == repr(sweep.run_sweep(small, tmp_path / "whole", backend="sequential", form="csv"))


@pytest.mark.nightly
def test_a_mistake_in_a_users_policy_is_shown_where_it_is_even_from_other_processes(tmp_path: Path, mine: Path) -> None:
    words = ["--policies", "mine", "--policy-file", mine, "--capacity", "2,5", "--seeds", "1", "--jobs", "2"]
    failed = finished("bench", "--suite", "interruption-v1", *words, "--out", tmp_path, TEST_FAIL="1")
    assert failed.returncode == 2 and failed.stderr.count("\n") == 1
    assert f"{mine}, line 8: ArithmeticError: on purpose" in failed.stderr
