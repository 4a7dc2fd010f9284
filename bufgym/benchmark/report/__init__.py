"""Report of a suite's run: one HTML page that needs no network, and tables for a terminal or a README.

It reads a folder of ``bufgym bench --suite``. It simulates nothing and takes all statistics from the task.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from bufgym import policies
from bufgym.benchmark.folder import SuiteRun, read
from bufgym.benchmark.report import page, tables
from bufgym.benchmark.rows import Row
from bufgym.benchmark.summary import Summary
from bufgym.benchmark.table import Unranked
from bufgym.benchmark.tasks import Task
from bufgym.policies import Policy
from bufgym.scenario import about
from bufgym.scenario.suites import Setting
from bufgym.utils import __version__
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import write_text


def write(folder: str | Path) -> Path:
    """Write the page of a run as ``report.html`` into its folder; return its path.

    Raises:
        BufgymError: for a folder without a run, a broken file in it, rows that can't be scored, or where matplotlib or
            Jinja is not installed.
    """
    run, summary = run_of(folder)
    return write_text(run.folder / "report.html", page.html(run, summary))


def page_of_rows(
    task: Task,
    rows: Sequence[Row],
    players: Sequence[Policy],
    unranked: Unranked,
    scenario: Any,
    heading: str,
    command: str,
) -> str:
    """The page of one scenario's rows, with an episode of the ``players``. Errors as for ``write``."""
    name = rows[0]["scenario"] or "this stream"
    rows = [{**row, "scenario": name} for row in rows]
    manifest = {"task": task.kind, "suite": name, "split": "", "about": heading, "episodes": ""}
    manifest |= {"bufgym": __version__, "made": "", "unranked": unranked, "changes": {}}
    manifest |= {"scenarios": {name: {"about": about(scenario), "value": scenario.value.name}}}
    example = task.example(players, rows, lambda row: Setting(scenario, about(scenario)))
    return page_of_run(SuiteRun(Path(), manifest, rows, Path("rows"), example), command)


def page_of_run(run: SuiteRun, command: str) -> str:
    """The page of a run that is at hand, made again by ``command``. Errors as for ``write``."""
    return page.html(*_summed(replace(run, manifest={**run.manifest, "command": command}), None))


def markdown(folder: str | Path, against: str | None = None) -> str:
    """The command, the ranking and the tables of every cell as Markdown, for a README. Errors as for ``write``.

    ``against`` is the policy that every other is compared with, by default ``best_rule``; empty for none.
    """
    return tables.markdown(*run_of(folder, against))


def best_rule(summary: Summary) -> str:
    """The first ranked policy that was not learned; empty if all were."""
    for standing in summary.overall:
        with suppress(BufgymError):  # a run's agent that is not registered
            if standing.ranked and not policies.get(standing.policy).weights:
                return "" if math.isnan(standing[summary.rank_by].value) else standing.policy
    return ""


def run_of(folder: str | Path, against: str | None = None) -> tuple[SuiteRun, Summary]:
    """Read a run and sum it up."""
    return _summed(read(Path(folder)), against)


def _summed(run: SuiteRun, against: str | None) -> tuple[SuiteRun, Summary]:
    """The run and its summary, scores in the order of the manifest's scenarios."""
    try:
        summary = run.task.summary(run.rows, run.manifest["unranked"], against or "")
        if against is None and (rule := best_rule(summary)):
            summary = run.task.summary(run.rows, run.manifest["unranked"], rule)
    except BufgymError as error:
        raise BufgymError(f"{run.rows_file}: {error}") from None
    if summary.scores is not None:
        place = {scenario: k for k, scenario in enumerate(run.manifest["scenarios"])}  # any others come last, by name
        cells = sorted(
            summary.scores.cells, key=lambda c: (place.get(c.scenario, len(place)), c.scenario, c.capacity, c.policy)
        )
        summary = replace(summary, scores=replace(summary.scores, cells=cells))
    return run, summary
