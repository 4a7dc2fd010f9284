"""The run of a suite, for ``bufgym bench --suite``, and one policy topic by topic."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bufgym.cli.options import OutOptions, SuiteOptions, WhoOptions, command_line, load_policies, loaded, one_policy
from bufgym.ground.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.benchmark.rows import Row
    from bufgym.benchmark.tasks import Task


def run_suite(
    options: SuiteOptions,
    who: WhoOptions,
    out: OutOptions,
    changes: dict[str, Any],
    *,
    against: str = "",
    by_topic: str | None = None,
) -> None:
    """Run a suite and print its summary.

    ``changes`` are parameters of its scenarios that are not as they are. Every policy is compared with ``against``,
    which runs too, as does the task's reference. ``by_topic`` is printed topic by topic.
    """
    from bufgym import policies
    from bufgym.benchmark import report
    from bufgym.benchmark.rows import write_rows
    from bufgym.benchmark.sweep import Sweep, run_sweep
    from bufgym.benchmark.tasks import TASKS
    from bufgym.scenario import suites

    suite, file, page = suites.get(options.suite or ""), out.file(), out.page()
    task = TASKS[suite.kind]
    named, sources = loaded(who.policies)
    specs = named or task.default_policies(suite.name)
    if against:
        rival = one_policy(against)
        sources = tuple(dict.fromkeys([*sources, *loaded([against])[1]]))
        against = policies.get(rival).name
        known = {policies.get(spec).name for spec in specs}
        specs = [*specs, *(name for name in dict.fromkeys((against, task.reference)) if name not in known)]
    by_name = topic_policy(by_topic, task, specs)
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
        "bufgym bench",
        suite=suite.name,
        split=None if options.split == "test" else options.split,
        policies=tuple(who.policies or ()) or None,
        capacity=who.capacity,
        seeds=who.seeds,
        against=against or None,
        by_topic=by_topic,
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
        if page is not None:
            print(f"\nwrote {report.write(folder, page)}")
    if file is not None:
        print(f"\n{len(rows)} rows in {write_rows(rows, file, task.layout)}")
    elif out.out is not None:
        print(f"\n{len(rows)} rows in {folder}; bufgym report {folder} makes a page of them")
    if by_name is not None:
        print_topics(rows, by_name)


def topic_policy(by_topic: str | None, task: Task, specs: Sequence[str]) -> str | None:
    """The policy of ``--by-topic``; an error if it does not run, or not on several topics."""
    from bufgym import policies

    if by_topic is None:
        return None
    if task.kind != "topics":
        raise BufgymError("--by-topic needs several topics")
    name = policies.get(by_topic).name
    if name not in {policies.get(spec).name for spec in (*specs, task.baseline)}:
        raise BufgymError(f"--by-topic {by_topic}: not among the policies that run")
    return name


def print_topics(rows: Sequence[Row], policy: str) -> None:
    from bufgym.benchmark.tasks import topics

    print(f"\n{policy}, topic by topic: means over episodes\n{topics.by_topic(rows, policy)}")
