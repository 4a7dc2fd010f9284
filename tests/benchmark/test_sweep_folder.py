"""A sweep's folder: nothing mixed, every mistake named, and what the command line makes of it."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from cli_cases import Capsys, Patch, fails, shown
from sweep_cases import TINY, contents, interrupt

from bufgym.benchmark import sweep
from bufgym.benchmark.rows import read_rows, write_rows
from bufgym.benchmark.sweep import Sweep
from bufgym.cli.options import load_policies
from bufgym.errors import BufgymError, install
from bufgym.scenario import Uplink, suites
from bufgym.traces import Trace

pytest.importorskip("joblib", reason="a sweep needs joblib")


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"specs": ("afr", "red")}, "policies"),
        ({"specs": ("random", "afr", "drop-oldest")}, "policies"),
        ({"capacities": (2, 5)}, "capacities"),
        ({"seeds": 4}, "seeds"),
        ({"split": "train"}, "split"),
        ({"suite": "lte-v1"}, "suite"),
    ],
)
def test_another_sweep_needs_another_folder(finished: Path, change: dict[str, Any], key: str) -> None:
    before = contents(finished)
    with pytest.raises(BufgymError, match=rf"manifest\.json: {key} is .*, but this run has .*choose another --out"):
        sweep.run_sweep(Sweep(**{**vars(TINY), **change}), finished, backend="sequential")
    assert contents(finished) == before


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of ``TINY``; nobody writes there."""
    folder = tmp_path_factory.mktemp("finished")
    sweep.run_sweep(TINY, folder, backend="sequential")
    return folder


def test_so_does_another_version_or_another_policy_file(
    tmp_path: Path, small: Sweep, mine: Path, monkeypatch: Patch
) -> None:
    load_policies(str(mine))
    plan = Sweep("small-v1", ("mine",), policy_file=str(mine))
    sweep.run_sweep(plan, tmp_path / "out", backend="sequential")
    before = contents(tmp_path / "out")
    text = mine.read_text()
    mine.write_text(text.replace("% 2", "% 3"))
    with pytest.raises(BufgymError, match="policy_file is"):
        sweep.run_sweep(plan, tmp_path / "out", backend="sequential")
    mine.write_text(text)
    monkeypatch.setattr(sweep, "__version__", "0.0.0")
    with pytest.raises(BufgymError, match=r'bufgym is ".*", but this run has "0\.0\.0"'):
        sweep.run_sweep(plan, tmp_path / "out", backend="sequential")
    assert contents(tmp_path / "out") == before


def test_so_do_other_recordings_of_the_same_names(tmp_path: Path, monkeypatch: Patch) -> None:
    def build(split: str, data: Path | None) -> dict[str, suites.Setting]:
        assert data is not None
        trace = Trace.steps([(1.0, float((data / "rate").read_text()))], name="link")
        return {"link": suites.Setting(Uplink(traces=(trace,), rate_hz=5, duration_s=2), "a link")}

    found = suites.Suite("found-v1", "found", build, (2,), 1, needs="rate")
    monkeypatch.setitem(suites.SUITES, "found-v1", found)
    for name, rate in (("a", "500000"), ("b", "600000"), ("c", "500000")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "rate").write_text(rate)
    first, other, same = (Sweep("found-v1", ("afr",), data=str(tmp_path / name)) for name in "abc")
    rows = sweep.run_sweep(first, tmp_path / "out", backend="sequential")
    with pytest.raises(BufgymError, match="scenarios is"):
        sweep.run_sweep(other, tmp_path / "out", backend="sequential")
    assert repr(sweep.run_sweep(same, tmp_path / "out", backend="sequential")) == repr(rows)


@pytest.mark.parametrize("name", ["rows.csv", "rows.parquet", "parts/one-0-0.csv"])
def test_rows_without_a_manifest_are_left_alone(tmp_path: Path, small: Sweep, name: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("someone else's")
    with pytest.raises(BufgymError, match=r"holds rows without a manifest\.json; choose another --out"):
        sweep.run_sweep(small, tmp_path, backend="sequential")
    assert list(contents(tmp_path)) == [name]


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_a_broken_part_is_named_and_made_anew_once_deleted(
    tmp_path: Path, small: Sweep, form: str, monkeypatch: Patch
) -> None:
    if form == "parquet":
        pytest.importorskip("pyarrow")
    out = tmp_path / "out"
    whole = sweep.run_sweep(small, tmp_path / "whole", backend="sequential", form=form)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(sweep, "_read", interrupt)  # all parts are there, but not yet their sum
        sweep.run_sweep(small, out, backend="sequential", form=form)
    part = out / "parts" / f"one-1-1000.{form}"
    rows, content = read_rows(part), part.read_bytes()
    without = [{name: row[name] for name in row if name != "qoi"} for row in rows]
    for harm in (content[: len(content) // 2], b"", b"\xff\x00" * 99, rows[:-1], without):
        part.write_bytes(harm) if isinstance(harm, bytes) else write_rows(harm, part)
        before = contents(out)
        with pytest.raises(BufgymError, match=rf"one-1-1000\.{form}.*; delete this file and run the command again"):
            sweep.run_sweep(small, out, backend="sequential", form=form)
        assert contents(out) == before
    part.unlink()
    assert repr(sweep.run_sweep(small, out, backend="sequential", form=form)) == repr(whole)
    assert (out / f"rows.{form}").read_bytes() == (tmp_path / "whole" / f"rows.{form}").read_bytes()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"suite": "small-v0"}, "unknown suite 'small-v0'"),
        ({"split": "exam"}, "split = 'exam'"),
        ({"specs": ("afr", "afr")}, "'afr' is given more than once"),
        ({"specs": ("afr", "nobody")}, "unknown policy 'nobody'"),
        ({"specs": ("decimate:every=2", "decimate:every=2.0")}, "'decimate:every=2' is given more than once"),
        ({"seeds": 0}, "seeds = 0: must lie between 1 and 1000"),
        ({"seeds": 1001}, "seeds = 1001"),
        ({"capacities": (0,)}, r"capacities = \[0\]"),
        ({"capacities": (2, 2)}, r"capacities = \[2, 2\]: .* no two alike"),
        ({"suite": "mahimahi-v1"}, r"needs a folder of recordings \(--data DIR\)"),
        ({"jobs": 0}, "jobs = 0:"),
        ({"jobs": -2}, "jobs = -2:"),
        ({"backend": "sloky"}, "backend = 'sloky': must be one of loky"),
    ],
)
def test_a_bad_sweep_ends_before_anything_is_written(
    tmp_path: Path, small: Sweep, change: dict[str, Any], told: str
) -> None:
    where = {name: change.pop(name) for name in ("jobs", "backend") if name in change}
    with pytest.raises(BufgymError, match=told):
        sweep.run_sweep(Sweep(**{**vars(small), **change}), tmp_path / "out", **where)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("backend", "module", "extra"),
    [("ray", "ray", "ray"), ("dask", "distributed", "dask"), ("loky", "joblib", "bench")],
)
def test_a_backend_that_is_not_installed_names_the_extra(
    tmp_path: Path, small: Sweep, backend: str, module: str, extra: str, monkeypatch: Patch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)  # importing it now fails
    with pytest.raises(BufgymError, match=re.escape(f"{module} is missing: {install(extra)}")):
        sweep.run_sweep(small, tmp_path, jobs=2, backend=backend)


QUEUE_ALONE = ("--trace link.csv", "--motion none", "--fps 10", "--seconds 5", "--max-bytes 1000", "--t-max 5")


@pytest.mark.parametrize("words", [*QUEUE_ALONE, "--value saturating:2", "--interruption", "--decide-at overflow"])
def test_a_suites_episodes_cannot_be_changed(words: str, capsys: Capsys) -> None:
    told = fails(["bench", "--suite", "lte-v1", *words.split()], "cannot go with --suite", capsys)
    assert words.split()[0] in told


@pytest.mark.parametrize("words", ["--jobs 2", "--split train", "--data .", "--backend dask", "--address host:1"])
def test_options_of_a_suite_need_one(words: str, capsys: Capsys) -> None:
    fails(["bench", *words.split()], f"{words.split()[0]} needs --suite", capsys)


def test_the_command_line_prints_scores_and_the_report_reads_them(tmp_path: Path, small: Sweep, capsys: Capsys) -> None:
    pytest.importorskip("jinja2")
    pytest.importorskip("plotly")
    out = tmp_path / "a folder"
    words = ["bench", "--suite", "small-v1", "--policies", "afr,random", "--backend", "sequential", "--out", out]
    said = shown(words, capsys)
    assert "afr" in said and "drop-oldest" in said and f"48 rows in {out}; bufgym report" in said
    command = json.loads((out / "manifest.json").read_text())["command"]
    assert command == f"bufgym bench --suite small-v1 --policies afr,random --out '{out}'"
    tables = shown(["report", out, "--markdown"], capsys)
    assert command in tables and "| drop-oldest |" in tables
    page = Path(shown(["report", out], capsys).strip().removeprefix("wrote ")).read_text()
    assert page.startswith("<!") and "drop-oldest" in page and "small-v1" in page


def test_without_a_folder_nothing_is_left_behind(
    tmp_path: Path, small: Sweep, monkeypatch: Patch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    words = "bench --suite small-v1 --policies afr --backend sequential"
    assert "drop-oldest" in shown(words.split(), capsys) and not list(tmp_path.iterdir())
