"""A sweep's folder: nothing mixed, every mistake named, and what the command line makes of it."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sweep_cases import TINY, contents, fails, interrupt

from bufgym.benchmark import sweep
from bufgym.benchmark.rows import read_rows, write_rows
from bufgym.benchmark.sweep import Sweep
from bufgym.cli import main
from bufgym.cli.options import load_policies
from bufgym.errors import BufgymError, install
from bufgym.scenario import Uplink, suites
from bufgym.traces import Trace

pytest.importorskip("joblib", reason="a sweep needs joblib")


# -------------------- never mixed


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
def test_another_sweep_needs_another_folder(tmp_path: Path, change: dict[str, Any], key: str) -> None:
    sweep.run_sweep(TINY, tmp_path, backend="sequential")
    before = contents(tmp_path)
    with pytest.raises(BufgymError, match=rf"manifest\.json: {key} is .*, but this run has .*choose another --out"):
        sweep.run_sweep(Sweep(**{**vars(TINY), **change}), tmp_path, backend="sequential")
    assert contents(tmp_path) == before


def test_so_does_another_version_or_another_policy_file(
    tmp_path: Path, small: Sweep, mine: Path, monkeypatch: pytest.MonkeyPatch
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


def test_so_do_other_recordings_of_the_same_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda text: text[: len(text) // 2], "must be JSON"),
        (lambda text: "[]", "must be a JSON object"),
        (lambda text: text.replace('"format": 2', '"format": 99'), "format = 99: must be 2"),
        (lambda text: text.replace('"suite"', '"sweet"'), "no suite"),
        (lambda text: text.replace('"seeds": 2', '"seeds": Infinity'), "Infinity: numbers must be finite"),
    ],
)
def test_a_broken_manifest_is_named(tmp_path: Path, small: Sweep, change: Callable[[str], str], told: str) -> None:
    sweep.run_sweep(small, tmp_path, backend="sequential")
    file = tmp_path / "manifest.json"
    text = file.read_text()
    file.write_text(change(text))
    assert file.read_text() != text
    before = contents(tmp_path)
    with pytest.raises(BufgymError, match=rf"manifest\.json.*{told}"):
        sweep.run_sweep(small, tmp_path, backend="sequential")
    assert contents(tmp_path) == before


@pytest.mark.parametrize("form", ["csv", "parquet"])
@pytest.mark.parametrize("harm", ["cut", "empty", "fewer", "columns", "noise"])
def test_a_broken_part_is_named_and_made_anew_once_deleted(
    tmp_path: Path, small: Sweep, form: str, harm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if form == "parquet":
        pytest.importorskip("pyarrow")
    whole = sweep.run_sweep(small, tmp_path / "whole", backend="sequential", form=form)
    out = tmp_path / "out"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(sweep, "_read", interrupt)  # all parts are there, but not yet their sum
        sweep.run_sweep(small, out, backend="sequential", form=form)
    part = out / "parts" / f"one-1-1000.{form}"
    rows, content = read_rows(part), part.read_bytes()
    if harm == "fewer":
        write_rows(rows[:-1], part)
    elif harm == "columns":
        write_rows([{name: row[name] for name in row if name != "qoi"} for row in rows], part)
    else:
        part.write_bytes({"cut": content[: len(content) // 2], "empty": b"", "noise": b"\xff\x00" * 99}[harm])
    before = contents(out)
    with pytest.raises(BufgymError, match=rf"one-1-1000\.{form}.*; delete this file and run the command again"):
        sweep.run_sweep(small, out, backend="sequential", form=form)
    assert contents(out) == before
    part.unlink()
    assert repr(sweep.run_sweep(small, out, backend="sequential", form=form)) == repr(whole)
    assert (out / f"rows.{form}").read_bytes() == (tmp_path / "whole" / f"rows.{form}").read_bytes()


# -------------------- mistakes


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
    ],
)
def test_a_bad_sweep_ends_before_anything_is_written(
    tmp_path: Path, small: Sweep, change: dict[str, Any], told: str
) -> None:
    with pytest.raises(BufgymError, match=told):
        sweep.run_sweep(Sweep(**{**vars(small), **change}), tmp_path / "out", backend="sequential")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("jobs", "backend"), [(0, "loky"), (-2, "loky"), (1, "sloky")])
def test_so_do_a_bad_backend_and_number_of_jobs(tmp_path: Path, small: Sweep, jobs: int, backend: str) -> None:
    with pytest.raises(BufgymError, match="backend = 'sloky': must be one of loky" if jobs == 1 else f"jobs = {jobs}:"):
        sweep.run_sweep(small, tmp_path / "out", jobs=jobs, backend=backend)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("backend", "module", "extra"),
    [("ray", "ray", "ray"), ("dask", "distributed", "dask"), ("loky", "joblib", "bench")],
)
def test_a_backend_that_is_not_installed_names_the_extra(
    tmp_path: Path, small: Sweep, backend: str, module: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)  # importing it now fails
    with pytest.raises(BufgymError, match=re.escape(f"{module} is missing: {install(extra)}")):
        sweep.run_sweep(small, tmp_path, jobs=2, backend=backend)


@pytest.mark.parametrize(
    "words",
    [
        ["--trace", "link.csv"],
        ["--motion", "none"],
        ["--fps", 10],
        ["--seconds", 5],
        ["--max-bytes", 1000],
        ["--value", "saturating:2"],
        ["--t-max", 5],
        ["--interruption"],
        ["--decide-at", "overflow"],
    ],
)
def test_a_suites_episodes_cannot_be_changed(words: list[object], capsys: pytest.CaptureFixture[str]) -> None:
    fails(["bench", "--suite", "lte-v1", *words], "cannot go with --suite", capsys)
    assert main(["bench", "--suite", "lte-v1", *map(str, words)]) == 2
    assert str(words[0]) in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [["--jobs", 2], ["--split", "train"], ["--data", "."], ["--backend", "dask"], ["--address", "host:1"]]
)
def test_options_of_a_suite_need_one(words: list[object], capsys: pytest.CaptureFixture[str]) -> None:
    fails(["bench", *words], f"{words[0]} needs --suite", capsys)


# -------------------- what the command line makes of it


def test_the_command_line_prints_scores_and_the_report_reads_them(
    tmp_path: Path, small: Sweep, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("jinja2")
    pytest.importorskip("plotly")
    out = tmp_path / "a folder"
    words = ["bench", "--suite", "small-v1", "--policies", "afr,random", "--backend", "sequential", "--out", str(out)]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "afr" in said and "drop-oldest" in said and f"48 rows in {out}; bufgym report" in said
    command = json.loads((out / "manifest.json").read_text())["command"]
    assert command == f"bufgym bench --suite small-v1 --policies afr,random --out '{out}'"
    assert main(["report", str(out), "--markdown"]) == 0
    tables = capsys.readouterr().out
    assert command in tables and "| drop-oldest |" in tables
    assert main(["report", str(out)]) == 0
    page = Path(capsys.readouterr().out.strip().removeprefix("wrote ")).read_text()
    assert page.startswith("<!") and "drop-oldest" in page and "small-v1" in page


def test_without_a_folder_nothing_is_left_behind(
    tmp_path: Path, small: Sweep, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["bench", "--suite", "small-v1", "--policies", "afr", "--backend", "sequential"]) == 0
    assert "drop-oldest" in capsys.readouterr().out and not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", ["csv", "parquet"])
@pytest.mark.parametrize("harm", ["cut", "noise", "empty"])
def test_a_report_of_broken_rows_names_the_file(
    tmp_path: Path, small: Sweep, form: str, harm: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if form == "parquet":
        pytest.importorskip("pyarrow")
    sweep.run_sweep(small, tmp_path, backend="sequential", form=form)
    path = tmp_path / f"rows.{form}"
    content = path.read_bytes()
    path.write_bytes({"cut": content[: len(content) // 2], "noise": b"\xff\x00" * 99, "empty": b""}[harm])
    fails(["report", tmp_path, "--markdown"], str(path), capsys)
    fails(["report", tmp_path], str(path), capsys)
