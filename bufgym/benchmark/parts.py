"""``run`` in several processes: a scenario's traces and seeds in parts, whose rows come in the order of ``run``."""

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from bufgym import policies as registry
from bufgym.benchmark import cluster, sources
from bufgym.benchmark.rows import Row
from bufgym.benchmark.run import check_distinct, run
from bufgym.policies import Policy
from bufgym.scenario.numbered import by_trace
from bufgym.utils import modules
from bufgym.utils.errors import BufgymError
from bufgym.utils.progress import bar

_SEEDS = 10  # Seeds of a part


@dataclass(frozen=True)
class Part:
    """Some seeds on one trace of a scenario, with all policies and capacities; policies go by their names."""

    names: tuple[str, ...]
    scenario: Any  # on this trace alone
    trace: str  # its label in the whole scenario
    capacities: tuple[int, ...]
    seeds: tuple[int, ...]
    label: str
    settings: dict[str, Any]
    policy_file: str | None
    sources: tuple[str, ...]
    home: str = field(default_factory=os.getcwd)


def run_part(part: Part) -> list[Row]:
    """The rows of a part, in this process or another."""
    sources.prepare(part.policy_file, part.sources, part.home)
    policies = [registry.get(name) for name in part.names]
    rows = run(policies, part.scenario, part.capacities, part.seeds, label=part.label, **part.settings)
    return [{**row, "trace": part.trace} for row in rows]


def _attempt(number: int, part: Part) -> tuple[int, list[Row] | Exception]:
    try:
        return number, run_part(part)
    except BufgymError as error:
        return number, error
    except Exception as error:  # the traceback stays in this process, so the place in the user's file is added here
        place = modules.line_of(error)
        return number, error if place is None else BufgymError(f"{place}: {type(error).__name__}: {error}")


def run_parts(
    policies: Sequence[Policy],
    scenario: Any,
    capacities: Sequence[int],
    seeds: int | Sequence[int],
    *,
    jobs: int | None = None,
    backend: str = "loky",
    address: str | None = None,
    policy_file: str | None = None,
    label: str = "",
    progress: bool = False,
    **settings: Any,
) -> list[Row]:
    """``run`` in so many processes: -1 is one a core, None or 1 this process."""
    cluster.check(1 if jobs is None else jobs, backend)
    if jobs in (None, 1) and backend == "loky":
        return run(policies, scenario, capacities, seeds, label=label, progress=progress, **settings)
    check_distinct(policies)
    if type(scenario).__module__.startswith("bufgym_scenario_file"):
        raise BufgymError("jobs: other processes do not know what --scenario-file registers; name it module:function")
    numbers = list(range(seeds)) if isinstance(seeds, int) else list(seeds)
    names = tuple(policy.name for policy in policies)
    loaded = sources.loaded(names)
    how = label, settings, policy_file, loaded
    parts = [
        Part(names, part, trace, tuple(capacities), tuple(numbers[k : k + _SEEDS]), *how)
        for trace, part in by_trace(scenario)
        for k in range(0, len(numbers), _SEEDS)
    ]
    found: dict[int, list[Row]] = {}
    failed: list[Exception] = []
    with bar(len(parts), progress, unit="part") as advance:
        waiting = itertools.takewhile(lambda _: not failed, enumerate(parts))
        calls = ((_attempt, (k, part)) for k, part in waiting)
        for k, rows in cluster.spread(calls, len(parts), jobs or -1, backend, address):
            if isinstance(rows, Exception):
                failed.append(rows)
            else:
                found[k] = rows
            advance(1)
    if failed:
        raise failed[0]
    return _in_order([row for k in range(len(parts)) for row in found[k]], names, capacities)


def _in_order(rows: list[Row], names: Sequence[str], capacities: Sequence[int]) -> list[Row]:
    """Rows by trace, capacity and policy; seeds, and the rows of one run, stay in their order."""
    traces = {trace: k for k, trace in enumerate(dict.fromkeys(row["trace"] for row in rows))}
    return sorted(rows, key=lambda r: (traces[r["trace"]], capacities.index(r["capacity"]), names.index(r["policy"])))
