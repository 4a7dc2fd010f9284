"""A suite's benchmark: many runs over all cores or a cluster, safe against a kill.

The work is cut into shards (one scenario, one trace, some seeds; all policies and capacities). The rows of a finished
shard lie in a file of their own under ``parts/``; a run that is started again skips them. When all are there, they
become ``rows.parquet`` (or ``rows.csv``) beside ``manifest.json``, which says what was run, and ``timeline.json``, one
episode in full. The rows do not depend on where or in which order the shards ran.
"""

from __future__ import annotations

import datetime
import hashlib
import itertools
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bufgym import __version__, policies
from bufgym.benchmark import cluster, timeline
from bufgym.benchmark.cluster import BACKENDS
from bufgym.benchmark.folder import FORMAT, read_manifest
from bufgym.benchmark.rows import COLUMNS, Row, has_pyarrow, read_rows, write_rows
from bufgym.benchmark.run import bar, distinct, run
from bufgym.benchmark.score import BASELINE
from bufgym.errors import BufgymError, line_in
from bufgym.files import replaced
from bufgym.scenario import Scenario, Uplink, suites

_SEEDS_A_TRACE = 1000
"""Episode s of trace k has the seed 1000 k + s: no two traces of a scenario share an episode's chance."""

_SEEDS_A_SHARD = 25


@dataclass(frozen=True)
class Plan:
    """What to run."""

    suite: str
    specs: tuple[str, ...]
    """Policies, as ``bufgym.policies.get`` takes them."""
    split: str = "test"
    capacities: tuple[int, ...] = ()
    """Empty: those of the suite."""
    seeds: int | None = None
    """Episodes a trace; None: as many as the suite says."""
    data: str | None = None
    """Folder of recordings, for suites that need one."""
    policy_file: str | None = None
    """A Python file that registers policies; it is run wherever shards run."""

    def checked(self) -> Plan:
        """The same with nothing left open; a mistake in it ends in an error here, before any work."""
        suite = suites.get(self.suite)
        if suite.name in suites.TOPIC_SUITES:
            raise BufgymError(f"suite {suite.name} has several topics: bufgym topics --suite {suite.name}")
        suite.settings(self.split, self.data)
        seeds = seeds_a_trace(suite, self.seeds)
        if any(L < 1 or self.capacities.count(L) > 1 for L in self.capacities):
            raise BufgymError(f"capacities = {list(self.capacities)}: must be whole numbers >= 1, no two alike")
        specs = list(dict.fromkeys([*self.specs, BASELINE]))
        distinct([policies.get(spec) for spec in specs])
        return replace(self, specs=tuple(specs), capacities=self.capacities or suite.capacities, seeds=seeds)


def seeds_a_trace(suite: suites.Suite, seeds: int | None) -> int:
    """So many, or as many as the suite says."""
    seeds = suite.seeds if seeds is None else seeds
    if not 1 <= seeds <= _SEEDS_A_TRACE:
        raise BufgymError(f"seeds = {seeds}: must lie between 1 and {_SEEDS_A_TRACE}")
    return seeds


@dataclass(frozen=True)
class Shard:
    """One piece of the work."""

    plan: Plan
    label: str
    trace: int
    seeds: tuple[int, ...]

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{self.label}-{self.trace}-{self.seeds[0]}"


def shards(plan: Plan) -> list[Shard]:
    """All pieces of a checked plan, in the order of the rows."""
    made = []
    seeds = int(plan.seeds or 0)
    for label, setting in suites.get(plan.suite).settings(plan.split, plan.data).items():
        traces = len(setting.scenario.traces) if isinstance(setting.scenario, Uplink) else 1
        for trace in range(traces):
            numbers = seeds_of(trace, seeds)
            for k in range(0, seeds, _SEEDS_A_SHARD):
                made.append(Shard(plan, label, trace, tuple(numbers[k : k + _SEEDS_A_SHARD])))
    return made


def seeds_of(trace: int, seeds: int) -> list[int]:
    """Of so many episodes on the trace of that number."""
    return [_SEEDS_A_TRACE * trace + s for s in range(seeds)]


def cell(scenario: Scenario, trace: int) -> Scenario:
    """The scenario on one of its traces."""
    return replace(scenario, traces=(scenario.traces[trace],)) if isinstance(scenario, Uplink) else scenario


_LOADED: set[str] = set()
"""Policy files that this process has run for a shard."""


def run_shard(shard: Shard, load: Callable[[str | None], None] | None = None) -> list[Row]:
    """The rows of one shard; ``load`` runs the plan's policy file where that has not been done yet."""
    plan = shard.plan
    if load is not None and plan.policy_file is not None and plan.policy_file not in _LOADED:
        load(plan.policy_file)
        _LOADED.add(plan.policy_file)
    setting = suites.get(plan.suite).settings(plan.split, plan.data)[shard.label]
    chosen = [policies.get(spec) for spec in plan.specs]
    return run(chosen, cell(setting.scenario, shard.trace), plan.capacities, shard.seeds, label=shard.label)


def _attempt(number: int, shard: Shard, load: Callable[[str | None], None] | None) -> tuple[int, list[Row] | Exception]:
    """The shard's number and its rows, or what went wrong: joblib throws finished shards away when one raises."""
    try:
        return number, run_shard(shard, load)
    except BufgymError as error:
        return number, error
    except Exception as error:
        # A traceback stays behind in the process; where in the user's own file it was must be said here.
        place = line_in(error, shard.plan.policy_file or "")
        if place is None:
            return number, error
        return number, BufgymError(f"{place}: {type(error).__name__}: {error}")


# --- the folder ------------------------------------------------------------------------------------------------------


def run_sweep(
    plan: Plan,
    out: Path,
    *,
    jobs: int = -1,
    backend: str = "loky",
    address: str | None = None,
    command: str = "",
    form: str | None = None,
    load: Callable[[str | None], None] | None = None,
    progress: bool = True,
) -> list[Row]:
    """Run what of the plan is not yet in ``out``, and write the folder's files; all its rows.

    Args:
        plan: what to run.
        out: a folder that does not exist, is empty, or holds an earlier (perhaps unfinished) run of the same plan.
        jobs: processes side by side; -1: one a core.
        backend: one of ``BACKENDS`` (joblib's); "ray" and "dask" use the cluster at ``address``, or a local one.
        address: of the cluster's head.
        command: what the report shows as the way to run it again.
        form: "parquet" or "csv"; by default parquet if pyarrow is there.
        load: runs a policy file (``Plan.policy_file``) in a worker.
        progress: show a bar on stderr, where that is a terminal.
    """
    plan = plan.checked()
    if jobs < -1 or jobs == 0:
        raise BufgymError(f"jobs = {jobs}: must be a whole number >= 1, or -1 for one a core")
    if backend not in BACKENDS:
        raise BufgymError(f"backend = {backend!r}: must be one of {', '.join(BACKENDS)}")
    form = form or _form(out)
    whole = out / f"rows.{form}"
    wanted = manifest(plan, command)
    parts = out / "parts"
    _claim(out, wanted)
    if not whole.exists():
        parts.mkdir(exist_ok=True)
        todo = shards(plan)
        files = [parts / f"{shard.name}.{form}" for shard in todo]
        missing = [(shard, file) for shard, file in zip(todo, files, strict=True) if not file.exists()]
        with bar(len(todo), progress, unit="shard", done=len(todo) - len(missing)) as advance:
            for k, rows in _spread([shard for shard, _ in missing], jobs, backend, address, load):
                write_rows(rows, missing[k][1])
                advance(1)
        rows = [row for shard, file in zip(todo, files, strict=True) for row in _read(file, shard)]
        write_rows(rows, whole)
    else:
        rows = read_rows(whole)
    if not (out / "timeline.json").exists():
        shown = timeline.choose(rows)
        if shown is not None:
            setting = suites.get(plan.suite).settings(plan.split, plan.data)[shown["scenario"]]
            trace = shown["seed"] // _SEEDS_A_TRACE
            chosen = [policies.get(spec) for spec in plan.specs]
            one = timeline.timeline(chosen, cell(setting.scenario, trace), shown)
            _write_json(out / "timeline.json", {**one, "about": setting.about})
    shutil.rmtree(parts, ignore_errors=True)
    return rows


def manifest(plan: Plan, command: str = "") -> dict[str, Any]:
    """What ``manifest.json`` says about a checked plan."""
    suite = suites.get(plan.suite)
    chosen = [policies.get(spec) for spec in plan.specs]
    return {
        "format": FORMAT,
        "bufgym": __version__,
        "made": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "suite": suite.name,
        "split": plan.split,
        "about": suite.about,
        "command": command,
        "policies": [policy.name for policy in chosen],
        "unranked": {policy.name: policy.unranked_because for policy in chosen if not policy.ranked},
        "capacities": list(plan.capacities),
        "seeds": plan.seeds,
        "policy_file": plan.policy_file and hashlib.sha256(Path(plan.policy_file).read_bytes()).hexdigest()[:16],
        "scenarios": {
            label: {
                "about": setting.about,
                "value": setting.scenario.value.name,
                **({} if setting.outage_s is None else {"outage_s": setting.outage_s}),
                **({"recordings": _fingerprint(setting.scenario)} if suite.needs else {}),
            }
            for label, setting in suite.settings(plan.split, plan.data).items()
        },
    }


def _fingerprint(scenario: Scenario) -> str:
    """Tells recordings apart that go by the same names."""
    digest = hashlib.sha256()
    if isinstance(scenario, Uplink):
        for trace in scenario.traces:
            digest.update(trace.time_us.tobytes() + trace.cumulative_bytes.tobytes())
        for motion in scenario.motion:
            digest.update(motion.time_us.tobytes())
    return digest.hexdigest()[:16]


_SAME = ("format", "bufgym", "suite", "split", "policies", "policy_file", "capacities", "seeds", "scenarios")
"""What two runs that share a folder must have in common."""


def _form(out: Path) -> str:
    """That of the rows which are there already, else the best that can be written."""
    held = {file.suffix for pattern in ("rows.*", "parts/*") for file in out.glob(pattern)}
    return "csv" if not has_pyarrow() or (".csv" in held and ".parquet" not in held) else "parquet"


def _claim(out: Path, wanted: dict[str, Any]) -> None:
    """Make the folder ours, or an error if something else is in it."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / "manifest.json"
    if not file.exists():
        if (out / "parts").exists() or any(out.glob("rows.*")):
            raise BufgymError(f"{out}: holds rows without a manifest.json; choose another --out")
        _write_json(file, wanted)
        return
    held = read_manifest(file)
    for key in _SAME:
        if held.get(key) != wanted[key]:
            raise BufgymError(
                f"{file}: {key} is {_short(held.get(key))}, but this run has {_short(wanted[key])};"
                " choose another --out (finished rows are never mixed)"
            )


def _short(given: object) -> str:
    text = json.dumps(given)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _read(file: Path, shard: Shard) -> list[Row]:
    """The rows of a finished shard; an error if the file is not what this plan would have written."""
    again = "delete this file and run the command again: only its rows are made anew"
    try:
        rows = read_rows(file)
    except BufgymError as error:
        raise BufgymError(f"{error}; {again}") from None
    expected = len(shard.plan.specs) * len(shard.plan.capacities) * len(shard.seeds)
    if len(rows) != expected or any(tuple(row) != COLUMNS for row in rows):
        raise BufgymError(f"{file}: {len(rows)} rows where {expected} of {len(COLUMNS)} columns were written; {again}")
    return rows


def _write_json(file: Path, content: dict[str, Any]) -> None:
    with replaced(file) as temporary:
        temporary.write_text(json.dumps(content, indent=1), encoding="utf-8")


# --- where it runs ---------------------------------------------------------------------------------------------------


def _spread(
    work: Sequence[Shard],
    jobs: int,
    backend: str,
    address: str | None,
    load: Callable[[str | None], None] | None,
) -> Iterator[tuple[int, list[Row]]]:
    """(number, rows) of each shard, as they become ready; after an error no further ones are begun."""
    if not work:
        return
    if backend == "sequential" or (backend == "loky" and jobs == 1):
        for k, shard in enumerate(work):
            yield k, run_shard(shard)
        return
    if backend == "threading":
        load = None  # this process has run the policy file
    failed: list[Exception] = []
    calls = ((_attempt, (k, u, load)) for k, u in itertools.takewhile(lambda _: not failed, enumerate(work)))
    for k, found in cluster.spread(calls, len(work), jobs, backend, address):
        if isinstance(found, Exception):
            failed.append(found)
        else:
            yield k, found
    if failed:
        raise failed[0]
