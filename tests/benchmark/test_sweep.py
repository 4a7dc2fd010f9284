"""A suite's benchmark: the same rows wherever it runs, nothing lost by a kill, nothing mixed, every mistake named."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from bufgym import policies
from bufgym.benchmark import run, sweep
from bufgym.benchmark.rows import read_rows, write_rows
from bufgym.benchmark.sweep import Sweep
from bufgym.cli import main
from bufgym.cli.options import load_policies
from bufgym.errors import BufgymError
from bufgym.scenario import Uplink, suites
from bufgym.traces import Trace

pytest.importorskip("joblib", reason="a sweep needs joblib")

THREE = ("afr", "random", "drop-oldest")
TINY = Sweep("interruption-v1", THREE, capacities=(2, 4), seeds=3)
WORDS = ["bench", "--suite", "interruption-v1", "--policies", ",".join(THREE), "--capacity", "2,4", "--seeds", "3"]
"""The same as ``TINY``, typed."""


def bufgym(*words: object, **environment: str) -> subprocess.Popen[str]:
    """The command in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "bufgym", *map(str, words)],
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def finished(*words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    process = bufgym(*words, **environment)
    out, err = process.communicate(timeout=100)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def rows_in(out: Path, form: str = "csv") -> str:
    """All rows to the last bit: repr shows every one, and tells NaN from None."""
    return repr(read_rows(out / f"rows.{form}"))


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Every file's content and time."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


@pytest.fixture(scope="module")
def expected() -> str:
    """The rows of ``TINY``, straight from the experiment."""
    chosen = [policies.get(name) for name in THREE]
    rows = []
    for label, setting in suites.get("interruption-v1").settings("test").items():
        rows += run.run(chosen, setting.scenario, [2, 4], 3, label=label)
    return repr(rows)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Sweep:
    """A suite of two traces, two labels and messages that one can count."""

    def build(split: str, data: Path | None) -> dict[str, suites.Setting]:
        traces = tuple(
            Trace.steps([(1.0, 500_000), (2.0, 0), (1.0, 300_000)], name=f"{split}-{k}").scaled(1 + k / 2)
            for k in range(2)
        )
        uplink = Uplink(traces=traces, rate_hz=5, duration_s=5, size_bytes=100_000)
        return {label: suites.Setting(uplink, f"{label} here", outage_s=2.0) for label in ("one", "two")}

    monkeypatch.setitem(suites.SUITES, "small-v1", suites.Suite("small-v1", "small", build, (2, 3), 2))
    return Sweep("small-v1", THREE)


@pytest.fixture
def mine(tmp_path: Path) -> Iterator[Path]:
    """A policy file: ``mine`` may sleep and may fail, as the environment says."""
    path = tmp_path / "mine.py"
    path.write_text(
        "import os, time\n"
        "from bufgym.policies import ACCEPT, REJECT, register\n"
        "@register('mine', memory={'seen': 0})\n"
        "def mine(buffer, arrival, memory):\n"
        "    'Every other one.'\n"
        "    if memory[0] == 0:\n"
        "        time.sleep(float(os.environ.get('TEST_SLEEP_S', 0)))\n"
        "    memory[0] += 1\n"
        "    if os.environ.get('TEST_FAIL') and len(buffer.slots) == 2:\n"
        "        raise ArithmeticError('on purpose')\n"
        "    return ACCEPT if memory[0] % 2 and len(buffer.slots) < buffer.capacity else REJECT\n"
    )
    yield path
    policies.registry._REGISTRY.pop("mine", None)


# -------------------- the same rows wherever it runs


@pytest.mark.parametrize("backend", ["sequential", "threading"])
def test_in_this_process_the_rows_are_those_of_the_experiment(tmp_path: Path, backend: str, expected: str) -> None:
    rows = sweep.run_sweep(TINY, tmp_path, jobs=2, backend=backend, form="csv")
    assert repr(rows) == rows_in(tmp_path) == expected
    assert sorted(path.name for path in tmp_path.iterdir()) == ["manifest.json", "rows.csv", "timeline.json"]


@pytest.mark.parametrize(
    "backend",
    ["loky", pytest.param("dask", marks=pytest.mark.slow), pytest.param("ray", marks=pytest.mark.slow)],
)
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
    assert len(rows) == 2 * 2 * 2 * 3 * 2
    assert {(row["trace"], row["seed"]) for row in rows} == {
        *((rows[0]["trace"], seed) for seed in (0, 1)),
        *((rows[-1]["trace"], seed) for seed in (1000, 1001)),
    }
    assert rows[0]["trace"] != rows[-1]["trace"]
    wanted = []
    for label, setting in suites.get("small-v1").settings("test").items():
        for k, (_, part) in enumerate(run.by_trace(setting.scenario)):
            chosen = [policies.get(name) for name in THREE]
            wanted += run.run(chosen, part, [2, 3], [1000 * k, 1000 * k + 1], label=label)
    assert repr(rows) == repr(wanted)


@pytest.mark.slow
def test_many_seeds_are_several_shards_and_the_same_rows(
    tmp_path: Path, small: Sweep, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = Sweep(small.suite, small.specs, seeds=5)
    whole = sweep.run_sweep(plan, tmp_path / "whole", backend="sequential")
    monkeypatch.setattr(sweep, "_SEEDS_PER_SHARD", 2)
    assert [len(shard.seeds) for shard in plan.checked().shards()] == [2, 2, 1] * 4
    assert len({shard.name for shard in plan.checked().shards()}) == 12

    def key(row: dict[str, Any]) -> tuple[Any, ...]:
        return (row["scenario"], row["trace"], row["seed"], row["capacity"], row["policy"])

    parted = sweep.run_sweep(plan, tmp_path / "parted", backend="sequential")
    assert repr(sorted(parted, key=key)) == repr(sorted(whole, key=key))


def test_the_baseline_is_always_there_and_the_suite_fills_what_is_open(small: Sweep) -> None:
    plan = Sweep("small-v1", ("afr",)).checked()
    assert (plan.specs, plan.capacities, plan.seeds) == (("afr", "drop-oldest"), (2, 3), 2)
    assert Sweep("small-v1", ("drop-oldest", "afr")).checked().specs == ("drop-oldest", "afr")
    assert plan.checked() == plan


# -------------------- killed, failed, and taken up again


KILLED = {
    "lte-v1": ["bench", "--suite", "lte-v1", "--policies", "afr,mine", "--capacity", 5],
    "topics-v1": ["topics", "--split", "validation", "--policies", "mine", "--window", 2],
    "fleet-v1": ["fleet", "--policies", "mine", "--capacity", 5, "--robots", 2],
}
"""A command for each kind of suite."""


@pytest.mark.slow
@pytest.mark.parametrize("suite", KILLED)
def test_a_run_that_was_killed_goes_on_where_it_was(
    suite: str, tmp_path: Path, mine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [*KILLED[suite], "--seeds", 1, "--format", "csv", "--policy-file", mine, "--jobs", 2]
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    process = bufgym(*words, "--out", killed, TEST_SLEEP_S="0.4")
    deadline = time.monotonic() + 60
    while len(list(killed.glob("parts/*.csv"))) < 3:
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.02)
    process.kill()
    process.wait()
    os.killpg(process.pid, signal.SIGKILL)  # loky's workers, which would hold the pipes for minutes
    process.communicate()
    kept = contents(killed / "parts")
    shards = {"lte-v1": 24, "topics-v1": 18, "fleet-v1": 12}[suite]
    assert 3 <= len(kept) < shards and not (killed / "rows.csv").exists()

    alone = [str(word) for word in (*words[:-2], "--backend", "sequential", "--out")]
    with monkeypatch.context() as patch:
        patch.setattr(sweep.shutil, "rmtree", lambda *_, **__: None)  # the parts stay, to be looked at
        assert main([*alone, str(killed)]) == 0
    after = contents(killed / "parts")
    assert len([name for name in after if not name.startswith(".")]) == shards
    assert all(after[name] == was for name, was in kept.items()), "a finished shard was touched"
    assert main([*alone, str(whole)]) == 0
    names = {path.name for path in whole.iterdir()}
    assert names == {"manifest.json", "rows.csv"} | ({"timeline.json"} if suite == "lte-v1" else set())
    for name in names - {"manifest.json"}:
        assert (killed / name).read_bytes() == (whole / name).read_bytes()
    assert main([*alone, str(killed)]) == 0
    assert not (killed / "parts").exists()


def test_a_second_call_runs_nothing(tmp_path: Path, small: Sweep, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = sweep.run_sweep(small, tmp_path, backend="sequential", form="csv")
    before = contents(tmp_path)
    monkeypatch.setattr(sweep, "run_shard", None)
    # Without a word about the format, what is there counts.
    assert repr(sweep.run_sweep(small, tmp_path, backend="sequential")) == repr(rows)
    assert contents(tmp_path) == before


def test_parts_alone_say_the_format_too(tmp_path: Path, small: Sweep, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(sweep, "_read", _interrupt)
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
    tmp_path: Path, small: Sweep, backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second shard fails at once; a slower first one is finished and kept, and no shard is begun afterwards."""
    right, begun = sweep.run_shard, []

    def fails(shard: sweep.Shard, load: Any = None) -> Any:
        begun.append(shard.name)
        if shard.name == "one-1-1000":
            raise MemoryError("no room")
        time.sleep(0.2)
        return right(shard)

    monkeypatch.setattr(sweep, "run_shard", fails)
    with pytest.raises(MemoryError, match="no room"):
        sweep.run_sweep(small, tmp_path, jobs=2, backend=backend, form="csv")
    written = {path.stem for path in (tmp_path / "parts").iterdir()}
    assert "one-0-0" in written and written == set(begun) - {"one-1-1000"}
    kept = contents(tmp_path / "parts")

    begun.clear()
    monkeypatch.setattr(sweep, "run_shard", lambda shard, load=None: begun.append(shard.name) or right(shard))
    rows = sweep.run_sweep(small, tmp_path, jobs=2, backend="sequential", form="csv")
    assert len(begun) == 4 - len(kept) and not set(begun) & written
    assert repr(rows) == repr(sweep.run_sweep(small, tmp_path / "whole", backend="sequential", form="csv"))


def test_a_mistake_in_a_users_policy_is_shown_where_it_is_even_from_other_processes(tmp_path: Path, mine: Path) -> None:
    words = ["--policies", "mine,afr", "--policy-file", mine, "--capacity", "2,5", "--seeds", "2", "--jobs", "2"]
    failed = finished("bench", "--suite", "interruption-v1", *words, "--out", tmp_path, TEST_FAIL="1")
    assert failed.returncode == 2 and failed.stderr.count("\n") == 1
    assert f"{mine}, line 10: ArithmeticError: on purpose" in failed.stderr


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
        patch.setattr(sweep, "_read", _interrupt)  # all parts are there, but not yet their sum
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


def _interrupt(*_: Any) -> Any:
    raise KeyboardInterrupt


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
    with pytest.raises(BufgymError, match=rf'{module} is missing: pip install "bufgym\[{extra}\]"'):
        sweep.run_sweep(small, tmp_path, jobs=2, backend=backend)


def fails(words: list[object], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(word) for word in words]) == 2
    error = capsys.readouterr().err
    assert told in error and error.startswith("bufgym: error: ") and error.count("\n") == 1


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
    "words",
    [["--jobs", 2], ["--split", "train"], ["--data", "."], ["--backend", "dask"], ["--address", "host:1"]],
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
