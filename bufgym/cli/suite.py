"""Parts shared by commands that run a suite: ``bufgym bench --suite``, ``bufgym topics`` and ``bufgym fleet``."""

from __future__ import annotations

import argparse
import shlex
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from bufgym.cli.options import (
    SOURCES,
    capacities,
    episodes,
    given,
    load_policies,
    loaded,
    policies_option,
    policy_file,
)
from bufgym.ground.errors import BufgymError, install

if TYPE_CHECKING:
    from bufgym.benchmark.rows import Row

SUITE_OPTIONS = ("split", "data", "jobs", "backend", "address")
"""Options that need a suite."""


def suite_options(parser: argparse.ArgumentParser, default: str = "") -> None:
    """Add the options that choose a suite and its machines."""
    option = parser.add_argument_group("a suite: frozen episodes, scored, with a report").add_argument
    which = f"which (default: {default})" if default else "which ('bufgym list suites')"
    option("--suite", metavar="NAME", help=f"{which}; --out DIR keeps it, a second call resumes it")
    option("--split", metavar="S", help="train, validation or test (default: test)")
    option("--data", metavar="DIR", help="folder of recordings, for suites over real links")
    option("--jobs", type=int, metavar="N", help="processes side by side (default: one a core)")
    option("--backend", metavar="B", help="loky (default), threading, sequential, ray or dask")
    option("--address", metavar="A", help="head of the Ray or Dask cluster (default: one on this machine)")


def who_options(parser: argparse.ArgumentParser, policies: str, capacity: str, seeds: str) -> None:
    """Add the options for policies, capacities and seeds; the arguments describe the defaults."""
    group = parser.add_argument_group("who runs")
    policies_option(group, policies, SOURCES)
    group.add_argument("--capacity", type=capacities, metavar="L,...", help=f"capacities L, messages ({capacity})")
    group.add_argument("--seeds", type=episodes, metavar="N", help=f"episodes on each trace ({seeds})")
    policy_file(group)


def out_options(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add the options for the output; return their group."""
    group = parser.add_argument_group("where results go")
    target = "write rows and what was run into this folder, or rows alone into this .csv or .parquet file"
    group.add_argument("--out", metavar="DIR", help=target)
    group.add_argument("--format", choices=("csv", "parquet"), help="format of the rows (default: parquet if it can)")
    return group


def target(options: argparse.Namespace) -> Path | None:
    """Find the file of ``--out``; None for a folder or nothing. Another kind of file is an error."""
    from bufgym.benchmark.rows import checked_target, has_pyarrow

    if options.format == "parquet" and options.out is not None and not has_pyarrow():
        raise BufgymError(f"--format parquet needs pyarrow: {install('bench')} (or --format csv)")
    if options.out is None or not Path(options.out).suffix[1:].isalpha() or Path(options.out).is_dir():
        return None
    file = checked_target(options.out)
    if not file.absolute().parent.is_dir():
        raise BufgymError(f"{options.out}: no folder to write this file to")
    return file


def run_suite(
    options: argparse.Namespace, command: str, changes: tuple[str, ...] = (), kind: str | None = None
) -> list[Row]:
    """Run the suite that the options name, print its summary and return its rows.

    Args:
        options: must have all options that the functions above add.
        command: subcommand of bufgym, such as "topics".
        changes: options that change parameters of the suite's scenarios.
        kind: kind of task; a suite of another kind is an error.
    """
    from bufgym.benchmark import report
    from bufgym.benchmark.rows import write_rows
    from bufgym.benchmark.sweep import Sweep, run_sweep
    from bufgym.benchmark.tasks import TASKS
    from bufgym.scenario import suites

    suite, file = suites.get(options.suite), target(options)
    if kind not in (None, suite.kind):
        raise BufgymError(f"suite {suite.name} is not one of {kind}: bufgym bench --suite {suite.name}")
    task = TASKS[suite.kind]
    specs, sources = loaded(options.policies)
    sweep = Sweep(
        suite.name,
        tuple(specs or task.default_policies(suite.name)),
        options.split or "test",
        tuple(options.capacity or ()),
        options.seeds,
        options.data,
        options.policy_file,
        sources,
        changes=given(options, changes),
    )
    options.resumes = options.out is not None and file is None
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "run" if options.out is None or file is not None else Path(options.out)
        rows = run_sweep(
            sweep,
            out,
            jobs=options.jobs,
            backend=options.backend or "loky",
            address=options.address,
            command=_command(options, command, changes),
            form=options.format,
            load=load_policies,
        )
        print(report.plain(out))
    if file is not None:
        print(f"\n{len(rows)} rows in {write_rows(rows, file, task.layout)}")
    elif options.out is not None:
        print(f"\n{len(rows)} rows in {out}; bufgym report {out} makes a page of them")
    return rows


def _command(options: argparse.Namespace, command: str, changes: tuple[str, ...]) -> str:
    """Write the command that repeats this run."""
    words = [f"bufgym {command} --suite", options.suite]
    names = ("split", "policies", "capacity", "seeds", *changes, "policy_file", "data", "out")
    for name, value in given(options, names).items():
        if (name, value) != ("split", "test"):
            text = ",".join(map(str, value)) if isinstance(value, list) else str(value)
            words.append(f"--{name.replace('_', '-')} {shlex.quote(text)}")
    return " ".join(words)
