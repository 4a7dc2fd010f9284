"""Benchmark of a suite: many runs over all cores or a cluster, safe against a kill.

The work is cut into shards. A shard has one scenario, one trace and some seeds, with all policies and capacities. The
rows of a finished shard are in a file of their own under ``parts/``, and a restarted run skips them. At the end they
become ``rows.parquet`` or ``rows.csv`` beside ``manifest.json``, which records the settings. For one queue,
``timeline.json`` has one episode in full. The rows do not depend on where or in which order the shards ran.
"""

from __future__ import annotations

import datetime
import hashlib
import importlib.util
import itertools
import json
import os
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from bufgym import policies
from bufgym.benchmark import cluster, folder, sources, tasks
from bufgym.benchmark.rows import Row, read_rows, write_rows
from bufgym.benchmark.run import check_distinct, run
from bufgym.benchmark.table import unranked_among
from bufgym.benchmark.tasks import Task
from bufgym.policies import Policy
from bufgym.scenario import suites
from bufgym.scenario.numbered import SEEDS_PER_TRACE, by_trace
from bufgym.scenario.registry import with_parameters
from bufgym.scenario.suites import Setting
from bufgym.scenario.suites.own import MOST_SEEDS, fingerprint
from bufgym.utils import __version__, modules
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import locked, write_text
from bufgym.utils.progress import bar

_SEEDS_PER_SHARD = 25


@dataclass(frozen=True)
class Sweep:
    """Settings of a suite's benchmark."""

    suite: str
    specs: tuple[str | Policy, ...]
    """Policies, as ``bufgym.policies.get`` takes them; other processes get them by name. The task's baseline and
    reference, which rows are compared with, are added if they are missing."""
    split: str = "test"  # "train", "validation" or "test"
    capacities: tuple[int, ...] = ()  # L, messages; empty for the suite's own
    seeds: int | None = None  # episodes on each trace; None for the suite's own number
    data: str | None = None  # folder of recordings, for suites that need one
    policy_file: str | None = None  # a Python file that registers policies, run wherever shards run
    sources: tuple[str, ...] = ()
    """Files of models and functions of modules, loaded wherever shards run; by default those the policies are from."""
    home: str = field(default_factory=os.getcwd)  # folder of the sources
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of the scenarios that differ from the suite's, such as a client's ``window``."""

    own: suites.Suite | None = None
    """The suite where it is one's own, which other processes do not know by name; ``checked`` fills it in."""

    @property
    def frozen(self) -> suites.Suite:
        """The suite."""
        return self.own or suites.get(self.suite)

    @property
    def task(self) -> Task:
        return tasks.TASKS[self.frozen.kind]

    def __getstate__(self) -> dict[str, Any]:
        # A policy's functions may be of a module that only its file or source defines, so its name is pickled.
        return {**vars(self), "specs": tuple(policy.name for policy in self.policies)}

    @property
    def policies(self) -> list[Policy]:
        return [policies.get(spec) for spec in self.specs]

    def settings(self) -> dict[str, Setting]:
        settings = self.frozen.settings(self.split, self.data)
        if not self.changes:
            return settings
        return {
            label: replace(setting, scenario=with_parameters(setting.scenario, self.changes, place=self.suite))
            for label, setting in settings.items()
        }

    def capacities_of(self, setting: Setting) -> tuple[int, ...]:
        """L that a setting is met with: those asked for, or else its own or the suite's."""
        own = self.capacities in ((), self.frozen.capacities)
        return setting.capacities if own and setting.capacities else self.capacities

    def setting(self, label: str, trace: int) -> Setting:
        """Return one setting with its scenario on one trace alone."""
        setting = self.settings()[label]
        return replace(setting, scenario=by_trace(setting.scenario)[trace][1])

    def checked(self) -> Sweep:
        """Fill in all defaults and check everything, so that errors come before any work."""
        suite, task = self.frozen, self.task
        self.settings()
        seeds = suite.seeds if self.seeds is None else self.seeds
        most = MOST_SEEDS if suite.own else SEEDS_PER_TRACE
        if not 1 <= seeds <= most:
            raise BufgymError(f"seeds = {seeds}: must lie between 1 and {most}")
        if any(L < 1 or self.capacities.count(L) > 1 for L in self.capacities):
            raise BufgymError(f"capacities = {list(self.capacities)}: must be whole numbers >= 1, no two alike")
        given, compared = self.policies, dict.fromkeys((task.baseline, task.reference))
        names = [policy.name for policy in given]
        specs = (*given, *(policies.get(name) for name in compared if name not in names))
        files = self.sources or sources.loaded(names, self.home)
        complete = replace(
            self, specs=specs, sources=files, capacities=self.capacities or suite.capacities, seeds=seeds,
            own=suite if suite.own else None,
        )  # fmt: skip
        check_distinct(complete.policies)
        for policy in complete.policies:
            task.check(policy)
        return complete

    def shards(self) -> list[Shard]:
        """List all shards of a checked sweep, in the order of the rows."""
        shards = []
        for label, setting in self.settings().items():
            for trace in range(len(by_trace(setting.scenario))):
                first = SEEDS_PER_TRACE * trace + self.frozen.first_seeds.get(self.split, 0)
                numbers = [first + s for s in range(self.seeds or 0)]
                for k in range(0, len(numbers), _SEEDS_PER_SHARD):
                    shards.append(Shard(self, label, trace, tuple(numbers[k : k + _SEEDS_PER_SHARD])))
        return shards


@dataclass(frozen=True)
class Shard:
    """One piece of a sweep: one scenario on one trace, with some seeds."""

    sweep: Sweep  # the whole sweep
    label: str  # label of the scenario
    trace: int  # the number of the trace in the scenario
    seeds: tuple[int, ...]  # seeds of its episodes

    @property
    def name(self) -> str:
        return f"{self.label}-{self.trace}-{self.seeds[0]}"


_TRIES = 3  # worker deaths in a row, without a finished shard between them, that end the run


def run_shard(shard: Shard) -> list[Row]:
    """Run one shard and return its rows. Each process runs the sweep's policy file once."""
    sweep = shard.sweep
    sources.prepare(sweep.policy_file, sweep.sources, sweep.home)
    setting = sweep.setting(shard.label, shard.trace)
    limits: dict[str, Any] = {} if setting.max_bytes is None else {"max_bytes": setting.max_bytes}
    return run(sweep.policies, setting.scenario, sweep.capacities_of(setting), shard.seeds, label=shard.label, **limits)


def _attempt(number: int, shard: Shard) -> tuple[int, list[Row] | Exception]:
    """Return the shard's number with its rows or its error, because joblib discards finished shards when one raises."""
    try:
        return number, run_shard(shard)
    except BufgymError as error:
        return number, error
    except Exception as error:
        # The traceback stays in this process, so the place in the user's file is added here.
        place = modules.line_of(error)
        return number, error if place is None else BufgymError(f"{place}: {type(error).__name__}: {error}")


def run_sweep(
    sweep: Sweep,
    out: Path,
    *,
    jobs: int | None = None,
    backend: str = "loky",
    address: str | None = None,
    command: str = "",
    form: str | None = None,
    progress: bool = True,
) -> list[Row]:
    """Run the missing shards of the sweep, write the files in ``out`` and return all rows.

    Args:
        sweep: what to run.
        out: a folder that does not exist, is empty, or holds an earlier run of the same sweep, finished or not.
        jobs: parallel processes; -1 starts one per core, and None does too if joblib is installed.
        backend: one of ``BACKENDS`` (joblib's); "ray" and "dask" use the cluster at ``address``, or a local one.
        command: command that the report shows to run it again.
        form: "parquet" or "csv"; by default parquet if pyarrow is installed.
    """
    sweep = sweep.checked()
    if jobs is None:
        jobs = -1 if backend != "loky" or importlib.util.find_spec("joblib") else 1
    cluster.check(jobs, backend)
    layout = sweep.task.layout
    form = form or folder.form_of_rows(out)
    whole, parts = out / f"rows.{form}", out / "parts"
    shards = sweep.shards()
    with folder.made(out), locked(out):
        folder.claim(out, _manifest(sweep, shards, command))
        if whole.exists():
            rows = read_rows(whole, layout)
        else:
            parts.mkdir(exist_ok=True)
            files = [parts / f"{shard.name}.{form}" for shard in shards]
            missing = [(shard, file) for shard, file in zip(shards, files, strict=True) if not file.exists()]
            with bar(len(shards), progress, unit="shard", done=len(shards) - len(missing)) as advance:
                for k, part in _spread([shard for shard, _ in missing], jobs, backend, address):
                    write_rows(part, missing[k][1], layout)
                    advance(1)
            rows = [row for shard, file in zip(shards, files, strict=True) for row in _read(file, shard)]
            write_rows(rows, whole, layout)
        if not (out / "timeline.json").exists():
            example = sweep.task.example(
                sweep.policies, rows, lambda row: sweep.setting(row["scenario"], row["seed"] // SEEDS_PER_TRACE)
            )
            if example is not None:
                write_text(out / "timeline.json", json.dumps(example, indent=1))
        shutil.rmtree(parts, ignore_errors=True)
        return rows


def _manifest(sweep: Sweep, shards: Sequence[Shard], command: str) -> dict[str, Any]:
    suite, settings = sweep.frozen, sweep.settings()
    episodes = sum(len(shard.seeds) for shard in shards)
    code = sweep.policy_file and Path(sweep.policy_file).read_bytes()
    return {
        "format": folder.FORMAT,
        "bufgym": __version__,
        "made": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "task": suite.kind,
        "suite": suite.name,
        "split": sweep.split,
        "about": suite.about,
        "episodes": sweep.task.describe([setting.scenario for setting in settings.values()], episodes),
        "command": command,
        "policies": [policy.name for policy in sweep.policies],
        "unranked": unranked_among(sweep.policies),
        "capacities": list(sweep.capacities),
        "seeds": sweep.seeds,
        "changes": dict(sweep.changes),
        "policy_file": code and hashlib.sha256(code).hexdigest()[:16],
        "sources": sources.digests(sweep.sources, sweep.home) or None,
        "made_of": {p.name: sources.made_of(p) for p in sweep.policies if not sources.known_elsewhere(p)} or None,
        "scenarios": {
            label: {
                "about": setting.about,
                "value": setting.scenario.value.name,
                **({} if setting.outage_s is None else {"outage_s": setting.outage_s}),
                **({"recordings": _fingerprint(setting.scenario)} if suite.needs else {}),
                **({"episodes": fingerprint(setting.scenario)} if suite.own else {}),
            }
            for label, setting in settings.items()
        },
    }


def _fingerprint(scenario: Any) -> str:
    """Fingerprint that tells recordings of the same name apart."""
    stream = getattr(scenario, "uplink", scenario)
    digest = hashlib.sha256()
    for trace in getattr(stream, "traces", ()):
        digest.update(trace.time_us.tobytes() + trace.cumulative_bytes.tobytes())
    for motion in getattr(stream, "motion", ()):
        digest.update(motion.time_us.tobytes())
    return digest.hexdigest()[:16]


def _read(file: Path, shard: Shard) -> list[Row]:
    """Read the rows of a finished shard; raise an error if this sweep cannot have written the file."""
    again = "delete this file and run the command again: only its rows are made anew"
    sweep, layout = shard.sweep, shard.sweep.task.layout
    try:
        rows = read_rows(file, layout)
    except BufgymError as error:
        raise BufgymError(f"{error}; {again}") from None
    setting = sweep.settings()[shard.label]
    runs = len(sweep.specs) * len(sweep.capacities_of(setting)) * len(shard.seeds)
    expected, columns = runs * sweep.task.rows_per_run(setting.scenario), tuple(layout)
    if len(rows) != expected or any(tuple(row) != columns for row in rows):
        raise BufgymError(f"{file}: {len(rows)} rows where {expected} of {len(columns)} columns were written; {again}")
    return rows


def _spread(shards: Sequence[Shard], jobs: int, backend: str, address: str | None) -> Iterator[tuple[int, list[Row]]]:
    """Yield each shard's number and rows as they become ready; after an error start no more.

    When a worker dies, unfinished shards run again, as long as each attempt finishes some.
    """
    if backend == "sequential" or (backend == "loky" and jobs == 1):
        for k, shard in enumerate(shards):
            yield k, run_shard(shard)
        return
    failed: list[Exception] = []
    waiting, vain = dict(enumerate(shards)), 0
    while waiting and not failed:
        now = itertools.takewhile(lambda _: not failed, list(waiting.items()))
        calls = ((_attempt, (k, shard)) for k, shard in now)
        before = len(waiting)
        try:
            for k, result in cluster.spread(calls, before, jobs, backend, address):
                if isinstance(result, Exception):
                    failed.append(result)
                else:
                    del waiting[k]
                    yield k, result
        except cluster.WorkerDiedError as error:
            vain = vain + 1 if len(waiting) == before else 0
            if vain == _TRIES:
                raise
            print(f"bufgym: {error}; {len(waiting)} shards are run again", file=sys.stderr)
    if failed:
        raise failed[0]
