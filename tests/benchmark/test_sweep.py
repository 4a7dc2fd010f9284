"""A suite's benchmark: the same rows wherever it runs, nothing lost by a kill, nothing mixed in a folder."""

import importlib.util
import json
import pickle
import threading
from pathlib import Path
from typing import Any

import pytest
from cli_cases import Capsys, Patch, shown
from needs import needs
from refusal_cases import refuse
from sweep_cases import THREE, TINY, contents, ended, interrupt

from bufgym import policies
from bufgym.benchmark import run, sweep
from bufgym.benchmark.rows import read_rows, write_rows
from bufgym.benchmark.sweep import Sweep
from bufgym.cli.options import load_policies
from bufgym.scenario import Uplink, numbered, suites
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError

pytest.importorskip("joblib", reason=needs("extras", "joblib"))

WORDS = ["bench", "--suite", "interruption-v1", "--policies", ",".join(THREE), "--capacity", "2,4", "--seeds", "3"]
"""The same as ``TINY``, typed."""


@pytest.fixture(scope="module")
def expected() -> str:
    chosen = [policies.get(name) for name in THREE]
    rows = []
    for label, setting in suites.get("interruption-v1").settings("test").items():
        rows += run.run(chosen, setting.scenario, [2, 4], 3, label=label)
    return repr(rows)


@pytest.mark.parametrize("backend", ["sequential", "threading", "loky"])
def test_the_rows_are_those_of_the_experiment(tmp_path: Path, backend: str, expected: str) -> None:
    rows = sweep.run_sweep(TINY, tmp_path, jobs=2, backend=backend, form="csv")
    assert repr(rows) == repr(read_rows(tmp_path / "rows.csv")) == expected  # which tells NaN from None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["manifest.json", "rows.csv", "timeline.json"]


@pytest.mark.nightly
@pytest.mark.parametrize("backend", ["loky", "dask", "ray"])
def test_other_processes_know_a_users_policy(tmp_path: Path, backend: str, mine: Path, expected: str) -> None:
    """Dask and Ray: a cluster of this machine's own."""
    needed = {"loky": "joblib", "dask": "distributed", "ray": "ray"}[backend]
    if importlib.util.find_spec(needed) is None:
        pytest.skip(needs("ray" if needed == "ray" else "extras", needed))
    words = [word if word != ",".join(THREE) else ",".join(["mine", *THREE]) for word in WORDS]
    words += ["--policy-file", str(mine), "--backend", backend, "--jobs", "2", "--format", "csv"]
    out = tmp_path / "out"
    code, said, complaint = ended(*words, "--out", out)
    assert code == 0 and "mine" in said and f"72 rows in {out}" in said, complaint
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
        for k, (_, part) in enumerate(numbered.by_trace(setting.scenario)):
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
    assert ([p.name for p in plan.policies], plan.capacities, plan.seeds) == (["afr", "drop-oldest"], (2, 3), 2)
    assert [p.name for p in Sweep("small-v1", ("drop-oldest", "afr")).checked().policies] == ["drop-oldest", "afr"]
    assert plan.checked() == plan


def test_a_policy_stays_what_it_is_and_other_processes_get_its_name(small: Sweep) -> None:
    """A setting of ten digits is in the name whole, so the two are the same policy."""
    filtered = policies.get("time-filter").with_parameters(separation_s=0.1234567891)
    assert filtered.name == "time-filter:separation_s=0.1234567891"
    assert policies.get("time-filter").with_parameters(separation_s=2.0).name == "time-filter:separation_s=2"
    plan = Sweep(small.suite, (filtered,)).checked()
    assert plan.policies[0] is filtered
    there = pickle.loads(pickle.dumps(plan))
    assert there.specs == (filtered.name, "drop-oldest", "afr") and there.policies == plan.policies


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
def test_an_error_loses_no_finished_rows(tmp_path: Path, small: Sweep, backend: str, monkeypatch: Patch) -> None:
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
    monkeypatch.setattr(sweep, "run_shard", lambda shard: begun.append(shard.name) or right(shard))
    rows = sweep.run_sweep(small, tmp_path, jobs=2, backend="sequential", form="csv")
    assert len(begun) == 4 - len(kept) and not set(begun) & written
    assert repr(rows) == repr(sweep.run_sweep(small, tmp_path / "whole", backend="sequential", form="csv"))


@pytest.mark.nightly
def test_a_mistake_in_a_users_policy_is_shown_where_it_is_even_from_other_processes(tmp_path: Path, mine: Path) -> None:
    words = ["--policies", "mine", "--policy-file", mine, "--capacity", "2,5", "--seeds", "1", "--jobs", "2"]
    code, _, said = ended("bench", "--suite", "interruption-v1", *words, "--out", tmp_path, TEST_FAIL="1")
    assert code == 2 and said.count("\n") == 1 and f"{mine}, line 8: ArithmeticError: on purpose" in said


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"specs": ("afr", "red")}, "policies"),
        ({"specs": ("random", "afr", "drop-oldest")}, "policies"),
        ({"capacities": (2, 5)}, "capacities"),
        ({"seeds": 4}, "seeds"),
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
    folder = tmp_path_factory.mktemp("finished")
    sweep.run_sweep(TINY, folder, backend="sequential")
    return folder


def test_so_does_another_version_or_policy_file(tmp_path: Path, small: Sweep, mine: Path, monkeypatch: Patch) -> None:
    load_policies(str(mine))
    plan = Sweep("small-v1", ("mine",), policy_file=str(mine))
    sweep.run_sweep(plan, tmp_path / "out", backend="sequential")
    before = contents(tmp_path / "out")
    text = mine.read_text()
    mine.write_text(text.replace("% 2", "% 3"))
    refuse("policy_file is", sweep.run_sweep, plan, tmp_path / "out", backend="sequential")
    mine.write_text(text)
    monkeypatch.setattr(sweep, "__version__", "0.0.0")
    refuse(r'bufgym is ".*", but this run has "0\.0\.0"', sweep.run_sweep, plan, tmp_path / "out", backend="sequential")
    assert contents(tmp_path / "out") == before


def test_so_do_other_recordings_of_the_same_names(tmp_path: Path, monkeypatch: Patch) -> None:
    def build(split: str, data: Path | None) -> dict[str, suites.Setting]:
        assert data is not None
        trace = Trace.steps([(1.0, float((data / "rate").read_text()))], name="link")
        return {"link": suites.Setting(Uplink(traces=(trace,), rate_hz=5, duration_s=2), "a link")}

    monkeypatch.setitem(suites.SUITES, "found-v1", suites.Suite("found-v1", "found", build, (2,), 1, needs="rate"))
    for name, rate in (("a", "500000"), ("b", "600000"), ("c", "500000")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "rate").write_text(rate)
    first, other, same = (Sweep("found-v1", ("afr",), data=str(tmp_path / name)) for name in "abc")
    rows = sweep.run_sweep(first, tmp_path / "out", backend="sequential")
    refuse("scenarios is", sweep.run_sweep, other, tmp_path / "out", backend="sequential")
    assert repr(sweep.run_sweep(same, tmp_path / "out", backend="sequential")) == repr(rows)


@pytest.mark.parametrize("name", ["rows.csv", "rows.parquet", "parts/one-0-0.csv"])
def test_rows_without_a_manifest_are_left_alone(tmp_path: Path, small: Sweep, name: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("someone else's")
    with pytest.raises(BufgymError, match=r"holds rows without a manifest\.json; choose another --out"):
        sweep.run_sweep(small, tmp_path, backend="sequential")
    assert list(contents(tmp_path)) == [name]


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_a_broken_part_is_named_and_made_anew(tmp_path: Path, small: Sweep, form: str, monkeypatch: Patch) -> None:
    if form == "parquet":
        pytest.importorskip("pyarrow", reason=needs("extras", "pyarrow"))
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
    ("change", "message"),
    [
        ({"split": "exam"}, "split = 'exam'"),
        ({"specs": ("decimate:every=2", "decimate:every=2.0")}, "'decimate:every=2' is given more than once"),
        ({"seeds": 0}, "seeds = 0: must lie between 1 and 1000"),
        ({"capacities": (2, 2)}, r"capacities = \[2, 2\]: .* no two alike"),
        ({"suite": "mahimahi-v1"}, r"needs a folder of recordings \(--data DIR\)"),
        ({"jobs": 0}, "jobs = 0:"),
        ({"backend": "sloky"}, "backend = 'sloky': must be one of loky"),
    ],
)
def test_a_bad_sweep_writes_nothing(tmp_path: Path, small: Sweep, change: dict[str, Any], message: str) -> None:
    where = {name: change.pop(name) for name in ("jobs", "backend") if name in change}
    refuse(message, sweep.run_sweep, Sweep(**{**vars(small), **change}), tmp_path / "out", **where)
    assert not (tmp_path / "out").exists()


def test_the_command_line_prints_scores_and_the_report_reads_them(tmp_path: Path, small: Sweep, capsys: Capsys) -> None:
    pytest.importorskip("jinja2", reason=needs("extras", "jinja2"))
    pytest.importorskip("matplotlib", reason=needs("extras", "matplotlib"))
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
