"""The run of a suite, for ``bufgym bench --suite``, ``bufgym topics`` and ``bufgym fleet``."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bufgym.cli.options import OutOptions, SuiteOptions, WhoOptions, command_line, load_policies, loaded, one_policy
from bufgym.ground.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.benchmark.rows import Row


def run_suite(
    command: str,
    options: SuiteOptions,
    who: WhoOptions,
    out: OutOptions,
    changes: dict[str, Any] | None = None,
    *,
    default: str = "",
    kind: str | None = None,
    against: str = "",
) -> list[Row]:
    """Run a suite, print its summary and return its rows.

    Args:
        command: subcommand of bufgym, such as "topics".
        options: the suite and its machines.
        who: policies, capacities and seeds.
        out: where the rows go.
        changes: parameters of the suite's scenarios that are not as they are.
        default: suite where the options name none.
        kind: kind of task; a suite of another kind is an error.
        against: policy that every other is compared with; it and the task's reference run too.
    """
    from bufgym import policies
    from bufgym.benchmark import report
    from bufgym.benchmark.rows import write_rows
    from bufgym.benchmark.sweep import Sweep, run_sweep
    from bufgym.benchmark.tasks import TASKS
    from bufgym.scenario import suites

    suite, file, changes = suites.get(options.suite or default), out.file(), changes or {}
    if kind not in (None, suite.kind):
        raise BufgymError(f"suite {suite.name} is not one of {kind}: bufgym bench --suite {suite.name}")
    task = TASKS[suite.kind]
    named, sources = loaded(who.policies)
    specs = named or task.default_policies(suite.name)
    if against:
        rival = one_policy(against)
        sources = tuple(dict.fromkeys([*sources, *loaded([against])[1]]))
        against = policies.get(rival).name
        known = {policies.get(spec).name for spec in specs}
        specs = [*specs, *(name for name in dict.fromkeys((against, task.reference)) if name not in known)]
    sweep = Sweep(
        suite.name,
        tuple(specs),
        options.split or "test",
        who.capacity or (),
        who.seeds,
        options.data,
        who.policy_file,
        sources,
        changes=changes,
    )
    again = command_line(
        f"bufgym {command}",
        suite=suite.name,
        split=None if options.split == "test" else options.split,
        policies=tuple(who.policies or ()) or None,
        capacity=who.capacity,
        seeds=who.seeds,
        against=against or None,
        **changes,
        policy_file=who.policy_file,
        data=options.data,
        out=out.out,
    )
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "run" if out.out is None or file is not None else Path(out.out)
        try:
            rows = run_sweep(
                sweep,
                folder,
                jobs=options.jobs,
                backend=options.backend or "loky",
                address=options.address,
                command=again,
                form=out.format,
                load=load_policies,
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(*["the same command resumes it"] * (folder == Path(out.out or ""))) from None
        print(report.plain(folder, against))
    if file is not None:
        print(f"\n{len(rows)} rows in {write_rows(rows, file, task.layout)}")
    elif out.out is not None:
        print(f"\n{len(rows)} rows in {folder}; bufgym report {folder} makes a page of them")
    return rows
